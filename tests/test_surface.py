"""The surface of a lens without a formula: its map, its derivatives, and how rough it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import readable
import scenes

from ceres_cal import kernels
from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.parameters import Options, make_layout
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import pixel_slopes
from ceres_cal.problem.residuals import camera_optics
from ceres_cal.problem.structure import EXACT
from ceres_cal.scene.lens import Spline, make_lens
from ceres_cal.scene.lens.spline import COLUMNS, NODES, ROWS
from ceres_cal.scene.lens.surface import roughness
from ceres_cal.simulate import Disturbance, simulate
from ceres_cal.start.initialise import initialise

CAMERA = scenes.camera("spline-surface")
EXTENTS = np.array([0.92, 0.69])


def rays() -> Array:
    """(7, 3): inside the grid, and two beyond its edge."""
    rng = np.random.default_rng(3)
    across = np.vstack([rng.uniform(-0.5, 0.5, (5, 2)), (0.2, 0.75), (-1.05, 0.1)])
    return np.column_stack([across, np.ones(len(across))])


def by_kernel(lens: Spline) -> tuple[Array, Array]:
    """Offsets (N, 2) px, and their derivatives (numbers of the lens, 2, N) in the units of the files."""
    camera = replace(CAMERA, lens=lens, aspect=1.0, skew=0.0, principal_point=(0.0, 0.0)).at(Pose.exp(np.zeros(6)))
    seen = rays()
    slopes = pixel_slopes(camera, seen).intrinsics[:, :, 4:-1]
    points = kernels.PointColumns(
        np.array([0, len(seen)]), seen, np.zeros((len(seen), 2)), kernels.NOTHING, EXACT.point_slots, EXACT.bends
    )
    found = np.empty((len(seen), 2))
    pose = camera.cam_from_world.matrix[None]
    kernels.point_residuals(0, 1, camera_optics(camera), pose, points, np.arange(len(seen)), found)
    return found, np.moveaxis(slopes, 2, 0).transpose(0, 2, 1)


def test_kernel_and_arrays_are_one_map() -> None:
    lens = CAMERA.lens
    assert isinstance(lens, Spline)
    found, slopes = by_kernel(lens)
    assert np.abs(found - readable.offsets(lens, rays(), CAMERA.phi)).max() < 1e-10  # 3e-12 px measured
    assert np.abs(found - lens.distort(rays(), CAMERA.phi)).max() < 1e-11
    for name in ("wide", "high", "g3", "p1", NODES[0], NODES[2 * (7 * ROWS + 5)], NODES[2 * (9 * ROWS + 8) + 1]):
        k, step = lens.names.index(name), 1e-4
        ends = [np.array(lens.values) + sign * step * np.eye(len(lens.names))[k] for sign in (1.0, -1.0)]
        there, back = (lens.with_values(end).distort(rays(), CAMERA.phi) for end in ends)
        differences = (there - back).T / (2.0 * step)
        assert np.abs(slopes[k] - differences).max() < 1e-6 * (1.0 + np.abs(differences).max())


def test_there_and_back() -> None:
    pixels = np.array([(x, y) for x in np.linspace(-600.0, 600.0, 13) for y in np.linspace(-450.0, 450.0, 10)])
    found = CAMERA.lens.distort(CAMERA.lens.undistort(pixels, CAMERA.phi), CAMERA.phi)
    assert np.abs(found - pixels).max() < 1e-9


def test_it_may_end_in_one_direction_alone() -> None:
    """In a direction without observations; the rest of the picture is not affected."""
    heights = np.zeros((COLUMNS, ROWS, 2))
    heights[0, :, 0] = 400.0  # the left edge is folded back
    named = {**CAMERA.lens.coefficients, **dict(zip(NODES, heights.ravel().tolist(), strict=True))}
    folded = replace(CAMERA, lens=CAMERA.lens.with_values(list(named.values())))
    left, right = np.array([[-630.0, 0.0]]), np.array([[600.0, -440.0], [600.0, 440.0], [-300.0, 100.0]])
    assert folded.folds and not CAMERA.folds
    assert folded.lens.shows(right, CAMERA.phi).all() and not folded.lens.shows(left, CAMERA.phi).any()
    assert folded.lens.monotone_radius(CAMERA.phi) < 630.0
    rays_there = folded.lens.undistort(right, CAMERA.phi)
    assert np.abs(folded.lens.distort(rays_there, CAMERA.phi) - right).max() < 1e-9
    assert np.isnan(folded.lens.undistort(left, CAMERA.phi)).all()


def test_the_same_beyond_its_edge() -> None:
    named = {
        **CAMERA.lens.coefficients,
        **dict(zip(NODES, np.random.default_rng(0).normal(size=len(NODES)), strict=True)),
    }
    bare = make_lens("spline", coefficients={name: named[name] for name in ("rim", "wide", "high")}, terms=("surface",))
    assert isinstance(bare, Spline)
    rough = bare.with_values(
        [value if name in (*NODES, "rim", "wide", "high") else 0.0 for name, value in named.items()]
    )
    assert isinstance(rough, Spline)
    places = np.array([(0.92, 0.3), (1.5, 0.3), (0.1, -0.69), (0.1, -2.0)])
    moved = (rough.mapped(places) - bare.mapped(places)) * named["rim"]
    values, slopes = moved[:, 0].T, np.moveaxis(moved[:, 1:], 2, 0)
    assert np.allclose(values, readable.displacements(rough, places), rtol=0.0, atol=1e-9)
    assert np.allclose(values[0], values[1]) and np.allclose(values[2], values[3])
    assert np.abs(slopes[1, :, 0]).max() < 1e-9 and np.abs(slopes[3, :, 1]).max() < 1e-9 and slopes[1, :, 1].any()


def test_low_powers_are_left_to_the_rest_of_the_lens() -> None:
    """Size of a surface of each shape for one standard deviation of its prior."""
    x, y = (np.linspace(-1.0, 1.0, count) * (count - 1) / (count - 3) for count in (COLUMNS, ROWS))

    def size(shape: Array) -> float:
        heights = np.stack([shape, 0.0 * shape], axis=2).ravel()
        return float(1.0 / np.sqrt(heights @ roughness(*EXTENTS.tolist(), COLUMNS, ROWS) @ heights))

    long, short = (size(np.outer(np.cos(k * np.pi * x), np.cos(k * np.pi * y))) for k in (1, 3))
    assert long > 3.0 * short  # 0.37 and 0.11 measured
    assert max(size(np.outer(x**2, y)), size(np.outer(x, y)), size(np.outer(x**3, y**0))) < 0.04 * short  # 0.035


def test_it_is_asked_for_by_its_name() -> None:
    plain, longer = make_lens("spline"), make_lens("spline", terms=("surface",))
    assert set(longer.names) - set(plain.names) == {"wide", "high", *NODES} and not plain.nodes
    assert set(longer.listed) == {*plain.names, "wide", "high"}
    assert "192 nodes adds 0.2 px" in CAMERA.lens.note and "nodes" not in plain.note
    assert make_lens("spline", coefficients={"x0304": 1.0}).names == longer.names
    spanned = longer.spanning(0.6, 800.0, 1.1, (1280, 960)).coefficients
    assert spanned["wide"] == pytest.approx(0.92) and spanned["high"] == pytest.approx(0.69)


def test_fewer_observations_than_numbers_leave_a_cost_to_rely_on() -> None:
    """Rounding in the open directions made it thousands of times too large, with another value at each evaluation."""
    seen = simulate(scenes.lines("brown"), Disturbance(curves_sigma_px=0.3), 1).observations
    options = Options(lens="spline", terms=("surface",), max_iterations=6)
    start = initialise(gather_sights(seen), options).estimate
    problem = Problem(gather_sights(seen), make_layout(seen, options), options=options)
    assert problem.layout.size > 400 > 216 == problem.equations
    assert solve(problem, start, is_near=False).cost < 76.0  # 74.6 at its end
