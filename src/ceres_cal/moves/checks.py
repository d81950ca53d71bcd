"""Does a calibration still hold? A test of each station's pose and lens by new observations (design, section 10).

The posterior and the new observations are two statements about the same numbers. The test is whether they differ by
more than both leave open, in the pose, or in the intrinsics wherever the camera now stands. It uses the noise and the
dependence of the new observations. The calibration's own error is the same in every check: it counts as large as it may
be.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from ceres_cal.base import Array, Frozen, InputError, Mask, Pose, checked, log_f_tail, numerical, or_none, replace
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibration import loosened
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
from ceres_cal.moves.explanations import WORDS
from ceres_cal.moves.poses import (
    NOISES,
    PoseCandidate,
    PoseSearch,
    alike,
    least_moved,
    moved_from,
    moved_words,
    pose_candidates,
)
from ceres_cal.observations import Observations, Sights, gather_sights
from ceres_cal.problem import Estimate, Information, Key, Problem, Weighting, layout_of, solve
from ceres_cal.problem.priors import GaussianPrior, tolerances
from ceres_cal.problem.reduced import information
from ceres_cal.problem.residuals import residuals

# Sigmas up to which an observation is an inlier: of 2000 clean distances to a curve one is longer. At half of it too
# many good ones are rejected, and false alarms rise (0.05 -> 0.075 of 80 cases); at double nothing changes.
_INLIER_SIGMA = 3.5
# Share of the observations that must fit some pose; otherwise the station is not understood. Nothing changes from 0.33
# to 0.67.
_LEAST_SHARE = 0.5
# Standard deviations (m and rad) of a pose that few observations leave open, around the old one. Of 640 unmoved cameras
# with few lines or clicks none is said to have moved; at three times this 2, without a bound 64.
_NEARBY = (0.1, math.radians(5.0))
# Spare equations with which the calibration's noise counts, so that a few new ones that agree by chance do not make it
# 0.
_USUAL_EQUATIONS = 4.0


@checked
@numerical("the check")
def check(
    calibration: Calibration, observations: Observations, false_alarms: float = FALSE_ALARMS, checks: int = 1
) -> Agreements:
    """Test whether a calibration still holds for new observations of its stations.

    For each observed station two things are tested, each at half the level: the six numbers of its pose, and its
    camera's intrinsics, wherever it stands now. Noise and dependence are those of the new observations. Outliers are
    those that no nearby pose explains. A yes means that these observations show no change, not that there is none: see
    the sizes.

    Args:
        false_alarms: probability that an unmoved set of cameras is reported as moved at least once in so many `checks`
            with the same calibration; it is shared among checks and stations. One calibration in 20 is so far off that
            the rate may be higher.

    Raises:
        InputError: a station that the calibration does not have, or whose pose it does not know; or a station that
            seems to have moved where other poses show the same as the calibration's.
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
            raise InputError(f"station {name!r} sees no fixed target: observe the field with it")
    level = false_alarms / (len(world) * checks)
    stations = {name: _checked(calibration, sight, level) for name, sight in world.items()}
    for name in (name for name, answer in stations.items() if answer.holds is False):
        for words in calibration.ambiguities:
            if words.startswith(f"station {name!r}: "):
                raise InputError(f"{words}, and calibrate again: until then a move cannot be detected")
    return Agreements(stations, false_alarms, checks)


# ---- one station ----------------------------------------------------------------------------------------------------


_Fit = tuple[float, Estimate]  # twice a least cost, and the estimate


class _CheckCase(Frozen):
    """One station's new observations and the prior of its numbers."""

    calibration: Calibration
    sight: Sights
    estimate: Estimate
    prior: GaussianPrior

    @property
    def name(self) -> str:
        return self.sight.key.station

    @property
    def station_keys(self) -> tuple[Key, ...]:
        """Keys of the station's pose."""
        return tuple(key for key in self.prior.keys if key.kind == "station")

    @property
    def lens_keys(self) -> tuple[Key, ...]:
        """Keys of the camera's intrinsics in the prior."""
        return tuple(key for key in self.prior.keys if key.kind == "camera")

    @property
    def loosened(self) -> _CheckCase:
        """The case with a wider prior of the intrinsics: just enough to keep a solve from diverging along a valley."""
        # Where a lens has changed, its misfit is no noise. With a factor of 30 the solve diverges along directions that
        # new observations hardly determine, until nothing is linear, and 3 of 15 unmoved cameras seem changed.
        times = 3.0
        scale = [times if key.kind == "camera" else 1.0 for key in self.prior.keys]
        return replace(self, prior=self.prior.widened(np.array(scale)))

    @property
    def nearby(self) -> GaussianPrior:
        """A wide prior of the pose: where few observations leave the pose open, the nearest one that they allow is
        tested, since far along a valley nothing is linear.
        """
        sigmas = {key: _NEARBY[key.unit == "rad"] for key in self.station_keys}
        return GaussianPrior.about(Information.of_sigmas(sigmas), self.estimate)

    def problem(self, used: Sights, freed: Collection[Key] = (), noise: float = 1.0) -> Problem:
        """Return the problem of the station's pose and its camera's intrinsics with some observations, and the prior of
        all but the freed numbers. `noise`: relative to the calibration's.
        """
        layout = layout_of(self.prior.keys, self.estimate)
        nearby = (self.nearby,) if set(self.station_keys) <= set(freed) else ()
        fresh = tolerances(self.estimate.structure, self.prior.keys)
        points, curves = self.calibration.fit.scales
        weighting = Weighting(noise * points, noise * curves, "trivial")
        return Problem(used, layout, (self.prior.without(freed), *nearby, *fresh), weighting, self.calibration.options)

    @or_none  # reads: "check no ..." that nothing explains the observations
    def least(self, used: Sights, freed: Collection[Key], pose: Pose) -> _Fit | None:
        """Return twice the least cost and its estimate, starting at a pose; None where the solver does not converge."""
        station = replace(self.estimate.stations[self.name], cam_from_world=pose)
        start = replace(self.estimate, stations={self.name: station})
        solution = solve(self.problem(used, freed), start)
        return None if solution.failed else (2.0 * solution.cost, solution.estimate)

    def known(
        self, used: Sights, freed: Collection[Key], estimate: Estimate, keys: tuple[Key, ...]
    ) -> tuple[Information, Array]:
        """Return the prior of all but the freed numbers, over some keys: information, and estimate minus mean."""
        whole, offsets = Information.nothing(keys), np.zeros(len(keys))
        for prior in self.problem(used, freed).priors_at(estimate):  # no two of them are about the same number
            whole += prior.information
            offsets[whole.columns(prior.keys)] = prior.offsets(estimate)
        return whole, offsets


def _case(calibration: Calibration, sight: Sights) -> _CheckCase:
    key, old, posterior = sight.key, calibration.estimate, calibration.uncertainty.posterior
    own = posterior.keys_of(old, key.station)
    if not posterior.knows_station(key.station):
        raise InputError(f"station {key.station!r} defines the world: a move of it cannot be detected")
    structure = calibration.options.structure_of(sight.observations.targets).carrying(old.structure)
    estimate = Estimate({key.camera: old.cameras[key.camera]}, {key.station: old.stations[key.station]}, {}, structure)
    kept = [k for k in posterior.keys if k in own or k.is_structure]
    # Another lens may be the right one, and from straight above another phi with another pose; but then the new
    # observations are seen through that lens, too. With all alternatives together no floor would be known to a
    # millimetre.
    prior = calibration.prior_of(kept, of_lens=True)
    if key.camera in posterior.followed:
        across = posterior.of_lens.given([k for k in posterior.keys if k not in posterior.followed_phi])
        prior = GaussianPrior.about(across.marginal(across.among(kept)), old)
    return _CheckCase(calibration, sight, estimate, prior)


def _checked(calibration: Calibration, sight: Sights, level: float) -> Agreement:
    case = _case(calibration, sight)
    (points, curves), old = calibration.fit.scales, [case.estimate.stations[case.name].cam_from_world]
    searches = [PoseSearch(sight, case.estimate, (noise * points, noise * curves)) for noise in NOISES]
    found = [(one, candidates) for one in searches if (candidates := pose_candidates(one, old, patience=0))]
    search, candidates = min(found, key=lambda one: one[1][0].misfit, default=(searches[0], []))
    near = least_moved(alike(candidates), old) if candidates else None
    used = sight[:0] if near is None else sight.used(*_inliers(search, near))
    inside, count = (len(s.point_rows) + len(s.curve_rows) for s in (used, sight))
    misfit = Misfit(len(used.point_rows), len(used.curve_rows), count - inside)
    # phi keeps its prior: a height beside a free phi says little, and far along that valley nothing is linear.
    enough = inside >= _LEAST_SHARE * count
    posed = case.least(used, case.station_keys, near.pose) if near is not None and enough else None
    if posed is None:
        return _not_understood(case, misfit)
    noise, apart = _apart(case, used, posed, case.prior, case.station_keys)
    lensed = case.loosened.least(used, case.station_keys, posed[1].stations[case.name].cam_from_world)
    if lensed is not None:
        anywhere = case.prior.without(case.station_keys)
        of_lens = _apart(case.loosened, used, lensed, anywhere, case.lens_keys)[1]
        apart = min(apart, of_lens, key=lambda one: one.probability)
    least_probable = apart.probability
    if noise > NOISIER:
        least_probable = min(least_probable, _noise_is_no_other_lens(case, used, posed))
    probability = min(2.0 * least_probable, 1.0)  # corrected for two tests
    holds = probability >= level
    cause, estimate = (None, posed[1]) if holds else _cause(case, used, posed)
    answer = Agreement(
        name=case.name,
        holds=holds,
        probability=probability,
        statistic=apart.statistic,
        degrees=apart.degrees,
        cause=cause,
        change=_change(case, cause, estimate),
        misfit=replace(misfit, noise=(noise, noise)),
    )
    return replace(answer, words=_words(answer))


def _noise_is_no_other_lens(case: _CheckCase, used: Sights, posed: _Fit) -> float:
    """Return the probability by which noise looks as if another lens explained it: an F-test of all intrinsics free
    beside their prior. It is 1 where the noise stays. A prior that is only loosened leaves the misfit of a far change,
    such as a stretched picture, and that looks like noise.
    """
    freed = {*case.station_keys, *case.lens_keys}
    fit, spare = case.least(used, freed, posed[1].stations[case.name].cam_from_world), used.equations - len(freed)
    if fit is None or spare < 1 or _noise(used, fit[0], len(freed))[0] > NOISIER:
        return 1.0
    ratio = (posed[0] - fit[0]) / len(case.lens_keys) * spare / max(fit[0], np.finfo(float).tiny)
    return float(np.exp(log_f_tail(ratio, len(case.lens_keys), spare)))


def _cause(case: _CheckCase, used: Sights, posed: _Fit) -> tuple[str, Estimate]:
    """Return what explains the observations at the least price, as in a refit: a movement alone, or another zoom, iris
    or camera, too; and the estimate with it.
    """
    key = case.sight.key
    pose, lens = posed[1].stations[key.station].cam_from_world, case.estimate.cameras[key.camera].lens
    fits = {"pose": (0, posed)}
    for what in ("zoom", "iris", "everything"):
        freed = loosened(what, key.camera, lens) & set(case.lens_keys)
        fit = case.least(used, {*case.station_keys, *freed}, pose) if freed else None
        if fit is not None:
            fits[what] = len(freed), fit
    noise = _noise(used, min(fit[0] for _, fit in fits.values()), len(case.prior.keys))[0]
    count = len(used.point_rows) + len(used.curve_rows)
    cost = {what: fit[0] / noise**2 + 2.0 * price_nats(let_go, count) for what, (let_go, fit) in fits.items()}
    what = min(cost, key=cost.__getitem__)
    return what, fits[what][1][1]


def _noise(used: Sights, least: float, free: int) -> tuple[float, float]:
    """Return the noise, relative to the calibration's, by twice a least cost, and the spare equations behind it."""
    freedom = max(used.equations - free, 0) + _USUAL_EQUATIONS
    return math.sqrt((least + _USUAL_EQUATIONS) / freedom), freedom


def _change(case: _CheckCase, cause: str | None, anew: Estimate) -> MapChange:
    """Return the change from the calibration's camera to the one that explains the observations."""
    key, posterior = case.sight.key, case.calibration.uncertainty.posterior
    let_go = loosened(cause or "", key.camera, case.estimate.cameras[key.camera].lens)
    shift_m, turn = moved_from(case.prior.without(let_go), posterior, case.name, anew)
    grids = field_grids(case.calibration.targets)
    change = change_of(case.estimate, case.name, anew.camera_at(case.name), grids)
    return replace(change, moved_mm=1e3 * shift_m, turned_deg=math.degrees(turn))


def _apart(
    case: _CheckCase, used: Sights, fit: _Fit, before: GaussianPrior, tested: tuple[Key, ...]
) -> tuple[float, Contrast]:
    """Return the noise, relative to the calibration's, and the contrast between the prior `before` and the new
    observations, by their fit with the pose free.
    """
    least, estimate = fit
    noise, freedom = _noise(used, least, len({*case.station_keys, *tested}))
    problem = case.problem(used, case.station_keys, noise)
    reduced = information(problem, estimate)
    seen, keys = reduced.points + reduced.curves, reduced.shared.keys
    # At the solution, the priors pull as much as the observations do, with the noise that these had in the solve.
    earlier, offsets = case.known(used, case.station_keys, estimate, keys)
    best = seen.inverse @ (earlier.matrix @ offsets) / noise**2
    scatter = measure_scatter(problem, residuals(used, estimate), estimate, reduced)
    if scatter is not None:
        seen = scatter.widened(seen)
        freedom = 1.0 / (1.0 / freedom + scatter.dependence.inverse_freedom)
    old = NormalDistribution(
        *replace(case, prior=before).known(used, (), estimate, keys),
        case.calibration.uncertainty.posterior.degrees_of_freedom,
    )
    return noise, contrast(old, NormalDistribution(seen, -best, freedom), tested)


def _inliers(search: PoseSearch, near: PoseCandidate) -> tuple[Mask, Mask]:
    """Return which rows of the observations a nearby pose explains."""
    sight, observations = search.sight, search.sight.observations
    points, curves = (np.zeros(len(c), dtype=bool) for c in (observations.points, observations.curves))
    limit = _INLIER_SIGMA * max(1.0, min(near.scale, 2.0))
    in_points, in_curves = search.residuals(near.pose).in_sigmas(sight, search.scales)
    points[sight.point_rows], curves[sight.curve_rows] = in_points <= limit, in_curves <= limit  # not NaN
    return points, curves


# ---- in words -------------------------------------------------------------------------------------------------------


def _not_understood(case: _CheckCase, misfit: Misfit) -> Agreement:
    inside = misfit.points + misfit.curves
    words = (
        f"moved far, or cannot be explained: only {inside} of {inside + misfit.outliers} observations fit the known "
        "lens at any pose nearby: refit, or check labels and camera"
    )
    return not_found(case.name, words, misfit)


def not_found(station: str, words: str, misfit: Misfit | None = None) -> Agreement:
    """Return the answer for a station that does not hold, and whose movement is unknown."""
    answer = Agreement(name=station, holds=False, probability=0.0, statistic=np.inf, words=words)
    return answer if misfit is None else replace(answer, misfit=misfit)


def _words(answer: Agreement) -> str:
    change, misfit = answer.change, answer.misfit
    worst_mm = change.maps[0].worst_mm if change and change.maps else np.nan  # for a station that sees no field
    if answer.holds:
        at_most = f"{worst_mm:.1f} mm on the floor at most, " if np.isfinite(worst_mm) else ""
        words = f"holds: no change beyond the uncertainty ({at_most}probability {answer.probability:.2g})"
        if misfit.noise[0] > NOISIER:
            words += f"; but the noise is {misfit.noise[0]:.1f} times that of the calibration"
    else:
        shifts = f", which shifts the map by up to {worst_mm:.1f} mm on the floor" if np.isfinite(worst_mm) else ""
        words = f"no longer holds: {_cause_words(answer)}{shifts} (probability {answer.probability:.1g})"
    if misfit.many_out:
        remedy = "refit" if answer.cause in WORDS else "check labels"
        words += f"; but {misfit.outliers} of {misfit.count} observations do not fit: {remedy}"
    return words


def _cause_words(answer: Agreement) -> str:
    change = answer.change
    if change is None or answer.cause in ("iris", "everything"):
        return WORDS[answer.cause or "iris"]
    if answer.cause == "zoom":
        return f"{WORDS['zoom']} (phi {change.phi_px[0]:.1f} -> {change.phi_px[1]:.1f} px)"
    return moved_words(1e-3 * change.moved_mm, change.turned_deg, "about ")
