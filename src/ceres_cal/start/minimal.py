"""Minimal sets: cameras that four points or lines of a floor make by themselves: a wrong label spoils few of them.

A point P of the floor seen at p is p x H P = 0, a line l seen as l' is l x H^T l' = 0: two equations each for the eight
numbers of the homography H. Of H follow phi, by r1 . r2 = 0 and |r1| = |r2|, and the pose.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.transforms import skews
from ceres_cal.start.closed_forms import orthogonality_error, poses_from_homographies
from ceres_cal.start.sightlines import Candidates, Sightlines


def minimal_sets(lines: Sightlines, log_phi: Array) -> Candidates:
    """Cameras by four points or lines of the floor each.

    Args:
        log_phi: (P,) among which that of each is chosen.
    """
    second = 1e-4  # of the greatest singular value: where the second least is smaller, the four make no homography
    floor, image, is_line = _elements(lines)
    if len(floor) < 4:
        return Candidates.none()
    sets = _drawn(len(floor))
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
    """z at which most rows lie."""
    heights, votes = np.unique(lines.places[:, 2].round(9), return_counts=True)
    return float(heights[np.argmax(votes)])


def _elements(lines: Sightlines) -> tuple[Array, Array, Mask]:
    """Points and straight lines of the floor (E, 3), as they are seen (E, 3), and which are lines (E,)."""
    spread = 1e-6  # of an image line's rows, below which they are one place
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
    """(E, 3, 9) rows of each point or line, of rank two, in H from scaled places to scaled pixels."""
    # a line l becomes T^-T l where its points become T p
    f = np.where(is_line[:, None], floor @ np.linalg.inv(to_floor), floor @ to_floor)
    p = np.where(is_line[:, None], image @ np.linalg.inv(to_image), image @ to_image)
    f, p = f / np.linalg.norm(f, axis=1, keepdims=True), p / np.linalg.norm(p, axis=1, keepdims=True)
    # of a point [p]x H f, whose rows are sums of p_i H_jk f_k; of a line [f]x H^T p
    of_point = np.einsum("eij,ek->eijk", skews(p), f)
    of_line = np.einsum("eik,ej->eijk", skews(f), p)
    return np.asarray(np.where(is_line[:, None, None, None], of_line, of_point).reshape(len(f), 3, 9))


def _drawn(count: int) -> Indices:
    """(S, 4) sets of four of so many: all, or some at random, alike in every run."""
    few_elements, most_sets = 9, 120  # of so few all sets of four are taken, else so many at random
    if count <= few_elements:
        return np.array(list(combinations(range(count), 4)), dtype=np.int64)
    rng = np.random.default_rng(0)
    return np.array([rng.permutation(count)[:4] for _ in range(most_sets)], dtype=np.int64)
