"""The evidence of random effects: whether something is off, and by how much.

Q numbers that the model holds at zero (offsets of lines, bows of a board, bumps of a lens) are columns X beside its
free numbers. With P the projection that removes what the free numbers absorb, the residuals r say of them V = X^T P X
and u = X^T P r. If the numbers have the covariance C, in variances of the noise, the residuals have 1 + X C X^T, and
the restricted likelihood of C (Patterson and Thompson, Biometrika 58, 1971) is a function of V, u and r^T P r alone. C
is

    C = tau^2 1 + R R^T,

with a scatter tau that all numbers share, and roots R of what some of them have besides. In the directions in which V
is diagonal, w = S^-1/2 U^T u with V = U S U^T, the scatter costs no time, and R is small. Noise that is not known is
integrated out. Hypotheses are weighted by this evidence (Kass and Raftery, JASA 90, 1995).

Where amounts repeat from view to view, as those of a target as built, errors that are correlated within a view count as
noise: u has the covariance kappa V + tau^2 V V, with kappa by Cochran's Q of the views about their mean. Sizes of
several such effects are estimated one after the other, each beside the others (`RepeatedAmounts`).

Each group of equations (a line in one frame, for example) may be misplaced in a few modes. Correlated errors along a
line displace it, too, so all groups scatter by tau along each mode; a wrong group also has an offset of much larger
variance. Tau, the size of the wrong offset and the noise are integrated out, so that nothing is reported as a fault
that the scatter of the others explains (`Offsets`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, eigh, inverse_of, median, replace, ridged_root_of
from ceres_cal.effects.columns import SparseColumns
from ceres_cal.effects.linearised import Linearised


class SizePrior(Frozen, eq=True):
    """Prior knowledge of the size of an effect.

    Attributes:
        absent: probability that there is no such effect. sizes: possible standard deviations of its amounts, equally
            likely.
    """

    absent: float
    sizes: tuple[float, ...]

    @property
    def scatter(self) -> Array:
        """(1 + N,) 0 for no effect, and the sizes."""
        return np.append(0.0, self.sizes)

    @property
    def probabilities(self) -> Array:
        """(1 + N,) the probability of no effect, and of each size."""
        return self.over(len(self.sizes))

    def over(self, count: int) -> Array:
        """(1 + count,) the probability of no effect, and of each of `count` equally likely sizes."""
        return np.append(self.absent, np.full(count, (1.0 - self.absent) / max(count, 1)))

    def times(self, unit: float) -> SizePrior:
        """The prior in another unit: its sizes are `unit` times as large."""
        return SizePrior(self.absent, tuple(unit * size for size in self.sizes))


_FAR = (10.0, 40.0, 160.0)  # standard deviations of an observation, in steps of four: larger than any scatter
FEATURE_ASIDE = SizePrior(0.95, (3.0, *_FAR))
"""The offset of a misplaced feature, in standard deviations of an observation: lines are painted by hand.

For a line 3 px off its nominal position the log odds are 10 to 20. If a feature were wrong with probability 0.1, two of
200 sound fields would become doubtful; with 0.01, a quarter of the lines four standard deviations off would be missed
needlessly.
"""
VIEW_ASIDE = SizePrior(0.99, _FAR)
"""The offset of a wrong view or placement, in the same unit: it is from elsewhere, or shows another target."""
OFFSETS_SCATTER = SizePrior(0.5, tuple(np.geomspace(0.1, 60.0, 14).tolist()))
"""The scatter of offsets that all features or views have, in the same unit: it is as likely as not that their errors
are correlated.
"""
AS_BUILT = SizePrior(0.5, tuple(np.geomspace(1e-5, 3e-2, 30).tolist()))
"""Offsets of a target's features from its drawing, as a share of its size: that it is as drawn is as likely as not."""
HEIGHTS = SizePrior(0.8, AS_BUILT.sizes)
"""Heights of a board's points beside its bows. A few distant views say nothing of them, so even odds would stay even;
two of twelve flat boards were then taken for wavy ones. Of eight public sets, seven show heights with a probability of
1.
"""
STRETCHED = SizePrior(0.8, tuple(np.geomspace(1e-5, 1e-2, 27).tolist()))
"""The stretch of a board along each of its sides: a printer's rollers and its paper cause half a percent, a page that
is scaled to another paper size 2 %. No view determines the part common to both sides, so that part keeps this prior. As
rare as HEIGHTS: where all views show the board turned alike, nothing determines the stretch, either.
"""
FLOOR_OFF = SizePrior(0.8, (0.0005,))
"""The height of a floor's edges over its middle, and the error of a field's right angles, as a share of half of its
longer side: 2 mm for a field of 9 m. Four of five are flat and square.
"""
AS_STATED = SizePrior(0.0, (1.0,))
"""An error that is stated with the observations, in units of its stated standard deviation: it is certainly there."""
SMOOTH_ERRORS = SizePrior(0.8, tuple(np.geomspace(0.01, 3.0, 14).tolist()))
"""Smooth displacements of a view, in px; as rare as correlated errors, see DEPENDENCE."""
READ_OUT = SizePrior(0.8, tuple(np.geomspace(0.01, 30.0, 18).tolist()))
"""Displacement by a hand's motion while rows are read out, in px: larger than any other displacement of a view."""
LENS_LEAVES = SizePrior(0.8, tuple(np.geomspace(0.01, 1.0, 11).tolist()))
"""Displacements that all views have alike, in px at the corners: a lens that the data chose leaves no more."""
CENTRE_MOVES = SizePrior(0.9, tuple(np.geomspace(0.5, 60.0, 14).tolist()))
"""The motion of the principal point from view to view, in px: one of ten cameras is stabilised."""
DEPENDENCE = SizePrior(0.8, ())
"""Errors that are correlated within views, and views that scatter more than their equations say: errors are independent
in four of five calibrations. The sizes are those of a grid, or of a factor.
"""


# Degrees of freedom of the views about their mean below which their scatter cannot be estimated.
_FEWEST = 4
LIKELY = 0.5
"""Probability above which an effect is solved for: it is then the more likely explanation."""
LEAST_PX = 1e-3
"""Least noise, px: with exact observations rounding errors repeat, and would otherwise be found as offsets."""
_DETERMINED = 1e-6  # share of the largest eigenvalue of V above which a direction is determined
_Name = TypeVar("_Name", bound=Hashable)
Others = Sequence[tuple[Indices, float]]
"""The numbers of other effects, and the sigma of each effect."""
_NO_SCATTER, _AS_IS = np.zeros(1), np.ones(1)


class RandomEffects(Frozen):
    """The information of residuals on Q numbers, in the R independent directions that they determine.

    Attributes:
        size: (R,) S of each direction. value: (R,) w. turn: (Q, R) U.
        rest: squared residuals that no amounts of the numbers explain. freedom: degrees of freedom of these and the
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
        """Make it from V (Q, Q) and u (Q,), without directions with S up to `least`, or up to `share` of the
        largest.
        """
        size, turn = eigh(normal)
        kept = size > max(least, share * float(size[-1]))
        size, turn = size[kept], turn[:, kept]
        return cls(size, (turn.T @ slope) / np.sqrt(size), turn, rest, freedom)

    def modes(self, root: Array) -> Array:
        """(..., R, Z) the effect of roots (..., Q, Z) on w."""
        return np.asarray(np.sqrt(self.size)[:, None] * (self.turn.T @ root))

    def log_evidence(self, modes: Array | None = None, scatter: Array = _NO_SCATTER, sizes: Array = _AS_IS) -> Array:
        """(H, A, T) logarithm of the restricted likelihood, up to a constant.

        Args:
            modes: (H, R, Z) those of the roots of each hypothesis (see `modes`); None for scatter alone.
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
        """Root mean variance of the numbers if they scatter at all, and the probability that they do.

        Few numbers hardly determine their variance. Its mean is then far above the likeliest value, and little holds
        what is solved for.
        """
        logs = self.log_evidence(scatter=prior.scatter)[0, 0]
        weight = prior.probabilities * np.exp(logs - logs.max())
        variances = prior.scatter[1:] ** 2
        return float(np.sqrt(weight[1:] @ variances / weight[1:].sum())), float(1.0 - weight[0] / weight.sum())

    def amounts(self, root: Array, scatter: float = 0.0) -> tuple[Array, Array]:
        """(Z,) likeliest amounts of a root (Q, Z), best linear unbiased predictions, and their (Z,) standard
        deviations.
        """
        modes = self.modes(root)
        weighted = modes / (1.0 + scatter**2 * self.size)[:, None]
        covariance = np.linalg.inv(np.eye(root.shape[1]) + weighted.T @ modes)
        return -covariance @ (weighted.T @ self.value), np.sqrt(np.diagonal(covariance))

    def _precisions(self, modes: Array, scatter: Array) -> tuple[Array, Array, Array]:
        """(T, R) inverse variances of w by scatter; (H, T, Z, Z) and (H, T, Z), the normal equations of modes (H, R,
        Z).
        """
        precision = 1.0 / (1.0 + np.multiply.outer(scatter**2, self.size))
        count, directions, width = modes.shape
        pairs = (modes[..., :, None] * modes[..., None, :]).reshape(count, directions, width * width)
        normal = (precision @ pairs).reshape(count, len(scatter), width, width)
        return precision, normal, precision @ (modes * self.value[:, None])


def logsum(logs: Array) -> Array:
    """(...) logarithm of the summed evidence of hypotheses (..., N), which includes their prior probabilities."""
    most = np.max(logs, axis=-1, keepdims=True)
    return np.asarray((most + np.log(np.sum(np.exp(logs - most), axis=-1, keepdims=True)))[..., 0])


def agreement(scores: Array) -> float:
    """The agreement of the scores (S, Q) of different groups, in standard deviations of independent scores.

    It is the derivative of the evidence by a common variance, at size zero, without the squares of single groups: the
    products of different groups over their standard deviation. A score test (Rao 1948); 0 for one group.
    """
    total, each = scores.sum(axis=0), scores * scores
    squares = each.sum(axis=0)
    variance = 2.0 * float(squares @ squares - np.einsum("sq,sq->", each, each))
    return float(total @ total - squares.sum()) / np.sqrt(variance) if variance > 0.0 else 0.0


def shifts_by(taken: Array, moment: Array) -> Array:
    """(R, K) shifts of the free numbers whose outer products sum to what amounts add to their covariance.

    Args:
        taken: (K, Q) by how much the free numbers move with each amount. moment: (Q, Q) mean square of the amounts.
    """
    values, vectors = eigh(moment)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.linalg.qr((taken @ half).T, mode="r"))


# ---- amounts that repeat from view to view --------------------------------------------------------------------------


class RepeatedAmounts(Frozen):
    """The information of the residuals on Q amounts that are the same in all views, with everything else free.

    Attributes:
        score: (Q,) u. information: (Q, Q) V. scores, informations: (S, Q) those of each sight by itself, or of each
            strand if there are few sights; the scores are of what the best amounts leave.
        rest: squared residuals that the best amounts leave. spare: their degrees of freedom.
        in_shared: (P, Q) the parts of the amounts' columns along the shared directions.
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
        """Make it from the columns of the amounts over a model's equations.

        Args:
            part: (E,) numbers of the parts within which errors may be correlated; by default the sights.
        """
        part = model.equations.sight if part is None else part
        parts = int(part.max()) + 1
        information, score, in_shared = columns.left_of(model)
        rounding = 1e-12  # share of the columns' squares that is left by rounding where everything is projected out
        ridge = _DETERMINED * float(np.max(np.diagonal(information), initial=0.0))
        ridge += rounding * max(float(np.sum(columns.values**2)), 1.0)  # 1 where no observation that counts shows any
        root = ridged_root_of(information, ridge)
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
        """Mean square of what is left, per degree of freedom."""
        return self.rest / self.spare

    def _within(self, numbers: Indices) -> tuple[float, int]:
        """Cochran's Q of the sights about the best of all, for some numbers, over its degrees of freedom and the noise;
        and these degrees of freedom.
        """
        scores, informations = self.scores[:, numbers], self.informations[:, numbers]
        there = informations > _DETERMINED * np.max(informations, initial=1e-300)
        squares = scores[there] ** 2 / informations[there]
        freedom = int(np.sum(np.maximum(np.count_nonzero(there, axis=0) - 1, 0)))
        return float(np.sum(squares)) / max(freedom, 1) / self.noise, freedom

    def _beside(self, numbers: Indices, others: Others) -> tuple[Array, Array]:
        """Score and information of some numbers beside others, which are normal with their sigmas."""
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
        """(K,) likeliest values of some numbers under sigmas (K,), and their covariance (K, K)."""
        normal = self.information[np.ix_(numbers, numbers)] / self.noise
        inner = np.eye(len(numbers)) + sigmas[:, None] * normal * sigmas
        covariance = sigmas[:, None] * inverse_of(inner) * sigmas
        return np.asarray(-covariance @ self.score[numbers] / self.noise), np.asarray(covariance)

    def scatter(
        self, numbers: Indices, others: Others, prior: SizePrior, tells: float, within: float = 1.0
    ) -> tuple[float, float]:
        """Sigma and probability of some numbers, beside others with their sigmas (see `RandomEffects`).

        Args:
            tells: share of the largest eigenvalue above which a direction counts. within: factor on the variance of the
                scores.
        """
        score, information = self._beside(numbers, others)
        effects = RandomEffects.of(information / within, score / within, 0.0, self.rest, share=tells)
        effects = replace(effects, freedom=self.spare + len(effects.size))
        sigma, probability = effects.scatter_under(prior.times(1.0 / np.sqrt(self.noise)))
        return float(sigma * np.sqrt(self.noise)), probability

    def scatters(
        self, numbers: Mapping[_Name, Indices], priors: Mapping[_Name, SizePrior], tells: float
    ) -> dict[_Name, tuple[float, float]]:
        """Sigma and probability, by name, of amounts that each view has by itself, each beside the likely ones of the
        others.
        """
        return _beside_each_other(
            numbers, [*numbers], lambda name, others: self.scatter(numbers[name], others, priors[name], tells)
        )

    def _size(self, numbers: Indices, others: Others, prior: SizePrior) -> tuple[float, float]:
        """Sigma and probability, where errors correlated within a sight count as noise; those of the prior, if there
        are too few sights to determine that noise.
        """
        # Share of the largest eigenvalue above which a direction counts. The free numbers absorb nearly all of less
        # determined directions, and what they do not follow counts there a thousandfold: a board's shear of 3 %
        # explained what a lens had left over.
        tells = 1e-3
        within, freedom = self._within(numbers)
        if freedom < _FEWEST:
            return float(np.sqrt(np.mean(np.square(prior.sizes)))), 1.0 - prior.absent
        return self.scatter(numbers, others, prior, tells, max(within, 1.0))

    def sizes(
        self, numbers: Mapping[_Name, Indices], priors: Mapping[_Name, SizePrior], stated: Others = ()
    ) -> dict[_Name, tuple[float, float]]:
        """Sigma and probability of each effect by name, each beside the likely ones of the others.

        Args:
            stated: further effects, beside which all of them are estimated; their numbers come last.
        """
        own_last = min((of_other[0] for of_other, _ in stated), default=len(self.score))
        score, information = self._beside(np.arange(own_last), stated)
        where = replace(self, score=score, information=information)
        # Effects with most numbers take longest, so they are estimated when the others are known.
        each = sorted(numbers, key=lambda name: len(numbers[name])) if self.spare >= _FEWEST else []
        return _beside_each_other(numbers, each, lambda name, others: where._size(numbers[name], others, priors[name]))


def _beside_each_other(
    numbers: Mapping[_Name, Indices], each: Sequence[_Name], size_of: Callable[[_Name, Others], tuple[float, float]]
) -> dict[_Name, tuple[float, float]]:
    """Sigma and probability of effects, estimated one after the other, twice, each beside the likely ones of the
    others; the second time only where these have changed.

    Args:
        size_of: sigma and probability of one effect beside others.
    """
    sweeps, no_change = 2, 0.1  # change of the logarithm of another's sigma that counts as none
    found: dict[_Name, tuple[float, float]] = {}
    asked: dict[_Name, dict[_Name, float]] = {}
    for name in [*each] * sweeps:
        before = found.pop(name, None)  # so that the effect estimated last comes last
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
