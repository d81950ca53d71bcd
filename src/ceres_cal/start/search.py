"""Search for a camera's pose and phi from everything that one sight shows.

Candidates are cameras that closed forms propose, cameras from minimal sets of four points or lines of a floor (a wrong
label spoils few of them), and a grid of rotations and phi, for which the position is linear in the observations. All
are judged by the same robust cost of the same distances in px. The best are brought to their minima by damped
Gauss-Newton steps. Candidates that cost no more than the best, within chance, are kept beside it.

A point P of the floor seen at p gives p x H P = 0, a line l seen as l' gives l x H^T l' = 0: two equations each for the
eight numbers of the homography H. From H follow phi, by r1 . r2 = 0 and |r1| = |r2|, and the pose.
"""

from __future__ import annotations

import pickle
from functools import cache, lru_cache
from itertools import combinations

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, rotation_exp, skews
from ceres_cal.observations import joined
from ceres_cal.start.closed_forms import orthogonality_error, poses_from_homographies
from ceres_cal.start.sightlines import LEAST_PX, CameraPrior, Candidates, Sightlines

_PHI_GRID = (0.45, 0.8, 1.4, 2.4, 4.2, 7.0)  # in half image diagonals
_TILTS = tuple(np.deg2rad((0.0, 18.0, 36.0, 54.0, 70.0, 82.0)))
_AZIMUTHS, _ROLLS = (1, 6, 11, 15, 18, 18), 18
_FIRST_STEPS, _STEPS, _LAST_STEPS = 6, 12, 20
_ROUGH_PX = 2.0  # scale of the residuals in the first rounds of a search
_DAMPING, _LEAST_DAMPING, _GIVEN_UP = 1e-2, 1e-9, 1e2


class BestCameras(Frozen):
    """The best cameras, the least cost first.

    Attributes:
        poses: K of them. costs: (K,) robust, in variances. scale_px: of the residuals at the best.
    """

    poses: Candidates
    costs: Array
    scale_px: float


def information(lines: Sightlines, pose: Candidates, scale_px: float) -> Array:
    """(8, 8) information on one camera's numbers, from rows that fit it and the prior; 0 for held numbers."""
    r, derivatives = lines.equations(pose)
    weights = 1.0 / (scale_px**2 * (1.0 + (r[0] / (2.0 * scale_px)) ** 2) ** 2)
    matrix = (derivatives[0] * weights) @ derivatives[0].T
    matrix[range(3, 8), range(3, 8)] += lines.known.residuals(pose)[1] ** 2
    free = ~lines.known.held
    return np.asarray(matrix * free[:, None] * free)


def refined(lines: Sightlines, poses: Candidates, steps: int, most_px: float = np.inf) -> Candidates:
    """Move each candidate towards its minimum, at the scale of its own residuals but at most `most_px`."""
    nothing = 1e-3  # gain, in variances, below which a candidate has converged
    if not len(poses):
        return poses
    damping = np.full(len(poses), _DAMPING)
    free = np.flatnonzero(~lines.known.held)
    at = lines.equations(poses)
    for _ in range(steps):
        scale = np.clip(scales(at[0], lines.weight, len(free)), lines.known.least_px, most_px)
        step = _step(lines, at, poses, scale, damping)
        moved = poses.moved(step)
        there = lines.equations(moved)
        gained = _cost(lines, at[0], poses, scale) - _cost(lines, there[0], moved, scale)
        better = gained > 0.0
        better &= _possible(lines, moved)
        poses = moved.where(better, poses)
        at = np.where(better[:, None], there[0], at[0]), np.where(better[:, None, None], there[1], at[1])
        damping = np.clip(damping * np.where(better, 0.2, 6.0), _LEAST_DAMPING, 1e6)
        if np.all(np.where(better, gained < nothing, damping > _GIVEN_UP)):
            break
    return poses


def _step(lines: Sightlines, at: tuple[Array, Array], poses: Candidates, scale: Array, damping: Array) -> Array:
    """(K, 8) damped Gauss-Newton steps, reweighted against rows that do not fit."""
    most_step = 0.3  # largest turn (rad) and change of log phi in a step
    r, derivatives = at
    free = np.flatnonzero(~lines.known.held)
    weights = lines.weight / (scale**2 * (1.0 + (r / (2.0 * scale)) ** 2))
    jacobian = derivatives[:, free]
    weighted = jacobian * weights[:, None]
    normal = weighted @ np.swapaxes(jacobian, 1, 2)
    right = (weighted @ r[..., None])[..., 0]
    said, share = lines.known.residuals(poses)
    diagonal, sums = np.zeros(8), np.zeros((len(poses), 8))
    diagonal[3:], sums[:, 3:] = share**2, said * share
    each = range(len(free))
    normal[:, each, each] += diagonal[free]
    right += sums[:, free]
    sizes = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    normal = normal / sizes[:, :, None] / sizes[:, None, :]
    normal[:, each, each] += damping[:, None]
    step = np.zeros((len(poses), 8))
    step[:, free] = -np.linalg.solve(normal, (right / sizes)[..., None])[..., 0] / sizes
    step[:, :3] = _bounded(step[:, :3], most_step)
    step[:, 6] = np.clip(step[:, 6], -most_step, most_step)
    return step


def _bounded(vectors: Array, most: float) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, most / np.maximum(length, 1e-12)))


def scales(r: Array, share: Array, free: int) -> Array:
    """(K, 1) px: the weighted median of residuals (K, N), beyond those that `free` numbers can fit; `share`:
    weights.
    """
    rounding = 1e-9
    order = np.argsort(np.abs(r), axis=1)
    sums = np.cumsum(np.take_along_axis(np.broadcast_to(share, r.shape), order, 1), axis=1)
    total = sums[:, -1:]
    middle = np.argmax(sums >= np.minimum(0.5 * (total + free), total) - rounding, axis=1)[:, None]
    return np.maximum(np.abs(np.take_along_axis(r, np.take_along_axis(order, middle, 1), 1)), LEAST_PX)


def _cost(lines: Sightlines, r: Array, poses: Candidates, scale: Array | float) -> Array:
    said, _ = lines.known.residuals(poses)
    robust = 4.0 * np.log1p((r / (2.0 * scale)) ** 2)
    return np.asarray(robust @ lines.weight + np.sum(said**2, axis=1))


def _possible(lines: Sightlines, poses: Candidates) -> Mask:
    """(K,) whether a camera stands above what it sees, with a phi that lenses have."""
    widest = 2.7  # difference of log phi from the middle: from a fisheye to a telescope
    lowest = 0.01  # least height over the extent of what is seen: a camera that lies on a line sees it everywhere
    floor, reach = float(lines.places[:, 2].min()), float(np.ptp(lines.places, axis=0).max())
    is_lens = np.abs(poses.log_phi - lines.known.log_phi[0]) < widest
    return np.asarray(is_lens & (poses.positions[:, 2] > floor + lowest * reach))


def judged(lines: Sightlines, poses: Candidates, least_px: float) -> tuple[Array, Array]:
    """Costs (K,), minus twice the log likelihood of Cauchy errors, each at the scale (K, 1) px of the candidate's own
    residuals, which is at least `least_px`; rows in impossible places cost more.

    A curve's label is right; or it is wrong, which is unlikely, and all of its rows then count only as much as the
    numbers that it determines. The scale is that of the other rows.
    """
    behind = 20.0  # residual, in scales, of a row that is seen behind the camera or beyond the ends of its line
    far_px = 1e6
    r = np.nan_to_num(lines.distances(poses), nan=far_px, posinf=far_px, neginf=-far_px)
    free = int(np.count_nonzero(~lines.known.held))
    scale = np.maximum(scales(r, lines.weight, free), least_px)
    r = np.where(lines.seen(poses), r, np.maximum(np.abs(r), behind * scale))
    wrong = _by_labels(lines, r, np.maximum(scales(r, lines.weight, free), least_px))[1]
    scale = np.maximum(scales(r, np.where(wrong, 0.0, 1.0), free), least_px)
    cost = _by_labels(lines, r, scale)[0] + np.sum(lines.known.residuals(poses)[0] ** 2, axis=1)
    return np.where(_possible(lines, poses), cost, np.inf), scale


def _by_labels(lines: Sightlines, r: Array, scale: Array) -> tuple[Array, Mask]:
    """Costs (K,) of residuals (K, N), and a mask of the rows of curves whose labels are likely wrong."""
    wrong_label = 25.0  # cost of a wrong label, in variances
    rows = 4.0 * np.log1p((r / (2.0 * scale)) ** 2) + 4.0 * np.log(scale)
    first, wrong = lines.groups, np.zeros(r.shape, dtype=bool)
    if not len(first):
        return np.sum(rows, axis=1), wrong
    right = np.add.reduceat(rows, first, axis=1)
    otherwise = wrong_label + lines.weight[first] * right
    wrong[:, first[0] :] = np.repeat(otherwise < right, np.diff(np.append(first, r.shape[1])), axis=1)
    return np.sum(rows[:, : first[0]], axis=1) + np.sum(np.minimum(right, otherwise), axis=1), wrong


def costs(lines: Sightlines, poses: Candidates, least_px: float) -> Array:
    """(K,) costs of `judged`."""
    return judged(lines, poses, least_px)[0]


def searched(lines: Sightlines, few: Sightlines, proposed: Candidates | None = None) -> BestCameras:
    """The best cameras of the proposed ones, of minimal sets and of a grid.

    A calibration of few clicks asks for the same search four times or more, for lenses, stretched pictures and other
    starts; it is made once.

    Args:
        few: some of the rows, for the first rounds.
    """
    return _searched_once(pickle.dumps((lines, few, proposed or Candidates.none())))


@lru_cache(maxsize=32)
def _searched_once(asked: bytes) -> BestCameras:
    """The answer to the pickled arguments of `searched`."""
    return _searched(*pickle.loads(asked))


def _searched(lines: Sightlines, few: Sightlines, proposed: Candidates) -> BestCameras:
    near = 0.02  # rad, and share of the height: nearer candidates are on the way to the same minimum
    first, then = 64, 20  # numbers of candidates that are refined first, and further
    rough_px = max(_ROUGH_PX, lines.known.least_px)
    some = _drawn(few)
    some = some.take(np.argsort(costs(few, some, 8.0 * rough_px))[:first])
    sets = minimal_sets(few, _logs(few.known, np.geomspace(_PHI_GRID[0], _PHI_GRID[-1], 60)))
    sets = sets.take(np.argsort(costs(few, sets, rough_px))[:then]) if len(sets) else sets
    some = refined(few, joined([proposed, some]), _FIRST_STEPS)
    some = joined([refined(few, sets, _FIRST_STEPS, rough_px), some])
    some = some.take(apart(some, costs(few, some, rough_px), near)[:then])
    return best_of(lines, joined([proposed, refined(lines, some, _STEPS)]))


def best_of(lines: Sightlines, some: Candidates) -> BestCameras:
    """The best of some candidates, brought to their minima."""
    some = refined(lines, some, _LAST_STEPS)
    cost, scale = judged(lines, some, lines.known.least_px)
    order = np.argsort(cost)
    return BestCameras(some.take(order), cost[order], float(scale[order[0], 0]))


def apart(poses: Candidates, costs: Array, least: float) -> Indices:
    """(n,) numbers of candidates that differ in place from each one with a lower cost, the lowest first.

    Args:
        least: least difference, in rad for rotations, or as a share of the height for positions.
    """
    kept: list[int] = []
    height = np.maximum(np.abs(poses.positions[:, 2]), 1e-9)
    for number in np.argsort(costs, kind="stable"):
        turned = np.linalg.norm(poses.rotations[kept] - poses.rotations[number], axis=(1, 2)) / np.sqrt(2.0)
        moved = np.linalg.norm(poses.positions[kept] - poses.positions[number], axis=1) / height[kept]
        if np.all((turned > least) | (moved > least)):
            kept.append(int(number))
    return np.array(kept, dtype=np.int64)


def _logs(known: CameraPrior, grid: Array) -> Array:
    """Values of log phi to try, from a grid in half image diagonals; only one where phi is known."""
    middle, sd = known.log_phi
    return middle + np.log(grid) - np.log(1.1) if sd > 0.2 else np.array([middle])


def _drawn(few: Sightlines) -> Candidates:
    """A grid of rotations and phi, each with its position."""
    logs = _logs(few.known, np.array(_PHI_GRID))
    rotations = np.tile(_grid(), (len(logs), 1, 1))
    log_phi = np.repeat(logs, len(_grid()))
    positions, floor = few.positions(rotations, log_phi), float(few.places[:, 2].min())
    positions[:, 2] = floor + np.abs(positions[:, 2] - floor)  # a camera under the floor is mirrored to above it
    return Candidates(rotations, positions, log_phi, np.zeros(len(log_phi)))


@cache
def _grid() -> Array:
    """(K, 3, 3) frame_from_cam: axes evenly over the lower half sphere, each with some rolls."""
    down = np.diag([1.0, -1.0, -1.0])
    rolls = [down @ rotation_exp([0.0, 0.0, a]) for a in np.arange(_ROLLS) * (2.0 * np.pi / _ROLLS)]
    axes = [
        rotation_exp([tilt * np.cos(a), tilt * np.sin(a), 0.0])
        for tilt, count in zip(_TILTS, _AZIMUTHS, strict=True)
        for a in np.arange(count) * (2.0 * np.pi / count)
    ]
    return np.array([axis @ one for axis in axes for one in rolls])


# ---- minimal sets ---------------------------------------------------------------------------------------------------


def minimal_sets(lines: Sightlines, log_phi: Array) -> Candidates:
    """Cameras from sets of four points or lines of the floor.

    Args:
        log_phi: (P,) values from which that of each camera is chosen.
    """
    second = 1e-4  # ratio of the second least to the largest singular value, below which four make no homography
    floor, image, is_line = _elements(lines)
    if len(floor) < 4:
        return Candidates.none()
    sets = _sets_of_four(len(floor))
    reach = max(float(np.abs(lines.places[:, :2]).max()), 1e-9)
    to_floor = np.diag([1.0 / reach, 1.0 / reach, 1.0])
    to_image = np.diag([1.0 / lines.unit_px, 1.0 / lines.unit_px, 1.0])
    rows = _equations(floor, image, is_line, to_floor, to_image)[sets].reshape(len(sets), -1, 9)
    _, sizes, vectors = np.linalg.svd(rows)
    matrices = vectors[:, -1].reshape(-1, 3, 3)
    matrices = np.linalg.inv(to_image) @ matrices @ to_floor
    good = (sizes[:, -2] > second * sizes[:, 0]) & (np.abs(np.linalg.det(to_image @ matrices)) > 1e-12)
    return _cameras(matrices[good], lines, log_phi)


def _cameras(matrices: Array, lines: Sightlines, log_phi: Array) -> Candidates:
    """The cameras of homographies (K, 3, 3) of the floor, on its upper side."""
    if not len(matrices):
        return Candidates.none()
    error = orthogonality_error(matrices, np.exp(log_phi)) if len(log_phi) > 1 else np.zeros((1, len(matrices)))
    chosen = log_phi[np.argmin(error, axis=0)]
    scaled = matrices * np.stack([np.exp(-chosen), np.exp(-chosen), np.ones(len(chosen))], axis=1)[:, :, None]
    middle = np.append(lines.places[:, :2].mean(axis=0), 1.0)
    scaled *= np.copysign(1.0, (scaled @ middle)[:, 2])[:, None, None]
    poses = poses_from_homographies(scaled)
    finite = np.isfinite(poses).all(axis=(1, 2))
    poses, chosen = poses[finite], chosen[finite]
    rotations = np.swapaxes(poses[:, :, :3], 1, 2)
    positions = -(rotations @ poses[:, :, 3:])[:, :, 0]
    positions[:, 2] += _floor(lines)
    return Candidates(rotations, positions, chosen, np.zeros(len(chosen)))


def _floor(lines: Sightlines) -> float:
    """The z at which most rows lie."""
    heights, votes = np.unique(lines.places[:, 2].round(9), return_counts=True)
    return float(heights[np.argmax(votes)])


def _elements(lines: Sightlines) -> tuple[Array, Array, Mask]:
    """Points and straight lines of the floor (E, 3), their images (E, 3), and which are lines (E,)."""
    spread = 1e-6  # relative spread of the rows of an image line, below which they are one place
    level = 1e-9
    height, seen = _floor(lines), np.column_stack([lines.pixels, lines.w])
    floor, image, is_line = [], [], []
    for row in np.flatnonzero(np.abs(lines.places[: lines.counts[0], 2] - height) < level):
        floor.append([*lines.places[row, :2], 1.0])
        image.append(seen[row])
        is_line.append(False)
    arcs = 2 * lines.counts[0] + lines.counts[1]
    for first, last in lines.spans:
        place, along = lines.places[first], lines.along[first]
        if first >= arcs or abs(place[2] - height) > level or abs(along[2]) > level * np.linalg.norm(along):
            continue
        scaled = seen[first:last] / [lines.unit_px, lines.unit_px, 1.0]
        _, sizes, vectors = np.linalg.svd(scaled, full_matrices=True)
        if len(scaled) < 2 or sizes[1] < spread * sizes[0]:
            continue
        normal = np.array([-along[1], along[0]])
        floor.append([*normal, -normal @ place[:2]])
        image.append(vectors[-1] / [lines.unit_px, lines.unit_px, 1.0])
        is_line.append(True)
    return np.array(floor).reshape(-1, 3), np.array(image).reshape(-1, 3), np.array(is_line, dtype=bool)


def _equations(floor: Array, image: Array, is_line: Mask, to_floor: Array, to_image: Array) -> Array:
    """(E, 3, 9) rows of each point or line, of rank two, for H from scaled places to scaled pixels."""
    # A line l becomes T^-T l if points become T p.
    f = np.where(is_line[:, None], floor @ np.linalg.inv(to_floor), floor @ to_floor)
    p = np.where(is_line[:, None], image @ np.linalg.inv(to_image), image @ to_image)
    f, p = f / np.linalg.norm(f, axis=1, keepdims=True), p / np.linalg.norm(p, axis=1, keepdims=True)
    # For a point: [p]x H f, whose rows are sums of p_i H_jk f_k; for a line: [f]x H^T p.
    of_point = np.einsum("eij,ek->eijk", skews(p), f)
    of_line = np.einsum("eik,ej->eijk", skews(f), p)
    return np.asarray(np.where(is_line[:, None, None, None], of_line, of_point).reshape(len(f), 3, 9))


def _sets_of_four(count: int) -> Indices:
    """(S, 4) sets of four out of `count`: all of them, or some at random, the same in every run."""
    few_elements, most_sets = 9, 120  # elements of which all sets of four are taken, and number of sets of more
    if count <= few_elements:
        return np.array(list(combinations(range(count), 4)), dtype=np.int64)
    rng = np.random.default_rng(0)
    return np.array([rng.permutation(count)[:4] for _ in range(most_sets)], dtype=np.int64)
