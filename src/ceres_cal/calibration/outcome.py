"""Turn the result of a solve into a calibration without a posterior.

Also the warnings about what observations leave open: phi that they do not determine, or that rests on usual cameras.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import (
    Array,
    DegenerateError,
    Indices,
    Mask,
    bounds_text,
    first_of,
    grid_places,
    inverted,
    replace,
    two_digits,
)
from ceres_cal.calibration.calibration import Calibration
from ceres_cal.calibration.file import COPY, Fit, Rejection
from ceres_cal.effects.aside import Explanation
from ceres_cal.observations import Observations, SightKey, View
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.bundle import Solution
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import OF_PIXELS, Estimate, Layout, anchored_stations
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import natural_sizes
from ceres_cal.problem.residuals import residuals
from ceres_cal.robust.noise import visible_from
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.robust.usable import require_possible
from ceres_cal.start.initialise import Start

if TYPE_CHECKING:
    from ceres_cal.robust.bulk import BulkSolution


_UNKNOWN = (
    "camera {!r}: its views are too frontal to determine phi (95 %: {}). Heights are correlated with phi: places above "
    "the floor depend on it, places on the floor do not. Add boards tilted by 20 degrees, or a prior on height_m"
)
# Natural sizes (each moves a pixel of the image's corner by half the diagonal): a lens with a coefficient whose
# standard deviation is this many is undetermined. Where there are only as many equations as numbers, rounding leaves a
# coefficient thousands of times that.
_LOST = 1e3
# Factor on the standard deviation of phi without the prior of usual cameras, above which a remark says that phi rests
# on it.
_RESTING = 1.5
_USUAL = (
    "camera {!r}: phi and the numbers correlated with it are determined only by assuming a usual camera (a usual phi, "
    "a principal point near the middle of the image, square pixels, little decentring). Without this assumption the "
    "standard deviation of phi is {}"
)
_OBLONG = (
    "camera {!r}: fy / fx is estimated as {:.4f}. Few cameras have pixels so far from square. If its pixels are "
    "square, the length or the width of the target is wrong by {} %: measure it, or state --fix aspect=1"
)
_SQUARED = (
    "camera {!r}: its pixels are assumed to be square, but the observations alone give fy / fx = {:.3f} ± {:.3f}. If "
    "its pictures were stretched, its height and places above the floor are wrong: state --fix aspect=1 if they were "
    "not, --free-aspect if they were"
)
_BEHIND = (
    "camera {!r} sees all {} checkerboards from behind: its pictures are mirrored, x and y of its pixels or rows and "
    "columns are exchanged, or rows are counted upwards. In all but the last case the principal point is wrong"
)
_TWICE = (
    "stations {!r} and {!r} stand at one place and show the same part of {!r}, and no station shows the part opposite: "
    "if they are apart, the labels of one are half a turn off (its --facing); if not, state their position_m"
)
_MIRRORED = (
    "target {!r} is seen from its other side in {} of {} views ({}): their pictures are mirrored, or their points are "
    "listed in mirrored order. Correct them"
)


def require_lens_told(estimate: Estimate, posterior: Posterior) -> None:
    """Raise DegenerateError where the observations leave coefficients of a lens arbitrary."""
    # Where a valley of phi is open, so may be what is correlated with phi: along the valley, or in the quadratic model.
    known = np.minimum(posterior.spread.sd, posterior.sd)
    for name, camera in estimate.cameras.items():
        keys = [key for key in posterior.keys if key[:2] == ("camera", name) and key.quantity in camera.lens.names]
        sd = known[posterior.information.columns(keys)]
        lost = [
            key.quantity for key, size in zip(keys, sd / natural_sizes(estimate, keys), strict=True) if size > _LOST
        ]
        if lost:
            raise DegenerateError(
                f"camera {name!r}: its observations do not determine {', '.join(lost)} of the {camera.lens.kind} lens: "
                f"show more of the targets, or hold them, such as --fix {lost[-1]}=0",
                name,
            )


def unknown_phi(end: RobustSolution, posterior: Posterior) -> Iterator[str]:
    """Yield warnings about cameras whose phi the observations leave open."""
    if not posterior.followed:
        return
    from ceres_cal.posterior.uncertainty import Uncertainty

    known = Uncertainty(end.estimate, posterior, {})
    for name in posterior.followed:
        verdict = known.verdict("camera", name, "phi")
        if verdict.verdict == "unknown":
            yield _UNKNOWN.format(name, bounds_text(verdict.low, verdict.high, "px"))


def remarks_of(end: RobustSolution, problem: Problem, posterior: Posterior) -> Iterator[str]:
    """Yield remarks: how the observations were treated, without loss of trust."""
    yield from _resting_phi(end, problem, posterior)
    yield from _noisier_cameras(problem.observations.noise)
    yield from _worlds_apart(problem.observations)


def _resting_phi(end: RobustSolution, problem: Problem, posterior: Posterior) -> Iterator[str]:
    """Yield remarks on cameras whose phi rests on usual cameras, with phi's standard deviation without that prior."""
    estimate, reduced = end.estimate, end.reduced
    usual = [prior for prior in problem.priors_at(estimate) if prior.is_usual]
    if reduced is None or not usual:
        return
    every = [prior.information for prior in usual]
    without = reduced.shared.beside_all(replace(one, matrix=-one.matrix) for one in every)
    for name in estimate.cameras:
        key = Key("camera", name, "phi", "px")
        if key in reduced.shared.keys:
            at = reduced.shared.columns([key])[0]
            sd, alone = reduced.shared.spread.sd[at], without.spread.sd[at]
            if alone > _RESTING * sd:
                known = posterior.sd_of("camera", name, "phi")
                yield _USUAL.format(name, _share_text(known * alone / sd / estimate.cameras[name].phi))


def unusual_pixels(end: RobustSolution, problem: Problem, alone: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    """Yield warnings about cameras whose pixels are far from square where only targets of the world show that: a wrong
    length of the target looks the same. A board that is turned from view to view would contradict a wrong aspect. Also
    warn of cameras whose pixels are square only by the prior of usual cameras.

    Args:
        alone: see `aspects_alone`.
    """
    unusual = 0.007  # of fy / fx: the public cameras tried differ from 1 by up to 0.006
    surely = 2.5  # standard deviations: pictures stretched by 5 to 7 % have 2.9 to 9.5, thirty others at most 1.9
    turned = {view.camera for view in problem.observations.views if view.placement is not None}
    for name, camera in end.estimate.cameras.items():
        free = problem.layout.free.get(name, ())
        if OF_PIXELS.index("aspect") not in free or name in turned:
            continue
        if abs(camera.aspect - 1.0) > unusual:
            yield _OBLONG.format(name, camera.aspect, two_digits(100.0 * abs(camera.aspect - 1.0)))
            continue
        value, sd = alone.get(name, (1.0, np.inf))
        if abs(value - 1.0) > max(unusual, surely * sd):
            yield _SQUARED.format(name, value, sd)


def aspects_alone(end: RobustSolution, problem: Problem, posterior: Posterior) -> dict[str, tuple[float, float]]:
    """Camera -> fy / fx by the observations alone, to first order, and its standard deviation; for cameras that show
    only the world, and whose pixels are square by the prior of usual cameras.
    """
    found = dict[str, tuple[float, float]]()
    turned = {view.camera for view in problem.observations.views if view.placement is not None}
    for prior in problem.priors_at(end.estimate):
        keys = [key for key in prior.keys if prior.is_usual and key.quantity == "aspect" and key.owner not in turned]
        if not keys or end.reduced is None:
            continue
        own, off = prior.information.given(keys), prior.offsets(end.estimate)[prior.information.columns(keys)]
        known = end.reduced.shared.less(own), posterior.information.less(own)
        # Where correlated errors or other lenses widen it beyond the usual prior, that cannot be subtracted from it.
        sds = [sd for one in known if np.isfinite(sd := float(one.spread.sd[one.columns(keys)][0]))]
        if sds:
            camera = keys[0].owner
            value = end.estimate.cameras[camera].aspect + sds[0] ** 2 * float(own.matrix[0, 0] * off[0])
            found[camera] = value, max(sds)
    return found


def other_ways_round(end: RobustSolution, problem: Problem, lost: Collection[str | None]) -> Iterator[str]:
    """Yield warnings about targets that are probably seen another way round than their labels say, which fits as well.

    Args:
        lost: placements whose poses are not known.
    """
    yield from _seen_from_behind(end.estimate, problem.observations, lost)
    if len(end.estimate.stations) < 2:
        return
    priors = (*problem.observations.priors, *problem.options.priors)
    stated = {one.name for one in priors if one.quantity == "position_m"}
    for name in dict.fromkeys(view.target for view in problem.observations.shown_views if view.placement is None):
        yield from _seen_twice(end.estimate, problem.observations, name, stated)


def _seen_twice(estimate: Estimate, observations: Observations, name: str, stated: Collection[str]) -> Iterator[str]:
    """Check a field that looks the same after half a turn: do two stations at one place show one part of it, and none
    the part opposite? Boards that both see, or positions that were stated, decide it.
    """
    from ceres_cal.posterior.maps import visible_pixels
    from ceres_cal.scene.symmetry import TURNED, counterparts

    near, steps = 0.2, 24  # distance over height; places along each side
    same, unseen = 0.3, 0.15  # shares of the part that is shown; with these, none of 960 rigs of 2 and 4 is named
    target, boards = observations.targets[name], dict[str, set[str | None]]()
    if not target.curves or min(counterparts(target, TURNED)[1]) < 0:
        return
    low, high = target.box
    places = grid_places(*(np.linspace(low[axis], high[axis], steps) for axis in (0, 1)))
    for view in observations.shown_views:
        boards.setdefault(view.station, set()).add(view.placement)
    looking = dict.fromkeys(view.station for view in observations.shown_views if view.target == name)
    shown = {one: np.isfinite(visible_pixels(estimate, one, places, 0.0)[:, 0]) for one in looking}
    hidden = ~np.any([*shown.values()], axis=0)
    at = {one: estimate.stations[one].cam_from_world.position for one in looking}
    for first, second in combinations(shown, 2):
        if {first, second} <= {*stated} or boards[first] & boards[second] - {None}:
            continue
        apart, either = at[first] - at[second], shown[first] | shown[second]
        shares = np.array([np.sum(shown[first] & shown[second]), np.sum(either[::-1] & hidden)])
        is_near = np.hypot(*apart[:2]) < near * at[first][2]
        if is_near and np.all(shares > np.array([same, unseen]) * np.sum(either)):
            yield _TWICE.format(first, second, name)


def _seen_from_behind(estimate: Estimate, observations: Observations, lost: Collection[str | None]) -> Iterator[str]:
    """Yield warnings about opaque flat targets that some views show from the other side than most, and about cameras
    that see every printed checkerboard from behind: the mirrored picture of a plane fits as well as the true one. There
    is no warning of the second kind where a camera sees a floor, which `require_possible` found to be seen from above:
    then the pictures are right, and the rows of the boards are counted upwards.
    """
    posed = {*estimate.placements} - {*lost}
    yield from _seen_from_both_sides(estimate, observations, posed)
    if any(view.placement is None and not observations.targets[view.target].movable for view in observations.views):
        return
    boards = {name for name, target in observations.targets.items() if target.grid and target.grid.checkered}
    shown = [view for view in observations.views if view.target in boards and view.placement in posed]
    for name in estimate.cameras:
        own = [view for view in shown if view.camera == name]
        if own and np.all(_heights_of_cameras(estimate, own) > 0.0):
            yield _BEHIND.format(name, len(own))


def _seen_from_both_sides(
    estimate: Estimate, observations: Observations, posed: Collection[str | None]
) -> Iterator[str]:
    """Check placements that one camera alone sees; where others see them, too, a mirrored list does not fit."""
    seen = Counter(one.placement for one in observations.shown_views)
    alone = {placement for placement in posed if seen[placement] == 1}
    for name, target in observations.targets.items():
        heights = target.places[:, 2]
        views = [one for one in observations.shown_views if one.target == name and one.placement in alone]
        if not views or np.ptp(heights) > 0.0:
            continue
        above = _heights_of_cameras(estimate, views) > heights[0]
        other = above != (2 * np.count_nonzero(above) >= len(views))
        if np.any(other):
            frames = [repr(view.frame) for view, is_other in zip(views, other, strict=True) if is_other]
            yield _MIRRORED.format(name, len(frames), len(views), first_of(frames))


def _heights_of_cameras(estimate: Estimate, views: Sequence[View]) -> Array:
    """(V,) m, height of each view's camera above its target's plane, in the target's frame."""
    keys = [SightKey(view.camera, view.station, view.placement) for view in views]
    return np.asarray(inverted(estimate.pose_stack(keys))[:, 2, 3])


def _worlds_apart(observations: Observations) -> Iterator[str]:
    """Yield remarks on stations that nothing connects to the field or to each other."""
    alone = sorted(anchored_stations(observations))
    if len(alone) + any(view.placement is None for view in observations.shown_views) > 1:
        names = ", ".join(map(repr, alone))
        yield (
            f"nothing connects {names} to the other stations, so their relative poses are unknown. If they saw a board "
            "at the same moment, give these frames the same name (ceres-cal join --same-frame)"
        )


def _noisier_cameras(noise: Mapping[str, float]) -> Iterator[str]:
    """Yield remarks on cameras, or what they see, whose noise differs from that of the others beside what is stated."""
    if noise:
        each = ", ".join(f"{name!r} {two_digits(factor)}" for name, factor in noise.items())
        yield (
            f"the noise differs by more than the stated sigmas ({each} times the mean): each is weighted by its own "
            "noise. Check that the noisiest photographs are sharp, or state sigma_px of manual clicks"
        )


def _share_text(share: float) -> str:
    return f"{two_digits(100.0 * share)} %" if share < 1.0 else "larger than phi itself"


def came_out(
    phi_from: Mapping[str, str], problem: Problem, end: RobustSolution, explanations: Sequence[Explanation] = ()
) -> Calibration:
    """Return the calibration of a solve, without a posterior."""
    observations = problem.observations
    out = [np.flatnonzero(~mask) for mask in (end.inliers.points, end.inliers.curves)]
    far = end.inliers.point_sigmas[out[0]], end.inliers.curve_sigmas[out[1]]
    by_chance = None if end.by_chance is None else end.by_chance & (end.inliers.sigmas <= end.inliers.bound)
    return Calibration(
        end.estimate,
        observations.targets,
        _fit(end, problem.layout),
        _rejected(observations, out, far, explanations, by_chance),
        end.solution.termination,
        end.solution.converged,
        end.rounds,
        end.solution.history,
        phi_from,
        observations.warnings,
        problem.options,
        observations.digest,
        remarks=observations.remarks,
    )


def of_closed_form(start: Start, problem: Problem) -> Calibration:
    """Return the calibration by the paper's own method alone: nothing is minimised."""
    from ceres_cal.start.baseline import four_point_baseline

    estimate = four_point_baseline(problem.sights, start.estimate)
    there = residuals(problem.sights, estimate)
    require_possible(problem.sights, estimate, there)
    solution = Solution(estimate, np.nan, False, "the paper's closed form, nothing was minimised", ())
    end = RobustSolution(problem, solution, visible_from(problem.observations, there), there, 0)
    return came_out(start.phi_from, problem, end)


def of_all(calibration: Calibration, settled: BulkSolution) -> Calibration:
    """Return the calibration with the final solve of all observations, where a subset determined outliers and lens."""
    observations, used, scales = settled.observations, settled.used, calibration.fit.scales
    points, curves = used.sums
    sigmas = [own / scale for own, scale in zip(used.sigmas, scales, strict=True)]
    mean = [np.sqrt(sums[1:] / max(sums[0], 1.0)) for sums in (points, curves)]
    return replace(
        calibration,
        fit=replace(
            calibration.fit,
            points=int(points[0]),
            curves=int(curves[0]),
            points_rms_px=float(mean[0][0]),
            curves_rms_px=float(mean[1][0]),
            point_sigma_px=float(mean[0][1]),
            curve_sigma_px=float(mean[1][1]),
        ),
        rejected=_rejected(observations, used.rows, sigmas, settled.explanations),
        warnings=observations.warnings,
        remarks=observations.remarks,
    )


def _fit(end: RobustSolution, layout: Layout) -> Fit:
    points, curves = end.residuals.lengths
    used = points[end.inliers.points], curves[end.inliers.curves]
    sights, observations = end.problem.sights, end.problem.observations
    stated = observations.at_noise({})
    sigmas = stated.points.sigma_px[sights.point_rows], stated.curves.sigma_px[sights.curve_rows]
    return Fit(
        len(used[0]),
        len(used[1]),
        _rms(used[0]),
        _rms(used[1]),
        end.inliers.point_scale,
        end.inliers.curve_scale,
        layout.size,
        _rms(sigmas[0]),
        _rms(sigmas[1]),
        observations.noise,
    )


def _rms(values: Array) -> float:
    """Root mean square; 0 for an empty array."""
    return float(np.sqrt(values @ values / max(len(values), 1)))


def _rejected(
    observations: Observations,
    rows: Sequence[Indices],
    sigmas: Sequence[Array],
    explanations: Sequence[Explanation],
    by_chance: Mask | None = None,
) -> tuple[Rejection, ...]:
    """Return the rows of points and curve observations that did not take part, with how far off they are or why."""
    groups = [one for one in explanations if one.is_taken]
    entries, views, copies = [], observations.views, observations.copies
    for kind, out, far, column, copy_of, first in (
        ("point", rows[0], sigmas[0], observations.points, copies.points, 0),
        ("curve", rows[1], sigmas[1], observations.curves, copies.curves, len(observations.points)),
    ):
        for row, sigma in zip(out.tolist(), far.tolist(), strict=True):
            reason = f"{sigma:.1f} sigma off" if np.isfinite(sigma) else "cannot be seen from there"
            if by_chance is not None and by_chance[first + row]:
                reason += " by chance, as most around it are outliers"
            reason = next((one.words for one in groups if one.rows[first + row]), reason)
            if copy_of[row] >= 0:
                reason = f"{COPY} of frame {views[copy_of[row]].frame!r}"
            frame = views[column.view[row]].frame
            entries.append(Rejection(kind, row, frame, observations.feature_name(kind, row), reason))
    return tuple(entries)
