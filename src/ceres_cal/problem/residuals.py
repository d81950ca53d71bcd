"""Residuals: differences between the observations and an estimate, in measured pixels, one by one.

Also the equations: every observation that an estimate can show, as scalar equations with all their derivatives, in px.

A point gives two equations, one for each image axis; a curve observation gives one, along the image normal at its foot.
Any alternative to the model is a column over these equations: displacements in the image enter by `direction`,
displacements on a target by `built`, motions of the camera by `pose`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from ceres_cal import kernels
from ceres_cal.base import AnyArray, Array, Frozen, Indices, Mask, SolutionError, cached_property, replace
from ceres_cal.base.threads import parts_of, run_parts
from ceres_cal.observations.files import Content
from ceres_cal.observations.sights import Sights, nearest_feet
from ceres_cal.problem.parameters import Estimate, intrinsics_vector, unit_px
from ceres_cal.problem.structure import Structure, Tolerance, make_structure
from ceres_cal.scene import LENSES, Camera, Target, along_track

# Share of observations that may be anywhere in the image: as many as are wrong in the simulated days of
# scripts/accuracy/moves.py. Halving or doubling changes nothing.
_STRAY = 0.05


class Residuals(Frozen):
    """Residuals in the order of the observations, px; NaN where the estimate cannot show an observation at all.

    Attributes:
        points: (N, 2), projected minus observed. curves: (M,), signed distance from the observed pixel to the curve.
        feet: (M,) the foot of that distance, as the parameter of the curve's track.
    """

    points: Array
    curves: Array
    feet: Array

    @cached_property
    def lengths(self) -> tuple[Array, Array]:
        """Lengths of the residuals of points (N,) and of curves (M,), px."""
        points = np.abs(np.ascontiguousarray(self.points).view(complex)[:, 0])  # in one pass
        return points, np.abs(self.curves)

    def of_rows(self, points: Indices, curves: Indices) -> Residuals:
        """The residuals of some of the observations, given by rows, as if there were no others."""
        return Residuals(self.points[points], self.curves[curves], self.feet[curves])

    def in_sigmas(self, sights: Sights, scales: tuple[float, float]) -> tuple[Array, Array]:
        """(N,) lengths of the residuals of the sights' points and (M,) of their curve observations, in standard
        deviations at these noise scales.
        """
        points = np.linalg.norm(self.points[sights.point_rows], axis=1) / (scales[0] * sights.sigma_px)
        return points, np.abs(self.curves[sights.curve_rows]) / (scales[1] * sights.curve_sigma_px)

    def misfit(self, sights: Sights, camera: Camera, scales: tuple[float, float]) -> float:
        """Negative log likelihood, in nats, of a camera's sights at these noise scales, where each observation may,
        with a small probability, be anywhere in the image.
        """
        width, height = camera.image_size
        points, curves = self.in_sigmas(sights, scales)
        p, c = sights.sigma_px * scales[0], sights.curve_sigma_px * scales[1]
        total = 0.0
        for lengths, inside, stray in (
            (points, 1.0 / (2.0 * np.pi * p**2), 1.0 / (width * height)),
            (curves, 1.0 / (np.sqrt(2.0 * np.pi) * c), 1.0 / np.hypot(width, height)),
        ):
            likely = (1.0 - _STRAY) * inside * np.exp(-0.5 * np.minimum(np.nan_to_num(lengths, nan=1e3), 1e3) ** 2)
            total -= float(np.sum(np.log(likely + _STRAY * stray)))
        return total


def camera_optics(camera: Camera) -> kernels.Optics:
    """A camera's optics in the form that the kernels take."""
    lens = camera.lens
    kind = lens.kind if LENSES.get(lens.kind) is type(lens) else ""  # a user's lens of that name may differ
    return kernels.Optics(lens, kind, lens.form, intrinsics_vector(camera), unit_px(camera))


def point_columns(sights: Sights, structure: Structure, noise_scale: float | None = None) -> kernels.PointColumns:
    """The point observations of some sights in the form that the kernels take; without a noise scale, no weights."""
    moved = sights.point_index if len(structure.values) else sights.point_index[:0]
    return kernels.PointColumns(
        sights.point_bounds,
        structure.points(sights),
        sights.pixels,
        _weights(sights.sigma_px, noise_scale),
        structure.point_slots[moved],
        structure.bends[moved],
    )


def curve_columns(
    sights: Sights, structure: Structure, feet: Array, noise_scale: float | None = None
) -> kernels.CurveColumns:
    """The curve observations of some sights in the form that the kernels take; these move the feet (M of the
    sights,).
    """
    return kernels.CurveColumns(
        sights.curve_bounds,
        structure.tracks(sights),
        sights.is_arc,
        sights.track_index,
        sights.curve_pixels,
        _weights(sights.curve_sigma_px, noise_scale),
        feet,
        structure.track_slots,
    )


def _weights(sigma_px: Array, noise_scale: float | None) -> Array:
    if noise_scale is None:
        return kernels.NOTHING
    weights = noise_scale * sigma_px
    return np.reciprocal(weights, out=weights)


def residuals(sights: Sights, estimate: Estimate, feet: Array | None = None) -> Residuals:
    """Residuals of every observation in the sights; NaN for rows in none of them.

    Args:
        feet: (M,) initial foot of each curve observation on its track, such as those of earlier residuals; without them
            the search starts where the ray passes nearest.
    """
    return _residuals(len(sights.observations.points), len(sights.observations.curves), sights, estimate, feet)


def residuals_alone(sights: Sights, estimate: Estimate, feet: Array | None = None) -> Residuals:
    """Residuals of the sights' own observations, in their order, as if there were no others."""
    n, m = len(sights.point_rows), len(sights.curve_rows)
    own = replace(sights, point_rows=np.arange(n), curve_rows=np.arange(m))
    return _residuals(n, m, own, estimate, None if feet is None else feet[sights.curve_rows])


def _residuals(n: int, m: int, sights: Sights, estimate: Estimate, feet: Array | None) -> Residuals:
    points, curves, ends = np.full((n, 2), np.nan), np.full(m, np.nan), np.full(m, np.nan)
    poses = estimate.pose_stack(sights.keys)
    for name in sights.cameras:
        numbers = sights.numbers(camera=name)
        own = sights.take(numbers)
        optics = camera_optics(estimate.cameras[name])
        _point_residuals(optics, poses[numbers], own, estimate.structure, points)
        if len(own.curve_rows):
            distances = np.empty(len(own.curve_rows))
            columns = curve_columns(own, estimate.structure, starting_feet(own, estimate, feet))
            kernels.curve_residuals(optics, poses[numbers], columns, distances)
            curves[own.curve_rows], ends[own.curve_rows] = distances, columns.feet
    return Residuals(points, curves, ends)


def _point_residuals(
    optics: kernels.Optics, poses: Array, sights: Sights, structure: Structure, offsets: Array
) -> None:
    point_ns = 10.0
    columns = point_columns(sights, structure)

    def part(first: int, last: int) -> None:
        kernels.point_residuals(first, last, optics, poses, columns, sights.point_rows, offsets)

    run_parts(part, parts_of(len(sights), len(sights.points), point_ns))


def starting_feet(sights: Sights, estimate: Estimate, feet: Array | None) -> Array:
    """(M of the sights,) a copy of the feet of their rows, or the places where the rays pass nearest."""
    if not len(sights.curve_rows):
        return np.empty(0)
    if feet is not None:
        known = feet[sights.curve_rows]
        if np.all(np.isfinite(known)):
            return known
    seen = [sights[int(number)] for number in np.flatnonzero(np.diff(sights.curve_bounds))]
    nearest = [nearest_feet(s, estimate.camera_at(s.key.station, s.key.placement)) for s in seen]
    return np.concatenate(nearest)


def relative_lengths(observations: Content, residuals: Residuals) -> tuple[Array, Array]:
    """Lengths of the residuals of points and of curves in their stated sigmas; infinite where there is no residual."""
    points, curves = residuals.lengths
    points, curves = points / observations.points.sigma_px, curves / observations.curves.sigma_px
    return np.fmin(points, np.inf, out=points), np.fmin(curves, np.inf, out=curves)  # NaN is infinite


class Equations(Frozen):
    """E scalar equations, ordered by sight.

    Attributes:
        sights: the S sights, none of them empty. poses: (S, 3, 4) cam_from_frame. bounds: (S + 1,) where each sight's
            equations begin. sight: (E,) number of the sight.
        observation: (E,) number of the observation: points by row, then curves by row. view: (E,) of the observation.
        is_curve: (E,). feature: (E,) its `point_index` or, for a curve, its `track_index` (see `Sights`).
        residual: (E,) px. direction: (E, 2) its direction in the image. pixel: (E, 2) the predicted pixel.
        intrinsics: (E, K) px per solver's unit of [phi, aspect, cx, cy, coefficients, skew], 0 past a camera's own.
        pose: (E, 6) px per left perturbation of cam_from_frame. motion: (E, 3) px per metre that the point or foot
            moves in the camera frame. place: (E, 3) its place in its sight's frame, m.
        built: (E, BUILT) px per metre of displacements on the target: for a point those of `Structure.point_slots`; for
            a segment its offset to the left; for an arc x, y and radius; 0 for the rest.
    """

    sights: Sights
    poses: Array
    bounds: Indices
    sight: Indices
    observation: Indices
    view: Indices
    is_curve: Mask
    feature: Indices
    residual: Array
    direction: Array
    pixel: Array
    intrinsics: Array
    pose: Array
    place: Array
    built: Array

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def motion(self) -> Array:
        return self.pose[:, 3:]

    def along(self, displacement: Array) -> Array:
        """(E,) px, the component of a displacement (N, 2) of the observations along each direction."""
        return np.asarray(np.sum(displacement[self.observation] * self.direction, axis=1))

    def displacement(self, along: Array, count: int) -> Array:
        """(count, 2) px, the displacement of the observations from its components (E,) px along the directions."""
        moved = np.zeros((count, 2))
        np.add.at(moved, self.observation, along[:, None] * self.direction)
        return moved

    def of_sights(self, chosen: Mask) -> Mask:
        """(E,) mask of the equations of the chosen sights."""
        return np.asarray(chosen[self.sight])

    def slots(self, structure: Structure) -> Indices:
        """(E, BUILT) numbers of the structure's offsets in the order of `built`, -1 for none."""
        slots = np.full((len(self), kernels.BUILT), -1)
        if structure.names:
            slots[~self.is_curve] = structure.point_slots[self.feature[~self.is_curve]]
            slots[self.is_curve, :3] = structure.track_slots[self.feature[self.is_curve]]
        return slots

    def structure_columns(self, structure: Structure) -> Array:
        """(E, Q) px per metre of each of the structure's numbers."""
        columns, slots = np.zeros((len(self), len(structure.offsets))), self.slots(structure)
        for k in range(slots.shape[1]):
            moved = np.flatnonzero(slots[:, k] >= 0)
            columns[moved, slots[moved, k]] += self.built[moved, k]
        return columns if structure.mixing is None else columns @ structure.mixing

    def built_along(self, structure: Structure, directions: Array) -> Array:
        """(E, P) px by which directions (Q, P) of the structure's numbers move the equations: its columns times
        these.
        """
        offsets = directions if structure.mixing is None else structure.mixing @ directions
        moves, slots = np.vstack([offsets, np.zeros((1, directions.shape[1]))]), self.slots(structure)
        return np.asarray(sum(self.built[:, k, None] * moves[slots[:, k]] for k in range(slots.shape[1])))


def plane_shift(equations: Equations, values: Array) -> tuple[Array, Array]:
    """(E,) mm along x and (E,) mm along y of the target, equal for both equations of a point; across a curve, y
    is 0.
    """
    x, y = np.zeros(len(equations)), np.zeros(len(equations))
    first, second = pairs_of(equations)
    (a, b), (c, d) = equations.built[first, :2].T, equations.built[second, :2].T
    p, q = values[first], values[second]
    determinant = a * d - b * c
    x[first] = x[second] = 1e3 * (d * p - b * q) / determinant
    y[first] = y[second] = 1e3 * (a * q - c * p) / determinant
    curves = np.flatnonzero(equations.is_curve)
    x[curves] = 1e3 * values[curves] / np.hypot(*equations.built[curves, :2].T)  # the gradient points across the curve
    return x, y


def pairs_of(equations: Equations) -> tuple[Indices, Indices]:
    """The numbers of the two equations of each point, which are consecutive."""
    first, second = np.flatnonzero(~equations.is_curve).reshape(-1, 2).T
    return first, second


def whole_structure(targets: Mapping[str, Target], in_waves: Collection[str] | None = None) -> Structure:
    """The structure of everything that could differ from the drawing, with heights of the points of some or all
    boards.
    """
    boards = {name for name, target in targets.items() if target.bows}
    waves = boards if in_waves is None else boards & set(in_waves)
    is_board = {name: float(name in boards) for name in targets}
    every = {name: Tolerance(1.0, 1.0, is_board[name], float(name in waves), is_board[name]) for name in targets}
    return make_structure(targets, every)


def write_equations(sights: Sights, estimate: Estimate, there: Residuals) -> Equations:
    """The equations of every observation whose residual is finite.

    Raises:
        SolutionError: there is none.
    """
    x, y = there.points.T
    return equations_of(sights.used(np.isfinite(x + y), np.isfinite(there.curves)), estimate, there)


def equations_of(sights: Sights, estimate: Estimate, there: Residuals) -> Equations:
    """The equations of some sights, all of whose residuals are finite.

    An observation without derivatives has no equation: near a fold of the lens the search for the foot may not
    converge, and leaves the image when it continues from where the residuals stopped.

    Raises:
        SolutionError: there is none.
    """
    if not len(sights):
        raise SolutionError("the calibration cannot project any of the observations: give those that it was made from")
    poses = estimate.pose_stack(sights.keys)
    parts = []
    for numbers in map(sights.numbers, sights.cameras):
        own = sights.take(numbers)
        if len(own.point_rows):
            parts.append(_of_points(own, numbers, poses[numbers], estimate, there))
        if len(own.curve_rows):
            parts.append(_of_curves(own, numbers, poses[numbers], estimate, there))
    size = max(part["intrinsics"].shape[1] for part in parts)
    for part in parts:
        if missing := size - part["intrinsics"].shape[1]:
            part["intrinsics"] = np.pad(part["intrinsics"], ((0, 0), (0, missing)))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts[1:] else parts[0]
    points, curves = sights.observations.points, sights.observations.curves
    if np.any(lost := ~np.isfinite(columns["pose"][:, 0])):
        kept = np.ones(len(points) + len(curves), dtype=bool)
        kept[columns["observation"][lost]] = False
        return equations_of(sights.used(kept[: len(points)], kept[len(points) :]), estimate, there)
    if np.any(np.diff(columns["sight"]) < 0):
        order = np.argsort(columns["sight"], kind="stable")
        columns = {name: column[order] for name, column in columns.items()}
    bounds = np.searchsorted(columns["sight"], np.arange(len(sights) + 1))
    columns["is_curve"] = columns["observation"] >= len(points)
    view = of_observations(columns["observation"], points.view, curves.view)
    return Equations(sights=sights, poses=poses, bounds=bounds, view=view.astype(np.int64), **columns)


def of_observations(numbers: Indices, points: AnyArray, curves: AnyArray) -> AnyArray:
    """(E,) values of points (N,) and of curve observations (M,) by the number of the observation."""
    is_curve = numbers >= len(points)
    if not is_curve.any():
        return points[numbers]
    values = np.empty(len(numbers), dtype=points.dtype)
    values[~is_curve], values[is_curve] = points[numbers[~is_curve]], curves[numbers[is_curve] - len(points)]
    return values


def _of_points(
    own: Sights, numbers: Indices, poses: Array, estimate: Estimate, there: Residuals
) -> dict[str, AnyArray]:
    """The columns of the points of one camera's sights, which have these numbers and poses."""
    optics = camera_optics(estimate.cameras[own.keys[0].camera])
    size = len(optics.intrinsics)
    rows = np.empty((len(own.point_rows), 2, size + 6 + kernels.BUILT))
    points = point_columns(own, estimate.structure)
    bends = np.concatenate([target.bends for target in own.observations.targets.values()])
    points = points._replace(bends=bends[own.point_index])
    kernels.point_rows(optics, poses, points, rows)
    return {
        "sight": np.repeat(numbers[_sight_of(own.point_bounds)], 2),
        "observation": np.repeat(own.point_rows, 2),
        "feature": np.repeat(own.point_index, 2),
        "residual": there.points[own.point_rows].ravel(),
        "direction": np.tile(np.eye(2), (len(rows), 1)),
        "pixel": np.repeat(own.pixels + there.points[own.point_rows], 2, axis=0),
        "intrinsics": rows[:, :, :size].reshape(-1, size),
        "pose": rows[:, :, size : size + 6].reshape(-1, 6),
        "place": np.repeat(points.places, 2, axis=0),
        "built": rows[:, :, size + 6 :].reshape(-1, kernels.BUILT),
    }


def _of_curves(
    own: Sights, numbers: Indices, poses: Array, estimate: Estimate, there: Residuals
) -> dict[str, AnyArray]:
    """The columns of the curve observations of one camera's sights."""
    optics = camera_optics(estimate.cameras[own.keys[0].camera])
    size = len(optics.intrinsics)
    curves = curve_columns(own, estimate.structure, there.feet[own.curve_rows])
    rows, normals = np.empty((len(own.curve_rows), size + 6 + kernels.BUILT)), np.empty((len(own.curve_rows), 2))
    kernels.curve_rows(optics, poses, curves, rows, normals)
    distance = there.curves[own.curve_rows]
    return {
        "sight": numbers[_sight_of(own.curve_bounds)],
        "observation": len(own.observations.points) + own.curve_rows,
        "feature": own.track_index.astype(np.int64),
        "residual": distance,
        "direction": normals,
        "pixel": own.curve_pixels + distance[:, None] * normals,
        "intrinsics": rows[:, :size],
        "pose": rows[:, size : size + 6],
        "place": along_track(curves.tracks[own.track_index], own.on_arc, curves.feet),
        "built": rows[:, size + 6 :],
    }


def _sight_of(bounds: Indices) -> Indices:
    """The number of the sight to which each row belongs."""
    return np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
