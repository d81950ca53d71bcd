"""Crossings and corners: points where measured branches of painted curves meet."""

from __future__ import annotations

import numpy as np

from ceres_cal.base import Array, Indices, Mask, distinct
from ceres_cal.detect.courses import course_at
from ceres_cal.detect.lines import Lines
from ceres_cal.observations import Points
from ceres_cal.scene import Camera, Target, distance_to_curve, in_image, nearest_on_curve

# Number of places, beside the few of a branch, that are assumed to scatter as stated. A branch whose places scatter
# more (it ends in worn paint or in a shadow) gets a larger variance. From 0 to 8 only the largest errors change.
_AS_STATED = 2.0


_Branch = tuple[Array, float, float, Indices]
"""A curve near a point: its normal in the image, the paint's offset along it, px, its variance, and the rows used."""


def find_crossings(target: Target, camera: Camera, lines: Lines) -> tuple[Points, Mask]:
    """Return every point of the target in which at least two measured curves meet, and a mask (N,) of the lines' places
    that were used for them. A caller that uses both must leave these places out, or pixels count twice.

    Each branch is a parabola through the offsets of its nearest places from the course. The course itself bends as lens
    and arc do, except for what the lens model does not describe. With straight lines points were up to nine standard
    deviations off.
    """
    on_curve_m = 1e-6
    used = np.zeros(len(lines.course), dtype=bool)
    features, pixels, sigmas = [], [], []
    shapes, seen = list(target.curves.values()), distinct(lines.course.curve[lines.found]).tolist()
    for number, point in enumerate(target.point_array):
        curves = [curve for curve in seen if distance_to_curve(shapes[curve], point[None])[0] < on_curve_m]
        branches = [b for curve in curves if (b := _branch(target, camera, lines, curve, point, used)) is not None]
        met = _met(branches)
        if met is None:
            continue
        pixel = camera.project(point[None])[0] + met[0]
        if in_image(pixel, camera.image_size):
            features.append(number)
            pixels.append(pixel)
            sigmas.append(met[1])
            for *_, rows in branches:
                used[rows] = True
    columns = np.array(features, np.int32), np.reshape(pixels, (-1, 2)), np.array(sigmas, float)
    return Points(np.zeros(len(features), np.int32), *columns), used


def _branch(target: Target, camera: Camera, lines: Lines, curve: int, point: Array, used: Mask) -> _Branch | None:
    # How far a branch is followed, and the prior standard deviation of its bend at that distance.
    reach_px, bent_px = 100.0, 0.5
    # Number of places: on each side of a branch that continues, of a branch that ends, and the least number.
    each_way, one_way, fewest = 3, 8, 3
    course = lines.course
    foot = nearest_on_curve(target.curves[target.curve_names[curve]], point[None])
    here = course_at(target, camera, np.array([curve], np.int32), foot)
    rows = np.flatnonzero(lines.found & ~used & (course.curve == curve))
    away = course.pixels[rows] - here.pixels[0]
    along = away @ np.array([here.normals[0, 1], -here.normals[0, 0]])
    order = np.argsort(np.abs(along))
    order = order[np.linalg.norm(away[order], axis=1) < reach_px]
    before, after = order[along[order] <= 0.0], order[along[order] > 0.0]
    most = each_way if len(before) and len(after) else one_way
    chosen = np.concatenate([before[:most], after[:most]])
    if len(chosen) < fewest:
        return None
    rows, along = rows[chosen], along[chosen]
    weight = lines.sigma_px[rows] ** -2.0
    basis = np.vander(along / reach_px, 3, increasing=True)
    covariance = np.linalg.inv(basis.T @ (weight[:, None] * basis) + np.diag([0.0, 0.0, bent_px**-2.0]))
    offset = covariance @ (basis.T @ (weight * lines.offset_px[rows]))
    squares = float(weight @ (lines.offset_px[rows] - basis @ offset) ** 2)
    more = max(1.0, (squares + _AS_STATED) / (len(rows) - 2 + _AS_STATED))
    return here.normals[0], float(offset[0]), more * float(covariance[0, 0]), rows


def _met(branches: list[_Branch]) -> tuple[Array, float] | None:
    """Return the offset (2,) px of the branches' meeting point from its predicted place, and its standard deviation;
    None where they do not determine it.
    """
    most_stretched = 3.0  # largest ratio of the crossing's longest standard deviation to its shortest
    if len(branches) < 2:
        return None
    across, offsets, variances, _ = zip(*branches, strict=True)
    normals, weight = np.array(across), 1.0 / np.array(variances)
    information = normals.T @ (weight[:, None] * normals)
    least, most = np.linalg.eigvalsh(information)
    if not least > most / most_stretched**2:
        return None
    covariance = np.linalg.inv(information)
    offset = covariance @ (normals.T @ (weight * offsets))
    return offset, float(np.sqrt(0.5 * np.trace(covariance)))
