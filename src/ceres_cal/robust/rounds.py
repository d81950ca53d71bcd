"""The rounds of a robust solve: solve, judge the noise and the outliers, solve again, until nothing changes.

One loop for rows that are at hand and for sums over shares of very many: what an engine does in each step differs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, Protocol, Self, TypeVar

from ceres_cal.observations.sights import SightKey
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.reduced import ReducedInformation

MOST_ROUNDS = 15
# Relative change of a noise scale that is no change. From half to double the answer moves by under 1 % of its error;
# a refit must give the same answer to the same question, and nothing changes from half to double there.
AT_REST, AT_REST_AGAIN = 1e-2, 1e-5


class Round(Protocol):
    """Where one round ended: what was judged there, and the problem that it makes."""

    @property
    def problem(self) -> Problem:
        """What is to be solved next."""

    @property
    def rounds(self) -> int:
        """How many solves there were."""

    @property
    def reduced(self) -> ReducedInformation | None:
        """What observations and priors say there, once nothing changes."""

    def judged_like(self, before: Self, no_change: float) -> bool:
        """Whether nothing worth another solve changed since another round."""


_Round = TypeVar("_Round", bound=Round)


class Rounds(ABC, Generic[_Round]):
    """An engine that solves and judges."""

    no_change = AT_REST

    @abstractmethod
    def next(self, state: _Round) -> _Round:
        """One more solve of what was judged to take part, judged."""

    @abstractmethod
    def with_leverages(self, state: _Round) -> _Round:
        """The state with what its problem says there, judged by the leverages; without it where that asks for another
        round.
        """

    def mended(self, state: _Round, undecided: frozenset[SightKey]) -> tuple[_Round, int, frozenset[SightKey]]:
        """The state with poses changed that a solve cannot get out of, how many, and which sights are undecided."""
        return state, 0, undecided

    def refined(self, state: _Round) -> _Round:
        """The state after the first solve, nearer to what it settles at."""
        return state

    def to_rest(self, state: _Round, most_rounds: int = MOST_ROUNDS, *, is_near: bool = False) -> _Round:
        """Round after round, until nothing changes."""
        undecided: frozenset[SightKey] = frozenset(state.problem.sights.keys)
        before: _Round | None = None
        while state.rounds < most_rounds:
            at_rest = before is not None and state.judged_like(before, self.no_change)
            if not at_rest and before is not None:
                undecided = frozenset(state.problem.sights.keys)  # another lens had decided about mirrored poses
            if at_rest or before is None:
                state, changed, undecided = self.mended(state, undecided)
                if before is None and not is_near:
                    state = self.refined(state)
                if at_rest and not changed:
                    state = self.with_leverages(state)
                    if state.reduced is not None:
                        break
            before, state = state, self.next(state)
        return state
