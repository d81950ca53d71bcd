"""The evidence of random effects: whether, and by how much, something is off.

Q numbers that the model holds at zero (offsets of lines, bows of a board, bumps of a lens) are columns X beside its
free numbers. With P what the free numbers leave of the equations, the residuals r say of them V = X^T P X and u = X^T
P r. If the numbers have the covariance C, in variances of the noise, the residuals have 1 + X C X^T, and the restricted
likelihood of C (Patterson and Thompson, Biometrika 58, 1971) is a function of V, u and r^T P r alone. C is

    C = tau^2 1 + R R^T,

a scatter tau that all numbers share, and roots R of what some of them have besides. In the directions in which V is
diagonal, w = S^-1/2 U^T u with V = U S U^T, the scatter costs nothing, and R is small. Noise that is not known is
integrated out. Hypotheses are weighed by this evidence (Kass and Raftery, JASA 90, 1995).

Where amounts repeat from view to view, as those of a target as built, what goes together within a view counts as noise:
u has the covariance kappa V + tau^2 V V with kappa by Cochran's Q of the views about their mean. Sizes of several such
effects are found one after the other, each beside the others (`RepeatedAmounts`).

Groups of equations (a line in one frame, say) may each lie aside by a few modes. Errors that go together along a line
offset it, too, so all groups scatter by tau along each mode; one that does not belong has an offset of much larger
variance besides. With tau, the size of the wrong offset and the noise integrated out nothing is a fault that the
scatter of the others explains (`Offsets`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, inverse_of, inverse_root_of, median, replace
from ceres_cal.effects.columns import SparseColumns
from ceres_cal.effects.linearised import Linearised


class SizePrior(Frozen, eq=True):
    """What is expected of an effect's size before anything was seen.

    Attributes:
        absent: probability that there is no such effect. sizes: standard deviations of its amounts that may be, each
            as likely.
    """

    absent: float
    sizes: tuple[float, ...]

    @property
    def scatter(self) -> Array:
        """(1 + N,) no size, and the sizes."""
        return np.append(0.0, self.sizes)

    @property
    def probabilities(self) -> Array:
        """(1 + N,) of these."""
        return self.over(len(self.sizes))

    def over(self, count: int) -> Array:
        """(1 + N,) probabilities of none, and of so many that are as likely as one another."""
        return np.append(self.absent, np.full(count, (1.0 - self.absent) / max(count, 1)))

    def times(self, unit: float) -> SizePrior:
        """In another unit: sizes are so many times as large."""
        return SizePrior(self.absent, tuple(unit * size for size in self.sizes))


_FAR = (10.0, 40.0, 160.0)  # standard deviations of an observation: all that is no scatter, a factor of four apart
FEATURE_ASIDE = SizePrior(0.95, (3.0, *_FAR))
"""Of a feature that does not belong, in standard deviations of an observation: lines are painted by hand.

Of a line 3 px aside the log odds are 10 to 20. At a probability of 0.1 two of 200 sound fields come into doubt; at 0.01
a quarter of the lines four standard deviations aside go unseen that need not.
"""
VIEW_ASIDE = SizePrior(0.99, _FAR)
"""Of a view or placement that does not belong, in the same unit: it is one from elsewhere, or its target is another."""
OFFSETS_SCATTER = SizePrior(0.5, tuple(np.geomspace(0.1, 60.0, 14).tolist()))
"""Of the offsets that features or views have all alike, in the same unit: that errors go together along them is as
likely as not.
"""
AS_BUILT = SizePrior(0.5, tuple(np.geomspace(1e-5, 3e-2, 30).tolist()))
"""Of how far a target's features lie off its drawing, in its size: that it is as drawn is as likely as not."""
HEIGHTS = SizePrior(0.8, AS_BUILT.sizes)
"""Of how high a board's points lie beside its bows. A few distant views say nothing of that, so even odds would be left
as they are, and taken for waves by two of twelve flat boards. Of eight public sets seven say it at a probability of 1.
"""
STRETCHED = SizePrior(0.8, tuple(np.geomspace(1e-5, 1e-2, 27).tolist()))
"""Of by how much a board is stretched along each of its sides: a printer's rollers and its paper do half a percent, and
a page that is fitted to another 2 %. Both sides alike is what no view shows, so what is open of that is as likely.
As rare as HEIGHTS: where all views show the board turned alike nothing is said of it, either.
"""
FLOOR_OFF = SizePrior(0.8, (0.0005,))
"""Of how much higher or lower a floor's edges are than its middle, and of how far a field's are out of square, over
half of its longer side: 2 mm of a field of 9 m. Four of five are flat and square.
"""
AS_STATED = SizePrior(0.0, (1.0,))
"""Of what is stated with the observations, in the standard deviation that is stated: it is there, and as large."""
SMOOTH_ERRORS = SizePrior(0.8, tuple(np.geomspace(0.01, 3.0, 14).tolist()))
"""Of what displaces a view smoothly, in px; as rare as errors that go together, see DEPENDENCE."""
READ_OUT = SizePrior(0.8, tuple(np.geomspace(0.01, 30.0, 18).tolist()))
"""Of how far a hand moves what is seen while rows are read out, in px: further than anything else displaces a view."""
LENS_LEAVES = SizePrior(0.8, tuple(np.geomspace(0.01, 1.0, 11).tolist()))
"""Of what displaces all views alike, in px at the corners: a lens that the data chose leaves no more."""
CENTRE_MOVES = SizePrior(0.9, tuple(np.geomspace(0.5, 60.0, 14).tolist()))
"""Of a principal point that moves from view to view, in px: of ten cameras one is stabilised."""
DEPENDENCE = SizePrior(0.8, ())
"""Of errors that go together within views, and of views that scatter more than their equations say: errors are
independent in four of five calibrations. The sizes are those of a grid, or of a factor.
"""


# Degrees of freedom of the views about their mean below which they cannot be told from one another.
_FEWEST = 4
LIKELY = 0.5
"""Probability from which on an effect is solved for: it is then the more likely explanation."""
LEAST_PX = 1e-3
"""Noise that nothing is measured better than: of exact observations rounding repeats, and is no offset."""
_DETERMINED = 1e-6  # of the largest eigenvalue of V
_Name = TypeVar("_Name", bound=Hashable)
Others = Sequence[tuple[Indices, float]]
"""Numbers of other effects, and the sigma of each."""
_NO_SCATTER, _AS_IS = np.zeros(1), np.ones(1)


class RandomEffects(Frozen):
    """What residuals say of Q numbers, in the R independent directions that they determine.

    Attributes:
        size: (R,) S of each direction. value: (R,) w. turn: (Q, R) U.
        rest: squared residuals that no amount of the numbers explains. freedom: equations left over for these and the
            numbers together; None where the noise is known to be one.
    """

    size: Array
    value: Array
    turn: Array
    rest: float = 0.0
    freedom: float | None = None

    @classmethod
    def of(
        cls,
        normal: Array,
        slope: Array,
        least: float,
        rest: float = 0.0,
        freedom: float | None = None,
        share: float = 0.0,
    ) -> RandomEffects:
        """From V (Q, Q) and u (Q,), without directions whose S is at most `least`, or that share of the largest."""
        size, turn = np.linalg.eigh(normal)
        kept = size > max(least, share * float(size[-1]))
        size, turn = size[kept], turn[:, kept]
        return cls(size, (turn.T @ slope) / np.sqrt(size), turn, rest, freedom)

    def modes(self, root: Array) -> Array:
        """(..., R, Z) what roots (..., Q, Z) do to w."""
        return np.asarray(np.sqrt(self.size)[:, None] * (self.turn.T @ root))

    def log_evidence(self, modes: Array | None = None, scatter: Array = _NO_SCATTER, sizes: Array = _AS_IS) -> Array:
        """(H, A, T) logarithm of the restricted likelihood, up to a constant.

        Args:
            modes: (H, R, Z) of the roots of each hypothesis (see `modes`); none for that of scatter alone.
            scatter: (T,) tau, in standard deviations of the noise. sizes: (A,) factors on the modes.
        """
        modes = np.zeros((1, len(self.size), 0)) if modes is None else modes
        precision, normal, slope = self._precisions(modes, scatter)
        weighted, aside = precision @ self.value**2, sizes[:, None, None]
        explained = np.broadcast_to(np.sum(self.value**2) - weighted, (len(modes), len(sizes), len(scatter)))
        logs = 0.5 * np.sum(np.log(precision), axis=1)
        if width := modes.shape[2]:
            # The last pivot of (1 + N, n; n^T, c) is c - n^T (1 + N)^-1 n, at least half of this c.
            whole = np.empty((*explained.shape, width + 1, width + 1))
            whole[..., :-1, :-1] = np.eye(width) + aside[..., None] ** 2 * normal[:, None]
            whole[..., :-1, -1] = whole[..., -1, :-1] = aside * slope[:, None]
            whole[..., -1, -1] = bound = 2.0 * weighted + np.finfo(float).tiny
            pivots = np.diagonal(np.linalg.cholesky(whole), axis1=-2, axis2=-1)
            explained = explained + bound - pivots[..., -1] ** 2
            logs = logs - np.sum(np.log(pivots[..., :-1]), axis=-1)
        if self.freedom is None:
            return np.asarray(logs + 0.5 * explained)
        left = self.rest + np.sum(self.value**2) - explained
        return np.asarray(logs - 0.5 * self.freedom * np.log(left / max(self.freedom, 1.0)))

    def scatter_under(self, prior: SizePrior) -> tuple[float, float]:
        """Root of the mean variance of the numbers, where they scatter at all, and the probability that they do.

        Few numbers leave their variance open: its mean then goes far beyond the likeliest, and what is solved for is
        held by little.
        """
        logs = self.log_evidence(scatter=prior.scatter)[0, 0]
        weight = prior.probabilities * np.exp(logs - logs.max())
        variances = prior.scatter[1:] ** 2
        return float(np.sqrt(weight[1:] @ variances / weight[1:].sum())), float(1.0 - weight[0] / weight.sum())

    def amounts(self, root: Array, scatter: float = 0.0) -> tuple[Array, Array]:
        """(Z,) likeliest amounts of a root (Q, Z), best linear unbiased predictions, and (Z,) standard deviations."""
        modes = self.modes(root)
        weighted = modes / (1.0 + scatter**2 * self.size)[:, None]
        covariance = np.linalg.inv(np.eye(root.shape[1]) + weighted.T @ modes)
        return -covariance @ (weighted.T @ self.value), np.sqrt(np.diagonal(covariance))

    def _precisions(self, modes: Array, scatter: Array) -> tuple[Array, Array, Array]:
        """(T, R) inverse variances of w by scatter; (H, T, Z, Z) and (H, T, Z) what they make of modes (H, R, Z)."""
        precision = 1.0 / (1.0 + np.multiply.outer(scatter**2, self.size))
        count, directions, width = modes.shape
        pairs = (modes[..., :, None] * modes[..., None, :]).reshape(count, directions, width * width)
        normal = (precision @ pairs).reshape(count, len(scatter), width, width)
        return precision, normal, precision @ (modes * self.value[:, None])


def logsum(logs: Array) -> Array:
    """(...) logarithm of the sum of hypotheses (..., N), whose prior probabilities are in their evidence."""
    most = np.max(logs, axis=-1, keepdims=True)
    return np.asarray((most + np.log(np.sum(np.exp(logs - most), axis=-1, keepdims=True)))[..., 0])


def agreement(scores: Array) -> float:
    """By how many standard deviations the scores (S, Q) of different groups agree, were they independent.

    The derivative of the evidence by a common variance at size zero, without what each group says by itself: products
    of different groups alone, over their standard deviation. A score test (Rao 1948); 0 of one group.
    """
    total, each = scores.sum(axis=0), scores * scores
    squares = each.sum(axis=0)
    variance = 2.0 * float(squares @ squares - np.einsum("sq,sq->", each, each))
    return float(total @ total - squares.sum()) / np.sqrt(variance) if variance > 0.0 else 0.0


def shifts_by(taken: Array, moment: Array) -> Array:
    """(R, K) shifts of the free numbers whose products with themselves add up to what amounts do to their covariance.

    Args:
        taken: (K, Q) how the free numbers move with each amount. moment: (Q, Q) mean square of the amounts.
    """
    values, vectors = np.linalg.eigh(moment)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.linalg.qr((taken @ half).T, mode="r"))


# ---- amounts that repeat from view to view --------------------------------------------------------------------------


class RepeatedAmounts(Frozen):
    """What the residuals say of Q amounts that are the same in all views, everything else free at its best.

    Attributes:
        score: (Q,) u. information: (Q, Q) V. scores, informations: (S, Q) those of each sight by itself, or of each
            strand where there are few sights: the scores of what the best offsets leave.
        rest: squared residuals that the best offsets leave. spare: equations left over for these.
        in_shared: (P, Q) what the shared directions take of them.
    """

    score: Array
    information: Array
    scores: Array
    informations: Array
    rest: float
    spare: float
    in_shared: Array

    @classmethod
    def of(cls, model: Linearised, columns: SparseColumns, part: Indices | None = None) -> RepeatedAmounts:
        """By their columns over a model's equations.

        Args:
            part: (E,) whose errors go together; else the sights.
        """
        part = model.equations.sight if part is None else part
        parts = int(part.max()) + 1
        information, score, in_shared = columns.left_of(model)
        rounding = 1e-12  # of what they are before anything is taken: where all of it is, that is left
        ridge = _DETERMINED * float(np.max(np.diagonal(information), initial=0.0)) + rounding * float(
            np.sum(columns.values**2)
        )
        root = inverse_root_of(information + ridge * np.eye(columns.size))
        best = columns.at(root.T @ (root @ score))
        left = np.where(model.used, model.left_over - model.left_of_column(best), 0.0)
        spare = model.spare - columns.size + ridge * float(np.sum(root**2))
        least = spare * (LEAST_PX * median(model.weight)) ** 2
        return cls(
            score,
            information,
            columns.gathered(left, part, parts),
            columns.gathered(columns.values, part, parts) - np.sum(columns.in_private(model, part) ** 2, axis=0),
            max(float(left @ left), least),
            spare,
            in_shared,
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

    def _beside(self, numbers: Indices, others: Others) -> tuple[Array, Array]:
        """Score and information of some numbers, with others scattering by their sigmas."""
        score, information = self.score[numbers], self.information[np.ix_(numbers, numbers)]
        if not len(others):
            return score, information
        at = np.concatenate([own for own, _ in others])
        root = np.concatenate([np.full(len(own), sigma) for own, sigma in others]) / np.sqrt(self.noise)
        own = np.eye(len(at)) + root[:, None] * self.information[np.ix_(at, at)] * root
        across = root[:, None] * np.column_stack([self.information[np.ix_(at, numbers)], self.score[at]])
        taken = across[:, :-1].T @ np.linalg.solve(own, across)
        return score - taken[:, -1], information - taken[:, :-1]

    def amounts(self, numbers: Indices, sigmas: Array) -> tuple[Array, Array]:
        """(K,) likeliest of some numbers that scatter by sigmas (K,), and their covariance (K, K)."""
        normal = self.information[np.ix_(numbers, numbers)] / self.noise
        inner = np.eye(len(numbers)) + sigmas[:, None] * normal * sigmas
        covariance = sigmas[:, None] * inverse_of(inner) * sigmas
        return np.asarray(-covariance @ self.score[numbers] / self.noise), np.asarray(covariance)

    def scatter(
        self, numbers: Indices, others: Others, prior: SizePrior, tells: float, within: float = 1.0
    ) -> tuple[float, float]:
        """Sigma and probability of some numbers, with others scattering by their sigmas (see `RandomEffects`).

        Args:
            tells: share of the largest, of directions that tell a size. within: factor on the variance of the scores.
        """
        score, information = self._beside(numbers, others)
        effects = RandomEffects.of(information / within, score / within, 0.0, self.rest, share=tells)
        effects = replace(effects, freedom=self.spare + len(effects.size))
        sigma, probability = effects.scatter_under(prior.times(1.0 / np.sqrt(self.noise)))
        return float(sigma * np.sqrt(self.noise)), probability

    def scatters(
        self, numbers: Mapping[_Name, Indices], priors: Mapping[_Name, SizePrior], tells: float
    ) -> dict[_Name, tuple[float, float]]:
        """Sigma and probability of amounts that each view has by itself, by name, beside those of the others that are
        likely.
        """
        return _beside_each_other(
            numbers, [*numbers], lambda name, others: self.scatter(numbers[name], others, priors[name], tells)
        )

    def _size(self, numbers: Indices, others: Others, prior: SizePrior) -> tuple[float, float]:
        """The same where what goes together within a sight counts as noise; as it was beforehand where too few sights
        tell that.
        """
        # The same of directions that tell a size. What is free besides takes up nearly all of those that are less
        # determined, and what it does not follow counts there a thousandfold: a board's shear of 3 % explained what a
        # lens had left over.
        tells = 1e-3
        within, freedom = self._within(numbers)
        if freedom < _FEWEST:
            return float(np.sqrt(np.mean(np.square(prior.sizes)))), 1.0 - prior.absent
        return self.scatter(numbers, others, prior, tells, max(within, 1.0))

    def sizes(
        self, numbers: Mapping[_Name, Indices], priors: Mapping[_Name, SizePrior], stated: Others = ()
    ) -> dict[_Name, tuple[float, float]]:
        """Sigma and probability of each effect by name, beside those of the others that are likely.

        Args:
            stated: others, beside which all of them are; their numbers come last.
        """
        own_last = min((of_other[0] for of_other, _ in stated), default=len(self.score))
        score, information = self._beside(np.arange(own_last), stated)
        where = replace(self, score=score, information=information)
        # what takes longest is asked when others are known
        each = sorted(numbers, key=lambda name: len(numbers[name])) if self.spare >= _FEWEST else []
        return _beside_each_other(numbers, each, lambda name, others: where._size(numbers[name], others, priors[name]))


def _beside_each_other(
    numbers: Mapping[_Name, Indices], each: Sequence[_Name], size_of: Callable[[_Name, Others], tuple[float, float]]
) -> dict[_Name, tuple[float, float]]:
    """Sigma and probability of effects, one after the other and then again, each beside those of the others that are
    likely; not again where these are as they were.

    Args:
        size_of: both of an effect, beside others.
    """
    sweeps, no_change = 2, 0.1  # of the logarithm of one of the others' sigmas
    found: dict[_Name, tuple[float, float]] = {}
    asked: dict[_Name, dict[_Name, float]] = {}
    for name in [*each] * sweeps:
        before = found.pop(name, None)  # the last one looked at stands last
        beside = {one: sigma for one, (sigma, probability) in found.items() if probability > LIKELY}
        known = asked.get(name, {})
        same = known.keys() == beside.keys() and all(
            abs(np.log(known[one] / beside[one])) < no_change for one in beside
        )
        if before and same:
            found[name] = before
            continue
        found[name], asked[name] = size_of(name, [(numbers[one], sigma) for one, sigma in beside.items()]), beside
    return found
