"""Does a calibration still hold? A test of each station's pose and phi against new observations (design, section 10).

What was known and what the new observations say are two statements about the same numbers; whether they differ in pose
and phi by more than both leave open is asked at the noise, and with the dependence, that the new observations show. The
calibration's own error is the same in every check: it counts as large as it may be.

And how well cameras explain observations that they were not calibrated from: intrinsics held, poses at their best.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from ceres_cal.base import Array, DegenerateError, Frozen, InputError, Mask, Pose, numerical, or_none, replace, rms
from ceres_cal.base.typed import checked
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.solving import Task, solved_from
from ceres_cal.effects.dependence import measure_scatter
from ceres_cal.moves.agreement import (
    FALSE_ALARMS,
    NOISIER,
    Agreement,
    Agreements,
    Contrast,
    MapChange,
    Misfit,
    NormalDistribution,
    change_of,
    contrast,
    field_grids,
    matched,
    price_nats,
    require_posterior,
    require_stations,
)
from ceres_cal.moves.poses import PoseCandidate, PoseSearch, moved_from, moved_words, pose_candidates
from ceres_cal.observations import Observations, Sights, gather_sights
from ceres_cal.problem import EXACT, Estimate, Information, Key, Options, Station, layout_of, make_layout, solve
from ceres_cal.problem.priors import GaussianPrior, gather_priors, tolerances
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.reduced import information
from ceres_cal.problem.residuals import Residuals, residuals
from ceres_cal.start.initialise import Start
from ceres_cal.start.world import chained_poses

# Of 2000 clean distances to a curve one is longer. At half of it too many good ones go, and false alarms rise (0.05
# -> 0.075 of 80 cases); at double nothing changes.
_INLIER_SIGMA = 3.5
# Of observations that fit somewhere; with fewer than half nothing is understood. Nothing changes from 0.33 to 0.67.
_LEAST_SHARE = 0.5
# Spare equations that the calibration's noise counts as: a few new ones that agree by chance do not make it 0.
_USUAL_EQUATIONS = 4.0


@checked
@numerical("the check")
def check(
    calibration: Calibration, observations: Observations, false_alarms: float = FALSE_ALARMS, checks: int = 1
) -> Agreements:
    """Test whether a calibration still holds for new observations of its stations.

    Seven numbers of each station that was observed are tested at once: its pose and its camera's phi. Noise and
    dependence are those of the new observations. Outliers are those that no pose near by explains. A yes means that
    these observations show no movement, not that there is none: see the sizes.

    Args:
        false_alarms: how often an unmoved set of cameras may be said to have moved at least once in so many `checks`
            with the same calibration; shared among checks and stations. One calibration in 20 is so far off that it
            may come more often.

    Raises:
        InputError: a station that the calibration does not have, or that it says nothing of.
        SolutionError: another camera or another field than those calibrated.
    """
    if not 0.0 < false_alarms < 1.0:
        raise InputError(f"false_alarms must be a probability between 0 and 1, not {false_alarms}")
    if checks < 1:
        raise InputError(f"checks must be 1 or more, not {checks}")
    require_posterior(calibration)
    observed = matched(calibration, observations)
    require_stations(calibration, observed)
    sights = gather_sights(observed)
    world = sights.of_world
    for name in observed.stations:
        if name not in world:
            raise InputError(f"station {name!r} sees nothing that lies in the world: observe the field with it")
    level = false_alarms / (len(world) * checks)
    stations = {name: _checked(calibration, sight, level) for name, sight in world.items()}
    return Agreements(stations, false_alarms, checks)


# ---- one station ----------------------------------------------------------------------------------------------------


class _CheckCase(Frozen):
    """One station's new observations and what was known of its numbers."""

    calibration: Calibration
    sight: Sights
    estimate: Estimate
    prior: GaussianPrior
    tested: tuple[Key, ...]

    @property
    def name(self) -> str:
        return self.sight.key.station

    @property
    def station_keys(self) -> tuple[Key, ...]:
        """The tested numbers that are the station's."""
        return tuple(key for key in self.tested if key.kind == "station")

    def problem(self, used: Sights, freed: Collection[Key] = (), noise: float = 1.0) -> Problem:
        """The station's pose and its camera's intrinsics from what is used, under what was known of all but the freed
        numbers. `noise`: times that of the calibration.
        """
        layout = layout_of(self.prior.keys, self.estimate)
        fresh = tolerances(self.estimate.structure, self.prior.keys)
        points, curves = self.calibration.fit.scales
        weighting = Weighting(noise * points, noise * curves, "trivial")
        return Problem(used, layout, (self.prior.without(freed), *fresh), weighting, self.calibration.options)

    @or_none  # reads: "check no ..." that nothing explains the observations
    def least(self, used: Sights, freed: Collection[Key], pose: Pose) -> tuple[float, Estimate] | None:
        """Twice the least cost, and where, from a pose; None where the solver does not get there."""
        station = replace(self.estimate.stations[self.name], cam_from_world=pose)
        start = replace(self.estimate, stations={self.name: station})
        solution = solve(self.problem(used, freed), start)
        return None if solution.failed else (2.0 * solution.cost, solution.estimate)

    def known(
        self, used: Sights, freed: Collection[Key], estimate: Estimate, keys: tuple[Key, ...]
    ) -> tuple[Information, Array]:
        """What was known before of all but the freed numbers, over some keys: information, and estimate less mean."""
        whole, offsets = Information.nothing(keys), np.zeros(len(keys))
        for prior in self.problem(used, freed).priors_at(estimate):  # no two of them speak of the same number
            whole += prior.information
            offsets[whole.columns(prior.keys)] = prior.offsets(estimate)
        return whole, offsets


def _case(calibration: Calibration, sight: Sights) -> _CheckCase:
    key, old, posterior = sight.key, calibration.estimate, calibration.uncertainty.posterior
    own = posterior.keys_of(old, key.station)
    if not posterior.knows_station(key.station):
        raise InputError(f"station {key.station!r} was held as the world: it cannot be said to have moved")
    structure = calibration.options.structure_of(sight.observations.targets).carrying(old.structure)
    estimate = Estimate({key.camera: old.cameras[key.camera]}, {key.station: old.stations[key.station]}, {}, structure)
    kept = [k for k in posterior.keys if k in own or k.is_structure]
    # Another lens may be the right one, and from straight above another phi with another pose; but then the new
    # observations are seen through that as well. By all that may be together no floor is known to a millimetre.
    prior = calibration.prior_of(kept, of_lens=True)
    if key.camera in posterior.followed:
        across = posterior.of_lens.given([k for k in posterior.keys if k not in posterior.followed_phi])
        prior = GaussianPrior.about(across.marginal(across.among(kept)), old)
    tested = tuple(k for k in prior.keys if k.kind == "station" or k.quantity == "phi")
    return _CheckCase(calibration, sight, estimate, prior, tested)


def _checked(calibration: Calibration, sight: Sights, level: float) -> Agreement:
    case = _case(calibration, sight)
    search = PoseSearch(sight, case.estimate, calibration.fit.scales)
    near = pose_candidates(search, [case.estimate.stations[case.name].cam_from_world], patience=0)
    used = sight.used(*_inliers(search, near[0])) if near else sight[:0]
    inside, count = (len(s.point_rows) + len(s.curve_rows) for s in (used, sight))
    misfit = Misfit(len(used.point_rows), len(used.curve_rows), count - inside)
    # With phi under what is known of it: next to it a height says little, and far along that valley nothing is linear.
    posed = case.least(used, case.station_keys, near[0].pose) if inside >= _LEAST_SHARE * count else None
    if posed is None:
        return _not_understood(case, misfit)
    noise, apart = _apart(case, used, *posed)
    holds = apart.probability >= level
    zoomed = None if holds else case.least(used, case.tested, near[0].pose)
    will_do = zoomed is None or posed[0] - zoomed[0] < 2.0 * price_nats(1, inside) * noise**2
    anew, freed = (posed[1], ()) if will_do or zoomed is None else (zoomed[1], case.tested)
    prior, posterior = case.prior.without(set(freed) - set(case.station_keys)), calibration.uncertainty.posterior
    shift_m, turn = moved_from(prior, posterior, case.name, anew)
    misfit = replace(misfit, noise=(noise, noise))
    grids = field_grids(calibration.targets)
    change = change_of(case.estimate, case.name, anew.camera_at(case.name), grids)
    change = replace(change, moved_mm=1e3 * shift_m, turned_deg=math.degrees(turn))
    return Agreement(
        name=case.name,
        holds=holds,
        probability=apart.probability,
        statistic=apart.statistic,
        degrees=apart.degrees,
        words=_words(case, holds, apart.probability, misfit, change),
        change=change,
        misfit=misfit,
    )


def _apart(case: _CheckCase, used: Sights, least: float, estimate: Estimate) -> tuple[float, Contrast]:
    """The noise, in that of the calibration, and how far what was known and what is seen now are apart.

    Args:
        least: twice the least cost with the pose free. estimate: there.
    """
    freedom = max(used.equations - len(case.station_keys), 0) + _USUAL_EQUATIONS
    noise = math.sqrt((least + _USUAL_EQUATIONS) / freedom)
    problem = case.problem(used, case.station_keys, noise)
    reduced = information(problem, estimate)
    seen, keys = reduced.points + reduced.curves, reduced.shared.keys
    # At its end the solve's priors pull as much as the observations do, at the noise that they had there.
    earlier, offsets = case.known(used, case.station_keys, estimate, keys)
    best = seen.inverse @ (earlier.matrix @ offsets) / noise**2
    scatter = measure_scatter(problem, residuals(used, estimate), estimate, reduced)
    if scatter is not None:
        seen = scatter.widened(seen)
        freedom = 1.0 / (1.0 / freedom + scatter.dependence.inverse_freedom)
    before = case.calibration.uncertainty.posterior.degrees_of_freedom
    old = NormalDistribution(*case.known(used, (), estimate, keys), before)
    return noise, contrast(old, NormalDistribution(seen, -best, freedom), case.tested)


def _inliers(search: PoseSearch, near: PoseCandidate) -> tuple[Mask, Mask]:
    """Which rows of the observations a pose near by explains."""
    sight, observations = search.sight, search.sight.observations
    points, curves = (np.zeros(len(c), dtype=bool) for c in (observations.points, observations.curves))
    limit = _INLIER_SIGMA * max(1.0, min(near.scale, 2.0))
    in_points, in_curves = search.residuals(near.pose).in_sigmas(sight, search.scales)
    points[sight.point_rows], curves[sight.curve_rows] = in_points <= limit, in_curves <= limit  # NaN is not
    return points, curves


# ---- in words -------------------------------------------------------------------------------------------------------


def _not_understood(case: _CheckCase, misfit: Misfit) -> Agreement:
    inside = misfit.points + misfit.curves
    words = (
        f"moved far, or not understood: only {inside} of {inside + misfit.outliers} observations fit the known lens "
        "from anywhere near: refit, or check labels and camera"
    )
    return not_found(case.name, words, misfit)


def not_found(station: str, words: str, misfit: Misfit | None = None) -> Agreement:
    """A station that does not hold, of whose movement nothing is known."""
    answer = Agreement(name=station, holds=False, probability=0.0, statistic=np.inf, words=words)
    return answer if misfit is None else replace(answer, misfit=misfit)


def _words(case: _CheckCase, holds: bool, probability: float, misfit: Misfit, change: MapChange) -> str:
    many_outliers = 0.25
    worst_mm = change.maps[0].worst_mm if change.maps else np.nan  # of a station that sees none of a field
    if holds:
        at_most = f"{worst_mm:.1f} mm on the floor at most, " if np.isfinite(worst_mm) else ""
        words = f"holds: no movement beyond what is known ({at_most}probability {probability:.2g})"
        if misfit.noise[0] > NOISIER:
            noisy = f"; but the noise is {misfit.noise[0]:.1f} times that of the calibration"
            words += f"{noisy}: where the focus or the iris may have changed, `refit` says so"
    else:
        shifts = f", which shifts the map by up to {worst_mm:.1f} mm on the floor" if np.isfinite(worst_mm) else ""
        moved = moved_words(1e-3 * change.moved_mm, change.turned_deg, "about ") + shifts
        words = f"no longer holds: {moved} (probability {probability:.1g})"
    count = misfit.points + misfit.curves + misfit.outliers
    if misfit.outliers > many_outliers * count:
        words += f"; but {misfit.outliers} of {count} observations fit nowhere: check labels"
    return words


# ---- how well a calibration predicts --------------------------------------------------------------------------------


@checked
@numerical("the score")
def score(
    calibration: Calibration, observations: Observations, *, options: Options | None = None, hold_stations: bool = False
) -> Agreements:
    """How well new observations of fields or boards agree with a calibration: poses alone are solved for.

    Targets are taken as the calibration says that they were built. A calibration of another program will do. The
    answers are those of its cameras, with what each view leaves, the worst first, and the poses that suit the
    observations best (`solution`). Whether the calibration holds is not decided: the noise says how well.

    Args:
        options: loss and rejection; those of the calibration by default.
        hold_stations: stations stand where the calibration has them, so that only boards are posed: the poses of a
            rig's cameras, or of a camera over its field, are tested, too.

    Raises:
        InputError: a camera, or a station that is held, which the calibration does not have.
        DegenerateError: naming the sight whose pose the observations do not determine.
        SolutionError: another camera or target than those calibrated, or intrinsics that do not explain them at all.
    """
    observed = matched(calibration, observations)
    given = replace(options or calibration.options, lens=calibration.options.lens, tolerances={}, dimensions=())
    sights = sights_as_built(observed, calibration)
    if hold_stations:
        require_stations(calibration, observed)
    known = {name: calibration.estimate.stations[name] for name in observed.stations} if hold_stations else {}
    layout = make_layout(observed, given)
    layout = replace(
        layout,
        free={name: np.empty(0, dtype=np.int64) for name in layout.free},
        stations=layout.stations - known.keys(),
    )
    if not layout.size:
        raise InputError("with its stations held nothing is left to be posed: `ceres-cal check` is for that")
    start = Start(_start(calibration, sights, known), calibration.phi_from)
    priors = gather_priors(observed, given, EXACT)
    posed = solved_from(Task(tested=False, before=layout), start, Problem(sights, layout, priors, options=given))
    left = residuals(sights, posed.estimate)
    noise = _noise_ratios(posed, calibration)
    views = [(view.camera, _view(number, observed, left, posed, noise)) for number, view in enumerate(observed.views)]
    views.sort(key=lambda one: -one[1].misfit.all_rms_px)
    answers = {}
    for name in posed.cameras:
        own = np.array([view.camera == name for view in observed.views])
        misfit = _misfit(own, observed, left, posed, noise)
        its = tuple(view for camera, view in views if camera == name)
        answers[name] = Agreement(name=name, misfit=misfit, views=its, pose_free=True, solution=posed)
    return Agreements(answers)


def sights_as_built(observations: Observations, calibration: Calibration) -> Sights:
    """The sights of targets as the calibration says that they were built."""
    sights = gather_sights(observations)
    built = calibration.options.structure_of(observations.targets).carrying(calibration.estimate.structure)
    return built.built_into(sights)


def _start(calibration: Calibration, sights: Sights, known: Mapping[str, Station]) -> Estimate:
    """Every sight's pose under the calibrated lens, chained into stations and placements."""
    stations = {name: Station(camera, Pose.identity()) for name, camera in sights.observations.stations.items()}
    cameras = {name: calibration.cameras[name] for name in sights.observations.cameras}  # some of a rig's
    blank = Estimate(cameras, stations, {}, EXACT)
    numbers, poses = [], []
    for number, key in enumerate(sights.keys):
        old = calibration.estimate.stations.get(key.station)
        before = [old.cam_from_world] if old is not None and key.placement is None else []
        candidates = pose_candidates(PoseSearch(sights[number], blank, (1.0, 1.0)), before)
        if candidates:
            numbers.append(number)
            poses.append(candidates[0].pose.matrix)
    if not poses:
        raise DegenerateError(
            f"{sights.keys[0]}: its pose is not determined: show four points or more, not on one line"
        )
    stations, placements = chained_poses(sights, np.array(numbers), np.array(poses), known)
    return Estimate(cameras, stations, placements, EXACT)


# ---- what is left ---------------------------------------------------------------------------------------------------


def _noise_ratios(posed: Calibration, before: Calibration) -> tuple[float, float]:
    """Noise of points and of curves over that of the calibration, px over px; NaN where either has none."""
    pairs = zip(posed.fit.noise_px, before.fit.noise_px, strict=True)
    points, curves = (new / old if new > 0.0 and old > 0.0 else float("nan") for new, old in pairs)
    return points, curves


def _view(
    number: int, observations: Observations, left: Residuals, posed: Calibration, noise: tuple[float, float]
) -> Agreement:
    view = observations.views[number]
    name = f"frame {view.frame!r} of station {view.station!r}, {view.target}"
    here = np.arange(len(observations.views)) == number
    return Agreement(name=name, misfit=_misfit(here, observations, left, posed, noise), pose_free=True)


def _misfit(
    views: Mask, observations: Observations, left: Residuals, posed: Calibration, noise: tuple[float, float]
) -> Misfit:
    own = views[observations.points.view], views[observations.curves.view]
    kept = posed.inlier_masks(observations)
    inside = [lengths[mine & used] for lengths, mine, used in zip(left.lengths, own, kept, strict=True)]
    every = np.nan_to_num(
        np.concatenate([lengths[mine] for lengths, mine in zip(left.lengths, own, strict=True)]), nan=np.inf
    )
    points, curves = inside
    outliers = len(every) - len(points) - len(curves)
    return Misfit(len(points), len(curves), outliers, rms(points, 0.0), rms(curves, 0.0), rms(every, 0.0), noise)
