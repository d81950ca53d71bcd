"""Solve for effects with a prior: their sizes, their best amounts, and what they add to the covariance.

Such an effect displaces the observations by amounts that are the same in all views. Its size is estimated from the
residuals (`effects.evidence`). Where the effect is likelier present than absent, its best amounts are subtracted from
the observations and everything else is solved for again, until the amounts converge. The covariance then includes the
uncertainty of the amounts and, with its probability, the explanation without the effect. An effect that is in doubt but
not solved for adds all of its amounts, with its probability, to the covariance. So does the stretch of a board in few
views: `as_built` solves only for what repeats in many views beside what a lens may leave.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, cached_property, replace
from ceres_cal.effects import FLOOR_OFF, LIKELY, RepeatedAmounts, make_linear_model, shifts_by, strand_names
from ceres_cal.effects.columns import EffectColumns, ScoreTest, SparseColumns
from ceres_cal.effects.effect import Case, Effect, EffectEstimate, ShiftsAt
from ceres_cal.effects.table import estimated
from ceres_cal.problem import Estimate, Key, Problem, free_keys, write_equations
from ceres_cal.robust.robust import RobustSolution, solve_robustly

_MOST_ROUNDS, _AT_REST = 3, 0.05  # solves; change of the amounts, in standard deviations, below which they converged


class EffectsEnd(Frozen):
    """The result of a solve beside effects.

    Attributes:
        problem: of all the observations, with the effects' best amounts subtracted. end: the end of its rounds.
        estimates: the effects that were solved for. shifts_at: what all effects add to the covariance of the shared
            numbers.
    """

    problem: Problem
    end: RobustSolution
    estimates: tuple[EffectEstimate, ...]
    shifts_at: ShiftsAt


def solve_beside_effects(problem: Problem, part: Problem, end: RobustSolution, *, solves: bool = True) -> EffectsEnd:
    """Solve for all effects that likely displace the observations, together with everything else.

    Args:
        problem: of all the observations. part: without observations that were left out as a whole. end: of its rounds.
        solves: whether likely effects are solved for. If not, as for a subset of the observations that count, effects
            only widen the covariance.
    """
    points, off = len(problem.observations.points), np.zeros((problem.observations.rows, 2))

    def amounts_at(under: Problem, end: RobustSolution) -> _Amounts:
        return _Amounts.of(under, end, off, solves)

    displaced, amounts = part, amounts_at(part, end)
    for _ in range(_MOST_ROUNDS):
        if not len(amounts.likely):
            break
        off = amounts.displacement(len(off))
        shifts = -off[:points], -off[points:]
        displaced = replace(part, sights=part.sights.displaced(*shifts))
        end = solve_robustly(displaced, end.estimate, is_near=True)
        before, amounts = amounts, amounts_at(displaced, end)
        if amounts.stay(before):
            break
    last, solved = end, end.estimate

    def shifts_at(there: Estimate, other: Problem | None) -> tuple[Sequence[Key], Sequence[Array]]:
        # Along a valley, and where something else is stated, the numbers are correlated differently.
        own, under = amounts, displaced
        if there is not solved or other is not None:
            under = displaced if other is None else replace(displaced, priors=other.priors, layout=other.layout)
            own = amounts_at(under, last.moved_to(there, under))
        return free_keys(there, under.layout, part.private), list(own.shifts())

    if np.any(off):
        problem = replace(problem, sights=problem.sights.displaced(-off[:points], -off[points:]))
        end = end.moved_to(solved, problem)
    return EffectsEnd(problem, end, tuple(amounts.estimates()), shifts_at)


class _EffectGroup(Frozen):
    """One group of an effect, with the numbers of its amounts among all amounts."""

    effect: Effect
    columns: EffectColumns
    number: int
    own: Indices


class _Amounts(Frozen):
    """The information of the residuals on the amounts of all effects.

    Attributes:
        taken: (K, Q) by how much the shared numbers move with each amount. groups: by number.
        sizes: sigma and probability of each group. solves: whether likely groups are solved for.
    """

    case: Case
    repeated: RepeatedAmounts
    taken: Array
    groups: Sequence[_EffectGroup]
    sizes: Sequence[tuple[float, float]]
    solves: bool

    @classmethod
    def of(cls, problem: Problem, end: RobustSolution, off: Array, solves: bool) -> _Amounts:
        """The amounts at the end of a problem from whose observations a displacement (N + M, 2) px was subtracted."""
        estimate = end.estimate
        equations = write_equations(problem.sights, estimate, end.residuals)
        equations = replace(equations, residual=equations.residual - equations.along(off))
        model = make_linear_model(problem, estimate, equations, end.weights_of(equations))
        case = Case(problem, estimate, model)
        groups, parts, size = list[_EffectGroup](), list[SparseColumns](), 0
        for effect in estimated(problem.observations):
            for columns in effect.columns(case):
                width, count = columns.columns.shape[1], len(columns.subjects)
                scaled = columns.columns * model.weight[:, None]
                parts.append(SparseColumns.of_groups(model, scaled, columns.group, count))
                for number in range(count):
                    own = size + width * number + np.arange(width)
                    groups.append(_EffectGroup(effect, columns, number, own))
                size += parts[-1].size
        every = SparseColumns.side_by_side(parts, len(equations))
        # With few views, curves show how far correlated errors displace, but not how a lens is wrong.
        fewest_sights = 3  # sights from which on an effect differs from what a wrong lens leaves
        few = len(problem.sights) < fewest_sights
        repeated = RepeatedAmounts.of(model, every, strand_names(equations, equations.sight) if few else None)
        each = ((number, one.effect.prior_of(one.columns, one.number, case)) for number, one in enumerate(groups))
        priors = {number: prior for number, prior in each if prior is not None}
        found = repeated.sizes({number: groups[number].own for number in priors}, priors)
        taken, sizes = -model.root @ repeated.in_shared, [found.get(n, (0.0, 0.0)) for n in range(len(groups))]
        return cls(case, repeated, taken, groups, sizes, solves and not few)

    @cached_property
    def likely(self) -> list[int]:
        """Numbers of the groups that are solved for. How boards are built is left to `as_built`, or only widens."""
        if not self.solves:
            return []
        of_world = (number for number, group in enumerate(self.groups) if not group.effect.built)
        return [number for number in of_world if self.sizes[number][1] > LIKELY]

    @cached_property
    def _best(self) -> tuple[Array, Array]:
        """Best amounts (Q,) of the likely groups, 0 for all others, and their covariance (Q, Q)."""
        amounts, covariance = np.zeros(len(self.repeated.score)), np.zeros_like(self.repeated.information)
        if self.likely:
            at = np.concatenate([self.groups[number].own for number in self.likely])
            sigmas = np.concatenate([np.full(len(self.groups[n].own), self.sizes[n][0]) for n in self.likely])
            amounts[at], covariance[np.ix_(at, at)] = self.repeated.amounts(at, sigmas)
        return amounts, covariance

    def stay(self, before: _Amounts) -> bool:
        """Whether the likely groups are the same as before, and their amounts have converged."""
        amounts, covariance = self._best
        moved, sd = amounts - before._best[0], np.sqrt(np.diagonal(covariance))
        return self.likely == before.likely and bool(np.all(np.abs(moved) <= _AT_REST * sd))

    @property
    def _explained(self) -> Array:
        """(E,) px by which the best amounts of the likely groups move the observations in the model."""
        likely, amounts = (self.groups[number] for number in self.likely), self._best[0]
        shifts = (group.columns.of(group.number) @ amounts[group.own] for group in likely)
        return sum(shifts, np.zeros(len(self.case.equations)))

    def displacement(self, observations: int) -> Array:
        """(N + M, 2) px by which the best amounts displace the observations."""
        return self.case.equations.displacement(self._explained, observations)

    def estimates(self) -> Iterator[EffectEstimate]:
        """The effects that are solved for; and, if not solved for, whether a floor or a board is likely off its
        drawing.
        """
        case, (amounts, covariance) = self.case, self._best
        left = case.model.left_over + case.model.left_of_column(self._explained * case.model.weight)
        for number in self.likely:
            group, (sigma, probability) = self.groups[number], self.sizes[number]
            own, sd = amounts[group.own], np.sqrt(np.diagonal(covariance)[group.own])
            score = ScoreTest(group.columns, group.number, float(np.sum((own / sd) ** 2)), len(own), 0.0, own, sd)
            sentence, _, mending = group.effect.words(group.effect.evidence(case, score, case.model, left))
            yield EffectEstimate(group.effect.kind, score.subject, score.frame, sigma, probability, sentence, mending)
        for number, group in enumerate(self.groups):
            is_said = group.effect.prior is FLOOR_OFF or (group.effect.built and self.sizes[number][1] > LIKELY)
            if number not in self.likely and is_said:
                subject = group.columns.subjects[group.number]
                yield EffectEstimate(group.effect.kind, subject, None, *self.sizes[number], "", ())

    def shifts(self) -> Iterator[Array]:
        """(K,) each: vectors whose outer products are added to the covariance, see `EffectsEnd`."""
        # Probability below which an effect is ignored: such a share of its amounts' variance visibly widens nothing.
        negligible = 0.01
        amounts, covariance = self._best
        yield from shifts_by(self.taken, covariance)
        for number, group in enumerate(self.groups):
            (sigma, probability), taken = self.sizes[number], self.taken[:, group.own]
            if number in self.likely:
                yield np.sqrt(1.0 - probability) * taken @ amounts[group.own]
            elif probability > negligible:
                alone, open_ = self.repeated.amounts(group.own, np.full(len(group.own), sigma))
                yield from np.sqrt(probability) * shifts_by(taken, open_ + np.outer(alone, alone))
