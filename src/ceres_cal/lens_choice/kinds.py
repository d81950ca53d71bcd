"""Each kind of lens near its best, and what follows for each of its lenses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.errors import CalibrationError, DegenerateError
from ceres_cal.base.tails import upper_tail
from ceres_cal.base.transforms import Poses
from ceres_cal.lens_choice.forms import PAPER, Form, kinds
from ceres_cal.lens_choice.rule import AS_GOOD, CLEARLY, standard_errors, surprise
from ceres_cal.model.equations import Equations, write_equations
from ceres_cal.model.parameters import Estimate, Options, make_layout
from ceres_cal.model.priors import gather_priors
from ceres_cal.model.quantities import moved, values_of
from ceres_cal.model.residuals import Residuals, residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.observations.thinning import thinned
from ceres_cal.solve import Problem, RobustSolution, solve, solve_robustly
from ceres_cal.solve.left_out import GroupNormals, group_normals
from ceres_cal.solve.linear_model import equation_weights
from ceres_cal.start.initialise import LensProfile, edge_over, initialise

_LEAST_ROWS, _SHARE, _FEWEST_FRAMES = 1_000, 0.025, 24  # of the observations, how many take part
_FEWEST_GROUPS = 8  # with fewer nothing tells lenses apart
# What shows any direction and comes near to any lens but for its decentring: the first solve is with it.
_WIDEST = "kannala-brandt"
# Share of its squares: a kind that leaves less is solved instead, for it may have other inliers.
_QUIETER = 0.7
_MOST_ROUNDS = 8
_SOUND_PX = 1.0  # noise beyond which a first solve may have ended in a wrong valley: others are tried from nothing
_PRECISION = 1e-2  # relative change of the cost from which on normal equations say where the least is
_MOST_STEPS = 10  # a kind that takes more is no lens for these observations
_KEPT = 1.5  # times the squares that normal equations promise: what leaves more is not the lens that was compared
# Probability of what a lens leaves more than a longer one, under which it is no lens for these observations. At 0.001
# halves of real sets took a lens too simple, 4 to 5 standard deviations off; at 0.02 the paper's is still recognised.
_REFUTED = 0.02
_FEWEST_PLACEMENTS = 8  # with fewer the features of each are held out one by one


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of lens near its best, and what follows for each of its lenses.

    Attributes:
        forms: the longest first. normals: None where it gives no answer, and `failed` says why. sigma_px: of a typical
            observation. reach_px: how far from its principal point each camera's observations reach.
    """

    forms: tuple[Form, ...]
    estimate: Estimate
    normals: GroupNormals | None = None
    sigma_px: float = np.nan
    reach_px: Mapping[str, float] = field(default_factory=dict)
    failed: str = ""

    @property
    def least(self) -> float:
        """The least squares of its longest lens."""
        return np.inf if self.normals is None else self.normals.least

    def candidates(self, *, first: bool) -> Iterator[Candidate]:
        """The longest lens of the kind and the paper's, or all others."""
        for form in self.forms:
            if first == (form is self.forms[0] or form.label == PAPER):
                yield self._judged(form)

    def _judged(self, form: Form) -> Candidate:
        """A lens with its errors of prediction."""
        if self.normals is None:
            return Candidate(form, self, failed=self.failed)
        lens = set(self.forms[0].names) - set(form.names)
        held = [key for key in self.normals.keys if key.kind == "camera" and key.quantity in lens]
        squares, step = self.normals.held_out(dict(zip(held, -values_of(self.estimate, held), strict=True)))
        rms_px = self.sigma_px * float(np.sqrt(squares.sum() / self.normals.counts.sum()))
        least = self.normals.squares_at(step)
        return Candidate(form, self, surprise(squares, self.normals.counts), rms_px, step, least)

    @cached_property
    def scatter(self) -> float:
        """Mean of the variances of its coefficients as groups scatter, over those by the noise alone; at least 1."""
        if self.normals is None:
            return 1.0
        names = set(self.forms[0].names)
        own = [i for i, key in enumerate(self.normals.keys) if key.kind == "camera" and key.quantity in names]
        return max(1.0, self.normals.scatter_of(np.array(own)))


@dataclass(frozen=True, eq=False)
class Candidate:
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
        return more > 0 and upper_tail((other.least - self.least) / self.of.scatter, more) < _REFUTED

    def may_win(self, best: Candidate | None) -> bool:
        """Whether it is the longest of a kind whose shorter ones may be as good as the best."""
        if self.form is not self.of.forms[0] or self.of.normals is None:
            return False
        if best is None or best.squares is None or self.squares is None:
            return True
        return standard_errors(self.squares, best.squares) <= AS_GOOD

    def clearly_beats(self, other: Candidate) -> bool:
        """Whether it predicts so much better that a lens which few programs know is worth it."""
        if self.squares is None or other.squares is None or self.fault:
            return False
        return standard_errors(other.squares, self.squares) > AS_GOOD and self.rms_px < CLEARLY * other.rms_px

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

    @cached_property
    def fault(self) -> str:
        """Why it cannot be used, "" where it can."""
        try:
            cameras = self.estimate.cameras
        except CalibrationError as error:
            return str(error)
        for name, reach_px in self.of.reach_px.items():
            camera = cameras[name]
            if camera.folds and (not camera.lens.may_fold or camera.lens.monotone_radius(camera.phi) <= reach_px):
                return "folds inside the image"
        return ""


def compared_kinds(observations: Observations, options: Options, start: Estimate) -> tuple[Seen, list[Kind], float]:
    """The observations that take part, each kind near its best over them, at the noise of the one that explains the
    most, and their share of all.

    Raises:
        CalibrationError: too little to tell lenses apart, or no calibration.
    """
    every = sorted(kinds(), key=lambda forms: forms[0].lens != _WIDEST)
    total = len(observations.points) + len(observations.curves)
    few = thinned(observations, max(_LEAST_ROWS, int(_SHARE * total)), _FEWEST_FRAMES)
    sights = gather_sights(few)
    _require_groups(sights)
    names = list(dict.fromkeys(key.placement for key in sights.keys if key.placement is not None))
    start = replace(start, placements=Poses.stacked(names, Poses.of(start.placements).of_names(names)))
    tried = every
    while True:
        end, used = _solved(few, options, sights, start, tried)
        seen = Seen(few, end, options)
        compared = [seen.kind(forms, is_solved=forms is used) for forms in every]
        best = min(compared, key=lambda one: one.least)
        least = next(one.least for one in compared if one.forms is used)
        if len(tried) == 1 or best.least > _QUIETER * least:
            return seen, compared, (len(few.points) + len(few.curves)) / total
        tried = [best.forms]


_Found = tuple[RobustSolution, tuple[Form, ...]]


def _solved(
    observations: Observations, options: Options, sights: Sights, start: Estimate, kinds: Sequence[tuple[Form, ...]]
) -> _Found:
    """The robust solve with the first of these kinds that explains the observations, or with the one that does it best,
    up to where the noise is known well enough.
    """
    failure: CalibrationError | None = None
    found: list[_Found] = []
    for forms, from_nothing in [(kinds[0], False), *((forms, True) for forms in kinds)]:
        own = forms[0].of(options)
        try:
            near = initialise(observations, sights, own).estimate if from_nothing else start
            near = seen_through(near, own, _profiles(near, sights))
            problem = problem_of(observations, sights, own, near)
            most_rounds = _MOST_ROUNDS if from_nothing else 1
            end = solve_robustly(problem, observations, near, most_rounds=most_rounds)
        except CalibrationError as error:
            failure = error
            continue
        if _noise_px(end) < _SOUND_PX:
            return end, forms
        found.append((end, forms))
    if not found:
        raise failure or DegenerateError("there is no lens")
    return min(found, key=lambda one: _noise_px(one[0]))


def _noise_px(end: RobustSolution) -> float:
    """Of a typical observation."""
    sights, inliers = end.problem.sights, end.inliers
    sigmas = inliers.point_scale * sights.sigma_px, inliers.curve_scale * sights.curve_sigma_px
    return float(np.exp(np.mean(np.log(np.concatenate(sigmas)))))


def problem_of(observations: Observations, sights: Sights, options: Options, estimate: Estimate) -> Problem:
    """What is minimised, before anything was weighed."""
    priors = gather_priors(observations, options, estimate.structure)
    return Problem(sights, make_layout(observations, options), priors, options=options)


def _profiles(estimate: Estimate, sights: Sights) -> dict[str, LensProfile]:
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
        blank = options.blank_lens.spanning(float(profile.angles[-1]), phi, edge)
        lens = profile.nearest(blank, phi, options.held)
        cameras[name] = replace(cameras[name], lens=lens)
    return replace(estimate, cameras=cameras)


@dataclass(frozen=True, eq=False)
class Seen:
    """The inliers of a solve."""

    observations: Observations
    end: RobustSolution
    options: Options

    @property
    def sights(self) -> Sights:
        return self.end.problem.sights

    @cached_property
    def _profiles(self) -> dict[str, LensProfile]:
        return _profiles(self.end.solution.estimate, self.sights)

    def kind(self, forms: tuple[Form, ...], *, is_solved: bool) -> Kind:
        """A kind near its best, and the normal equations of each group there; `is_solved`: the one that was solved."""
        options = replace(forms[0].of(self.options), max_iterations=_MOST_STEPS)
        estimate = self.end.solution.estimate
        try:
            problem = self._problem(options, estimate)
            if not is_solved:
                estimate = seen_through(estimate, options, self._profiles)
                self._shown(estimate)
                estimate = solve(problem, estimate, precision=_PRECISION, is_near=False).estimate
            return self._near_best(forms, problem, estimate)
        except CalibrationError as error:
            return Kind(forms, estimate, failed=str(error))

    def solved(self, forms: tuple[Form, ...], near: Estimate) -> Kind:
        """A kind whose roughness the data tell, by all rounds of a robust solve from an estimate with another lens."""
        options = forms[0].of(self.options)
        estimate = seen_through(near, options, _profiles(near, self.sights))
        try:
            problem = problem_of(self.observations, gather_sights(self.observations), options, estimate)
            end = solve_robustly(problem, self.observations, estimate, most_rounds=_MOST_ROUNDS)
            estimate = end.solution.estimate
            problem = replace(self._problem(options, estimate), smoothness=end.problem.smoothness)
            return self._near_best(forms, problem, estimate)
        except CalibrationError as error:
            return Kind(forms, estimate, failed=str(error))

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

    def keeps(self, candidate: Candidate) -> bool:
        """Whether a lens leaves no more than the normal equations of a longer one promised, at once or when solved."""
        with suppress(CalibrationError):
            points, curves = self.in_sigmas(candidate.estimate)
            if np.sum(points**2) + curves @ curves <= _KEPT * candidate.least:
                return True
            options = replace(candidate.form.of(self.options), max_iterations=_MOST_STEPS)
            problem = self._problem(options, candidate.estimate)
            return 2.0 * solve(problem, candidate.estimate, precision=_PRECISION).cost <= _KEPT * candidate.least
        return False

    def _problem(self, options: Options, estimate: Estimate) -> Problem:
        """All inliers weigh the same with every kind: what one of them misses must not weigh less with it."""
        problem = problem_of(self.observations, self.sights, options, estimate)
        return problem.weighted(replace(self.end.problem.weighting, loss="trivial"))

    def _near_best(self, forms: tuple[Form, ...], problem: Problem, estimate: Estimate) -> Kind:
        normals, sigma_px = self._normals(problem, estimate, self._shown(estimate))
        reach_px = {name: profile.reach_px for name, profile in self._profiles.items()}
        return Kind(forms, estimate, normals, sigma_px, reach_px)

    def _shown(self, estimate: Estimate) -> Residuals:
        """The residuals there; DegenerateError where something is not seen."""
        there = residuals(self.observations, self.sights, estimate, self.end.residuals.feet)
        known = np.isfinite(there.points[self.sights.point_rows]), np.isfinite(there.curves[self.sights.curve_rows])
        if not (known[0].all() and known[1].all()):
            raise DegenerateError("cannot show all that another lens shows")
        return there

    def _normals(self, problem: Problem, estimate: Estimate, there: Residuals) -> tuple[GroupNormals, float]:
        """The normal equations of each group, and the sigma of a typical observation, px."""
        equations = write_equations(self.observations, self.sights, estimate, there)
        weights = equation_weights(self.observations, problem.weighting, equations, there)
        normals = group_normals(problem, estimate, equations, weights, _groups(equations, problem))
        return normals, 1.0 / float(np.mean(weights.inverse_sigma))


def _placed(sights: Sights) -> Mask:
    """(S,) which sights are held out whole: those of placements, where there are enough of them."""
    placed = np.array([key.placement is not None for key in sights.keys])
    return placed & (np.count_nonzero(placed) >= _FEWEST_PLACEMENTS)


def _require_groups(sights: Sights) -> None:
    """Raise DegenerateError where there is too little to hold out."""
    placed = _placed(sights)
    count = int(np.count_nonzero(placed))
    for own in (sights[int(number)] for number in np.flatnonzero(~placed)):
        count += len(np.unique(own.point_index)) + len(np.unique(own.track_index))
    if count < _FEWEST_GROUPS:
        raise DegenerateError("too few views or features to tell lenses apart")


def _groups(equations: Equations, problem: Problem) -> tuple[Indices, frozenset[str | None]]:
    """(E,) number of the placement of each equation, or, of what stays where it is, of the feature; and the private
    placements that are held out whole.
    """
    placed = _placed(equations.sights)
    feature = 2 * equations.feature + equations.is_curve + 1
    name = equations.sight * (feature.max() + 1) + np.where(placed[equations.sight], 0, feature)
    return np.unique(name, return_inverse=True)[1], problem.private if placed.any() else frozenset()
