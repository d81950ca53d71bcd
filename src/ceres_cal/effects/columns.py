"""Columns of an effect over the equations, and what the residuals say of its amounts after the free numbers followed.

An effect has groups (each line, each frame, everything after a frame), and each group has its own amounts. Sums for
each group by itself suffice for a score test (`EffectSums`); sums for all groups together give the evidence
(`SparseColumns`). Each amount moves few equations, so sums are taken by amount, and no array has the size equations
times amounts.

Score tests of many effects at once: let X be the columns of one group beyond the free numbers and r the residuals, both
in standard deviations. Then r'X (X'X)^-1 X'r over the mean square of what is left is Fisher's F if the noise is normal,
and -(X'X)^-1 X'r is the amount that would correct the fault. The strongest significant effect is chosen first, then the
strongest of what it leaves (forward selection).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, cached_property, field, log_f_tail, replace
from ceres_cal.effects.linearised import LEAST_LEFT, Linearised, inverse_roots
from ceres_cal.problem import Equations, Estimate, unit_px


class EffectColumns(Frozen):
    """Columns of an effect over the equations, by group: each group has its own amounts.

    Attributes:
        columns: (E, Q) px per unit of the Q amounts, for every equation.
        group: (E,) the group whose amounts move each equation, -1 for none.
        subjects: what each group is about. frames: the frame of each group; empty where all are about all frames.
        onwards: whether the amounts of group g move the groups after g instead of group g itself.
        kind: the kind of the effect.
    """

    columns: Array
    group: Indices
    subjects: tuple[str, ...]
    frames: tuple[str, ...] = ()
    onwards: bool = False
    kind: str = ""

    def of(self, number: int) -> Array:
        """(E, Q) columns of one group over all equations."""
        moved = self.group > number if self.onwards else self.group == number
        return np.asarray(self.columns * moved[:, None])


def grouped(values: Indices, rows: Mask) -> tuple[Indices, Indices]:
    """The distinct values in the chosen rows, and the number of the value of each row (N,), -1 for other rows."""
    numbers, inverse = np.unique(values[rows], return_inverse=True)
    group = np.full(len(values), -1)
    group[rows] = inverse
    return numbers, group


def least_absolute(columns: Array, residual: Array) -> Array:
    """(Q,) amounts for which columns (N, Q) leave the least absolute deviations of residuals (N,), all in standard
    deviations, by iteratively reweighted least squares.
    """
    amount = np.zeros(columns.shape[1])
    for _ in range(30):
        sizes = 1.0 / np.sqrt(np.maximum(np.abs(residual + columns @ amount), 1.0))
        amount = -np.asarray(np.linalg.lstsq(columns * sizes[:, None], residual * sizes, rcond=1e-9)[0])
    return amount


class EffectSums(Frozen):
    """Sums over the equations of each of an effect's G groups, with X its columns beyond the free numbers of a model
    and r the residuals, both in standard deviations.

    Attributes:
        rows: (N,) the used equations that it moves, by group. columns: (N, Q) of the effect in these rows.
        sizes: (G, Q) squared lengths of the original columns. normals: (G, Q, Q) X'X. scores: (G, Q) X'r.
        directions: number of shared directions of the model that are projected out of X.
    """

    effect: EffectColumns
    rows: Indices
    columns: Array
    sizes: Array = field(default_factory=lambda: np.empty(0))
    normals: Array = field(default_factory=lambda: np.empty(0))
    scores: Array = field(default_factory=lambda: np.empty(0))
    directions: int = 0

    @classmethod
    def of(cls, model: Linearised, effect: EffectColumns) -> EffectSums:
        """The sums of an effect beyond the free numbers of a model."""
        inside = np.flatnonzero((effect.group >= 0) & model.used)
        rows = inside[np.argsort(effect.group[inside], kind="stable")]
        blank = cls(effect, rows, effect.columns[rows] * model.weight[rows, None])
        sums = blank._products(np.column_stack([blank.columns, model.placed_score[rows]]))
        normals, scores = sums[:, :, :-1], sums[:, :, -1]
        sizes = np.diagonal(normals, axis1=1, axis2=2)
        whole = replace(blank, sizes=sizes, normals=normals - blank._private_squares(model), scores=scores)
        return whole.beside(model)

    def beside(self, model: Linearised) -> EffectSums:
        """The sums beyond everything that is free in a model with more shared directions."""
        new = slice(self.directions, None)
        taken = self._products(model.shared[:, new].take(self.rows, axis=0))
        normals, scores = taken @ taken.transpose(0, 2, 1), taken @ model.step[new]
        return replace(self, normals=self.normals - normals, scores=self.scores - scores, directions=len(model.step))

    def _products(self, values: Array) -> Array:
        """(G, Q, K) products of each group's columns with values (N, K) of the rows."""
        products = np.zeros((len(self.effect.subjects), self.columns.shape[1], values.shape[1]))
        for number, first, last in self._runs:
            np.matmul(self.columns[first:last].T, values[first:last], out=products[number])
        if self.effect.onwards:  # group g moves all groups after it
            products[:-1] = np.cumsum(products[:0:-1], axis=0)[::-1]
            products[-1] = 0.0
        return products

    @cached_property
    def _runs(self) -> list[tuple[int, int, int]]:
        """Number, first row and end of each group that has rows."""
        group = self.effect.group[self.rows]
        starts = np.flatnonzero(np.diff(group, prepend=-1))
        ends = np.append(starts, len(group))[1:]
        return list(zip(group[starts].tolist(), starts.tolist(), ends.tolist(), strict=True))

    def _private_squares(self, model: Linearised) -> Array:
        """(G, Q, Q) squares of the parts of each group's columns along the private bases."""
        size, count = self.columns.shape[1], len(self.effect.subjects)
        squares, held = np.zeros((count + 1, size, size)), np.flatnonzero(model.of_private[self.rows])
        if not len(held):
            return squares[:-1]
        key = model.equations.sight[self.rows[held]] * count + self.effect.group[self.rows[held]]
        order = np.argsort(key, kind="stable")
        key, held = key[order], held[order]
        starts = np.flatnonzero(np.diff(key, prepend=-1))
        own, private = (np.ascontiguousarray(x.T) for x in (self.columns[held], model.private[self.rows[held]]))
        inside = np.add.reduceat(own[:, None] * private, starts, axis=2).transpose(
            2, 0, 1
        )  # rows last: in half the time
        sight, group = np.divmod(key[starts], count)
        if not self.effect.onwards:
            np.add.at(squares, group, inside @ inside.transpose(0, 2, 1))
            return squares[:-1]
        # All groups from one that a sight shows up to its next one move the same equations: those that come after.
        first = np.flatnonzero(np.diff(sight, prepend=-1))
        after = np.vstack([np.cumsum(inside[::-1], axis=0)[::-1], np.zeros_like(inside[:1])])
        end = np.append(first, len(sight))[np.searchsorted(first, np.arange(len(sight)), side="right")]
        inside, before = after[:-1] - after[end], np.append(0, group[:-1])
        before[first] = 0
        np.add.at(squares, before, inside @ inside.transpose(0, 2, 1))
        np.subtract.at(squares, group, inside @ inside.transpose(0, 2, 1))
        return np.cumsum(squares, axis=0)[:-1]


_MOST_ENTRIES = 4_000_000  # entries of a matrix: 32 MB


class SparseColumns(Frozen):
    """Columns of Q numbers over E equations, in standard deviations, stored by equation.

    Attributes:
        slots: (E, B) numbers that move each equation, Q for none. values: (E, B) by how much, 0 where it is not
            used.
        size: Q.
    """

    slots: Indices
    values: Array
    size: int

    @classmethod
    def of_groups(cls, model: Linearised, columns: Array, group: Indices, groups: int) -> SparseColumns:
        """Those of groups of equations (E,), -1 for none, each with a number for each of the columns (E, M) in standard
        deviations; numbers are ordered by group.
        """
        width, there = columns.shape[1], (group >= 0) & model.used
        slots = np.where(there[:, None], group[:, None] * width + np.arange(width), groups * width)
        return cls(slots, np.where(there[:, None], columns, 0.0), groups * width)

    @classmethod
    def side_by_side(cls, parts: Sequence[SparseColumns], equations: int) -> SparseColumns:
        """The columns of several effects, one effect after the other."""
        firsts = np.cumsum([0, *(part.size for part in parts)])
        size, nothing = int(firsts[-1]), np.zeros((equations, 0), dtype=np.int64)
        slots = [
            np.where(one.slots < one.size, one.slots + first, size) for one, first in zip(parts, firsts, strict=False)
        ]
        return cls(np.hstack([nothing, *slots]), np.hstack([nothing, *(part.values for part in parts)]), size)

    def gathered(self, factors: Array, owner: Indices, owners: int) -> Array:
        """(owners, Q) sums of the values times factors (E,) or (E, B), by owner (E,) and number."""
        products = self.values * (factors if factors.ndim == 2 else factors[:, None])
        key = owner[:, None] * (self.size + 1) + self.slots
        sums = np.bincount(key.ravel(), products.ravel(), minlength=owners * (self.size + 1))
        return np.asarray(sums.reshape(owners, -1)[:, :-1])

    def summed(self, factors: Array) -> Array:
        """(Q,) sums of the values times factors over all equations."""
        return np.asarray(self.gathered(factors, np.zeros(len(self.slots), dtype=np.int64), 1)[0])

    @cached_property
    def _matrix(self) -> Array | None:
        """(E, Q) the columns as one dense matrix; None where separate sums take less time or memory."""
        few, (equations, width) = 2, self.slots.shape
        small = self._has_few and equations * self.size <= _MOST_ENTRIES
        return self._rows(slice(None)) if small or self.size <= few * width else None

    @property
    def _has_few(self) -> bool:
        """Whether sums of many columns take less time as products of a dense matrix, zeros included."""
        many = 40  # ratio of all numbers to those that move one equation
        return bool(self.size <= many * self.slots.shape[1])

    def _rows(self, rows: slice) -> Array:
        """(E, Q) some equations as a dense matrix."""
        slots, values = self.slots[rows], self.values[rows]
        at = np.arange(len(slots))[:, None] * (self.size + 1) + slots
        whole = np.bincount(at.ravel(), values.ravel(), minlength=len(slots) * (self.size + 1))
        return np.asarray(whole.reshape(len(slots), -1)[:, :-1])

    def products(self) -> Array:
        """(Q, Q) X^T X."""
        if self._matrix is not None:
            return np.asarray(self._matrix.T @ self._matrix)
        every = [self.gathered(self.values[:, k], self.slots[:, k], self.size + 1) for k in range(self.slots.shape[1])]
        return np.asarray(np.sum(every, axis=0)[:-1])

    def at(self, amounts: Array) -> Array:
        """(E,) by how much amounts (Q,) move the equations."""
        return np.asarray(np.sum(self.values * np.append(amounts, 0.0)[self.slots], axis=1))

    def in_private(self, model: Linearised, part: Indices | None = None) -> Array:
        """(6, S, Q) their parts along the private basis of each sight, or of parts (E,) of sights."""
        part = model.equations.sight if part is None else part
        parts = int(part.max()) + 1
        if not model.of_private.any():
            return np.zeros((6, parts, self.size))
        bounds = model.equations.bounds
        if part is model.equations.sight and (whole := self._matrix) is not None:
            rows = list(map(slice, bounds[:-1], bounds[1:]))
            return np.stack([model.private[own].T @ whole[own] for own in rows], axis=1)
        return np.array([self.gathered(column, part, parts) for column in model.private.T])

    def in_shared(self, model: Linearised) -> Array:
        """(P, Q) their parts along the shared directions."""
        if self._matrix is not None:
            return np.asarray(model.shared.T @ self._matrix)
        if self._has_few:
            step = _MOST_ENTRIES // max(self.size, 1)
            parts = (slice(first, first + step) for first in range(0, len(self.slots), step))
            taken = np.zeros((model.shared.shape[1], self.size))
            for part in parts:
                taken += model.shared[part].T @ self._rows(part)
            return taken
        return np.array([self.summed(column) for column in model.shared.T]).reshape(-1, self.size)

    def left_of(self, model: Linearised) -> tuple[Array, Array, Array]:
        """V (Q, Q) and u (Q,), see `effects.evidence`, and the parts along the shared directions (P, Q)."""
        private, shared = np.concatenate(self.in_private(model)), self.in_shared(model)
        return self.products() - private.T @ private - shared.T @ shared, self.summed(model.left_over), shared


# ---- score tests ----------------------------------------------------------------------------------------------------

# Difference of log p, in nats, below which only luck distinguishes alternatives. For planted faults the right name is
# ahead by 20.
_ALIKE = 7.0
# Share of the first cause's statistic below which a test shows only the error of the first cause's linear model. At
# half of it, one of seven planted faults has a second finding beside it; at double nothing changes.
_LEAST_SHARE = 0.02


class ScoreTest(Frozen):
    """The score test of one group of an effect.

    Attributes:
        effect, number: the group. statistic: decrease of the squared residuals, in variances. rank: determined numbers.
        log_p: natural logarithm of the probability of such a statistic in noise, not corrected for the number of tests.
        amount: (Q,) the amounts that would correct it. sd: (Q,) their standard deviations, infinite if undetermined.
        rivals: alternatives of other kinds that explain nearly as much, and nothing once it is included.
    """

    effect: EffectColumns
    number: int
    statistic: float
    rank: int
    log_p: float
    amount: Array
    sd: Array
    rivals: tuple[ScoreTest, ...] = ()

    @property
    def subject(self) -> str:
        return self.effect.subjects[self.number]

    @property
    def frame(self) -> str | None:
        return self.effect.frames[self.number] if self.effect.frames else None

    @property
    def columns(self) -> Array:
        """(E, Q) px per unit of its amounts."""
        return self.effect.of(self.number)


def score_all(
    model: Linearised, alternatives: Sequence[EffectSums], inflation: float = 1.0, *, by_chance: bool = True
) -> list[ScoreTest]:
    """Test every alternative that the free numbers leave testable.

    Args:
        alternatives: the sums of each effect beyond the free numbers of this model.
        inflation: number of observations that count as one independent one, where neighbours' errors are correlated.
        by_chance: whether log_p is computed, which takes as long as the rest; otherwise it is 0.
    """
    squares, equations = float(model.left_over @ model.left_over), model.spare + model.known_noise
    slope = _robust_slope(model)
    found: list[tuple[EffectColumns, Indices, Array, Array]] = []
    all_ranks, all_z = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    for sums in alternatives:
        roots, ranks = inverse_roots(sums.normals, sums.sizes, LEAST_LEFT)
        z = np.einsum("gqk,gq->gk", roots, sums.scores)
        amounts, spreads = np.einsum("gqk,gk->gq", roots, z) / -slope, np.sqrt(np.sum(roots**2, axis=2))
        spreads[sums.sizes == 0.0] = np.inf
        numbers = np.flatnonzero((ranks > 0) & (equations - ranks >= 1.0))
        found.append((sums.effect, numbers, amounts[numbers], spreads[numbers]))
        all_ranks.append(ranks[numbers])
        all_z.append(np.sum(z[numbers] ** 2, axis=1))
    ranks, statistics = np.concatenate(all_ranks), np.concatenate(all_z)
    spare = equations - ranks
    variance = (np.maximum(squares - statistics, 1e-12 * squares) + model.known_noise) / spare
    ratio = statistics / (inflation * ranks * np.maximum(variance, 1e-300))
    log_p = log_f_tail(ratio, ranks, spare) if by_chance else np.zeros(len(ratio))
    sd = np.sqrt(variance * inflation) / slope
    of_each = zip((statistics / variance).tolist(), ranks.tolist(), log_p.tolist(), sd.tolist(), strict=True)
    tests = []
    for effect, numbers, amounts, spreads in found:
        rows = zip(numbers.tolist(), amounts, spreads, strict=True)
        tests += [
            ScoreTest(effect, number, statistic, rank, one_log_p, amount, spread * one_sd, ())
            for (number, amount, spread), (statistic, rank, one_log_p, one_sd) in zip(rows, of_each, strict=False)
        ]
    return tests


def _robust_slope(model: Linearised) -> float:
    """Mean derivative of a robust residual by the residual itself: 1 without a loss (Stein's lemma)."""
    plain = model.weight * model.equations.residual * model.used
    return float(plain @ model.score) / max(float(plain @ plain), 1e-300)


# ---- the selection --------------------------------------------------------------------------------------------------


class Selection(Frozen):
    """The alternatives chosen, and the model that includes all of them.

    Attributes:
        chosen: in the order of selection, with their amounts when all of them are free at once.
        tests: number of alternatives that could be tested, plus `extra`.
        log_level: natural logarithm of the probability below which one is chosen.
        model: the model with the chosen ones free.
    """

    chosen: tuple[ScoreTest, ...]
    tests: int
    log_level: float
    model: Linearised

    def log10_p(self, log_p: float) -> float:
        """Decimal logarithm of a probability after Bonferroni."""
        return min(0.0, (log_p + float(np.log(self.tests))) / float(np.log(10.0)))


def select(
    model: Linearised, alternatives: Sequence[EffectSums], rate: float, extra: int, inflation: float = 1.0
) -> Selection:
    """Select significant alternatives one after the other, each beside those before it. In noise, any is selected with
    probability `rate`.

    Args:
        alternatives: see `score_all`. extra: number of other tests that share the rate. inflation: see `score_all`.
    """
    most = 12  # causes that are reported; with more, it is no calibration with faults but none at all
    chosen: list[ScoreTest] = []
    extended, scores = model, score_all(model, alternatives, inflation)
    tests = len(scores) + extra
    log_level = float(np.log(rate / tests))
    while scores and len(chosen) < most:
        best = min(scores, key=lambda score: score.log_p)
        if best.log_p > log_level or (chosen and best.statistic < _LEAST_SHARE * chosen[0].statistic):
            break
        before, extended = scores, extended.with_columns(best.columns)
        alternatives = [sums.beside(extended) for sums in alternatives]
        scores = score_all(extended, alternatives, inflation)
        chosen.append(replace(best, rivals=_rivals(best, before, scores, log_level)))
    if chosen:
        together = model.freed(np.hstack([score.columns for score in chosen]))
        ends = np.cumsum([len(score.amount) for score in chosen])[:-1]
        parts = zip(chosen, np.split(together.amount, ends), np.split(together.sd, ends), strict=True)
        chosen = [replace(score, amount=amount, sd=sd) for score, amount, sd in parts]
    return Selection(tuple(chosen), tests, log_level, extended)


def _rivals(
    best: ScoreTest, before: Sequence[ScoreTest], after: Sequence[ScoreTest], log_level: float
) -> tuple[ScoreTest, ...]:
    """Alternatives of other kinds that were about as probable as the best one, and are not significant beside it."""
    left = {(id(score.effect), score.number): score.log_p for score in after}
    near = [
        score
        for score in before
        if score.effect.kind != best.effect.kind
        and score.log_p < best.log_p + _ALIKE
        and left.get((id(score.effect), score.number), 0.0) > log_level
    ]
    return tuple(sorted(near, key=lambda score: score.log_p))


def smooth_image(equations: Equations, estimate: Estimate) -> Array:
    """(E, K) smooth displacements of each camera's image, of order one at its corners: polynomials, and powers of the
    radius.
    """
    every = []
    degree, powers = 3, (0.5, 1.5, 2.0, 2.5, 3.0, 4.0)  # degree of polynomials; powers of r^2 along the radius
    owner = np.array([key.camera for key in equations.sights.keys])[equations.sight]
    for name in equations.sights.cameras:
        camera = estimate.cameras[name]
        place = (equations.pixel - camera.principal_point) / unit_px(camera)
        x, y = place.T
        smooth = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
        along = np.sum(place * equations.direction, axis=1)
        radial = [np.sum(place**2, axis=1) ** power * along for power in powers]
        columns = [*(equations.direction[:, axis] * one for one in smooth for axis in range(2)), *radial]
        every.append(np.column_stack(columns) * (owner == name)[:, None])
    return np.column_stack(every)


def places_in_view(equations: Equations) -> Array:
    """(E, 2) x and y of the pixels, scaled to -1 ... 1 over the observed part of each sight."""
    starts = equations.bounds[:-1]
    low, high = np.minimum.reduceat(equations.pixel, starts), np.maximum.reduceat(equations.pixel, starts)
    half = np.maximum(np.max(high - low, axis=1), 1.0) / 2.0
    return np.asarray((equations.pixel - ((low + high) / 2.0)[equations.sight]) / half[equations.sight, None])


def smooth_view(equations: Equations, place: Array) -> Array:
    """(E, 2, 5) smooth displacements of each sight along both axes of the image: polynomials of places (E, 2) without
    the constant, which the pose absorbs.
    """
    (x, y), third = place.T, 1.0 / 3.0  # the mean of x^2
    each = np.column_stack([x, y, x**2 - third, x * y, y**2 - third])
    return np.asarray(equations.direction[:, :, None] * each[:, None, :])
