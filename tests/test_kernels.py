"""The compiled kernels, compared with plain lens models, brute force, differences and the uncompressed problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pyceres
import pytest
import readable
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from scenery import overhead_pose
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from ceres_cal import kernels
from ceres_cal.base.arrays import Array, Indices, Indices32
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.detect.photographs.upright import Upright
from ceres_cal.detect.registration import REDUCED, Nearness
from ceres_cal.kernels import CurveColumns, Loss, PointColumns, Unknowns, core
from ceres_cal.problem.parameters import intrinsic_names, intrinsics_vector, with_intrinsics
from ceres_cal.problem.residuals import camera_optics
from ceres_cal.problem.structure import EXACT
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import along_track
from ceres_cal.scene.lens import Brown, KannalaBrandt, Radial
from ceres_cal.scene.targets import Arc, Segment, custom

LOSSES = {
    "trivial": pyceres.TrivialLoss,
    "huber": pyceres.HuberLoss,
    "soft_l1": pyceres.SoftLOneLoss,
    "cauchy": pyceres.CauchyLoss,
    "tukey": None,  # pyceres has none
}

each_lens = pytest.mark.parametrize("lens", scenes.EVERY_LENS)
each_loss = pytest.mark.parametrize("loss", LOSSES)

TARGET = custom(
    {"a": (-3.1, -1.9, 0.0), "b": (2.9, -2.1, 0.4), "c": (3.2, 1.7, 0.0), "d": (-2.8, 2.0, 1.1), "e": (0.1, 0.2, 0.0)},
    {
        "along": Segment((-3.5, -2.2, 0.0), (3.5, -2.0, 0.0), 0.08),
        "rising": Segment((-3.0, 2.1, 0.0), (2.5, 1.6, 0.7), 0.05),
        "circle": Arc((0.4, 0.1, 0.0), 0.6, width_m=0.06),
        "bow": Arc((1.8, 0.3, 0.2), 1.1, -0.9, 1.4, 0.04),
    },
)


Shown = tuple[PointColumns, CurveColumns]
"""Observations of one camera in one frame, in the form of the kernels' arguments; searches start at the feet."""


def shown(
    places: Array, pixels: Array, point_sigma_px: Array, track: Indices32, curve_pixels: Array,
    curve_sigma_px: Array, feet: Array,
) -> Shown:  # fmt: skip
    tracks, is_arc = TARGET.tracks.reshape(-1, 3, 3), np.tile(TARGET.is_arc, 3)
    points = np.array([0, len(pixels)]), places, pixels, 1.0 / point_sigma_px
    curves = np.array([0, len(track)]), tracks, is_arc, track, curve_pixels, 1.0 / curve_sigma_px, feet
    slots, bends, track_slots = EXACT.point_slots, EXACT.bends, EXACT.track_slots
    return PointColumns(*points, slots, bends), CurveColumns(*curves, track_slots)


def take(seen: Shown, points: Any = slice(0, 0), curves: Any = slice(0, 0)) -> Shown:
    """Some of the points and some of the curve observations of one frame."""
    moving = ("slots", "bends") if len(seen[0].slots) else ()
    columns = {name: getattr(seen[0], name)[points] for name in ("places", "pixels", "weights", *moving)}
    lines = {name: getattr(seen[1], name)[curves] for name in ("track", "pixels", "weights", "feet")}
    return (
        seen[0]._replace(bounds=np.array([0, len(columns["pixels"])]), **columns),
        seen[1]._replace(bounds=np.array([0, len(lines["track"])]), **lines),
    )


def singles(seen: Shown) -> list[Shown]:
    """Each observation alone."""
    points = [take(seen, points=slice(k, k + 1)) for k in range(len(seen[0].pixels))]
    return points + [take(seen, curves=slice(k, k + 1)) for k in range(len(seen[1].pixels))]


def with_points(seen: Shown, **columns: Any) -> Shown:
    """The same with other columns of the points."""
    return seen[0]._replace(**columns), seen[1]


def fresh(curves: CurveColumns) -> CurveColumns:
    """Columns whose feet may be changed."""
    return curves._replace(feet=curves.feet.copy())


@cache
def looked_at(lens: str) -> tuple[Camera, Shown]:
    """A tilted camera with pixels that are not square, and its observations: points, lines and arcs, all sides, 2 px
    noise.

    There are about a hundred curve observations: more than one chunk, and not a whole number of chunks.
    """
    rng = np.random.default_rng(4)
    height = 3.2 if lens.startswith("kannala-brandt") else 5.2
    pose = overhead_pose(-0.5, -1.0, height, tilt_x_deg=-12.0, tilt_y_deg=-9.0, yaw_deg=25.0)
    camera = replace(scenes.camera(lens), aspect=1.03, skew=4e-3).at(pose)
    curves = list(TARGET.curves.values())
    number = np.repeat(np.arange(3 * len(curves)), 9)  # three sides of every curve
    ranges = [curves[k % len(curves)].parameter_range for k in number[::9]]
    places = np.concatenate([low + (high - low) * np.linspace(0.1, 0.9, 9) for low, high in ranges])
    there = along_track(TARGET.tracks.reshape(-1, 3, 3)[number], np.tile(TARGET.is_arc, 3)[number], places)
    points, pixels = TARGET.point_array.copy(), camera.project(TARGET.point_array)
    curve_pixels = camera.project(there)
    return camera, shown(
        points,
        pixels + rng.normal(0.0, 2.0, pixels.shape),
        rng.uniform(0.7, 1.6, len(pixels)),
        number.astype(np.int32),
        curve_pixels + rng.normal(0.0, 2.0, curve_pixels.shape),
        rng.uniform(0.7, 1.6, len(places)),
        places + rng.normal(0.0, 0.01, len(places)),
    )


def matrix(pose: Pose) -> Array:
    return np.column_stack([pose.rotation, pose.translation])


def normal_equations(
    camera: Camera, seen: Shown, loss: str = "trivial", scale: float = 1.0, *, structure: int = 0, newton: bool = False
) -> tuple[float, Array]:
    """Sum of rho, and the full matrix A over [intrinsics | structure | 6 pose | residual]."""
    optics = camera_optics(camera)
    count = len(optics.intrinsics)
    size = count + structure + 7
    normals, costs, poses = np.empty((1, size, size)), np.empty(1), matrix(camera.cam_from_world)[None]
    core().sight_normals(
        0, 1, optics, Unknowns(np.arange(count), structure), seen[0], fresh(seen[1]),
        Loss(kernels.LOSS_CODES[loss], scale), newton, poses, np.ones(size), costs, normals,
    )  # fmt: skip
    return float(costs[0]), normals[0]


def point_residuals(camera: Camera, seen: Shown) -> Array:
    found = np.empty((len(seen[0].pixels), 2))
    poses = matrix(camera.cam_from_world)[None]
    kernels.point_residuals(0, 1, camera_optics(camera), poses, seen[0], np.arange(len(found)), found)
    return found


def curve_residuals(camera: Camera, seen: Shown) -> tuple[Array, Array]:
    """Distances px, and the feet at which they are measured."""
    found, curves = np.empty(len(seen[1].pixels)), fresh(seen[1])
    kernels.curve_residuals(camera_optics(camera), matrix(camera.cam_from_world)[None], curves, found)
    return found, curves.feet


def residual_vector(camera: Camera, seen: Shown) -> Array:
    """All residuals in sigmas: x and y of the points, then the distances of the curves."""
    points = point_residuals(camera, seen) * seen[0].weights[:, None]
    return np.concatenate([points.ravel(), curve_residuals(camera, seen)[0] * seen[1].weights])


def moved(camera: Camera, change: Array) -> Camera:
    """The camera with a small change of [intrinsics | left perturbation of its pose]."""
    count = len(change) - 6
    pose = camera.cam_from_world
    turned = Pose(rotation_exp(change[count : count + 3]) @ pose.rotation, pose.translation + change[count + 3 :])
    return with_intrinsics(camera, intrinsics_vector(camera) + change[:count]).at(turned)


def derivative(function: Callable[[Array], Array], steps: Array) -> Array:
    """Jacobian (residuals, numbers) at 0 by central differences of fourth order."""
    columns = []
    for k, step in enumerate(steps):
        along = np.zeros(len(steps))
        along[k] = step
        once, twice = function(along) - function(-along), function(2.0 * along) - function(-2.0 * along)
        columns.append((8.0 * once - twice) / (12.0 * step))
    return np.column_stack(columns)


POSE_STEPS = np.repeat([1e-3, 3e-3], 3)


def intrinsics_steps(camera: Camera) -> Array:
    """A step for each number that moves pixels by about one."""
    return np.array([1.0, 1e-3, 1.0, 1.0, *[2e-3] * len(camera.lens.values), 1e-3])


# ---- residuals ------------------------------------------------------------------------------------------------------


@each_lens
def test_point_residuals_are_those_of_the_readable_lens(lens: str) -> None:
    camera, seen = looked_at(lens)
    by_lens = camera.project(seen[0].places)
    read = by_lens if isinstance(camera.lens, Radial) else readable.project(camera, seen[0].places)
    for found in (by_lens, point_residuals(camera, seen) + seen[0].pixels):
        assert np.max(np.abs(found - read)) < 1e-11  # 5e-13 px measured


def foot_by_search(camera: Camera, seen: Shown, row: int) -> tuple[float, float]:
    """Signed distance from a pixel to its curve, and the foot, by minimisation along the projected curve."""
    track, is_arc, start = (
        seen[1].tracks[seen[1].track[row]],
        bool(seen[1].is_arc[seen[1].track[row]]),
        seen[1].feet[row],
    )

    def away(s: float) -> Array:
        return np.asarray((camera.project(along_track(track, is_arc, [s])) - seen[1].pixels[row])[0])

    reach = 0.3 if is_arc else 0.1
    bounds = (start - reach, start + reach)
    found = minimize_scalar(lambda s: np.sum(away(s) ** 2), bounds=bounds, method="bounded", options={"xatol": 1e-10})
    tangent = away(found.x + 1e-4) - away(found.x - 1e-4)
    normal = np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
    return float(normal @ away(found.x)), float(found.x)


@each_lens
def test_curve_residuals_are_true_distances(lens: str) -> None:
    camera, seen = looked_at(lens)
    distances, places = curve_residuals(camera, seen)
    assert np.std(distances) > 1.0  # 2 px of noise: the feet differ from the pixels
    brute = np.array([foot_by_search(camera, seen, row) for row in range(len(distances))])
    assert np.max(np.abs(distances - brute[:, 0])) < 1e-10  # 3e-13 px measured
    assert np.max(np.abs(places - brute[:, 1])) < 1e-6  # 6e-8 measured: the tolerance of the search


def test_far_pixels_have_the_nearest_foot_too() -> None:
    """Gross errors: pixels tens of px from the centre circle, some of them beyond a sharp bend."""
    camera, seen = looked_at("radial-2-3")
    rows = np.flatnonzero(seen[1].is_arc[seen[1].track])
    seen = take(seen, curves=rows)
    far = seen[1].pixels + np.random.default_rng(0).normal(0.0, 25.0, (len(rows), 2))
    distances, _ = curve_residuals(camera, (seen[0], seen[1]._replace(pixels=far)))
    for row in range(len(rows)):
        around = along_track(seen[1].tracks[seen[1].track[row]], True, np.linspace(0.0, 2.0 * np.pi, 7200))
        nearest = np.min(np.linalg.norm(camera.project(around) - far[row], axis=1))
        assert abs(distances[row]) == pytest.approx(nearest, abs=0.01)  # the steps round the arc are 0.15 px long


# ---- derivatives ----------------------------------------------------------------------------------------------------


def jacobian_by_gradients(camera: Camera, seen: Shown) -> Array:
    """Jacobian (residuals, numbers) from single observations: the last row of A is e J for any e.

    A point's pixel is moved so that its residual is (1, 0), then (0, 1).
    """
    rows = []
    for k in range(len(seen[0].places)):
        for unit in np.eye(2):
            one = take(seen, points=slice(k, k + 1))
            one = with_points(one, pixels=camera.project(one[0].places) - unit, weights=np.ones(1))
            rows.append(normal_equations(camera, one)[1][-1, :-1] * seen[0].weights[k])
    for k in range(len(seen[1].pixels)):
        one = take(seen, curves=slice(k, k + 1))
        rows.append(normal_equations(camera, one)[1][-1, :-1] / residual_vector(camera, one)[0])
    return np.array(rows)


@each_lens
def test_every_residual_knows_its_derivatives(lens: str) -> None:
    """Points compared with the plain lens model, curves with their own distance after a new search for the foot."""
    camera, seen = looked_at(lens)
    found = jacobian_by_gradients(camera, seen)

    def project(change: Array) -> Array:
        return np.asarray((moved(camera, change).project(seen[0].places) * seen[0].weights[:, None]).ravel())

    def distance(change: Array) -> Array:
        return residual_vector(moved(camera, change), take(seen, curves=slice(None)))

    steps = np.concatenate([intrinsics_steps(camera), POSE_STEPS])
    error = np.abs(found - np.vstack([derivative(project, steps), derivative(distance, steps)]))
    error /= np.maximum(np.max(np.abs(found), axis=0), 1e-12)  # some of a spline's numbers have no effect
    moved_once = [
        intrinsic_names(camera.lens).index(name) for name in camera.lens.set_at_start if name in camera.lens.names
    ]
    error = np.delete(error, moved_once, axis=1)  # at its knots differences are less smooth
    points = 2 * len(seen[0].places)
    assert np.max(error[:points]) < 5e-8  # 6e-9 measured
    curved = 2e-6 if lens == "spline" else 1e-7  # the foot is not linear in the first B-spline
    assert np.max(error[points:]) < curved  # 1e-8 measured, 9e-7 of the spline


@each_lens
@each_loss
def test_normal_equations_sum_up_single_observations(lens: str, loss: str) -> None:
    """The cost is sum rho and A is sum w [J e]^T [J e], over chunks whole and broken."""
    camera, seen = looked_at(lens)
    cost, normal = normal_equations(camera, seen, loss, 1.5)
    parts = [normal_equations(camera, one, loss, 1.5) for one in singles(seen)]
    assert cost == pytest.approx(sum(part[0] for part in parts), rel=1e-12)  # 1e-14 measured
    total = np.sum([part[1] for part in parts], axis=0)
    size = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    # A foot with an error of 1e-9 px is accurate enough for both, but the two feet differ.
    assert np.max(np.abs(normal - total) / size) < 1e-8  # 4e-10 measured


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 128, 130])
def test_chunks_of_any_length_count_every_row_once(count: int) -> None:
    camera, seen = looked_at("brown")
    points, curves = (np.resize(np.arange(len(rows)), count) for rows in (seen[0].pixels, seen[1].pixels))
    for many in (take(seen, points, curves), take(seen, points), take(seen, curves=curves)):
        expected = float(np.sum(residual_vector(camera, many) ** 2))
        assert normal_equations(camera, many)[0] == pytest.approx(expected, rel=1e-12)  # 2e-15 measured


# ---- losses ---------------------------------------------------------------------------------------------------------


def loss_of(loss: str, scale: float, length: float) -> tuple[float, float, float]:
    """rho, rho' s and s of one point whose residual has about that length."""
    camera, seen = looked_at("brown")
    one = with_points(take(seen, points=slice(0, 1)), weights=np.ones(1))
    one = with_points(one, pixels=camera.project(one[0].places) + length * np.array([[0.6, -0.8]]))
    cost, normal = normal_equations(camera, one, loss, scale)
    return cost, float(normal[-1, -1]), float(np.sum(point_residuals(camera, one) ** 2))


lengths, scales = st.floats(1e-3, 1e3), st.floats(0.1, 20.0)


@each_loss
@given(length=lengths, scale=scales)
def test_losses_are_those_of_ceres(loss: str, length: float, scale: float) -> None:
    rho, weighted, s = loss_of(loss, scale, length)
    if loss == "tukey":  # Ceres: a^2 / 3 (1 - (1 - s / a^2)^3), constant from a on
        rest = max(0.0, 1.0 - s / scale**2)
        expected = scale**2 / 3.0 * (1.0 - rest**3), rest**2
    else:
        expected = (LOSSES[loss]() if loss == "trivial" else LOSSES[loss](scale)).evaluate(s)[:2]
    assert rho == pytest.approx(expected[0], rel=1e-6)  # 9e-8 measured: pyceres passes s in single precision
    assert weighted == pytest.approx(expected[1] * s, rel=1e-6, abs=1e-12)


@each_loss
@given(length=lengths, scale=scales)
def test_losses_are_concave_enough_for_the_extra_row(loss: str, length: float, scale: float) -> None:
    """rho >= rho' s: without it the block's last row would be the root of a negative number (design, section 6)."""
    rho, weighted, s = loss_of(loss, scale, length)
    assert rho >= weighted * (1.0 - 1e-13)  # 2e-14 measured where the compiler optimises little
    # s is evaluated separately, and a compiler may contract that differently. Both round pixels of up to 591 px: an
    # error of one epsilon of this in the residual (0.17 measured with little optimisation), and of 10 in its root and
    # square.
    rounding = np.finfo(float).eps * np.array([591.0, 10.0])
    assert 0.0 <= weighted <= (np.sqrt(s) + rounding[0]) ** 2 * (1.0 + rounding[1])


def bent(loss: str, squared: float, scale: float) -> float:
    """1 + 2 s rho'' / rho' at the squared residual s, with the lower limit that keeps the step short."""
    if loss == "huber":
        return 1.0 if squared <= scale**2 else 0.01
    return 1.0 / (1.0 + squared / scale**2) if loss == "soft_l1" else 1.0


@each_lens
@each_loss
def test_newtons_step_takes_the_bend_of_the_loss_along(lens: str, loss: str) -> None:
    """The gradient is unchanged; the part of each residual in A decreases along it by 1 + 2 s rho'' / rho'."""
    camera, seen = looked_at(lens)
    plain, newton = (normal_equations(camera, seen, loss, 4.0, newton=newton)[1] for newton in (False, True))
    size = np.sqrt(np.diag(plain))
    assert np.max(np.abs(newton - plain)[-1, :-1] / size[:-1] / size[-1]) < 1e-12  # 3e-16 measured
    expected = plain[:-1, :-1].copy()
    for one in singles(seen):
        part = normal_equations(camera, one, loss, 4.0)[1]
        whole = normal_equations(camera, one)[1]
        if part[-1, -1] > 0.0:
            along = part[-1, :-1] / np.sqrt(part[-1, -1])  # root of rho', times the Jacobian along the residual
            expected -= (1.0 - bent(loss, whole[-1, -1], 4.0)) * np.outer(along, along)
    assert np.max(np.abs(newton[:-1, :-1] - expected) / np.outer(size[:-1], size[:-1])) < 1e-8


def test_where_most_are_outliers_the_loss_stays_straight() -> None:
    """There the loss's curvature does not describe the minimum, and a Newton step would be very long."""
    camera, seen = looked_at("brown")
    far = (
        seen[0]._replace(pixels=seen[0].pixels + 50.0),
        seen[1]._replace(pixels=seen[1].pixels + 50.0),
    )
    plain, newton = (normal_equations(camera, far, "huber", 1.5, newton=newton)[1] for newton in (False, True))
    assert np.array_equal(plain, newton)


# ---- the compressed block -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Block:
    """The block given to Ceres: columns of the Jacobian in the order camera, station, placement, structure."""

    residuals: Array
    jacobian: Array


def evaluate_block(
    camera: Camera, poses: tuple[Array, Array], seen: Shown, loss: str = "trivial", scale: float = 1.0, *,
    free: Indices | None = None, held: tuple[str, ...] = (), structure: int = 0,
) -> Block | None:  # fmt: skip
    """The block of a camera at station @ placement; None where the kernel reports no result."""
    optics = camera_optics(camera)
    free = np.arange(len(optics.intrinsics)) if free is None else free
    rows = len(free) + structure + 7
    sizes = {"camera": len(free), "station": 6, "placement": 6, "structure": structure}
    outputs = {name: np.full(0 if name in held else rows * size, 7.0) for name, size in sizes.items()}
    residuals = np.full(rows, 7.0)
    good = kernels.evaluate_block(
        optics, Unknowns(free, structure), seen[0], fresh(seen[1]), Loss(kernels.LOSS_CODES[loss], scale),
        kernels.Blocks(optics.intrinsics[free], *poses, kernels.NOTHING), residuals, kernels.Blocks(**outputs),
    )  # fmt: skip
    kept = [outputs[name].reshape(rows, size) for name, size in sizes.items() if name not in held and size]
    return Block(residuals, np.hstack([np.empty((rows, 0)), *kept])) if good else None


def uncompressed(
    camera: Camera, poses: tuple[Array, Array], seen: Shown, loss: str, scale: float
) -> tuple[float, Array, Array]:
    """Sum of rho, Newton's matrix and J^T W e of the problem with one row per residual and a
    Jacobian by differences.
    """
    count = len(intrinsics_vector(camera))

    def residuals(change: Array) -> Array:
        station, placement = poses[0] + change[count : count + 6], poses[1] + change[count + 6 :]
        changed = with_intrinsics(camera, intrinsics_vector(camera) + change[:count])
        return residual_vector(changed.at(Pose.exp(station) @ Pose.exp(placement)), seen)

    jacobian = derivative(residuals, np.concatenate([intrinsics_steps(camera), POSE_STEPS, POSE_STEPS]))
    e = residuals(np.zeros(count + 12))
    pairs, alone = e[: 2 * len(seen[0].places)].reshape(-1, 2), e[2 * len(seen[0].places) :]
    lengths = np.concatenate([np.linalg.norm(pairs, axis=1), np.abs(alone)])
    rho = np.array([loss_of(loss, scale, length)[0] for length in lengths])
    s, slope = lengths**2, np.empty(len(lengths))
    kernels.loss_weights(Loss(kernels.LOSS_CODES[loss], scale), s, slope)
    row = np.concatenate([np.repeat(np.arange(len(pairs)), 2), len(pairs) + np.arange(len(alone))])
    weights = slope[row]
    along = np.zeros((len(lengths), count + 12))
    np.add.at(along, row, jacobian * (e / np.maximum(lengths, 1e-300)[row])[:, None])
    shortened = slope * np.array([1.0 - bent(loss, one, scale) for one in s])
    normal = jacobian.T @ (weights[:, None] * jacobian) - along.T @ (shortened[:, None] * along)
    return float(rho.sum()), normal, jacobian.T @ (weights * e)


def split(camera: Camera, rotation: Array, *, turned: str) -> tuple[Array, Array]:
    """The camera's pose as station @ placement, where one of the two has this rotation vector."""
    given = Pose.exp([*rotation, 0.3, -0.2, 0.5])
    if turned == "station":
        return np.array([*rotation, 0.3, -0.2, 0.5]), (given.inverse @ camera.cam_from_world).log()
    return (camera.cam_from_world @ given.inverse).log(), np.array([*rotation, 0.3, -0.2, 0.5])


AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
ANGLES = [0.0, 1e-9, 0.99e-4, 1.01e-4, 0.7, 2.5, np.pi - 1e-6, np.pi, 4.0]
"""Near the switch to the series at 1e-4, near pi where the logarithm jumps, and beyond it, where steps may lead."""


def assert_same_problem(block: Block, problem: tuple[float, Array, Array]) -> None:
    """Cost, gradient, J^T J and damped step of a block equal those of the uncompressed problem."""
    cost, normal, gradient = problem
    assert block.residuals @ block.residuals == pytest.approx(cost, rel=1e-12)  # 2e-14 measured
    size = np.sqrt(np.diag(normal))
    found = block.jacobian.T @ block.jacobian
    assert np.max(np.abs(found - normal) / np.outer(size, size)) < 3e-8  # 3e-9 measured: of the differences
    found_gradient = block.jacobian.T @ block.residuals
    assert np.max(np.abs(found_gradient - gradient) / size) < 1e-8 * np.sqrt(cost)  # 6e-10 measured
    damping = np.diag(1e-3 * size**2)
    step = np.linalg.solve(normal + damping, gradient)
    found_step = np.linalg.solve(found + damping, found_gradient)
    assert np.max(np.abs(found_step - step) * size) < 1e-6 * np.max(np.abs(step) * size)  # 1e-7 measured


@pytest.mark.parametrize("lens", scenes.LENSES)
@each_loss
def test_block_is_the_uncompressed_problem(lens: str, loss: str) -> None:
    camera, seen = looked_at(lens)
    poses = split(camera, 0.7 * AXIS, turned="placement")
    block = evaluate_block(camera, poses, seen, loss, 4.0)
    assert block is not None
    assert_same_problem(block, uncompressed(camera, poses, seen, loss, 4.0))


@pytest.mark.parametrize("turned", ["station", "placement"])
@pytest.mark.parametrize("angle", ANGLES)
def test_chain_rule_to_both_pose_vectors(angle: float, turned: str) -> None:
    camera, seen = looked_at("brown")
    poses = split(camera, angle * AXIS, turned=turned)
    block = evaluate_block(camera, poses, seen, "huber", 4.0)
    assert block is not None
    assert_same_problem(block, uncompressed(camera, poses, seen, "huber", 4.0))


@pytest.mark.parametrize(
    "held", [("camera",), ("station",), ("placement",), ("camera", "placement"), ("station", "placement")]
)
def test_held_blocks_change_nothing_for_the_others(held: tuple[str, ...]) -> None:
    camera, seen = looked_at("kannala-brandt")
    poses = split(camera, 0.7 * AXIS, turned="placement")
    whole, part = evaluate_block(camera, poses, seen), evaluate_block(camera, poses, seen, held=held)
    assert whole is not None and part is not None
    count = len(intrinsics_vector(camera))
    columns = np.repeat(["camera", "station", "placement"], [count, 6, 6])
    assert np.array_equal(part.jacobian, whole.jacobian[:, ~np.isin(columns, held)])
    assert np.array_equal(part.residuals, whole.residuals)


@pytest.mark.parametrize("free", [[], [0], [0, 4, 5], [1, 2, 3, 8]])
def test_fixed_intrinsics_have_no_column(free: list[int]) -> None:
    camera, seen = looked_at("brown")
    poses = split(camera, 0.7 * AXIS, turned="placement")
    chosen = np.array(free, dtype=np.int64)
    block, whole = evaluate_block(camera, poses, seen, free=chosen), evaluate_block(camera, poses, seen)
    assert block is not None and whole is not None
    kept = np.concatenate([chosen, np.arange(10, 22)])
    normal, everything = block.jacobian.T @ block.jacobian, whole.jacobian.T @ whole.jacobian
    size = np.sqrt(np.diag(normal))
    assert np.max(np.abs(normal - everything[np.ix_(kept, kept)]) / np.outer(size, size)) < 1e-12  # 2e-15 measured
    assert block.residuals @ block.residuals == pytest.approx(whole.residuals @ whole.residuals, rel=1e-12)


@pytest.mark.parametrize("lens", scenes.LENSES)  # few observations: a rational lens's squares round away
@pytest.mark.parametrize("what", ["one point", "one place on a line", "residuals of zero"])
def test_blocks_of_less_than_full_rank(lens: str, what: str) -> None:
    """Zero pivots: fewer residuals than numbers, and a last column that is zero."""
    camera, seen = looked_at(lens)
    if what == "residuals of zero":
        seen = with_points(take(seen, points=slice(None)), pixels=camera.project(seen[0].places))
    else:
        seen = take(seen, points=slice(0, 1)) if what == "one point" else take(seen, curves=slice(4, 5))
    poses = split(camera, 0.7 * AXIS, turned="placement")
    block = evaluate_block(camera, poses, seen)
    assert block is not None
    assert np.all(np.isfinite(block.jacobian))
    cost, normal, gradient = uncompressed(camera, poses, seen, "trivial", 1.0)
    size = np.maximum(np.sqrt(np.diag(normal)), 1e-3)
    assert block.residuals @ block.residuals == pytest.approx(cost, rel=1e-9, abs=1e-18)
    # Without pivoting, rounding in undetermined directions grows by |A11^-1 A12|^2 (Higham, Accuracy and Stability,
    # section 10.3): 7e-9 measured, and 2e-6 for four radial powers without vectors.
    assert np.max(np.abs(block.jacobian.T @ block.jacobian - normal) / np.outer(size, size)) < 1e-5
    found = block.jacobian.T @ block.residuals
    assert np.max(np.abs(found - gradient) / size) < 1e-7 * np.sqrt(cost) + 1e-10  # 7e-9 measured


@each_lens
def test_a_point_on_the_axis_moves_as_through_a_pinhole(lens: str) -> None:
    """At radius 0 no lens has distortion: the columns of the coefficients are 0, without a division by 0."""
    camera = replace(scenes.camera(lens), aspect=1.03)
    seen = with_points(
        take(looked_at(lens)[1], points=slice(0, 1)), places=np.array([[0.0, 0.0, 2.0]]), pixels=np.zeros((1, 2))
    )
    block = evaluate_block(camera, (np.zeros(6), np.zeros(6)), seen, held=("placement",))
    assert block is not None
    count = len(camera.lens.values) + 1  # and the skew
    x = np.array([0.0, 0.0, 1.0, 0.0, *[0.0] * count, 0.0, 2.0, 0.0, 1.0, 0.0, 0.0])
    y = np.array([0.0, 0.0, 0.0, 1.0, *[0.0] * count, -2.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    x[-6:], y[-6:] = x[-6:] * camera.phi / 2.0, y[-6:] * 1.03 * camera.phi / 2.0
    expected = (np.outer(x, x) + np.outer(y, y)) * seen[0].weights[0] ** 2
    found = block.jacobian.T @ block.jacobian
    assert np.max(np.abs(found - expected)) < 1e-12 * np.max(expected)  # 2e-16 measured


# ---- structure ------------------------------------------------------------------------------------------------------


def everything_moves(seen: Shown) -> tuple[Shown, int]:
    """Numbers for x and y of each point, two common bows, the offset of each segment, and x, y, radius of arcs."""
    points = len(TARGET.points)
    slots = np.full((points, kernels.BUILT), -1)
    slots[:, :4] = np.column_stack(
        [np.arange(2 * points).reshape(-1, 2), np.tile([2 * points, 2 * points + 1], (points, 1))]
    )
    first = 2 * points + 2
    tracks = np.array([[0, -1, -1], [1, -1, -1], [2, 3, 4], [5, 6, 7]])
    tracks = np.tile(np.where(tracks < 0, -1, tracks + first), (3, 1)).astype(np.int32)
    bends = np.zeros((points, kernels.BUILT - 2))
    bends[:, :2] = np.random.default_rng(2).uniform(-1.0, 1.0, (points, 2))
    moving = seen[0]._replace(slots=slots.astype(np.int32), bends=bends), seen[1]._replace(slots=tracks)
    return moving, first + 8


def as_built(seen: Shown, values: Array) -> Shown:
    """The target with these structure numbers: points moved along x and y, bows along z, segments to the left."""
    slots = seen[0].slots
    bowed = np.sum(seen[0].bends[:, :2] * values[slots[:, 2:4]], axis=1)
    shift = np.column_stack([values[slots[:, :2]], bowed])
    tracks = seen[1].tracks.copy()
    for k, (first, second, third) in enumerate(seen[1].slots):
        if seen[1].is_arc[k]:
            tracks[k, 0, :2] += values[[first, second]]
            tracks[k, 1, 0] += values[third]
            tracks[k, 2, 1] += values[third]
        else:
            along = tracks[k, 1, :2] / np.linalg.norm(tracks[k, 1, :2])
            tracks[k, 0, :2] += values[first] * np.array([-along[1], along[0]])
    return seen[0]._replace(places=seen[0].places + shift), seen[1]._replace(tracks=tracks)


@pytest.mark.parametrize("lens", scenes.LENSES)
def test_structure_knows_its_derivatives(lens: str) -> None:
    """J^T J and J^T e with the structure's numbers, compared with differences of all residuals."""
    camera, seen = looked_at(lens)
    seen, structure = everything_moves(seen)
    count, total = len(intrinsics_vector(camera)), len(intrinsics_vector(camera)) + structure

    def residuals(change: Array) -> Array:
        built = as_built(seen, change[count:total])
        return residual_vector(moved(camera, np.concatenate([change[:count], change[total:]])), built)

    steps = np.concatenate([intrinsics_steps(camera), np.full(structure, 3e-3), POSE_STEPS])
    jacobian, e = derivative(residuals, steps), residuals(np.zeros(total + 6))
    both = np.column_stack([jacobian, e])
    expected = both.T @ both
    found = normal_equations(camera, seen, structure=structure)[1]
    size = np.sqrt(np.diag(expected))
    assert np.max(np.abs(found - expected) / np.outer(size, size)) < 5e-8  # 6e-9 measured
    poses = split(camera, 0.7 * AXIS, turned="placement")
    block = evaluate_block(camera, poses, seen, structure=structure)
    assert block is not None
    columns = [*range(count), *range(count + 12, count + 12 + structure)]
    normal = block.jacobian.T @ block.jacobian
    inside = range(total)
    assert (
        np.max(
            np.abs(normal[np.ix_(columns, columns)] - found[np.ix_(inside, inside)])
            / np.outer(size, size)[:total, :total]
        )
        < 1e-12
    )


def test_what_a_chunk_says_nothing_of_is_left_out_of_it_alone() -> None:
    """A surface's nodes, each with few observations, and the structure's numbers: summed one by one, with nearly all
    rows left out, and all at once.
    """
    camera, seen = looked_at("spline-surface")
    seen, structure = everything_moves(seen)
    points, curves = seen

    def alone(one: Shown) -> Array:
        return normal_equations(camera, one, structure=structure)[1]

    parts = [take(seen, curves=slice(k, k + 1)) for k in range(len(curves.pixels))]
    parts += [take(seen, points=slice(k, k + 1)) for k in range(len(points.pixels))]
    whole, total = alone(seen), np.sum([alone(part) for part in parts], axis=0)
    size = np.sqrt(np.diag(total))
    shown = size > 0.0
    assert 0.1 < np.mean(shown) < 0.9
    assert np.array_equal(shown, np.diag(whole) > 0.0)
    close = np.abs(whole - total)[np.ix_(shown, shown)] / np.outer(size[shown], size[shown])
    assert np.max(close) < 1e-8  # see above
    assert all(np.count_nonzero(np.diag(alone(part))) < 80 for part in parts[::20])


# ---- placements eliminated ------------------------------------------------------------------------------------------


def eliminate(
    camera: Camera, poses: list[Pose], parts: list[Shown], loss: str, tolerance: float
) -> tuple[float, Array, list[Pose]]:
    """Sum of rho at the best poses, the full complement over [intrinsics | residual], and those poses."""
    optics = camera_optics(camera)
    count = len(optics.intrinsics)
    stack, costs = np.stack([matrix(pose) for pose in poses]), np.empty(len(parts))
    points, curves = parts[0]
    joined, lines = (
        {name: np.concatenate([getattr(part[k], name) for part in parts]) for name in names}
        for k, names in ((0, ("places", "pixels", "weights")), (1, ("track", "pixels", "weights", "feet")))
    )
    bounds, curve_bounds = (np.cumsum([0, *(len(part[k].pixels) for part in parts)]) for k in (0, 1))
    sweep = kernels.Sweep(stack, np.zeros((len(parts), 6, count)), costs, np.zeros((count + 1, count + 1)))
    kernels.eliminate_placements(
        0, len(parts), optics, Unknowns(np.arange(count), 0), points._replace(bounds=bounds, **joined),
        curves._replace(bounds=curve_bounds, **lines), Loss(kernels.LOSS_CODES[loss], 1.5), False, tolerance,
        np.zeros(count), sweep,
    )  # fmt: skip
    lower = np.tril(sweep.reduced)
    return float(costs.sum()), lower + np.tril(lower, -1).T, [Pose(pose[:, :3], pose[:, 3]) for pose in stack]


def three_sights(lens: str) -> tuple[Camera, list[Pose], list[Shown]]:
    """Thirds of the observations, as of three placements whose poses have errors of 10 mm and 10 mrad."""
    camera, seen = looked_at(lens)
    rng = np.random.default_rng(8)
    parts = [take(seen, points=slice(None), curves=slice(k, None, 3)) for k in range(3)]
    starts = [Pose.exp(rng.normal(0.0, 0.01, 6)) @ camera.cam_from_world for _ in parts]
    return camera, starts, parts


@each_lens
@pytest.mark.parametrize("loss", ["trivial", "huber", "cauchy"])
def test_eliminated_poses_are_the_best_ones(lens: str, loss: str) -> None:
    """At the returned poses the gradient of each sight with respect to its pose is 0, and the cost
    is the cost there.
    """
    camera, starts, parts = three_sights(lens)
    cost, reduced, poses = eliminate(camera, starts, parts, loss, 0.0)
    count = len(intrinsics_vector(camera))
    total, complement = 0.0, np.zeros((count + 1, count + 1))
    for pose, part in zip(poses, parts, strict=True):
        one, normal = normal_equations(camera.at(pose), part, loss, 1.5)
        total += one
        inside, size = slice(count, count + 6), np.sqrt(np.diag(normal))
        assert np.max(np.abs(normal[-1, inside]) / size[inside]) < 1e-6 * np.sqrt(one)  # 4e-8 measured
        outside = [*range(count), count + 6]
        across = normal[np.ix_(outside, range(count, count + 6))]
        complement += normal[np.ix_(outside, outside)] - across @ np.linalg.solve(normal[inside, inside], across.T)
    assert cost == pytest.approx(total, rel=1e-12)  # 2e-14 measured
    size = np.sqrt(np.diag(complement))
    assert np.max(np.abs(reduced - complement) / np.outer(size, size)) < 1e-6  # 6e-8 measured


@pytest.mark.parametrize("loss", ["trivial", "soft_l1"])
def test_eliminated_gradient_is_that_of_the_best_cost(loss: str) -> None:
    """Compared with differences of the minimised cost: Ceres gets a true derivative."""
    camera, starts, parts = three_sights("radial-2-3")
    _, reduced, poses = eliminate(camera, starts, parts, loss, 0.0)

    def best(change: Array) -> Array:
        changed = with_intrinsics(camera, intrinsics_vector(camera) + change)
        return np.array([0.5 * eliminate(changed, poses, parts, loss, 0.0)[0]])

    expected = derivative(best, 0.3 * intrinsics_steps(camera))[0]
    size = np.sqrt(np.diag(reduced)[:-1] * reduced[-1, -1])
    assert np.max(np.abs(reduced[-1, :-1] - expected) / size) < 3e-6  # 2e-7 measured


def test_eliminating_loosely_is_right_to_second_order() -> None:
    """A sight slightly off its best pose reports the cost and the pose at the optimum."""
    camera, starts, parts = three_sights("radial-2-3")
    exact, _, best = eliminate(camera, starts, parts, "trivial", 0.0)
    off = [Pose.exp([1e-5, -2e-5, 1e-5, 2e-5, 1e-5, -3e-5]) @ pose for pose in best]
    cost, _, poses = eliminate(camera, off, parts, "trivial", 1e-2)
    plain = sum(normal_equations(camera.at(pose), part)[0] for pose, part in zip(off, parts, strict=True))
    assert plain - exact > 1e-6 * exact  # the offset has an effect
    assert abs(cost - exact) < 1e-2 * (
        plain - exact
    )  # 1e-3 measured: Gauss and Newton's, not Newton's own second order
    for pose, ideal in zip(poses, best, strict=True):
        assert np.max(np.abs((pose @ ideal.inverse).log())) < 1e-5  # 2e-6 measured, 2e-4 before


def test_eliminating_where_there_is_no_answer() -> None:
    camera, starts, parts = three_sights("brown")
    away = Pose.exp([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]) @ starts[1]
    assert np.isposinf(eliminate(camera, [starts[0], away, starts[2]], parts, "trivial", 0.0)[0])


# ---- where there is no answer ---------------------------------------------------------------------------------------

FOLDING = {
    "radial": Radial((0.0, -6e-7), (2, 3)),  # r' = r - 6e-7 r^3 turns at r = 745 px, r' = 497 px
    "brown": Brown((-0.3, 0.0, 0.0, 0.0, 0.0)),  # at an ideal radius of 1.054
    "kannala-brandt": KannalaBrandt((-0.2, 0.0, 0.0, 0.0)),  # at 1.29 rad
}


def before(lens: str) -> Camera:
    return Camera((1280, 960), 500.0, (640.0, 480.0), FOLDING[lens])


def rays(*angles_rad: float) -> Array:
    return np.array([[2.0 * np.sin(a), 0.0, 2.0 * np.cos(a)] for a in angles_rad])


@pytest.mark.parametrize("lens", FOLDING)
@pytest.mark.parametrize("hidden", ["behind", "beyond"])
def test_what_cannot_be_projected_has_no_residual(lens: str, hidden: str) -> None:
    limit = {"radial": np.arctan(497.0 / 500.0), "brown": np.arctan(1.054), "kannala-brandt": 1.2910}[lens]
    bad = np.pi - 0.3 if hidden == "behind" else limit + 0.02
    camera, whole = before(lens), looked_at("brown")[1]
    points = rays(0.1, limit - 0.02, bad, 0.3)
    seen = with_points(take(whole, points=slice(0, 4)), places=points, pixels=np.zeros((4, 2)), weights=np.ones(4))
    found = point_residuals(camera, seen)
    assert np.all(np.isnan(found[2]))
    assert np.all(np.isfinite(found[[0, 1, 3]]))  # each on its own
    assert np.array_equal(np.isnan(camera.project(points)[:, 0]), np.isnan(found[:, 0]))
    assert np.isnan(normal_equations(camera, seen)[0])
    poses = np.zeros(6), np.zeros(6)
    assert evaluate_block(camera, poses, seen) is None
    assert evaluate_block(camera, poses, take(seen, points=[0, 1, 3])) is not None


@pytest.mark.parametrize("lens", FOLDING)
def test_a_curve_that_cannot_be_projected_has_no_residual(lens: str) -> None:
    """A line that is wholly behind the camera or, for a fisheye, past its limit."""
    camera, whole = before(lens), looked_at("brown")[1]
    away = camera.at(Pose.exp([0.0, np.pi, 0.0, 0.0, 0.0, -2.0]))  # looks away from the target
    seen = take(whole, curves=slice(0, 3))
    assert np.all(np.isnan(curve_residuals(away, seen)[0]))
    assert np.isnan(normal_equations(away, seen)[0])


@pytest.mark.parametrize("values", [(0.0,) * 5, (1e-3, 0.0, 0.0, 0.0, 0.0)])
def test_a_pinhole_shows_what_is_far_off_its_axis(values: tuple[float, ...]) -> None:
    camera = Camera((1280, 960), 100.0, (640.0, 480.0), Brown(values))
    points = rays(np.deg2rad(79.0), np.deg2rad(85.0), np.deg2rad(-89.9))
    seen = with_points(take(looked_at("brown")[1], points=slice(0, 3)), places=points, pixels=np.zeros((3, 2)))
    assert point_residuals(camera, seen) == pytest.approx(camera.project(points), rel=1e-12)  # measured 2e-16


def test_a_fisheye_sees_behind_itself() -> None:
    """130 degrees from the axis, up to where its polynomial increases."""
    camera = Camera((1280, 960), 200.0, (640.0, 480.0), KannalaBrandt((0.01, 0.0, 0.0, 0.0)))
    points = rays(np.deg2rad(130.0), -np.deg2rad(100.0))
    seen = with_points(take(looked_at("brown")[1], points=slice(0, 2)), places=points, pixels=np.zeros((2, 2)))
    assert np.max(np.abs(point_residuals(camera, seen) - camera.project(points))) < 1e-10


# ---- saddles --------------------------------------------------------------------------------------------------------


def saddle_levels(numbers: Array, bends: Array, size: tuple[int, int]) -> Array:
    """The picture of the model in `detect.saddles`, by its formula."""
    dy, dx = np.indices(size) - numbers[1::-1, None, None]
    steps = []
    for angle, bend in zip(numbers[2:4], bends, strict=True):
        along, across = np.cos(angle) * dx + np.sin(angle) * dy, np.cos(angle) * dy - np.sin(angle) * dx
        steps.append(np.tanh(numbers[4] * (across - 0.5 * bend * along**2)))
    mean, contrast = (numbers[k] + numbers[k + 1] * dx + numbers[k + 2] * dy for k in (5, 8))
    return np.asarray(mean + contrast * steps[0] * steps[1])


def saddle_start(x: float, y: float, first: float, other: float, bends: Array, radius: float) -> Array:
    """(1, 14), with unknown light and sharpness."""
    return np.array([[x, y, first, other, *[np.nan] * 7, *bends, radius]])


@settings(max_examples=30)
@given(
    place=st.tuples(st.floats(18.0, 22.0), st.floats(18.0, 22.0)),
    turn=st.floats(-3.0, 3.0),
    sharp=st.floats(0.3, 2.0),
    slopes=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
)
def test_a_saddle_is_found_again(
    place: tuple[float, float], turn: float, sharp: float, slopes: tuple[float, float, float, float]
) -> None:
    numbers = np.array([*place, turn, turn + 1.4, sharp, 120.0, *slopes[:2], 60.0, *slopes[2:]])
    bends = np.array([1e-3, -2e-3])
    levels = saddle_levels(numbers, bends, (40, 44)).astype(np.float32)
    start, fitted = saddle_start(20.0, 20.0, turn + 0.1, turn + 1.3, bends, 14.0), np.empty((1, 14))
    kernels.fit_saddles(levels, start, fitted)
    assert fitted[0, :11] == pytest.approx(numbers, abs=1e-3)  # 3e-5, of float32's rounding
    assert fitted[0, 11] < 5e-3  # 2e-3 where the last step, from which it is predicted, is longest
    again, start[:, :11] = fitted.copy(), fitted[:, :11]
    kernels.fit_saddles(levels, start, again)
    assert again[0, :11] == pytest.approx(numbers, abs=1e-3)


def test_the_scatter_of_saddles_is_what_noise_makes_of_them() -> None:
    numbers, rng = np.array([20.3, 19.8, 0.3, 1.8, 0.7, 120.0, 0.0, 0.0, 60.0, 0.0, 0.0]), np.random.default_rng(4)
    picture, bends = saddle_levels(numbers, np.zeros(2), (40, 40)), np.zeros(2)
    start = saddle_start(20.0, 20.0, 0.3, 1.8, bends, 12.0)
    found = np.empty((300, 14))
    for own in found:
        kernels.fit_saddles((picture + rng.standard_normal(picture.shape)).astype(np.float32), start, own[None])
    assert np.std(found[:, :2], axis=0) == pytest.approx(np.mean(found[:, 12:], axis=0), rel=0.15)  # 4 % expected
    assert np.mean(found[:, 11]) == pytest.approx(1.0, abs=0.05)  # 11 of 450 degrees of freedom are used


def test_no_saddle_is_looked_for_outside_of_a_picture() -> None:
    wrong, fitted = ((-3.0, 5.0), (np.nan, 5.0), (5.0, 1e300)), np.zeros((3, 14))
    starts = np.concatenate([saddle_start(x, 5.0, 0.0, 1.5, np.zeros(2), radius) for x, radius in wrong])
    kernels.fit_saddles(np.ones((10, 10), np.float32), starts, fitted)
    assert np.isnan(fitted).all()


# ---- profiles -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("smear_px, lean", [(0.0, 0.0), (2.5, 0.7), (4.0, -1.0)])
def test_the_equations_of_profiles_are_those_of_their_formula(smear_px: float, lean: float) -> None:
    """The formula of `detect.profiles` with its smear by quadrature and derivatives by differences; several chunks."""
    rng, edges, heights = np.random.default_rng(1), np.array([-1.4, 1.3]), np.array([80.0, -70.0])
    distance, values = rng.uniform(-9.0, 9.0, 301), rng.uniform(0.0, 255.0, 301)
    nodes, weights = np.polynomial.legendre.leggauss(100)
    u = 0.5 * (1.0 + nodes)

    def model(numbers: Array) -> Array:
        b, g, first, second, c, log_blur, log_stretch, log_smear = numbers
        away, smear = distance - c, smear_px * np.exp(log_smear)
        total = b + g * away
        for height, edge in zip((first, second), edges * np.exp(log_stretch), strict=True):
            t = away[:, None] - edge + (0.5 - lean / 6.0 - u) * smear
            total += height * norm.cdf(t / np.exp(log_blur)) @ (0.5 * weights * (1.0 + lean * (1.0 - 2.0 * u)))
        return np.asarray(total)

    at, free = np.array([0.0, 0.0, *heights, 0.2, np.log(0.9), 0.0, 0.0]), 3 if smear_px else 2
    steps = 1e-4 * np.eye(8)[: 5 + free]
    columns = np.array([(model(at + step) - model(at - step)) / 2e-4 for step in steps])
    normals, rights = np.empty((1, 5 + free, 5 + free)), np.empty((1, 5 + free))
    shape = np.array([[0.9, smear_px, lean, 0.2]])
    kernels.profile_equations(distance[None], values[None], edges[None], shape, heights[None], free, normals, rights)
    sizes = np.linalg.norm(columns, axis=1)
    assert np.max(np.abs(normals[0] - columns @ columns.T) / np.outer(sizes, sizes)) < 1e-6  # 1.2e-8  # 3e-8
    assert np.max(np.abs(rights[0] - columns @ values) / sizes / np.linalg.norm(values)) < 1e-6


# ---- strokes --------------------------------------------------------------------------------------------------------


def test_how_many_strokes_run_along_a_floor() -> None:
    """For any number of strokes, also distant ones; NaN or 0 where almost none are along one of the axes."""
    rng = np.random.default_rng(2)
    planes, axes, weights = rng.normal(0.0, 3.0, (3, 77)), rng.normal(0.0, 1.0, (40, 2, 3)), rng.random(77)
    along = np.exp(-((axes @ planes) ** 2))
    least, expected = along @ weights, along.max(axis=1) @ weights
    shares, limit = np.empty(40), float(np.median(least.min(axis=1)))
    single = np.float32
    kernels.shares_along(planes.astype(single), weights.astype(single), axes.astype(single), limit, shares)
    assert shares == pytest.approx(np.where(least.min(axis=1) > limit, expected, 0.0), rel=1e-5)


def test_how_much_of_lines_is_near_strokes() -> None:
    """From a camera's place, and from behind the lines, where nothing is seen; places outside the
    picture do not count.
    """
    upright, size, rng = Upright(-0.3, 1.2, np.eye(3), 1.0), (400, 300), np.random.default_rng(3)
    middle = 0.5 * (np.array(size) - 1.0)
    pixels = np.column_stack([np.linspace(-20.0, 420.0, 45), np.linspace(50.0, 250.0, 45)])
    feet = np.array([[0.3, -0.2, 0.1], [0.0, 0.0, 99.0]])
    along = feet[0] + rng.uniform(1.0, 3.0, 45)[:, None] * upright.rays((pixels - middle) / 250.0)
    near, joined, sums = Nearness(rng.random((75, 100)).astype(np.float32)), np.arange(45) % 20 > 0, np.empty((2, 3))
    optics = upright.bend, upright.phi, 250.0, *middle, *size
    single = along.T.astype(np.float32), joined, feet.astype(np.float32)
    kernels.lines_near(near.plane, REDUCED, optics, *single, sums)
    inside = (pixels[:, 0] > -0.5) & (pixels[:, 0] < 399.5)
    step = np.linalg.norm(np.diff(pixels, axis=0), axis=1) * (inside & joined)[1:]
    assert sums[0] == pytest.approx([step @ near.at(*pixels[1:].T), step.sum(), inside.mean()], rel=1e-4)
    assert not sums[1].any()


def test_the_normal_distribution_is_told_far_out() -> None:
    """To the smallest representable values, for arrays of any shape."""
    x = np.array([[-37.0, -8.0, -1.0], [0.0, 2.0, 9.0]])
    found = kernels.normal_cdf(x)
    assert np.allclose(found, norm.cdf(x), rtol=1e-12, atol=0.0)
    assert kernels.normal_cdf([-np.inf, np.inf]).tolist() == [0.0, 1.0] and np.isnan(kernels.normal_cdf(np.nan))
    assert kernels.normal_cdf(x.T[::2]).tolist() == found.T[::2].tolist()


def test_how_much_of_a_mixture_lies_above() -> None:
    rng = np.random.default_rng(5)
    weights, means, scales = rng.random(7), rng.normal(0.0, 3.0, (7, 20)), 1.0 / rng.uniform(0.01, 2.0, (7, 20))
    means[2, 4], means[3, 4], scales[1, 4] = np.inf, -np.inf, 0.0
    columns = np.array([4, 0, 19, 19, 7])
    places = rng.normal(0.0, 4.0, 5)
    expected = weights @ kernels.normal_cdf((means[:, columns] - places) * scales[:, columns])
    found = kernels.mixture_above(weights, means, scales, places, columns)
    assert found == pytest.approx(expected, abs=1e-15)
    for wrong in ([20], [-1]):
        with pytest.raises(ValueError, match="columns"):
            kernels.mixture_above(weights, means, scales, places[:1], np.array(wrong))
    with pytest.raises(ValueError, match="weights"):
        kernels.mixture_above(weights[:3], means, scales, places, columns)
