"""The inliers of a solve, each kind of lens near its minimum over them, and what follows for each of its lenses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ceres_cal.base import Array, CalibrationError, DegenerateError, Mask, attempt, or_none, upper_tail
from ceres_cal.base.frozen import Frozen, cached_property, field, replace
from ceres_cal.calibration.file import TOO_FEW
from ceres_cal.calibration.lens_forms import AS_GOOD, PAPER, Form, standard_errors, surprise
from ceres_cal.effects.groups import GroupNormals, group_normals
from ceres_cal.observations.sights import Sights
from ceres_cal.posterior.other_lenses import LensSpread, OtherLenses, shown_slopes
from ceres_cal.problem import (
    Estimate,
    Information,
    Key,
    Options,
    Problem,
    Solution,
    intrinsic_names,
    moved,
    problem_of,
    solve,
    values_of,
)
from ceres_cal.problem.parameters import as_held
from ceres_cal.problem.residuals import Residuals, residuals
from ceres_cal.robust.as_built import Construction
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.start.closed_forms import LensProfile, edge_over
from ceres_cal.start.initialise import initialise

# Probability of the excess of a lens's squares over a longer one's below which the lens is refuted. At 0.01 the paper's
# lens is missed more often, and seams in a carpet become decentring; at 0.001, with a scatter that one group could
# increase, too simple a lens was chosen for halves of real sets.
_REFUTED = 0.003
_UNSEEN_GROUPS = 10.0  # groups that scatter like the noise, added to those seen: the scatter of a dozen varies


class Kind(Frozen):
    """A kind of lens near its minimum, and what follows for each of its lenses.

    Attributes:
        forms: its lenses, longest first. normals: None where the kind cannot be used, see `failed`. sigma_px: noise of
            a typical observation. reach_px: camera -> distance from the principal point that observations reach.
        smoothness: of a lens without a formula, see `Problem`.
    """

    forms: tuple[Form, ...]
    estimate: Estimate
    normals: GroupNormals | None = None
    sigma_px: float = np.nan
    reach_px: Mapping[str, float] = field(default_factory=dict)
    smoothness: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    failed: str = ""

    @property
    def may_fall(self) -> float:
        """Share of the least squares by which the cost may still fall: a solve in a valley takes small steps."""
        return 0.0 if self.normals is None else float(self.normals.squares.sum()) / self.normals.least - 1.0

    @property
    def least(self) -> float:
        """Least sum of squares with its longest lens, by the normal equations."""
        return np.inf if self.normals is None else self.normals.least

    def candidates(self, *, first: bool) -> list[Candidate]:
        """Return the longest lens of the kind and the paper's, or all others, with their errors of prediction."""
        return [one for one in self._every if first == (one.form is self.forms[0] or one.form.label == PAPER)]

    @cached_property
    def _every(self) -> list[Candidate]:
        """All of its lenses; computing them together takes hardly longer than one."""
        if (normals := self.normals) is None:
            return [Candidate(form, self, failed=self.failed) for form in self.forms]
        squares, foreseen, spread, steps = normals.held_out([*map(self.to_nothing, self.forms)])
        rms_px = self.sigma_px * np.sqrt(np.maximum(squares.sum(axis=1), 0.0) / normals.counts.sum())
        told = 2.0 * surprise(foreseen, normals.counts) + spread  # Student's t: as many degrees of freedom as residuals
        each = zip(self.forms, surprise(squares, normals.counts), told, rms_px.tolist(), steps, strict=True)
        return [Candidate(form, self, own, said, rms, at, normals.squares_at(at)) for form, own, said, rms, at in each]

    def slopes(self, lenses: OtherLenses) -> Sequence[Array]:
        """Return the derivatives of the places that pixels show by its numbers, see `shown_slopes`."""
        return () if self.normals is None else shown_slopes(self.estimate, self.normals.keys, lenses)

    def to_nothing(self, form: Form) -> dict[Key, float]:
        """Return the steps that set the coefficients to 0 which one of its lenses does not have."""
        return {key: step for key, step in self._to_nothing.items() if key.quantity not in form.names}

    @cached_property
    def _to_nothing(self) -> dict[Key, float]:
        """The steps that set all coefficients of its longest lens to 0."""
        names, every = set(self.forms[0].names), self.normals.keys if self.normals else ()
        keys = [key for key in every if key.kind == "camera" and key.quantity in names]
        return dict(zip(keys, (-values_of(self.estimate, keys)).tolist(), strict=True))

    @cached_property
    def noise(self) -> float:
        """Mean square of its residuals over the stated noise; at most 1, because a first solve with another lens may
        have left more.
        """
        no_noise = 1e-12  # mean square: rounding leaves at most this of exact observations
        if self.normals is None:
            return 1.0
        spare = float(self.normals.counts.sum() - len(self.normals.keys))
        return min(1.0, max(self.least / max(spare, 1.0), no_noise))

    @cached_property
    def scatter(self) -> float:
        """Mean of the variances of its coefficients by the scatter of groups, over those by the stated noise; at least
        the noise's own share, and closer to that the fewer groups there are.
        """
        if self.normals is None:
            return 1.0
        own = [i for i, key in enumerate(self.normals.keys) if key in self._to_nothing]
        groups = len(self.normals.counts)
        more = self.normals.scatter_of(np.array(own)) - self.noise
        return self.noise + max(0.0, more) * groups / (groups + _UNSEEN_GROUPS)


class Candidate(Frozen):
    """A lens and its errors of prediction.

    Attributes:
        squares: (G,) squared error of predicting each group, in variances; None where it cannot be used, see `failed`.
        densities: (G,) minus twice the logarithm of the density that it predicts for each group.
        rms_px: of all predictions. step: from the kind's estimate to this lens's minimum. least: sum of squares there.
    """

    form: Form
    of: Kind
    squares: Array | None = None
    densities: Array = field(default_factory=lambda: np.empty(0))
    rms_px: float = np.nan
    step: Array = field(default_factory=lambda: np.empty(0))
    least: float = np.nan
    failed: str = ""

    def refutes(self, other: Candidate) -> bool:
        """Return whether the other lens, which has fewer coefficients, leaves more than it may by chance."""
        more = self.form.size - other.form.size
        if more <= 0 or self.squares is None:
            return False
        left, known = other.least - self.least, len(self.squares) + _UNSEEN_GROUPS
        if left <= more * self.of.noise:  # noise alone leaves as much every other time: no tail needed
            return False
        # First by the noise alone, which is cheaper to compute and seldom exceeded.
        by_noise = upper_tail(left / self.of.noise, more, known) < _REFUTED
        return by_noise and upper_tail(left / self.of.scatter, more, known) < _REFUTED

    def may_win(self, best: Candidate | None) -> bool:
        """Return whether it is the longest of a kind whose shorter ones may be as good as the best."""
        if self.form is not self.of.forms[0] or self.of.normals is None:
            return False
        if best is None or best.squares is None or self.squares is None:
            return True
        return standard_errors(self.squares, best.squares) <= AS_GOOD

    def beats(self, other: Candidate, least: float) -> bool:
        """Return whether it predicts better by more than `least` standard errors."""
        if self.squares is None or other.squares is None or self.fault:
            return False
        return standard_errors(other.squares, self.squares) > least

    def extends(self, other: Candidate, as_good: float) -> bool:
        """Return whether it is the other lens with more coefficients, and as good: no data say that these are 0."""
        if self.form.lens != other.form.lens or self.squares is None or other.squares is None:
            return False
        is_longer = {*self.form.names} > {*other.form.names}
        return is_longer and standard_errors(self.squares, other.squares) <= as_good

    @cached_property
    def estimate(self) -> Estimate:
        """The estimate with this lens, near its minimum.

        Raises:
            InputError: there is no valid camera there.
        """
        there = moved(self.of.estimate, self.of.normals.keys if self.of.normals else (), self.step)
        blank = self.form.blank
        cameras = {}
        for name, camera in there.cameras.items():
            values = camera.lens.coefficients
            lens = blank.with_values([values[n] if n in self.form.names else 0.0 for n in blank.names])
            cameras[name] = replace(camera, lens=lens)
        return replace(there, cameras=cameras)

    def spread(self, stated: Information, slopes: Sequence[Array]) -> LensSpread | None:
        """Return how all numbers vary with this lens; None where it cannot be used.

        Args:
            stated: prior information. slopes: see `Kind.slopes`.
        """
        if self.of.normals is None:
            return None
        keys = self.of.normals.keys
        besides = stated.marginal(stated.among(keys)).over(keys).matrix
        return LensSpread(self.of.estimate, keys, self.of.normals.root(self.of.to_nothing(self.form), besides), slopes)

    @property
    def is_near(self) -> bool:
        """Whether normal equations give its minimum, except for placements. They do for boards, where its kind was near
        its own minimum. Over a floor they lead along a valley, and ten standard deviations off it.
        """
        kind = self.of.normals
        if kind is None or any(key.kind != "camera" for key in kind.keys):
            return False
        return float(kind.squares.sum()) + self.least - 2.0 * self.of.least <= _NEAR

    @cached_property
    def fault(self) -> str:
        """Why it cannot be used, else ""."""
        there = attempt(lambda: self.estimate)  # reads: "..." beside that lens, why it failed
        if isinstance(there, CalibrationError):
            return str(there)
        for name, reach_px in self.of.reach_px.items():
            camera = there.cameras[name]
            if camera.folds and (not camera.lens.may_fold or camera.lens.monotone_radius(camera.phi) <= reach_px):
                return "folds inside the image"
        return ""


MOST_ROUNDS = 8  # of a robust solve
_PRECISION = 1e-2  # relative change of the cost from which on normal equations locate the minimum
# Share of its squares by which a kind may be above its minimum; otherwise it is solved finely. The share is up to 0.06,
# and 3 in a valley of phi over a field, where the cost falls by less than the precision at each step: there a lens
# without k3 seemed to leave 6 variances more instead of 110.
_FAR = 0.1
# Relative precision of a cost: of a placement's, because with a coarser one every step of the solve is rejected; and of
# the whole, where the next step is a thousandth of a standard deviation.
_AT_BEST = 1e-6
_MOST_STEPS = 10  # a kind that takes more is no lens for these observations
# Variances by which a kind was above its minimum, plus those by which one of its lenses is above that. Up to this, a
# solve moved lenses of 24 simulated sets of boards by less than a tenth of a standard deviation, at 3 times by a third.
_NEAR = 4.0
_KEPT = 1.5  # times the squares that normal equations predict: a lens that leaves more is not the one compared


def found(solution: Solution) -> Solution:
    """Return a solve that converged; raise DegenerateError for one that failed."""
    if solution.failed:
        raise DegenerateError(f"cannot be solved for: {solution.termination}")
    return solution


def _at_best(problem: Problem, estimate: Estimate) -> Estimate:
    return found(solve(problem, estimate, precision=_AT_BEST)).estimate


def profiles_of(estimate: Estimate, sights: Sights) -> dict[str, LensProfile]:
    """Return each camera's lens as far as it was observed; over its picture where all observations were rejected."""
    seen = {name: sights.of_camera(name).about(estimate.cameras[name]).reach_px for name in sights.cameras}
    every = estimate.cameras.items()
    return {name: LensProfile.of(camera, seen.get(name, camera.corner_radius)) for name, camera in every}


def seen_through(estimate: Estimate, options: Options, profiles: Mapping[str, LensProfile]) -> Estimate:
    """Return the estimate with the options' lens, fitted to its own; DegenerateError: its own lens shows nothing."""
    cameras = dict(estimate.cameras)
    for name, profile in profiles.items():
        if not len(profile.angles):
            raise DegenerateError(f"camera {name!r}: its lens projects no observation: check pixels and labels")
        phi, edge = cameras[name].phi, edge_over(cameras[name], profile.reach_px)
        blank = options.blank_lens.spanning(float(profile.angles[-1]), phi, edge, cameras[name].image_size)
        lens = profile.nearest(blank, phi, options.held)
        cameras[name] = replace(cameras[name], lens=lens)
    return replace(estimate, cameras=cameras)


class InlierRows(Frozen):
    """The inliers of a solve.

    Attributes:
        every: sights of all the observations, with targets as `built`.
    """

    end: RobustSolution
    options: Options
    every: Sights
    built: Construction

    @property
    def sights(self) -> Sights:
        return self.end.problem.sights

    @cached_property
    def _profiles(self) -> dict[str, LensProfile]:
        return profiles_of(self.end.estimate, self.sights)

    def kind(self, forms: tuple[Form, ...], *, is_solved: bool) -> Kind:
        """Return a kind near its minimum, with each group's normal equations; `is_solved`: it is that of the solve."""
        options = forms[0].of(self.options, max_iterations=_MOST_STEPS)
        start = self.end.estimate

        def near_best() -> Kind:
            problem, estimate = self._problem(options, start, {}), start
            if not is_solved:
                estimate = seen_through(estimate, options, self._profiles)
                solution = solve(problem, estimate, precision=_PRECISION, is_near=False)
                if solution.failed:
                    self._shown(estimate)  # raises a more specific message where that is the reason
                estimate = found(solution).estimate
            kind = self._near_best(forms, problem, estimate)
            return kind if not kind.may_fall > _FAR else self._near_best(forms, problem, _at_best(problem, estimate))

        return _or_failed(near_best, forms, start)

    def solved(self, forms: tuple[Form, ...], near: Estimate | None) -> Kind:
        """Return a kind whose roughness is estimated, by a full robust solve near an estimate or from a new start."""
        options = forms[0].of(self.options)

        def near_best() -> Kind:
            start = initialise(self.sights, options).estimate if near is None else near
            start = seen_through(start, options, profiles_of(start, self.sights))
            problem = problem_of(self.every, options, start)
            end = solve_robustly(problem, start, most_rounds=MOST_ROUNDS)
            problem = self._problem(options, end.estimate, end.problem.smoothness)
            there = end.estimate if near is not None else _at_best(problem, end.estimate)
            return self._near_best(forms, problem, there)

        return _or_failed(near_best, forms, self.end.estimate)

    def holding(self, options: Options) -> InlierRows:
        """Return a copy that holds the numbers of cameras that other options hold."""
        held = {name: getattr(options, name) for name in ("fixed", "free_principal_point")}
        now = replace(self.options, **held)
        return self if now == self.options else replace(self, options=now)

    @property
    def splits_placements(self) -> bool:
        """Whether placements are too few to be held out whole."""
        return any(key.placement for key in self.sights.keys) and not _placed(self.sights).any()

    def in_sigmas(self, estimate: Estimate, scales: tuple[float, float] | None = None) -> tuple[Array, Array]:
        """Return (N, 2), (M,) residuals of points and curve observations, in standard deviations by these noise scales
        or by those of the solve.

        Raises:
            DegenerateError: an observation cannot be shown.
        """
        there, sights, scales = self._shown(estimate), self.sights, scales or self.end.problem.weighting.scales
        points = there.points[sights.point_rows] / (scales[0] * sights.sigma_px[:, None])
        return points, there.curves[sights.curve_rows] / (scales[1] * sights.curve_sigma_px)

    @or_none  # quiet: the lens leaves more than was predicted, and is not used
    def reached(self, candidate: Candidate) -> Estimate | None:
        """The estimate where a lens, solved if needed, leaves no more than a longer one predicts; else None."""
        points, curves = self.in_sigmas(candidate.estimate)
        if np.sum(points**2) + curves @ curves <= self._kept(candidate):
            return candidate.estimate
        options = candidate.form.of(self.options, max_iterations=_MOST_STEPS)
        problem = self._problem(options, candidate.estimate, candidate.of.smoothness)
        solution = solve(problem, candidate.estimate, precision=_PRECISION)
        return solution.estimate if 2.0 * solution.cost <= self._kept(candidate) else None

    def solved_near(
        self,
        candidate: Candidate,
        *,
        as_promised: bool = False,
        there: Estimate | None = None,
        held: Key | None = None,
    ) -> Solution:
        """Solve with a lens, starting at its minimum by the normal equations.

        Args:
            as_promised: whether leaving more than these predict is a failure.
            there: another start. held: a number that keeps its value there.

        Raises:
            CalibrationError: it cannot be solved for.
        """
        options = candidate.form.of(self.options)
        start = as_held(there or candidate.estimate, options)
        problem = self._problem(options, start, candidate.of.smoothness)
        if held is not None:
            problem = problem.holding(held.owner, intrinsic_names(start.cameras[held.owner].lens).index(held.quantity))
        solution = found(solve(problem, start, precision=_AT_BEST, posed=_AT_BEST))
        if as_promised and 2.0 * solution.cost > self._kept(candidate):
            raise DegenerateError("the solve leaves larger residuals than its linear model predicted")
        return solution

    def _kept(self, candidate: Candidate) -> float:
        """Largest squares of a lens that counts as the one compared; exact observations leave less than noise."""
        return _KEPT * max(candidate.least, self.sights.equations)

    def _problem(self, options: Options, estimate: Estimate, smoothness: Mapping[str, tuple[float, ...]]) -> Problem:
        """Return the problem without a loss, so that inliers that a kind misses do not weigh less with that kind."""
        weighting, feet = replace(self.end.problem.weighting, loss="trivial"), self.end.residuals.feet
        problem = problem_of(self.sights, options, estimate)
        return replace(problem, weighting=weighting, feet=feet, smoothness=smoothness)

    def _near_best(self, forms: tuple[Form, ...], problem: Problem, estimate: Estimate) -> Kind:
        whole = bool(_placed(self.sights).any())
        normals = group_normals(problem, estimate, self._groups, problem.private if whole else frozenset())
        reach_px = {name: self._profiles[name].reach_px for name in self.sights.cameras}
        return Kind(forms, estimate, normals, self._sigma_px, reach_px, problem.smoothness)

    @cached_property
    def _groups(self) -> Sights:
        return _groups_of(self.sights)

    @cached_property
    def _sigma_px(self) -> float:
        """Noise of a typical observation, px (harmonic mean)."""
        sights, (points, curves) = self.sights, self.end.problem.weighting.scales
        inverse = 2.0 * np.sum(1.0 / (points * sights.sigma_px)) + np.sum(1.0 / (curves * sights.curve_sigma_px))
        return sights.equations / float(inverse)

    def _shown(self, estimate: Estimate) -> Residuals:
        """Return the residuals there; raise DegenerateError where an observation cannot be shown."""
        there = residuals(self.sights, estimate, self.end.residuals.feet)
        known = np.isfinite(there.points[self.sights.point_rows]), np.isfinite(there.curves[self.sights.curve_rows])
        if not (known[0].all() and known[1].all()):
            raise DegenerateError("cannot show all that another lens shows")
        return there


def _or_failed(near_best: Callable[[], Kind], forms: tuple[Form, ...], start: Estimate) -> Kind:
    """Return a kind near its minimum, or with the reason why it failed."""
    found = attempt(near_best)  # reads: "..." beside that lens, why it failed
    return Kind(forms, start, failed=str(found)) if isinstance(found, CalibrationError) else found


def _placed(sights: Sights) -> Mask:
    """(S,) which sights are held out whole: those of placements, where there are enough of them."""
    fewest_placements = 8  # with fewer the features of each are held out one by one
    placed = np.array([key.placement is not None for key in sights.keys], dtype=bool)
    return placed & (np.count_nonzero(placed) >= fewest_placements)


# Fewer groups do not distinguish lenses. Estimates from seven corners were 3.3 times as far off as stated with the
# paper's lens alone, and 1.1 times with the lenses that they were compared with.
_FEWEST_GROUPS = 6


def _groups_of(sights: Sights) -> Sights:
    """Return a sight for each group: a placement, or a feature of a fixed target; half a line where these are few."""
    placed = _placed(sights)
    groups = sights.by_feature(placed)
    return groups if len(groups) >= _FEWEST_GROUPS else sights.by_feature(placed, halved=True)


def require_groups(sights: Sights) -> None:
    """Raise DegenerateError where there are too few groups to hold out."""
    if len(_groups_of(sights)) < _FEWEST_GROUPS:
        raise DegenerateError(TOO_FEW)
