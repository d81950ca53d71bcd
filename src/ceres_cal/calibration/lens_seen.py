"""What a solve saw: each kind of lens near its best, and what follows for each of its lenses."""

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

# Probability of what a lens leaves more than a longer one, under which it is no lens for these observations. At 0.01
# the paper's is missed more often, and seams in a carpet are decentring; at 0.001, by a scatter that one group could
# swell, halves of real sets took a lens too simple.
_REFUTED = 0.003
_UNSEEN_GROUPS = 10.0  # so many that scatter as the noise has it stand beside those that were seen: a dozen vary


class Kind(Frozen):
    """A kind of lens near its best, and what follows for each of its lenses.

    Attributes:
        forms: the longest first. normals: None where it gives no answer, and `failed` says why. sigma_px: of a typical
            observation. reach_px: how far from its principal point each camera's observations reach.
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
        """The share of its least squares by which these may fall yet: a solve in a valley falls by little at a step."""
        return 0.0 if self.normals is None else float(self.normals.squares.sum()) / self.normals.least - 1.0

    @property
    def least(self) -> float:
        """The least squares of its longest lens."""
        return np.inf if self.normals is None else self.normals.least

    def candidates(self, *, first: bool) -> list[Candidate]:
        """The longest lens of the kind and the paper's, or all others, with their errors of prediction."""
        return [one for one in self._every if first == (one.form is self.forms[0] or one.form.label == PAPER)]

    @cached_property
    def _every(self) -> list[Candidate]:
        """All of its lenses, which together take hardly longer than one."""
        if self.normals is None:
            return [Candidate(form, self, failed=self.failed) for form in self.forms]
        counts, (squares, steps) = self.normals.counts, self.normals.held_out([*map(self.to_nothing, self.forms)])
        rms_px = self.sigma_px * np.sqrt(np.maximum(squares.sum(axis=1), 0.0) / counts.sum())
        each = zip(self.forms, surprise(squares, counts), rms_px.tolist(), steps, strict=True)
        return [Candidate(form, self, own, rms, at, self.normals.squares_at(at)) for form, own, rms, at in each]

    def slopes(self, lenses: OtherLenses) -> Sequence[Array]:
        """How what pixels show moves with its numbers, see `shown_slopes`."""
        return () if self.normals is None else shown_slopes(self.estimate, self.normals.keys, lenses)

    def to_nothing(self, form: Form) -> dict[Key, float]:
        """How far from where they stand the coefficients that one of its lenses does not have are 0."""
        return {key: step for key, step in self._to_nothing.items() if key.quantity not in form.names}

    @cached_property
    def _to_nothing(self) -> dict[Key, float]:
        """The same of all coefficients of its longest lens."""
        names, every = set(self.forms[0].names), self.normals.keys if self.normals else ()
        keys = [key for key in every if key.kind == "camera" and key.quantity in names]
        return dict(zip(keys, (-values_of(self.estimate, keys)).tolist(), strict=True))

    @cached_property
    def noise(self) -> float:
        """Mean square of what it leaves, over the stated noise: 1 at most, for a first solve with another lens may have
        left more.
        """
        no_noise = 1e-12  # mean square that rounding leaves of exact observations, or less
        if self.normals is None:
            return 1.0
        spare = float(self.normals.counts.sum() - len(self.normals.keys))
        return min(1.0, max(self.least / max(spare, 1.0), no_noise))

    @cached_property
    def scatter(self) -> float:
        """Mean of the variances of its coefficients as groups scatter, over those by the stated noise; at least what
        noise alone makes of it, and the nearer to that the fewer groups there are.
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
        squares: (G,) of each group, in standard deviations; None where it gives no answer, and `failed` says why.
        rms_px: of all. step: from the kind's estimate to where this lens is at its best. least: all squares there.
    """

    form: Form
    of: Kind
    squares: Array | None = None
    rms_px: float = np.nan
    step: Array = field(default_factory=lambda: np.empty(0))
    least: float = np.nan
    failed: str = ""

    def refutes(self, other: Candidate) -> bool:
        """Whether the other lens, which has fewer numbers, leaves more than it may by chance."""
        more = self.form.size - other.form.size
        if more <= 0 or self.squares is None:
            return False
        left, known = other.least - self.least, len(self.squares) + _UNSEEN_GROUPS
        if left <= more * self.of.noise:  # of noise alone every other one leaves as much, which takes no tail
            return False
        # Seldom does it leave more than the noise alone explains, which takes less to know.
        by_noise = upper_tail(left / self.of.noise, more, known) < _REFUTED
        return by_noise and upper_tail(left / self.of.scatter, more, known) < _REFUTED

    def may_win(self, best: Candidate | None) -> bool:
        """Whether it is the longest of a kind whose shorter ones may be as good as the best."""
        if self.form is not self.of.forms[0] or self.of.normals is None:
            return False
        if best is None or best.squares is None or self.squares is None:
            return True
        return standard_errors(self.squares, best.squares) <= AS_GOOD

    def beats(self, other: Candidate, least: float) -> bool:
        """Whether it predicts better by so many standard errors."""
        if self.squares is None or other.squares is None or self.fault:
            return False
        return standard_errors(other.squares, self.squares) > least

    def extends(self, other: Candidate, as_good: float) -> bool:
        """Whether it is the other lens with more coefficients and predicts as well: no data say that these are 0."""
        if self.form.lens != other.form.lens or self.squares is None or other.squares is None:
            return False
        is_longer = {*self.form.names} > {*other.form.names}
        return is_longer and standard_errors(self.squares, other.squares) <= as_good

    @cached_property
    def estimate(self) -> Estimate:
        """Near its best.

        Raises:
            InputError: there is no camera there.
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
        """How all numbers vary with it; None where it gives no answer.

        Args:
            stated: what is known besides. slopes: of its kind.
        """
        if self.of.normals is None:
            return None
        keys = self.of.normals.keys
        besides = stated.marginal(stated.among(keys)).over(keys).matrix
        return LensSpread(self.of.estimate, keys, self.of.normals.root(self.of.to_nothing(self.form), besides), slopes)

    @property
    def is_near(self) -> bool:
        """Whether normal equations have it at its best, but for placements: of boards, where its kind was nearly so.
        Over a floor they lead along a valley, and ten standard deviations off it.
        """
        kind = self.of.normals
        if kind is None or any(key.kind != "camera" for key in kind.keys):
            return False
        return float(kind.squares.sum()) + self.least - 2.0 * self.of.least <= _NEAR

    @cached_property
    def fault(self) -> str:
        """Why it cannot be used, "" where it can."""
        there = attempt(lambda: self.estimate)  # reads: "..." beside that lens, why it failed
        if isinstance(there, CalibrationError):
            return str(there)
        for name, reach_px in self.of.reach_px.items():
            camera = there.cameras[name]
            if camera.folds and (not camera.lens.may_fold or camera.lens.monotone_radius(camera.phi) <= reach_px):
                return "folds inside the image"
        return ""


MOST_ROUNDS = 8  # of a robust solve
_PRECISION = 1e-2  # relative change of the cost from which on normal equations say where the least is
# Share of its squares by which a kind may be off its best, else it is solved for finely: it is up to .06, and three
# times them in a valley of phi over a field, which falls by less than the precision at each step. A lens without k3
# seemed to leave 6 variances more there, not 110.
_FAR = 0.1
# Share of a cost: of a placement's, for from one that is taken for less, whatever the solve does is rejected; and of
# all, where the next step is of a thousandth of a standard deviation.
_AT_BEST = 1e-6
_MOST_STEPS = 10  # a kind that takes more is no lens for these observations
# Variances by which a kind was off its best, and by which one of its lenses is off that. So far a solve moved lenses
# of 24 simulated sets of boards by less than a tenth of a standard deviation, at three times as many by a third.
_NEAR = 4.0
_KEPT = 1.5  # times the squares that normal equations promise: what leaves more is not the lens that was compared


def found(solution: Solution) -> Solution:
    """A solve that came to an end; DegenerateError of one that did not."""
    if solution.failed:
        raise DegenerateError(f"cannot be solved for: {solution.termination}")
    return solution


def _at_best(problem: Problem, estimate: Estimate) -> Estimate:
    return found(solve(problem, estimate, precision=_AT_BEST)).estimate


def profiles_of(estimate: Estimate, sights: Sights) -> dict[str, LensProfile]:
    """What each camera's lens does, as far as it was observed; over its picture where all it showed was taken out."""
    seen = {name: sights.of_camera(name).about(estimate.cameras[name]).reach_px for name in sights.cameras}
    every = estimate.cameras.items()
    return {name: LensProfile.of(camera, seen.get(name, camera.corner_radius)) for name, camera in every}


def seen_through(estimate: Estimate, options: Options, profiles: Mapping[str, LensProfile]) -> Estimate:
    """The estimate with the lens of the options, as near to its own as it comes; DegenerateError: it shows nothing."""
    cameras = dict(estimate.cameras)
    for name, profile in profiles.items():
        if not len(profile.angles):
            raise DegenerateError(f"camera {name!r}: its lens shows nothing that was observed: check pixels and labels")
        phi, edge = cameras[name].phi, edge_over(cameras[name], profile.reach_px)
        blank = options.blank_lens.spanning(float(profile.angles[-1]), phi, edge, cameras[name].image_size)
        lens = profile.nearest(blank, phi, options.held)
        cameras[name] = replace(cameras[name], lens=lens)
    return replace(estimate, cameras=cameras)


class InlierRows(Frozen):
    """The inliers of a solve.

    Attributes:
        every: sights of all the observations, of targets as they are `built`.
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
        """A kind near its best, and the normal equations of each group there; `is_solved`: the one that was solved."""
        options = forms[0].of(self.options, max_iterations=_MOST_STEPS)
        start = self.end.estimate

        def near_best() -> Kind:
            problem, estimate = self._problem(options, start, {}), start
            if not is_solved:
                estimate = seen_through(estimate, options, self._profiles)
                solution = solve(problem, estimate, precision=_PRECISION, is_near=False)
                if solution.failed:
                    self._shown(estimate)  # where that is why, its own words are said
                estimate = found(solution).estimate
            kind = self._near_best(forms, problem, estimate)
            return kind if not kind.may_fall > _FAR else self._near_best(forms, problem, _at_best(problem, estimate))

        return _or_failed(near_best, forms, start)

    def solved(self, forms: tuple[Form, ...], near: Estimate | None) -> Kind:
        """A kind whose roughness the data tell, by all rounds of a robust solve near an estimate or from nothing."""
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
        """The same with what other options hold of cameras."""
        held = {name: getattr(options, name) for name in ("fixed", "free_principal_point")}
        now = replace(self.options, **held)
        return self if now == self.options else replace(self, options=now)

    @property
    def splits_placements(self) -> bool:
        """Whether placements are too few to be held out whole."""
        return any(key.placement for key in self.sights.keys) and not _placed(self.sights).any()

    def in_sigmas(self, estimate: Estimate, scales: tuple[float, float] | None = None) -> tuple[Array, Array]:
        """(N, 2), (M,) residuals of points and curve observations, in standard deviations, by these scales of the noise
        or those of the solve.

        Raises:
            DegenerateError: something is not seen.
        """
        there, sights, scales = self._shown(estimate), self.sights, scales or self.end.problem.weighting.scales
        points = there.points[sights.point_rows] / (scales[0] * sights.sigma_px[:, None])
        return points, there.curves[sights.curve_rows] / (scales[1] * sights.curve_sigma_px)

    @or_none  # quiet: the lens does not reach what was promised, and gives no answer
    def reached(self, candidate: Candidate) -> Estimate | None:
        """Where a lens leaves no more than the normal equations of a longer one promised, at once or when solved."""
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
        """Where a lens is at its best, solved for from where the normal equations have it.

        Args:
            as_promised: whether what leaves more than these promise is no answer.
            there: from where else. held: what stays as it is there.

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
            raise DegenerateError("is not at its best where normal equations have it")
        return solution

    def _kept(self, candidate: Candidate) -> float:
        """Squares up to which a lens is the one that was compared: exact observations leave less than noise would."""
        return _KEPT * max(candidate.least, self.sights.equations)

    def _problem(self, options: Options, estimate: Estimate, smoothness: Mapping[str, tuple[float, ...]]) -> Problem:
        """All inliers weigh the same with every kind: what one of them misses must not weigh less with it."""
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
        """Of a typical observation."""
        sights, (points, curves) = self.sights, self.end.problem.weighting.scales
        inverse = 2.0 * np.sum(1.0 / (points * sights.sigma_px)) + np.sum(1.0 / (curves * sights.curve_sigma_px))
        return sights.equations / float(inverse)

    def _shown(self, estimate: Estimate) -> Residuals:
        """The residuals there; DegenerateError where something is not seen."""
        there = residuals(self.sights, estimate, self.end.residuals.feet)
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
    fewest_placements = 8  # with fewer the features of each are held out one by one
    placed = np.array([key.placement is not None for key in sights.keys], dtype=bool)
    return placed & (np.count_nonzero(placed) >= fewest_placements)


# With fewer nothing tells lenses apart. Seven corners were 3.3 times as far off as stated with the paper's lens alone,
# 1.1 times with the lenses that they were compared with.
_FEWEST_GROUPS = 6


def _groups_of(sights: Sights) -> Sights:
    """A sight of each group: a placement, or, of what stays where it is, a feature; half of a line where these are
    few.
    """
    placed = _placed(sights)
    groups = sights.by_feature(placed)
    return groups if len(groups) >= _FEWEST_GROUPS else sights.by_feature(placed, halved=True)


def require_groups(sights: Sights) -> None:
    """Raise DegenerateError where there is too little to hold out."""
    if len(_groups_of(sights)) < _FEWEST_GROUPS:
        raise DegenerateError(TOO_FEW)
