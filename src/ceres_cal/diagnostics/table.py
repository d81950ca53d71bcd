"""The residual table: one row per observation, stored in columns, with its permanent id."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ceres_cal.base import AnyArray, Array, Codes, Indices, InputError, Mask, numbers_of, write_bytes, write_json
from ceres_cal.base.frozen import Frozen
from ceres_cal.effects.linearised import Linearised
from ceres_cal.observations import Observations, column_of
from ceres_cal.problem.residuals import Equations, plane_shift
from ceres_cal.robust.noise import Inliers
from ceres_cal.scene.camera import Camera

INLIER, TOO_FAR, NOT_SEEN, COPIED = 0, 1, 2, 3
REASONS = ("", "too far off", "cannot be seen from there", "a copy of another")
"""Reasons why an observation was rejected, by its code in `ResidualTable.reason`."""
_MEASURES = ("distance_px", "error_mm", "sigma_px", "scale", "weight", "leverage", "standardised", "radius_px")
"""Columns that files contain unchanged."""


class ResidualTable(Frozen):
    """N observations: the points by row, then the curve observations by row.

    Attributes:
        is_curve, row: (N,) the permanent id: kind and row of the observations' columns.
            view: (N,) index into `views`, each with the names of frame, camera, station, target and placement.
            feature: (N,) index into `features`, "target/name".
            pixel: (N, 2) where it was observed, px. residual_px: (N, 2) model minus observation; of a curve observation
                to the foot of the perpendicular. distance_px: (N,) its length; of a curve observation signed, positive
                where the curve is on the right of the observation for somebody who walks along the curve in the image.
            error_mm: (N,) the same on the target's plane, by the local derivative of the projection: distance from its
                feature to where the observation places it. NaN where the plane is seen edge-on.
            sigma_px: (N,) stated; scale: (N,) estimated factor on it. weight: (N,) of the robust loss, 0 where
                rejected.
            leverage: (N,) share of the observation that the fit absorbed, 0 to 1 (mean of a point's two equations); of
                a rejected one, the fit's own variance there over the noise's.
            standardised: (N,) residual over its own standard deviation, which is reduced by the fit's share: of a point
                the length of two such numbers, of a curve observation signed.
            radius_px: (N,) from the principal point, square pixels. reason: (N,) code of REASONS, 0 for an inlier.

        Values are NaN where the calibration cannot show the observation.
    """

    is_curve: Mask
    row: Indices
    view: Indices
    views: tuple[dict[str, str | None], ...]
    feature: Indices
    features: tuple[str, ...]
    pixel: Array
    residual_px: Array
    distance_px: Array
    error_mm: Array
    sigma_px: Array
    scale: Array
    weight: Array
    leverage: Array
    standardised: Array
    radius_px: Array
    reason: Codes

    def __len__(self) -> int:
        return len(self.row)

    @property
    def inlier(self) -> Mask:
        return np.asarray(self.reason == INLIER)

    @property
    def outlier(self) -> Mask:
        """(N,) observations that were rejected for their residuals; copies of others were rejected, too."""
        return np.asarray((self.reason == TOO_FAR) | (self.reason == NOT_SEEN))

    def id_of(self, number: int) -> str:
        """Return the name of an observation in messages: "point 17" or "curve 4"."""
        return f"{'curve' if self.is_curve[number] else 'point'} {self.row[number]}"

    def columns(self) -> dict[str, AnyArray]:
        """Return every column as a flat array, by its name in the exported files, with names written out."""
        views = {
            name: np.array([view[name] or "" for view in self.views], dtype=np.str_)[self.view]
            for name in ("frame", "camera", "station", "target", "placement")
        }
        return {
            "kind": np.where(self.is_curve, "curve", "point"),
            "row": self.row,
            **views,
            "feature": np.array([name.partition("/")[2] for name in self.features], dtype=np.str_)[self.feature],
            "pixel_x": self.pixel[:, 0],
            "pixel_y": self.pixel[:, 1],
            "residual_x_px": self.residual_px[:, 0],
            "residual_y_px": self.residual_px[:, 1],
            **{name: getattr(self, name) for name in (*_MEASURES, "inlier")},
            "reason": np.array(REASONS, dtype=np.str_)[self.reason],
        }

    def save(self, path: Path) -> None:
        """Write columns as .csv, .json or .npz; numbers keep every digit, NaN is empty or null in text.

        Raises:
            InputError: another ending, or the file cannot be written.
        """
        format, version = "ceres-cal/residuals", 1
        if path.suffix not in (".csv", ".json", ".npz"):
            raise InputError(f"{path}: the table is written as .csv, .json or .npz: give one of these endings")
        columns = self.columns()
        if path.suffix == ".npz":
            stream = io.BytesIO()
            np.savez_compressed(stream, allow_pickle=False, **columns)
            write_bytes(path, stream.getvalue())
        elif path.suffix == ".json":
            plain = {name: _plain(column) for name, column in columns.items()}
            write_json(path, {"format": format, "version": version, "columns": plain})
        else:
            import csv

            text = io.StringIO(newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*(_plain(column) for column in columns.values()), strict=True))
            write_bytes(path, text.getvalue().encode())


def _plain(column: AnyArray) -> list[Any]:
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f" and not np.all(np.isfinite(column)):
        return [value if np.isfinite(value) else None for value in values]
    return values


def make_table(inliers: Inliers, model: Linearised, weight: Array, cameras: Mapping[str, Camera]) -> ResidualTable:
    """Return the table of all observations.

    Args:
        weight: (E,) robust weight of each equation's observation.
    """
    equations, observations = model.equations, model.equations.sights.observations
    points, curves = observations.points, observations.curves
    count = len(points) + len(curves)
    is_curve = np.arange(count) >= len(points)
    features, first = _feature_names(observations)
    view = column_of(observations, "view").astype(np.int64)
    target_of_view = numbers_of((one.target for one in observations.views), observations.targets)
    feature = np.concatenate([points.feature, curves.feature]) + first[is_curve.astype(int), target_of_view[view]]
    pixel = column_of(observations, "pixels")
    residual, shown = np.full((count, 2), np.nan), equations.observation
    residual[shown] = equations.displacement(equations.residual, count)[shown]
    distance = np.where(is_curve, _at(shown, equations.residual, count), np.linalg.norm(residual, axis=1))
    inlier = inliers.rows
    original = np.concatenate(observations.copies.originals)
    seen = np.isfinite(residual[:, 0])
    return ResidualTable(
        is_curve,
        np.concatenate([np.arange(len(points)), np.arange(len(curves))]),
        view,
        tuple(vars(one) for one in observations.views),
        feature,
        features,
        pixel,
        residual,
        distance,
        error_mm(equations, equations.residual, count),
        column_of(observations, "sigma_px"),
        np.where(is_curve, inliers.curve_scale, inliers.point_scale),
        np.where(inlier, _at(shown, weight, count), 0.0),
        _mean_leverage(model, count),
        _at(*model.studentised, count),
        _radii(observations, view, pixel, cameras),
        np.select([inlier, seen, original], [INLIER, TOO_FAR, NOT_SEEN], COPIED).astype(np.int8),
    )


def _feature_names(observations: Observations) -> tuple[tuple[str, ...], Indices]:
    """Return all features as "target/name", points of all targets first, and where each target's begin."""
    targets = observations.targets
    points = [f"{name}/{point}" for name, target in targets.items() for point in target.point_names]
    curves = [f"{name}/{curve}" for name, target in targets.items() for curve in target.curve_names]
    starts = [np.cumsum([0, *(len(t.points) for t in targets.values())])[:-1]]
    starts.append(len(points) + np.cumsum([0, *(len(t.curves) for t in targets.values())])[:-1])
    return (*points, *curves), np.array(starts, dtype=np.int64)


def _at(observation: Indices, values: Array, count: int) -> Array:
    """(N,) values at their observations, of several the last one (of a point's two equations); NaN without any."""
    column = np.full(count, np.nan)
    column[observation] = values
    return column


def error_mm(equations: Equations, values: Array, count: int) -> Array:
    """(N,) mm on the target's plane by displacements (E,) px in the image; of a curve signed, else lengths.

    NaN where there is no equation, or where the plane is seen edge-on.
    """
    answer = np.full(count, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = plane_shift(equations, values)
        curves = equations.is_curve
        answer[equations.observation[curves]] = x[curves]
        answer[equations.observation[~curves]] = np.hypot(x, y)[~curves]
    return np.where(np.isfinite(answer), answer, np.nan)


def _mean_leverage(model: Linearised, count: int) -> Array:
    equations, leverage = model.equations, model.leverage
    sums = np.bincount(equations.observation, leverage, count)
    numbers = np.bincount(equations.observation, minlength=count)
    return np.where(numbers > 0, sums / np.maximum(numbers, 1), np.nan)


def _radii(observations: Observations, view: Indices, pixel: Array, cameras: Mapping[str, Camera]) -> Array:
    owner = np.array([one.camera for one in observations.views])[view]
    radii = np.full(len(view), np.nan)
    for name in observations.cameras:
        own = owner == name
        radii[own] = np.linalg.norm(cameras[name].offsets(pixel[own]), axis=1)
    return radii
