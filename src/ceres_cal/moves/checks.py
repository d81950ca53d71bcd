"""Does a calibration still hold? A test of each station's pose and phi against new observations (design, section 10).

What was known and what the new observations say are two statements about the same numbers; whether they differ in pose
and phi by more than both leave open is asked at the noise, and with the dependence, that the new observations show. The
calibration's own error is the same in every check: it counts as large as it may be.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from ceres_cal.base import Array, Frozen, InputError, Mask, Pose, numerical, or_none, replace
from ceres_cal.base.typed import checked
from ceres_cal.calibration import Calibration
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
from ceres_cal.problem import Estimate, Information, Key, layout_of, solve
from ceres_cal.problem.priors import GaussianPrior, tolerances
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.reduced import information
from ceres_cal.problem.residuals import residuals

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

    Seven numbers of each station that was observed are tested at once: its pose and its camera's phi; from straight
    above, where phi is hardly known, six. The lens's distortion is not: another focus may show as more noise alone.
    Noise and dependence are those of the new observations. Outliers are those that no pose near by explains. A yes
    means that these observations show no movement, not that there is none: see the sizes.

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
            words += f"{noisy}: the focus or the iris may have changed, `refit` says whether"
    else:
        shifts = f", which shifts the map by up to {worst_mm:.1f} mm on the floor" if np.isfinite(worst_mm) else ""
        moved = moved_words(1e-3 * change.moved_mm, change.turned_deg, "about ") + shifts
        words = f"no longer holds: {moved} (probability {probability:.1g})"
    count = misfit.points + misfit.curves + misfit.outliers
    if misfit.outliers > many_outliers * count:
        words += f"; but {misfit.outliers} of {count} observations fit nowhere: check labels"
    return words
