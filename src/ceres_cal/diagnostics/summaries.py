"""The residual table by frame, feature, image region and radius."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, numbers_of
from ceres_cal.diagnostics.table import ResidualTable
from ceres_cal.effects import Case, Linearised
from ceres_cal.scene.camera import Camera

REGIONS = (6, 4)
"""Numbers of columns and rows of equal parts into which an image is divided."""
RADIUS_BINS = 12
"""Number of rings of equal width, from the principal point to the farthest corner."""


class Summary(Frozen):
    """Statistics of G groups of observations.

    Attributes:
        names: of the groups. points, curves: (G,) numbers of inliers. rejected: (G,) numbers of outliers.
        points_rms_px: (G,) of the lengths of residual vectors. curves_rms_px: (G,) of the distances. rms_mm: (G,) of
            both on the targets' planes. rms_sigma: (G,) of both in their standard deviations, 1 where the noise is as
            everywhere. All are of inliers, and NaN where a group has none.
    """

    names: tuple[str, ...]
    points: Indices
    curves: Indices
    rejected: Indices
    points_rms_px: Array
    curves_rms_px: Array
    rms_mm: Array
    rms_sigma: Array


class RadiusTrend(Frozen):
    """Radial residuals of one camera, in RADIUS_BINS rings.

    Attributes:
        radius_px: (B + 1,) edges of the rings. outward_px: (B,) mean displacement of the model from the observations,
            away from the principal point, by least squares from points and curves; sd_px: (B,) its standard deviation;
            NaN in a ring without observations.
    """

    camera: str
    radius_px: Array
    outward_px: Array
    sd_px: Array


class Summaries(Frozen):
    """The table by frame ("station frame" where there are several stations), feature ("target/name"), region
    ("camera column,row" from the image's top left) and radius ("camera from-to px"), and each camera's radius trend.
    """

    frames: Summary
    features: Summary
    regions: Summary
    radii: Summary
    trends: tuple[RadiusTrend, ...]


def summarise(case: Case, table: ResidualTable) -> Summaries:
    """Return all summaries of a table."""
    observations, cameras = case.problem.observations, case.estimate.cameras
    several = len(observations.stations) > 1
    labels = [f"{view.station} {view.frame}" if several else view.frame for view in observations.views]
    frames = list(dict.fromkeys(labels))
    frame_of_view = numbers_of(labels, frames)
    camera_names = list(observations.cameras)
    camera = numbers_of([view.camera for view in observations.views], camera_names)[table.view]
    region_names, region = _regions(table, camera, camera_names, cameras)
    radius_names, ring, edges = _rings(table, camera, camera_names, cameras)
    return Summaries(
        _summary(table, frame_of_view[table.view], frames),
        _summary(table, table.feature, list(table.features)),
        _summary(table, region, region_names),
        _summary(table, ring, radius_names),
        tuple(_trend(case.model, cameras[name], name, camera == i, edges[i]) for i, name in enumerate(camera_names)),
    )


def _summary(table: ResidualTable, group: Indices, names: list[str]) -> Summary:
    """Return the groups with any observation, in the order of their names."""
    size, inlier = len(names), table.inlier
    points, curves = inlier & ~table.is_curve, inlier & table.is_curve

    def count(rows: Mask) -> Indices:
        return np.asarray(np.bincount(group[rows], minlength=size))

    def rms(rows: Mask, values: Array) -> Array:
        rows = rows & np.isfinite(values)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(np.bincount(group[rows], values[rows] ** 2, size) / count(rows)))

    numbers = np.where(table.is_curve, 1.0, 2.0)
    sigmas = table.distance_px / (table.sigma_px * table.scale * np.sqrt(numbers))
    counts = np.stack([count(points), count(curves), count(table.outlier)])
    filled = np.flatnonzero(counts.sum(axis=0))
    measured = (points, table.distance_px), (curves, table.distance_px), (inlier, table.error_mm), (inlier, sigmas)
    return Summary(tuple(names[i] for i in filled), *counts[:, filled], *(rms(*one)[filled] for one in measured))


def _regions(
    table: ResidualTable, camera: Indices, names: list[str], cameras: Mapping[str, Camera]
) -> tuple[list[str], Indices]:
    columns, rows = REGIONS
    sizes = np.array([cameras[name].image_size for name in names], dtype=float)[camera]
    place = np.clip(((table.pixel + 0.5) / sizes * REGIONS).astype(np.int64), 0, np.array(REGIONS) - 1)
    region = (camera * rows + place[:, 1]) * columns + place[:, 0]
    return [f"{name} {c},{r}" for name in names for r in range(rows) for c in range(columns)], region


def _rings(
    table: ResidualTable, camera: Indices, names: list[str], cameras: Mapping[str, Camera]
) -> tuple[list[str], Indices, list[Array]]:
    edges = [np.linspace(0.0, cameras[name].corner_radius, RADIUS_BINS + 1) for name in names]
    ring = np.zeros(len(table), dtype=np.int64)
    labels = []
    for number, name in enumerate(names):
        own = camera == number
        ring[own] = number * RADIUS_BINS + _ring_of(table.radius_px[own], edges[number])
        labels += [f"{name} {low:.0f}-{high:.0f} px" for low, high in pairwise(edges[number])]
    return labels, ring, edges


def _ring_of(radius: Array, edges: Array) -> Indices:
    return np.asarray(np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, RADIUS_BINS - 1))


def _trend(model: Linearised, camera: Camera, name: str, own: Mask, edges: Array) -> RadiusTrend:
    equations = model.equations
    rows = np.flatnonzero(own[equations.observation] & model.used)
    offsets = camera.offsets(equations.pixel[rows])
    radius = np.linalg.norm(offsets, axis=1)
    outward = np.sum(equations.direction[rows] * offsets, axis=1) / np.maximum(radius, 1e-9)
    ring = _ring_of(radius, edges)
    weight = model.weight[rows] ** 2
    total = np.bincount(ring, weight * outward**2, RADIUS_BINS)
    moved = np.bincount(ring, weight * outward * equations.residual[rows], RADIUS_BINS)
    with np.errstate(divide="ignore", invalid="ignore"):
        known = total > 0.0
        return RadiusTrend(
            name, edges, np.where(known, moved / total, np.nan), np.where(known, 1.0 / np.sqrt(total), np.nan)
        )
