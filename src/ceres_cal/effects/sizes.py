"""The sizes of effects whose amounts repeat from view to view: one after the other, each beside the others.

With X the columns of amounts that are the same in all views and P what all free numbers leave, the residuals say of
them u = X^T P r. If they scatter by tau,

    Cov u = kappa V + tau^2 V V,    V = X^T P X,

with kappa for what goes together within a view (Cochran's Q of the views about their mean). Along the eigenvectors of V
that is independent, and the restricted likelihood of tau (`effects.evidence`) weighs sizes against none.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ceres_cal.base.arrays import Array, Indices, median
from ceres_cal.effects.columns import SparseColumns
from ceres_cal.effects.evidence import RandomEffects, SizePrior
from ceres_cal.effects.linearised import Linearised

# Degrees of freedom of the views about their mean below which they cannot be told from one another.
_FEWEST = 4
LIKELY = 0.5
"""Probability from which on an effect is solved for: it is then the more likely explanation."""
_SWEEPS = 2  # over the effects, each beside the others
_LEAST_PX = 1e-3  # noise that nothing is measured better than: of exact observations rounding repeats
_DETERMINED = 1e-6  # of the largest eigenvalue of V
_Name = TypeVar("_Name", bound=Hashable)


@dataclass(frozen=True, eq=False)
class RepeatedAmounts:
    """What the residuals say of Q amounts that are the same in all views, everything else free at its best.

    Attributes:
        score: (Q,) u. information: (Q, Q) V. scores, informations: (S, Q) those of each sight by itself, the scores of
            what the best offsets leave.
        rest: squared residuals that the best offsets leave. spare: equations left over for these.
    """

    score: Array
    information: Array
    scores: Array
    informations: Array
    rest: float
    spare: float

    @classmethod
    def of(cls, model: Linearised, columns: SparseColumns) -> RepeatedAmounts:
        """By their columns over a model's equations."""
        sight, sights = model.equations.sight, len(model.equations.bounds) - 1
        information, score = columns.left_of(model)
        ridge = _DETERMINED * float(np.max(np.diagonal(information))) * np.eye(columns.size)
        inverse = np.linalg.inv(information + ridge)
        left = np.where(model.used, model.left_over - model.left_of_column(columns.at(inverse @ score)), 0.0)
        spare = model.spare - float(np.sum(inverse * information))
        least = spare * (_LEAST_PX * median(model.weight)) ** 2
        return cls(
            score,
            information,
            columns.gathered(left, sight, sights),
            columns.gathered(columns.values, sight, sights) - np.sum(columns.in_private(model) ** 2, axis=0),
            max(float(left @ left), least),
            spare,
        )

    @property
    def noise(self) -> float:
        """Mean square of what is left."""
        return self.rest / self.spare

    def _within(self, numbers: Indices) -> tuple[float, int]:
        """Cochran's Q of the sights about the best of all, for some numbers, over its degrees of freedom and the noise;
        and these.
        """
        scores, informations = self.scores[:, numbers], self.informations[:, numbers]
        there = informations > _DETERMINED * np.max(informations, initial=1e-300)
        squares = scores[there] ** 2 / informations[there]
        freedom = int(np.sum(np.maximum(np.count_nonzero(there, axis=0) - 1, 0)))
        return float(np.sum(squares)) / max(freedom, 1) / self.noise, freedom

    def _beside(self, numbers: Indices, others: Indices, sigmas_m: Array) -> tuple[Array, Array]:
        """Score and information of some numbers, with others scattering by sigmas (K,)."""
        score, information = self.score[numbers], self.information[np.ix_(numbers, numbers)]
        if not len(others):
            return score, information
        root = sigmas_m / np.sqrt(self.noise)
        own = np.eye(len(others)) + root[:, None] * self.information[np.ix_(others, others)] * root
        across = root[:, None] * np.column_stack([self.information[np.ix_(others, numbers)], self.score[others]])
        taken = across[:, :-1].T @ np.linalg.solve(own, across)
        return score - taken[:, -1], information - taken[:, :-1]

    def amounts(self, numbers: Indices, sigmas: Array) -> tuple[Array, Array]:
        """(K,) likeliest of some numbers that scatter by sigmas (K,), and their covariance (K, K)."""
        normal = self.information[np.ix_(numbers, numbers)] / self.noise
        inner = np.eye(len(numbers)) + sigmas[:, None] * normal * sigmas
        covariance = sigmas[:, None] * np.linalg.inv(inner) * sigmas
        return np.asarray(-covariance @ self.score[numbers] / self.noise), np.asarray(covariance)

    def size(self, numbers: Indices, others: Indices, sigmas: Array, prior: SizePrior) -> tuple[float, float]:
        """Sigma and probability of some numbers, with others scattering by sigmas (see `RandomEffects`)."""
        within, freedom = self._within(numbers)
        if freedom < _FEWEST:
            return 0.0, 0.0
        within = max(within, 1.0)
        score, information = self._beside(numbers, others, sigmas)
        least = _DETERMINED * float(np.linalg.eigvalsh(information)[-1]) / within
        effects = RandomEffects.of(information / within, score / within, least, self.rest)
        effects = replace(effects, freedom=self.spare + len(effects.size))
        sigma, probability = effects.scatter_under(prior.times(1.0 / np.sqrt(self.noise)))
        return float(sigma * np.sqrt(self.noise)), probability

    def sizes(
        self, numbers: Mapping[_Name, Indices], priors: Mapping[_Name, SizePrior]
    ) -> dict[_Name, tuple[float, float]]:
        """Sigma and probability of each effect by name, beside those of the others that are likely."""
        found: dict[_Name, tuple[float, float]] = {}
        for name, own in [*numbers.items()] * _SWEEPS if self.spare >= _FEWEST else ():
            others = [one for one, (_, probability) in found.items() if one != name and probability > LIKELY]
            at = np.concatenate([np.empty(0, dtype=np.int64), *(numbers[one] for one in others)])
            sigmas = np.concatenate([np.empty(0), *(np.full(len(numbers[one]), found[one][0]) for one in others)])
            found.pop(name, None)  # the last one looked at stands last
            found[name] = self.size(own, at, sigmas, priors[name])
        return found
