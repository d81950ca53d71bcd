"""What a solve saw, and how each kind of lens sees it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Mask, distinct
from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import CalibrationError, DegenerateError, attempt, or_none
from ceres_cal.calibration.lens_forms import Form
from ceres_cal.calibration.lens_kinds import Candidate, Kind
from ceres_cal.effects.groups import group_normals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.parameters import Estimate, Options
from ceres_cal.problem.problem import Problem, problem_of
from ceres_cal.problem.residuals import Residuals, residuals
from ceres_cal.robust.as_built import Built
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.start.lens_profile import LensProfile, edge_over

MOST_ROUNDS = 8  # of a robust solve
_FEWEST_GROUPS = 8  # with fewer nothing tells lenses apart
_PRECISION = 1e-2  # relative change of the cost from which on normal equations say where the least is
_MOST_STEPS = 10  # a kind that takes more is no lens for these observations
_KEPT = 1.5  # times the squares that normal equations promise: what leaves more is not the lens that was compared
_FEWEST_PLACEMENTS = 8  # with fewer the features of each are held out one by one


class FewGroupsError(DegenerateError):
    """There is too little to hold out: nothing tells lenses apart."""


def profiles_of(estimate: Estimate, sights: Sights) -> dict[str, LensProfile]:
    """What each camera's lens does, as far as it was observed."""
    return {
        name: LensProfile.of(camera := estimate.cameras[name], sights.of_camera(name).about(camera).reach_px)
        for name in sights.cameras
    }


def seen_through(estimate: Estimate, options: Options, profiles: Mapping[str, LensProfile]) -> Estimate:
    """The estimate with the lens of the options, as near to its own as it comes."""
    cameras = dict(estimate.cameras)
    for name, profile in profiles.items():
        phi, edge = cameras[name].phi, edge_over(cameras[name], profile.reach_px)
        blank = options.blank_lens.spanning(float(profile.angles[-1]), phi, edge, cameras[name].image_size)
        lens = profile.nearest(blank, phi, options.held)
        cameras[name] = replace(cameras[name], lens=lens)
    return replace(estimate, cameras=cameras)


@dataclass(frozen=True, eq=False)
class InlierRows:
    """The inliers of a solve.

    Attributes:
        every: sights of all the observations, of targets as they are `built`.
    """

    observations: Observations
    end: RobustSolution
    options: Options
    every: Sights
    built: Built

    @property
    def sights(self) -> Sights:
        return self.end.problem.sights

    @cached_property
    def _profiles(self) -> dict[str, LensProfile]:
        return profiles_of(self.end.solution.estimate, self.sights)

    def kind(self, forms: tuple[Form, ...], *, is_solved: bool) -> Kind:
        """A kind near its best, and the normal equations of each group there; `is_solved`: the one that was solved."""
        options = forms[0].of(self.options, max_iterations=_MOST_STEPS)
        start = self.end.solution.estimate

        def near_best() -> Kind:
            problem, estimate = self._problem(options, start), start
            if not is_solved:
                estimate = seen_through(estimate, options, self._profiles)
                self._shown(estimate)
                estimate = solve(problem, estimate, precision=_PRECISION, is_near=False).estimate
            return self._near_best(forms, problem, estimate)

        return _or_failed(near_best, forms, start)

    def solved(self, forms: tuple[Form, ...], near: Estimate) -> Kind:
        """A kind whose roughness the data tell, by all rounds of a robust solve from an estimate with another lens."""
        options = forms[0].of(self.options)
        start = seen_through(near, options, profiles_of(near, self.sights))

        def near_best() -> Kind:
            problem = problem_of(self.observations, self.every, options, start)
            end = solve_robustly(problem, self.observations, start, most_rounds=MOST_ROUNDS)
            estimate = end.solution.estimate
            problem = replace(self._problem(options, estimate), smoothness=end.problem.smoothness)
            return self._near_best(forms, problem, estimate)

        return _or_failed(near_best, forms, start)

    @property
    def splits_placements(self) -> bool:
        """Whether placements are too few to be held out whole."""
        return any(key.placement for key in self.sights.keys) and not _placed(self.sights).any()

    def in_sigmas(self, estimate: Estimate) -> tuple[Array, Array]:
        """(N, 2), (M,) residuals of points and curve observations, in standard deviations.

        Raises:
            DegenerateError: something is not seen.
        """
        there, sights, scales = self._shown(estimate), self.sights, self.end.problem.weighting.scales
        points = there.points[sights.point_rows] / (scales[0] * sights.sigma_px[:, None])
        return points, there.curves[sights.curve_rows] / (scales[1] * sights.curve_sigma_px)

    @or_none  # quiet: the lens does not reach what was promised, and gives no answer
    def reached(self, candidate: Candidate) -> Estimate | None:
        """Where a lens leaves no more than the normal equations of a longer one promised, at once or when solved."""
        points, curves = self.in_sigmas(candidate.estimate)
        if np.sum(points**2) + curves @ curves <= _KEPT * candidate.least:
            return candidate.estimate
        options = candidate.form.of(self.options, max_iterations=_MOST_STEPS)
        problem = self._problem(options, candidate.estimate)
        solution = solve(problem, candidate.estimate, precision=_PRECISION)
        return solution.estimate if 2.0 * solution.cost <= _KEPT * candidate.least else None

    def solved_near(self, candidate: Candidate) -> Estimate:
        """Where a lens is at its best, solved for from where the normal equations have it.

        Raises:
            CalibrationError: it cannot be solved for.
        """
        options = candidate.form.of(self.options)
        solution = solve(self._problem(options, candidate.estimate), candidate.estimate)
        if solution.failed:
            raise DegenerateError(f"cannot be solved for: {solution.termination}")
        return solution.estimate

    def _problem(self, options: Options, estimate: Estimate) -> Problem:
        """All inliers weigh the same with every kind: what one of them misses must not weigh less with it."""
        problem = problem_of(self.observations, self.sights, options, estimate)
        return replace(
            problem, weighting=replace(self.end.problem.weighting, loss="trivial"), feet=self.end.residuals.feet
        )

    def _near_best(self, forms: tuple[Form, ...], problem: Problem, estimate: Estimate) -> Kind:
        whole = bool(_placed(self.sights).any())
        normals = group_normals(problem, estimate, self._groups, problem.private if whole else frozenset())
        reach_px = {name: profile.reach_px for name, profile in self._profiles.items()}
        return Kind(forms, estimate, normals, self._sigma_px, reach_px)

    @cached_property
    def _groups(self) -> Sights:
        """A sight of each group: a placement, or, of what stays where it is, a feature."""
        return self.sights.by_feature(_placed(self.sights))

    @cached_property
    def _sigma_px(self) -> float:
        """Of a typical observation."""
        sights, (points, curves) = self.sights, self.end.problem.weighting.scales
        inverse = 2.0 * np.sum(1.0 / (points * sights.sigma_px)) + np.sum(1.0 / (curves * sights.curve_sigma_px))
        return sights.equations / float(inverse)

    def _shown(self, estimate: Estimate) -> Residuals:
        """The residuals there; DegenerateError where something is not seen."""
        there = residuals(self.observations, self.sights, estimate, self.end.residuals.feet)
        known = np.isfinite(there.points[self.sights.point_rows]), np.isfinite(there.curves[self.sights.curve_rows])
        if not (known[0].all() and known[1].all()):
            raise DegenerateError("cannot show all that another lens shows")
        return there


def _or_failed(near_best: Callable[[], Kind], forms: tuple[Form, ...], start: Estimate) -> Kind:
    """A kind near its best, or why it failed."""
    found = attempt(near_best)  # reads: "..." beside that lens, why it failed
    return Kind(forms, start, failed=str(found)) if isinstance(found, CalibrationError) else found


def _placed(sights: Sights) -> Mask:
    """(S,) which sights are held out whole: those of placements, where there are enough of them."""
    placed = np.array([key.placement is not None for key in sights.keys])
    return placed & (np.count_nonzero(placed) >= _FEWEST_PLACEMENTS)


def require_groups(sights: Sights) -> None:
    """Raise FewGroupsError where there is too little to hold out."""
    placed = _placed(sights)
    count = int(np.count_nonzero(placed))
    for own in (sights[int(number)] for number in np.flatnonzero(~placed)):
        count += len(distinct(own.point_index)) + len(distinct(own.track_index))
    if count < _FEWEST_GROUPS:
        raise FewGroupsError("too few views or features to tell lenses apart")
