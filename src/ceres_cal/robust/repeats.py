"""By how much targets lie off their drawings: what residuals repeat at the same features, and the sigma that it shows.

A board's corners and bows, a field's lines: a few numbers move each of them, the same in all views. With X their
columns and P what all other free numbers leave, the residuals say of them u = X^T P r. If they scatter by tau,

    Cov u = kappa V + tau^2 V V,    V = X^T P X,

with kappa for what goes together within a view (Cochran's Q of the views about their mean). Along the eigenvectors of V
that is independent, and the restricted likelihood of tau (Patterson and Thompson, Biometrika 58, 1971) weighs a grid
of sizes against none. P also takes out smooth displacements that stay in the image: what repeats there is the lens'.
Whether there is anything to look for is asked first of some views, by products of different views alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, median
from ceres_cal.base.words import two_digits
from ceres_cal.effects.columns import SparseColumns
from ceres_cal.effects.evidence import RandomEffects, agreement
from ceres_cal.effects.linearised import Linearised, Weights, equation_weights, make_linear_model
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.equations import Equations, equations_of, whole_structure
from ceres_cal.problem.parameters import Estimate, unit_px
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.structure import Kind, Structure, make_structure, numbers_by_kind
from ceres_cal.robust.robust import RobustSolution

_MOST_SCREENED, _MOST_SIGHTS = 12, 200  # of a camera: that are asked first, and that tell the sigma
# Standard deviations of products of different views from which on the likelihood is asked, which costs as much again.
_REPEATS = 2.0
# Degrees of freedom of the views about their mean below which they cannot be told from one another.
_FEWEST = 4
# Probability, before anything was seen, that a target is as drawn, and from which on what it is not is solved for.
_AS_DRAWN, _LIKELY = 0.5, 0.5
_SIZES = np.geomspace(1e-5, 3e-2, 30)  # sigmas that may be, of the target's size
_SWEEPS = 2  # over the kinds, each beside the others
_LEAST_PX = 1e-3  # noise that nothing is measured better than: of exact observations rounding repeats
_DETERMINED = 1e-6  # of the largest eigenvalue of V
_DEGREE, _POWERS = 3, (0.5, 1.5, 2.0, 2.5, 3.0, 4.0)  # of smooth displacements of the image; of r^2 along the radius


@dataclass(frozen=True)
class AsBuilt:
    """By how much the features of one kind lie off a target's drawing.

    Attributes:
        target, kind: "lines", "points" or "warp". sigma_m: the standard deviation that their offsets were solved for
            under. probability: that they are off at all. rms_m: of the offsets.
    """

    target: str
    kind: Kind
    sigma_m: float
    probability: float
    rms_m: float = 0.0

    @property
    def words(self) -> str:
        """What it says, without the target."""
        amount = f"{two_digits(1e3 * self.rms_m)} mm rms"
        return f"it is bowed by {amount}" if self.kind == "warp" else f"its {self.kind} lie {amount} aside"


def estimate_as_built(
    problem: Problem, observations: Observations, end: RobustSolution
) -> tuple[tuple[AsBuilt, ...], Structure]:
    """The kinds of features that are likely not where they are drawn, of targets without a stated tolerance; and the
    whole structure with their likeliest offsets, and those of stated tolerances as they are.

    Args:
        problem: of all the observations. end: of its rounds.
    """
    structure, tolerances = whole_structure(observations.targets), problem.options.tolerances
    dimensions = problem.options.dimensions
    stated = make_structure(observations.targets, tolerances, dimensions).carrying(end.solution.estimate.structure)
    as_stated = structure.carrying(stated)
    kinds = {of: n for of, n in numbers_by_kind(structure, observations.targets).items() if of[0] not in tolerances}
    if len(end.problem.sights) < 2 or not kinds:
        return (), as_stated
    sights = _some(end.problem.sights, _MOST_SCREENED)
    equations, weights = _equations(stated, observations, end, sights)
    residuals = weights.robust * weights.inverse_sigma * weights.used * equations.residual
    scores = _columns(structure, equations, weights).gathered(residuals, equations.sight, len(sights))
    # What one kind leaves hides another: a board bowed by 0.1 mm was seen only once its points had been moved.
    if not any(agreement(scores[:, numbers]) > _REPEATS for numbers in kinds.values()):
        return (), as_stated
    repeats = _StructureEvidence.of(structure, stated, observations, end)
    every = tuple(_likely(repeats, kinds, observations))
    numbers = [kinds[one.target, one.kind] for one in every]
    moved = np.concatenate([np.empty(0, dtype=np.int64), *numbers])
    sigmas = np.repeat([one.sigma_m for one in every], [len(own) for own in numbers])
    values = as_stated.values.copy()
    values[moved] = repeats.offsets(moved, sigmas)
    return every, structure.with_values(values)


def _some(sights: Sights, most: int) -> Sights:
    """All of the world, and of each camera's others at most so many, evenly."""
    chosen = [sights.numbers(placements=(None,))]
    for camera in sights.cameras:
        others = np.setdiff1d(sights.numbers(camera), chosen[0])
        chosen.append(others[:: max(1, -(-len(others) // most))])
    return sights.take(np.sort(np.concatenate(chosen)))


# ---- columns of the structure ---------------------------------------------------------------------------------------


def _equations(
    stated: Structure, observations: Observations, end: RobustSolution, sights: Sights
) -> tuple[Equations, Weights]:
    """Of some sights, with the residuals to the drawing, offsets that were found before taken off."""
    estimate = end.solution.estimate
    equations = equations_of(observations, sights, estimate, end.residuals)
    stated_alone = stated.carrying(estimate.structure)
    before = estimate.structure.offsets - estimate.structure.carrying(stated_alone).offsets
    solved = np.append(before, 0.0)[equations.slots(estimate.structure)]
    weights = _weights(observations, end, equations)
    return replace(equations, residual=equations.residual - np.sum(equations.built * solved, axis=1)), weights


def _columns(structure: Structure, equations: Equations, weights: Weights) -> SparseColumns:
    """Of the structure's numbers."""
    slots, scale = equations.slots(structure), weights.inverse_sigma * weights.used
    values = np.where(slots >= 0, equations.built * scale[:, None], 0.0)
    return SparseColumns(np.where(slots >= 0, slots, len(structure.names)), values, len(structure.names))


def _weights(observations: Observations, end: RobustSolution, equations: Equations) -> Weights:
    """How the equations counted at the end."""
    taking_part = end.inliers.points, end.inliers.curves
    return equation_weights(observations, end.problem.weighting, equations, end.residuals, taking_part)


# ---- what is said of them -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _StructureEvidence:
    """What the residuals say of the structure, everything else free at its best.

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
    def of(
        cls, structure: Structure, stated: Structure, observations: Observations, end: RobustSolution
    ) -> _StructureEvidence:
        """At the end of all rounds."""
        sights = _some(end.problem.sights, _MOST_SIGHTS)
        equations, weights = _equations(stated, observations, end, sights)
        columns, model = _columns(structure, equations, weights), _drawn(equations, weights, stated, end)
        information, score = columns.left_of(model)
        ridge = _DETERMINED * float(np.max(np.diagonal(information))) * np.eye(columns.size)
        inverse = np.linalg.inv(information + ridge)
        left = model.left_over - _placed(model, columns.at(inverse @ score))
        spare = model.spare - float(np.sum(inverse * information))
        least = spare * (_LEAST_PX * median(model.weight)) ** 2
        taken, alone = np.sum(columns.in_private(model) ** 2, axis=0), (equations.sight, len(sights))
        return cls(
            score,
            information,
            columns.gathered(left, *alone),
            columns.gathered(columns.values, *alone) - taken,
            max(float(left @ left), least),
            spare,
        )

    @property
    def noise(self) -> float:
        """Mean square of what is left."""
        return self.rest / self.spare

    def scatter_within(self, numbers: Indices) -> tuple[float, int]:
        """Cochran's Q of the sights about the best of all, for some numbers, over its degrees of freedom and the noise;
        and these.
        """
        scores, informations = self.scores[:, numbers], self.informations[:, numbers]
        there = informations > _DETERMINED * np.max(informations, initial=1e-300)
        squares = scores[there] ** 2 / informations[there]
        freedom = int(np.sum(np.maximum(np.count_nonzero(there, axis=0) - 1, 0)))
        return float(np.sum(squares)) / max(freedom, 1) / self.noise, freedom

    def beside(self, numbers: Indices, others: Indices, sigmas_m: Array) -> tuple[Array, Array]:
        """Score and information of some numbers, with others scattering by sigmas (K,)."""
        score, information = self.score[numbers], self.information[np.ix_(numbers, numbers)]
        if not len(others):
            return score, information
        root = sigmas_m / np.sqrt(self.noise)
        own = np.eye(len(others)) + root[:, None] * self.information[np.ix_(others, others)] * root
        across = root[:, None] * np.column_stack([self.information[np.ix_(others, numbers)], self.score[others]])
        taken = across[:, :-1].T @ np.linalg.solve(own, across)
        return score - taken[:, -1], information - taken[:, :-1]

    def offsets(self, numbers: Indices, sigmas_m: Array) -> Array:
        """(K,) m, the likeliest of some numbers that scatter by sigmas (K,)."""
        normal, score = self.information[np.ix_(numbers, numbers)] / self.noise, self.score[numbers] / self.noise
        return np.asarray(sigmas_m * RandomEffects.of(normal, score, 0.0).amounts(np.diag(sigmas_m))[0])


def _placed(model: Linearised, column: Array) -> Array:
    """(E,) what is left of a column, in standard deviations, once everything free followed it."""
    rest = model.beyond_private(column[:, None])[:, 0]
    return np.asarray(rest - model.shared @ (model.shared.T @ rest))


def _drawn(equations: Equations, weights: Weights, stated: Structure, end: RobustSolution) -> Linearised:
    """The linear model of the targets as drawn, smooth displacements of the image free besides."""
    estimate = replace(end.solution.estimate, structure=stated)
    problem = end.problem.of_sights(np.flatnonzero([key in equations.sights.keys for key in end.problem.sights.keys]))
    model = make_linear_model(problem, estimate, equations, weights)
    return model.with_columns(np.column_stack(list(_of_image(equations, estimate))))


def _of_image(equations: Equations, estimate: Estimate) -> Iterator[Array]:
    """(E, K) smooth displacements of each camera's image, of order one at its corners: polynomials, and powers of the
    radius.
    """
    owner = np.array([key.camera for key in equations.sights.keys])[equations.sight]
    for name in equations.sights.cameras:
        camera = estimate.cameras[name]
        place = (equations.pixel - camera.principal_point) / unit_px(camera)
        x, y = place.T
        smooth = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
        along = np.sum(place * equations.direction, axis=1)
        radial = [np.sum(place**2, axis=1) ** power * along for power in _POWERS]
        every = [*(equations.direction[:, axis] * one for one in smooth for axis in range(2)), *radial]
        yield np.column_stack(every) * (owner == name)[:, None]


# ---- the sigmas -----------------------------------------------------------------------------------------------------


def _likely(
    repeats: _StructureEvidence, kinds: Mapping[tuple[str, Kind], Indices], observations: Observations
) -> Iterator[AsBuilt]:
    """The kinds that more likely scatter than not, each beside those of the others that do."""
    likely: dict[tuple[str, Kind], AsBuilt] = {}
    for (target, kind), numbers in [*kinds.items()] * _SWEEPS if repeats.spare >= _FEWEST else ():
        likely.pop((target, kind), None)
        at = np.concatenate([np.empty(0, dtype=np.int64), *(kinds[of] for of in likely)])
        sigmas = np.concatenate([np.empty(0), *(np.full(len(kinds[of]), one.sigma_m) for of, one in likely.items())])
        within, freedom = repeats.scatter_within(numbers)
        sizes = _SIZES * float(np.max(np.ptp(observations.targets[target].box, axis=0)))
        sigma, probability = _estimated(repeats, *repeats.beside(numbers, at, sigmas), max(within, 1.0), sizes)
        if freedom >= _FEWEST and probability > _LIKELY:
            likely[target, kind] = AsBuilt(target, kind, sigma, probability)
    yield from likely.values()


def _estimated(
    repeats: _StructureEvidence, score: Array, information: Array, within: float, sizes: Array
) -> tuple[float, float]:
    """Root of the mean variance, where there is any, and the probability that there is.

    Few numbers leave their variance open: its mean then goes far beyond the likeliest, and what is solved for is held
    by little.
    """
    least = _DETERMINED * float(np.linalg.eigvalsh(information)[-1]) / within
    effects = RandomEffects.of(information / within, score / within, least, repeats.rest)
    effects = replace(effects, freedom=repeats.spare + len(effects.size))
    logs = effects.log_evidence(scatter=np.append(0.0, sizes) / np.sqrt(repeats.noise))[0]
    prior = np.append(_AS_DRAWN, np.full(len(sizes), (1.0 - _AS_DRAWN) / len(sizes)))
    weight = prior * np.exp(logs - logs.max())
    probability = 1.0 - weight[0] / weight.sum()
    return float(np.sqrt(weight[1:] @ sizes**2 / weight[1:].sum())), float(probability)
