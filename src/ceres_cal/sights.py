"""Sights: what one camera at one station sees of one rigid frame, gathered over all its views.

The frame is the world or a placement. A static camera's many frames of a field are one sight; each board frame is one of
its own. Rows are kept so that residuals find their way back to the observations' permanent ids.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceres_cal.camera import Camera
from ceres_cal.observations import Columns, Observations
from ceres_cal.transforms import Array

Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Sight:
    """The observations of one camera at one station of one frame; `placement` None is the world.

    Attributes:
        point_rows, curve_rows: (N,), (M,) rows of the observations' columns.
        points: (N, 3) m in the frame. pixels: (N, 2). sigma_px: (N,).
        tracks: (T, 3, 3) and is_arc: (T,): every curve and side of every target (see `targets.along_track`).
        track: (M,) index into tracks. curve_pixels: (M, 2). curve_sigma_px: (M,).
    """

    camera: str
    station: str
    placement: str | None
    views: tuple[int, ...]
    point_rows: Rows
    points: Array
    pixels: Array
    sigma_px: Array
    curve_rows: Rows
    tracks: Array
    is_arc: Mask
    track: NDArray[np.int32]
    curve_pixels: Array
    curve_sigma_px: Array

    @property
    def frame_name(self) -> str:
        """How messages name the sight."""
        return f"station {self.station!r}" + (f", placement {self.placement!r}" if self.placement is not None else "")


def gather_sights(
    observations: Observations, points_used: Mask | None = None, curves_used: Mask | None = None
) -> tuple[Sight, ...]:
    """The sights of all observations, or of those rows that are used; sights without any observation are left out."""
    keys = [(view.camera, view.station, view.placement) for view in observations.views]
    order = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    sight_of_view = np.array([order[key] for key in keys], dtype=np.int64)
    views_of: list[list[int]] = [[] for _ in order]
    for number, key in enumerate(keys):
        views_of[order[key]].append(number)

    names = list(observations.targets)
    targets = [observations.targets[name] for name in names]
    target_of_view = np.array([names.index(view.target) for view in observations.views], dtype=np.int64)
    first_point = np.cumsum([0, *(len(t.points) for t in targets)])
    first_track = np.cumsum([0, *(3 * len(t.curves) for t in targets)])
    all_points = np.concatenate([t.point_array for t in targets])
    all_tracks = np.concatenate([t.tracks.reshape(-1, 3, 3) for t in targets])
    all_arcs = np.concatenate([np.tile(t.is_arc, 3) for t in targets])
    curve_count = np.array([len(t.curves) for t in targets], dtype=np.int64)

    points, curves = observations.points, observations.curves
    point_rows, point_bounds = _grouped(points, sight_of_view, len(order), points_used)
    curve_rows, curve_bounds = _grouped(curves, sight_of_view, len(order), curves_used)
    of_point = target_of_view[points.view[point_rows]]
    of_curve = target_of_view[curves.view[curve_rows]]
    xyz = all_points[first_point[of_point] + points.feature[point_rows]]
    side = curves.side[curve_rows] % 3  # -1 is the last of a target's three sets of tracks
    track = first_track[of_curve] + side * curve_count[of_curve] + curves.feature[curve_rows]

    sights = []
    for number, (camera, station, placement) in enumerate(order):
        p = slice(point_bounds[number], point_bounds[number + 1])
        c = slice(curve_bounds[number], curve_bounds[number + 1])
        if p.start == p.stop and c.start == c.stop:
            continue
        sights.append(
            Sight(
                camera,
                station,
                placement,
                tuple(views_of[number]),
                point_rows[p],
                xyz[p],
                points.pixels[point_rows[p]],
                points.sigma_px[point_rows[p]],
                curve_rows[c],
                all_tracks,
                all_arcs,
                track[c].astype(np.int32),
                curves.pixels[curve_rows[c]],
                curves.sigma_px[curve_rows[c]],
            )
        )
    return tuple(sights)


def _grouped(columns: Columns, sight_of_view: Rows, count: int, used: Mask | None) -> tuple[Rows, Rows]:
    """Rows in the order of their sights, and where each sight begins."""
    rows = np.arange(len(columns)) if used is None else np.flatnonzero(used)
    sight = sight_of_view[columns.view[rows]]
    order = np.argsort(sight, kind="stable")
    return rows[order], np.searchsorted(sight[order], np.arange(count + 1))


def nearest_places(sight: Sight, camera: Camera) -> Array:
    """Where on its track each curve observation's ray passes nearest, (M,): the start of the search for the foot.

    `camera` stands in the sight's own frame (cam_from_frame). Where the lens has no ray the track's origin is taken.
    """
    rays = np.nan_to_num(camera.rays(sight.curve_pixels) @ camera.cam_from_world.rotation)
    tracks, is_arc = sight.tracks[sight.track], sight.is_arc[sight.track]
    c, a = tracks[:, 0], tracks[:, 1]
    away = camera.position - c
    # Arc: where the ray meets the arc's plane. Segment: the common perpendicular of ray and line.
    with np.errstate(divide="ignore", invalid="ignore"):
        on_plane = away - (away[:, 2] / rays[:, 2])[:, None] * rays
        turned = np.arctan2(on_plane[:, 1], on_plane[:, 0])
        aa, ar, rr = np.sum(a * a, 1), np.sum(a * rays, 1), np.sum(rays * rays, 1)
        straight = (np.sum(a * away, 1) * rr - np.sum(rays * away, 1) * ar) / (aa * rr - ar * ar)
    return np.nan_to_num(np.where(is_arc, turned, straight), posinf=0.0, neginf=0.0)
