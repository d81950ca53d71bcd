"""Try other minima than the one in which a solve ended.

A small or distant board looks almost the same tilted either way, and each of the two mirrored poses of its plane has a
minimum of its own. Only trying both shows which is the lower one. They are tried where they compete, that is, where
perspective is too weak to have decided in the initial estimate.

From a poor initial estimate, most of a board's corners may lie outside the rejection bound, and rejected observations
do not attract the pose. With the lens solved from the other boards, four good corners give a lost board a pose by
consensus.

A floor seen by few points and lines may be explained from two places, by two lenses. The initial estimate shows neither
which minimum is the least nor that there are two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, Indices, Mask, Pose, median, or_none, replace
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.problem import Estimate, Information, Problem, Solution, Weighting, placement_costs, solve
from ceres_cal.problem.quantities import difference, natural_sizes
from ceres_cal.problem.residuals import residuals_alone
from ceres_cal.robust.noise import InlierFit, Inliers, deleted_lengths
from ceres_cal.scene import TURNED, Camera, Target, is_seen_turned
from ceres_cal.start import consensus_homography, pose_from_homography

# Standard deviations by which perspective bends a view; above this the pose is not in doubt. Of 200 small boards, none
# stays mirrored for values from 12 to 200, four do at 0; of 20 000, six did at 50.
_DECIDED_SIGMA = 100.0
# Difference of rotation matrices, and of positions in metres, below which two poses are the same: the two minima of a
# plane are degrees apart, rounding is not. Halving or doubling changes nothing.
_SAME = 1e-3
# Difference of costs in squared standard deviations above which the pose is decided: ten standard deviations decide,
# however the lens still changes. Halving or doubling changes nothing.
_MUCH_WORSE = 100.0


def without_mirrored_poses(
    problem: Problem, estimate: Estimate, among: frozenset[SightKey]
) -> tuple[Estimate, int, frozenset[SightKey]]:
    """Put private placements into the better one of their two mirrored poses.

    Args:
        among: keys of the sights that are tried.

    Returns:
        The estimate, the number of placements changed, and the keys of sights whose other pose is not much worse.
    """
    sights, weighting = problem.sights, problem.weighting
    changed, undecided = 0, frozenset[SightKey]()
    for camera in estimate.cameras:
        own = [number for number in sights.numbers(camera, placements=problem.private) if sights.keys[number] in among]
        if own:
            estimate, count, open_ones = _with_better_poses(sights.take(np.array(own)), estimate, weighting)
            changed, undecided = changed + count, undecided | open_ones
    return estimate, changed, undecided


def _with_better_poses(
    sights: Sights, estimate: Estimate, weighting: Weighting
) -> tuple[Estimate, int, frozenset[SightKey]]:
    poses = estimate.pose_stack(sights.keys)
    ambiguous = _ambiguous(sights, poses, estimate, weighting)
    if not len(ambiguous):
        return estimate, 0, frozenset()
    few = sights.take(ambiguous)
    twice = np.concatenate([poses[ambiguous], mirrored(few, poses[ambiguous])])
    costs, poses = placement_costs(sights.take(np.tile(ambiguous, 2)), estimate, weighting, twice)
    (as_is, other), (posed, turned) = np.split(costs, 2), np.split(poses, 2)
    better = np.flatnonzero(other < as_is * (1.0 - 1e-6))
    two = np.max(np.abs(turned - posed), axis=(1, 2)) > _SAME  # else the search from the mirrored pose came back
    close = np.flatnonzero(two & (np.abs(other - as_is) < _MUCH_WORSE))
    undecided = frozenset(few.keys[i] for i in close)
    if not len(better):
        return estimate, 0, undecided
    return estimate.with_placements([few.keys[i] for i in better], turned[better]), len(better), undecided


def _boxes(sights: Sights) -> tuple[Array, Array]:
    """Centre (S, 3) and half diagonal (S,) of the box around each sight's points; every sight must have points."""
    starts = sights.point_bounds[:-1]
    low, high = np.minimum.reduceat(sights.points, starts), np.maximum.reduceat(sights.points, starts)
    return 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)


def _ambiguous(sights: Sights, poses: Array, estimate: Estimate, weighting: Weighting) -> Indices:
    """Sights of points whose two poses hardly differ: the bend by perspective, phi (size / depth)^2 sin(tilt)
    cos(tilt), is small against the noise.
    """
    seen = np.flatnonzero(np.diff(sights.point_bounds) >= 4)
    if not len(seen):
        return seen
    few, pose = sights.take(seen), poses[seen]
    centres, reach = _boxes(few)
    middle = np.einsum("sij,sj->si", pose[:, :, :3], centres) + pose[:, :, 3]
    distance = np.linalg.norm(middle, axis=1)
    cosine = np.abs(np.sum(pose[:, :, 2] * middle, axis=1)) / distance
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    phi = estimate.cameras[sights.keys[0].camera].phi
    bend_px = phi * (reach / distance) ** 2 * sine * cosine
    sigma_px = weighting.point_scale * np.minimum.reduceat(few.sigma_px, few.point_bounds[:-1])
    return np.asarray(seen[bend_px < _DECIDED_SIGMA * sigma_px])


def mirrored(sights: Sights, poses: Array) -> Array:
    """cam_from_target (S, 3, 4) with the depth of each target's points reversed about their middle, along the line of
    sight: R' = (1 - 2 d d^T) R diag(1, 1, -1), which is again a rotation.
    """
    centres, _ = _boxes(sights)
    middle = np.einsum("sij,sj->si", poses[:, :, :3], centres) + poses[:, :, 3]
    d = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    reflect = np.eye(3) - 2.0 * d[:, :, None] * d[:, None, :]
    rotations = reflect @ poses[:, :, :3] @ np.diag([1.0, 1.0, -1.0])
    translations = middle - np.einsum("sij,sj->si", rotations, centres)
    return np.concatenate([rotations, translations[:, :, None]], axis=2)


LOST = 0.5
"""Share of a sight's observations in use below which its pose counts as lost. Of 40 boards before a fisheye with 30 %
outliers, 9 end in a wrong pose, and 19 at 0.33; at 0.67 nothing changes.
"""
# Least number of points for a consensus: four determine a pose, and two more hardly ever agree by chance. Halving or
# doubling changes nothing.
_FEWEST = 6


def with_lost_boards_posed(problem: Problem, inliers: Inliers, estimate: Estimate) -> tuple[Estimate, int]:
    """Pose lost placements anew where that lowers their cost. Returns the estimate and the number of them.

    Args:
        problem: of all observations, including rejected ones, weighted with a loss that tolerates outliers.
    """
    sights, weighting, count = problem.sights, problem.weighting, 0
    for number in np.flatnonzero(sights.used_share(inliers.points, inliers.curves) < LOST):
        sight = sights[int(number)]
        pose = _by_consensus(sight, estimate, weighting) if sight.key.placement in problem.layout.placements else None
        if pose is None:
            continue
        tried = [placement_costs(sight, estimate, weighting, p) for p in (pose, mirrored(sight, pose))]
        cost, best = min(tried, key=lambda one: float(one[0][0]))
        there = estimate.with_placements(sight.keys, best)
        if sight.key.placement in problem.private:
            as_is, _ = placement_costs(sight, estimate, weighting, estimate.pose_stack(sight.keys))
            is_better = cost[0] < 0.99 * as_is[0]
        else:
            is_better = _suits_all(
                sights.take(sights.numbers(placements=sight.keys[0][2:])), there, estimate, weighting
            )
        if is_better:
            estimate = there
            count += 1
    return estimate, count


def lost_rows(problem: Problem, inliers: Inliers) -> Mask:
    """(N + M,) the observations of lost placements. The few that agree with such a pose do so by chance."""
    sights, rows = problem.sights, np.zeros_like(inliers.rows)
    lost = np.flatnonzero(sights.used_share(inliers.points, inliers.curves) < LOST)
    own = sights.take(np.array([i for i in lost if sights.keys[i].placement in problem.layout.placements], np.int64))
    rows[own.point_rows] = rows[len(inliers.points) + own.curve_rows] = True
    return rows


def rows_among_outliers(inliers: Inliers, problem: Problem, fit: Callable[[], InlierFit]) -> Mask:
    """(N + M,) observations most of whose neighbours in the picture are outliers, and whose own residual says nothing,
    because the estimate follows them more than all others together (leverage above 1/2).

    A few of many outliers agree with some lens by chance. At the rim of the picture, where nothing else is left, that
    lens is the estimate.
    """
    observations, neighbours = problem.observations, 8
    rows, is_seen = np.zeros_like(inliers.rows), np.isfinite(inliers.sigmas)
    views = np.concatenate([observations.points.view, observations.curves.view])
    is_outlier = is_seen & ~inliers.rows
    judged = is_seen & (np.bincount(views[is_outlier], minlength=len(observations.views)) > neighbours // 2)[views]
    if not judged.any():
        return rows
    fitted = fit()
    observation, length = deleted_lengths(judged, inliers.weighting(problem.options), fitted)
    squared, own = length**2, inliers.sigmas[observation] ** 2
    is_followed = np.where(fitted.used[observation], squared > 2.0 * own, 2.0 * squared < own)
    pixels = np.concatenate([observations.points.pixels, observations.curves.pixels])
    for row in observation[is_followed]:
        near = np.flatnonzero(judged & (views == views[row]))
        near = near[near != row]
        if len(near) > neighbours:
            distances = np.sum((pixels[near] - pixels[row]) ** 2, axis=1)
            near = near[np.argpartition(distances, neighbours)[:neighbours]]
            rows[row] = 2 * np.count_nonzero(is_outlier[near]) > neighbours
    return rows


def _suits_all(sights: Sights, there: Estimate, before: Estimate, weighting: Weighting) -> bool:
    """Whether a new pose of a placement suits all its sights much better than its pose before. Two cameras that show it
    at different moments fit either pose badly.
    """
    much = 0.5  # ratio of Cauchy's costs below which the new pose is much better
    costs = []
    for estimate in (there, before):
        points, _ = residuals_alone(sights, estimate).lengths
        far = np.nan_to_num(points / (weighting.point_scale * weighting.loss_scale * sights.sigma_px), nan=np.inf)
        costs.append(float(np.sum(np.log1p(np.minimum(far, 1e6) ** 2))))  # places that are not shown count as very far
    return costs[0] < much * costs[1]


def _by_consensus(sight: Sights, estimate: Estimate, weighting: Weighting) -> Array | None:
    """cam_from_target (1, 3, 4) on which most points agree, or None."""
    camera = estimate.cameras[sight.key.camera]
    rays = camera.rays(sight.pixels)
    ahead = rays[:, 2] > 0.0  # NaN is not
    points, rays = sight.points[ahead], rays[ahead]
    if len(points) < _FEWEST or np.ptp(points[:, 2]) > 1e-9:
        return None
    ideal = np.column_stack([camera.phi * rays[:, :2] / rays[:, 2:], np.ones(len(rays))])
    limit_px = max(5.0 * weighting.point_scale * median(sight.sigma_px), 1.0)
    homography = consensus_homography(points[:, :2], ideal, limit_px)
    if homography is None:
        return None
    pose = pose_from_homography(homography, camera.phi)
    translation = pose.translation - points[0, 2] * pose.rotation[:, 2]
    return np.column_stack([pose.rotation, translation])[None]


FEW = 300  # equations above which only one minimum was ever seen: the cases with two had fewer than 200
# Share of the cost that the normal equations predict at another end; above it, the end is the same minimum, not quite
# reached, which costs nearly all of it.
_OTHER = 0.25
_APART = 0.05  # share of the height: places no farther apart are one valley, which the standard deviations cover


def least_of_few(
    problem: Problem, estimate: Estimate, elsewhere: Sequence[Estimate] = (), *, is_whole: bool = True
) -> tuple[Estimate, tuple[Solution, ...]]:
    """The estimate in the lowest minimum found from it, and other minima with their cost above it. Many observations
    keep the estimate, unless a turned camera shows them as well.

    Args:
        elsewhere: initial estimates that explained the observations equally well. is_whole: whether the problem has all
            the observations; rejected ones were judged in their own minimum.
    """
    lower = 1.0  # difference of twice the cost: rounding is smaller, and a minimum lower by less is as likely
    is_few, turned = is_whole and problem.sights.equations < FEW, tuple(_seen_turned(problem.sights, estimate))
    if not (is_few or turned):
        return estimate, ()
    least = solve(problem, estimate)
    starts = (*elsewhere, *turned) if is_few else turned
    others = [end for start in starts if (end := solved_soon(problem, start, is_near=False)) is not None]
    others += _at_other_phi(problem, least) if is_few else ()
    lowest = min(others, key=lambda one: one.cost, default=least)
    if 2.0 * (least.cost - lowest.cost) > lower:
        others.append(least)
        least = solve(problem, lowest.estimate)
        estimate = least.estimate
    return estimate, tuple(replace(one, cost=one.cost - least.cost) for one in others)


def _seen_turned(sights: Sights, estimate: Estimate) -> Iterator[Estimate]:
    """The estimate with a station turned by half a turn about the centre of the world, if all that it shows looks the
    same then: the halfway line, the centre line and the circle.
    """
    for name, station in estimate.stations.items():
        own = [number for number, key in enumerate(sights.keys) if key.station == name]
        of_world = own and all(sights.keys[number].placement is None for number in own)
        if of_world and all(is_seen_turned(*shown) for shown in _shown(sights.take(np.array(own)))):
            pose = station.cam_from_world
            turned = replace(station, cam_from_world=Pose(pose.rotation * TURNED, pose.translation))
            yield replace(estimate, stations={**estimate.stations, name: turned})


def _shown(sights: Sights) -> Iterator[tuple[Target, set[int], set[tuple[int, int]]]]:
    """Each target with the numbers of its observed points, and the numbers and sides of its observed curves."""
    seen = sights.observations
    points, curves = seen.points.take(sights.point_rows), seen.curves.take(sights.curve_rows)
    names = np.array([view.target for view in seen.views])
    for name, target in seen.targets.items():
        p, c = points.take(names[points.view] == name), curves.take(names[curves.view] == name)
        yield target, {*p.feature.tolist()}, {*zip(c.feature.tolist(), c.side.tolist(), strict=True)}


def minima_of(
    others: Sequence[Solution], estimate: Estimate, information: Information, half_width: float
) -> tuple[list[Array], list[float]]:
    """The shifts (K,) from the estimate to other minima whose cost is within the reach of 95 % intervals, and their
    probabilities.

    Args:
        others: solutions with their cost above that of the estimate. information: of the model, about the K numbers.
        half_width: of an interval, in standard deviations.
    """
    alike = 0.01  # share of natural sizes: ends of solves that are no farther apart are the same minimum
    sizes = natural_sizes(estimate, information.keys)
    shifts, odds = list[Array](), list[float]()
    here = np.zeros(len(sizes))
    for one in sorted(others, key=lambda other: other.cost):
        shift = difference(one.estimate, estimate, information.keys)
        least = min(half_width**2, _OTHER * float(shift @ information.matrix @ shift))
        if 2.0 * one.cost < least and all(np.max(np.abs(shift - d) / sizes) > alike for d in (here, *shifts)):
            shifts.append(shift)
            odds.append(float(np.exp(-max(one.cost, 0.0))))
    return shifts, [each / (1.0 + sum(odds)) for each in odds]


def seen_alike(
    others: Sequence[Solution], estimate: Estimate, stations: Iterable[str], half_width: float
) -> Iterator[tuple[str, bool]]:
    """A warning for each station that may stand elsewhere, with its likeliest other place, and whether it would then
    show other places on the floor; such places come first.

    Args:
        stations: those that see the world; boards alone determine no place on the floor. others, half_width: see
            `minima_of`.
    """
    likely = [one.estimate for one in sorted(others, key=lambda other: other.cost) if 2.0 * one.cost < half_width**2]
    for name in stations:
        here, camera = estimate.stations[name].cam_from_world.position, estimate.camera_at(name)
        far = _APART * abs(here[2])
        elsewhere = [one.camera_at(name) for one in likely]
        apart = [one for one in elsewhere if _floors_apart_m(camera, one) > far]
        elsewhere = [*apart, *(one for one in elsewhere if np.linalg.norm(one.position - here) > far)]
        if elsewhere:
            there = elsewhere[0].position
            first, second = (f"({', '.join(f'{value:.2f}' for value in place)}) m" for place in (here, there))
            known = "height" if abs(there[2] - here[2]) > far else "rough position (position_m)"
            yield (
                (
                    f"station {name!r}: its observations fit equally well from {first} and from {second}"
                    f"{', with other places on the floor' if apart else ''}: add a point or a line, or the "
                    f"camera's {known} as a prior"
                ),
                bool(apart),
            )


def _floors_apart_m(camera: Camera, other: Camera) -> float:
    """Median distance (m) over the picture between the places on the floor that two cameras show; it is nearly 0 along
    a valley of phi and height.
    """
    grid = np.linspace(0.1, 0.9, 5)
    pixels = np.stack(np.meshgrid(*(grid * size for size in camera.image_size)), axis=-1).reshape(-1, 2)
    apart = np.linalg.norm(camera.locate(pixels) - other.locate(pixels), axis=1)
    return median(apart[np.isfinite(apart)]) if np.isfinite(apart).any() else np.inf


@or_none  # quiet: nothing is visible from that start, so there is no minimum
def solved_soon(problem: Problem, start: Estimate, *, is_near: bool = True) -> Solution | None:
    """The end of a short solve; None where it finds nothing. Along a flat valley the solver would make hundreds of
    small steps that change nothing here.
    """
    near = 1e-6  # variance that may remain: the end is off by a thousandth of a standard deviation
    short = replace(problem.options, max_iterations=min(30, problem.options.max_iterations))
    precision = near / max(problem.equations, 1)
    solution = solve(replace(problem, options=short), start, is_near=is_near, precision=precision)
    return None if solution.failed else solution


def _at_other_phi(problem: Problem, least: Solution) -> Iterator[Solution]:
    """Where solves end that start with another phi of one camera, beside the least cost of all others."""
    factors = 0.7, 0.85, 1.15, 1.4  # on phi: the other valleys seen so far began within a sixth
    here = least.estimate
    for name in [name for name, numbers in problem.layout.free.items() if 0 in numbers]:
        alone, camera = problem.about(name, here), here.cameras[name]
        others = least.cost - (least if alone is problem else solve(alone, here)).cost
        for factor in factors:
            start = replace(here, cameras={**here.cameras, name: replace(camera, phi=factor * camera.phi)})
            if (end := solved_soon(alone, start, is_near=False)) is not None:
                yield replace(end, cost=end.cost + others)
