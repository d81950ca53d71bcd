"""The closed forms: the paper's sections 2 and 3.2 to 3.6 with corrections, and cases that the paper lacks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scenery import overhead_pose
from scipy.optimize import minimize

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.transforms import Pose, euler_from_rotation, nearest_rotation, rotation_from_euler
from ceres_cal.observations import Observations
from ceres_cal.start.closed_forms import (
    PlaneData,
    RadialProfile,
    facing,
    fit_lines,
    fit_rings,
    homography_from_points,
    orthogonality_error,
    point_lines,
    pose_from_homography,
    poses_from_homographies,
    profile_from_lines,
    radial_alignment,
    require_spread,
    ring_profile,
)

ROOT = Path(__file__).resolve().parents[1]
A1, A2, A3 = 1.07761103142178, -0.00096240306505, 0.00000401304361  # the paper's section 2
FIELD = np.array([(x, y) for x in np.linspace(-2.4, 2.4, 7) for y in np.linspace(-1.6, 1.6, 5)])

angles = st.floats(-0.5, 0.5)
poses = st.builds(
    lambda a, b, c, x, y, z: Pose.looking((x, y, z), rotation_from_euler(np.pi + a, b, c)),
    angles, angles, st.floats(-3.1, 3.1), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(2.0, 6.0),
)  # fmt: skip


def homography_of(pose: Pose) -> Array:
    """H = (r1 r2 -R t), the paper's section 3, in normalised coordinates."""
    return np.column_stack([pose.rotation[:, :2], pose.translation])


def sent(homography: Array, plane: Array) -> Array:
    """Image points (N, 2) of plane points (N, 2)."""
    homogeneous = np.column_stack([plane, np.ones(len(plane))]) @ homography.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def in_front(pose: Pose, plane: Array) -> Array:
    depth = np.column_stack([plane, np.zeros(len(plane))]) @ pose.rotation[2] + pose.translation[2]
    return np.asarray(plane[depth > 0.3])


def same_up_to_scale(found: Array, expected: ArrayLike) -> float:
    """Largest difference after both are scaled to unit size; the sign is significant."""
    return float(np.max(np.abs(found / np.linalg.norm(found) - np.asarray(expected) / np.linalg.norm(expected))))


# ---- section 3.2: the transformation matrix -------------------------------------------------------------------------


@given(poses)
def test_homography_of_many_points(pose: Pose) -> None:
    plane = in_front(pose, FIELD)
    found = homography_from_points(plane, sent(homography_of(pose), plane))
    assert same_up_to_scale(found, homography_of(pose)) < 1e-10  # 2e-13 measured


@given(poses)
def test_four_points_are_enough(pose: Pose) -> None:
    plane = np.array([(-0.4, -0.3), (0.5, -0.35), (0.45, 0.3), (-0.5, 0.4)]) + pose.position[:2]
    found = homography_from_points(plane, sent(homography_of(pose), plane))
    assert same_up_to_scale(found, homography_of(pose)) < 1e-8  # 1e-12 measured


def dlt_rows(plane: Array, image: Array) -> Array:
    """The paper's equations for each point, one row for x'' and one for y''."""
    rows = []
    for (x, y), (u, v) in zip(plane, image, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    return np.array(rows)


def as_printed(plane: Array, image: Array) -> Array:
    """The paper's 8 x 9 matrix as printed: its seventh column lacks x_i, its eighth has x_i'' also in the rows of
    y_i''.
    """
    rows = dlt_rows(plane, image)
    rows[:, 6] /= np.repeat(plane[:, 0], 2)
    rows[1::2, 7] = rows[::2, 7]
    return rows


def test_rows_of_the_dlt_are_not_the_printed_ones() -> None:
    pose = overhead_pose(-0.3, 0.2, 2.5, 6.0, -4.0, 30.0)
    plane = np.array([(-1.0, -0.8), (1.2, -0.7), (1.1, 0.9), (-0.9, 1.0)])
    image = sent(homography_of(pose), plane)
    found = homography_from_points(plane, image)
    found /= np.linalg.norm(found)
    assert np.max(np.abs(dlt_rows(plane, image) @ found.ravel())) < 1e-13  # 2e-16 measured
    assert np.max(np.abs(as_printed(plane, image) @ found.ravel())) > 0.03  # 0.047 measured
    # With the printed equations, even the four points themselves are missed by much of their distances.
    printed = np.linalg.svd(as_printed(plane, image))[2][-1].reshape(3, 3)
    assert np.max(np.abs(sent(printed, plane) - image)) > 0.3  # 0.53 measured


def test_h33_may_be_zero() -> None:
    """The world's origin at depth 0 in the camera frame: the paper's h33 = 1 is impossible, the null vector is not."""
    looking_along = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # along x, from above the origin
    pose = Pose.looking((0.0, 0.3, 2.5), looking_along)
    assert pose.translation[2] == 0.0
    plane = np.array([(3.0, -1.0), (3.2, 1.1), (6.0, 1.5), (5.5, -1.4), (4.0, 0.2)])
    image = sent(homography_of(pose), plane)
    found = homography_from_points(plane, image)
    assert same_up_to_scale(found, homography_of(pose)) < 1e-12  # 1e-15 measured
    assert abs(found[2, 2]) < 1e-12 * np.linalg.norm(found)
    # The paper's way: h33 = 1, the last column to the right side, eight equations.
    rows = dlt_rows(plane[:4], image[:4])
    assert np.linalg.cond(rows[:, :8]) > 1e14


@given(poses)
def test_sign_of_the_homography_puts_points_before_the_camera(pose: Pose) -> None:
    plane = in_front(pose, FIELD)
    image = np.column_stack([sent(homography_of(pose), plane), np.ones(len(plane))])
    for sign in (1.0, -1.0):
        right = facing(sign * homography_of(pose), plane, image)
        assert np.array_equal(right, homography_of(pose))
    assert pose_from_homography(homography_from_points(plane, image)).position[2] > 0.0


@pytest.mark.parametrize(
    "plane, message",
    [
        ([(0, 0), (1, 0), (0, 1)], "3 points cannot fix a plane's pose: give at least four"),
        ([(0, 0), (1, 2), (2, 4), (3, 6), (-1, -2)], "all 5 points lie on one line: add points off this line"),
        ([(1, 1)] * 6, "all 6 points lie on one line"),
        ([(0, 0), (1, 0), (2, 0), (0.3, 1.2)], "three"),  # section 3.5: no one of them on a line connecting other two
    ],
)
def test_points_that_fix_no_homography(plane: list[tuple[float, float]], message: str) -> None:
    points = np.array(plane, dtype=float)
    image = sent(homography_of(overhead_pose(0.5, 0.5, 3.0, 5.0, 8.0)), points)
    with pytest.raises(DegenerateError, match=message):
        homography_from_points(points, image)


def test_spread_is_asked_of_the_shape_alone() -> None:
    """A long thin strip is not taken for a line, at any place and any size."""
    strip = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1e-4), (0.0, 1e-4)])
    for scale, away in ((1.0, 0.0), (1e-3, 5.0), (1e3, -700.0)):
        require_spread(scale * strip + away)
    with pytest.raises(DegenerateError, match="one line"):
        require_spread(strip * (1.0, 1e-6) + 5.0)


# ---- sections 3.3, 3.5 and 3.6: lambda and the rotation -------------------------------------------------------------


@given(poses, st.floats(0.01, 100.0))
def test_an_exact_pose_comes_back(pose: Pose, scale: float) -> None:
    for phi in (1.0, 830.0):
        found = pose_from_homography(scale * np.diag([phi, phi, 1.0]) @ homography_of(pose), phi)
        assert np.max(np.abs((found @ pose.inverse).log())) < 1e-12  # 2e-14 measured


def error_of(homography: Array, rotation: Array, scale: float) -> float:
    """The paper's E (section 3.6)."""
    return float(np.sum((homography[:, :2] / scale - rotation[:, :2]) ** 2))


def lambda_of(homography: Array, rotation: Array) -> float:
    """The lambda of the least E at this rotation: a quadratic in 1 / lambda."""
    return float(np.sum(homography[:, :2] ** 2) / np.sum(homography[:, :2] * rotation[:, :2]))


@pytest.mark.parametrize("seed", range(8))
def test_the_rotation_minimises_the_papers_error(seed: int) -> None:
    """Compared with a search over the paper's own four unknowns, started with the max-norm lambda as in the paper."""
    rng = np.random.default_rng(seed)
    pose = overhead_pose(0.4, -0.7, 2.5, rng.uniform(-20.0, 20.0), rng.uniform(-20.0, 20.0), 40.0 * seed)
    homography = 3.7 * homography_of(pose) + rng.normal(0.0, 0.2, (3, 3))
    pose = pose_from_homography(homography)
    largest = float(np.linalg.norm(homography[:, :2], axis=0).max())
    found = error_of(homography, pose.rotation, lambda_of(homography, pose.rotation))

    def error(unknowns: Array) -> float:
        return error_of(homography, rotation_from_euler(*unknowns[:3]), float(np.exp(unknowns[3])))

    start = [*euler_from_rotation(pose.rotation), np.log(largest)]
    searched = minimize(error, start, method="BFGS", options={"gtol": 1e-10})
    assert found == pytest.approx(searched.fun, rel=1e-9)  # 1e-12 measured
    assert np.max(np.abs(rotation_from_euler(*searched.x[:3]) - pose.rotation)) < 1e-6  # 2e-8: the search's own end
    assert found < error_of(homography, pose.rotation, largest)


@given(poses, st.floats(0.7, 1.4))
def test_max_norm_is_what_the_paper_says_of_it(pose: Pose, wrong_phi: float) -> None:
    """lambda is the larger norm, so that with a wrong phi no column of H / lambda is longer than 1 (section 3.5)."""
    homography = np.diag([wrong_phi, wrong_phi, 1.0]) @ homography_of(pose)
    norms = np.linalg.norm(homography[:, :2], axis=0)
    found = pose_from_homography(homography)
    assert np.max(np.abs(found.translation - homography[:, 2] / norms.max())) < 1e-14 * np.linalg.norm(pose.translation)
    h1, h2 = (homography[:, :2] / norms.max()).T
    assert max(np.linalg.norm(h1), np.linalg.norm(h2)) <= 1.0 + 1e-15
    assert np.max(np.abs(found.rotation - nearest_rotation(np.column_stack([h1, h2, np.cross(h1, h2)])))) < 1e-14
    assert np.max(np.abs(found.rotation @ found.rotation.T - np.eye(3))) < 1e-12  # 4e-16 measured
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@given(st.lists(poses, min_size=1, max_size=5))
def test_poses_of_many_homographies(many: list[Pose]) -> None:
    """Against U V^T of the singular value decomposition and the larger norm."""
    stack = np.diag([1.1, 1.1, 1.0]) @ np.stack([homography_of(pose) for pose in many])
    for homography, found in zip(stack, poses_from_homographies(stack), strict=True):
        u, _, vt = np.linalg.svd(homography[:, :2], full_matrices=False)
        assert np.max(np.abs(found[:, :2] - u @ vt)) < 1e-13  # 1e-15 measured
        assert np.max(np.abs(found[:, 3] - homography[:, 2] / np.linalg.norm(homography[:, :2], axis=0).max())) < 1e-12


# ---- section 2: rings -----------------------------------------------------------------------------------------------


def test_the_papers_coefficients_come_back() -> None:
    r = np.linspace(5.0, 480.0, 40)
    ideal = A1 * r + A2 * r**2 + A3 * r**3
    found = fit_rings(r, ideal)
    assert np.max(np.abs(found / (A1, A2, A3) - 1.0)) < 1e-11  # 1e-14 measured, without any scaling by hand
    assert found @ (450.0, 450.0**2, 450.0**3) == pytest.approx(655.7, abs=0.05)
    assert fit_rings(r, 3.0 * ideal) == pytest.approx(3.0 * found, rel=1e-11)  # the gauge: phi takes the factor
    assert fit_rings(r, ideal, powers=(1, 2, 3, 5))[3] == pytest.approx(0.0, abs=1e-20)


def test_rings_of_the_sample_data_are_the_papers() -> None:
    """data/field_2004: a sheet tilted by 1 degree and 3 px from the axis, 0.2 px of noise; its scale is free.

    Noise alone causes 0.2 px at 450 px, 2.5e-6 and 3.4e-9. The tilt of the sheet, which circles do not determine, adds
    0.7 px, 9e-6 and 1.3e-8 (30 seeds). The bundle adjustment determines it: see `test_calibrate`.
    """
    observations = Observations.load(ROOT / "data/field_2004/rings.json")
    radii_m = np.array([curve.length_m / (2.0 * np.pi) for curve in observations.targets["rings"].curves.values()])
    measured = np.linalg.norm(observations.curves.pixels - (392.3, 287.6), axis=1)
    found = fit_rings(measured, radii_m[observations.curves.feature])
    found *= A1 / found[0]
    assert found @ (450.0, 450.0**2, 450.0**3) == pytest.approx(655.7, abs=1.3)  # 655.78 measured
    assert found[1] == pytest.approx(A2, abs=1.7e-5)  # 3.4e-6 measured
    assert found[2] == pytest.approx(A3, abs=2.3e-8)  # 7e-9 measured


@given(st.floats(-0.6, 0.2), st.floats(-0.2, 0.2), st.floats(200.0, 2000.0))
def test_ring_profile_takes_exact_rings_apart(c1: float, c2: float, kappa: float) -> None:
    r = np.linspace(10.0, 700.0, 30)
    profile = RadialProfile((c1, c2), 700.0)
    w = profile.lift(np.column_stack([r, np.zeros_like(r)]))[:, 2]
    found, magnification = ring_profile(r, r / (kappa * w), 700.0)
    assert magnification == pytest.approx(kappa, rel=1e-9)
    assert found.coefficients == pytest.approx((c1, c2), abs=1e-8)


# ---- design, section 7: radial alignment and lines ------------------------------------------------------------------

UNIT = 800.0
PROFILE = RadialProfile((-0.32, 0.05), UNIT)
PHI = 830.0
VIEWS = [
    overhead_pose(-0.5, 0.3, 3.4, 22.0, -10.0, 15.0),
    overhead_pose(1.0, -0.4, 3.0, -18.0, 12.0, 80.0),
    overhead_pose(0.2, 0.5, 3.8, 8.0, 25.0, -120.0),
]
PHI_DOWN = np.diag([PHI, PHI, 1.0])


def seen_through(pose: Pose, profile: RadialProfile, count: int = 60, seed: int = 0) -> tuple[Array, Array]:
    """Plane points and their exact offsets (N, 2) px through a profile, by its inverse."""
    offsets = np.random.default_rng(seed).uniform((-640.0, -480.0), (640.0, 480.0), (count, 2))
    plane = profile.lift(offsets) @ np.linalg.inv(PHI_DOWN @ homography_of(pose)).T
    return plane[:, :2] / plane[:, 2:], offsets


def aligned_data(noise_px: float = 0.0, wrong: float = 0.0) -> PlaneData:
    rng = np.random.default_rng(1)
    parts = [seen_through(pose, PROFILE, seed=i) for i, pose in enumerate(VIEWS)]
    plane, offsets = (np.concatenate(part) for part in zip(*parts, strict=True))
    offsets = offsets + rng.normal(0.0, noise_px, offsets.shape)
    rows = rng.choice(len(plane), round(wrong * len(plane)), replace=False)
    plane[rows] = np.roll(plane[rows], 1, axis=0)
    return PlaneData(np.arange(4) * 60, plane, offsets)


def test_profile_lifts_offsets() -> None:
    lifted = PROFILE.lift(np.array([[0.0, 0.0], [480.0, 640.0]]))
    assert lifted.tolist() == [[0.0, 0.0, 1.0], [480.0, 640.0, pytest.approx(1.0 - 0.32 + 0.05, rel=1e-15)]]


def test_radial_alignment_is_exact_on_exact_data() -> None:
    profile, error_px, _ = radial_alignment(aligned_data(), UNIT, terms=2, rounds=2)
    assert profile.coefficients == pytest.approx(PROFILE.coefficients, abs=1e-8)  # 2e-10 measured
    assert np.max(error_px) < 1e-6  # 1e-8 measured


def test_radial_alignment_does_not_mind_wrong_labels() -> None:
    """5 % of the points have the name of another, 0.3 px of noise."""
    data = aligned_data(0.3, 0.05)
    profile, error_px, relative_error = radial_alignment(data, UNIT, terms=2, rounds=8)
    assert profile.coefficients == pytest.approx(PROFILE.coefficients, abs=0.005)  # 6e-4 measured
    wrong = np.any(data.plane != aligned_data().plane, axis=1)
    assert wrong.sum() == 9
    assert np.min(error_px[wrong]) > 30.0 * np.max(error_px[~wrong])  # 65 px, 0.9 px measured
    assert np.min(relative_error[wrong]) > 50.0 > 8.0 > np.max(relative_error[~wrong])


def lines_seen(pose: Pose, profile: RadialProfile, lines: Array, seed: int) -> tuple[Array, Array]:
    """Offsets of pixels on lines (K, 3) of the plane, 20 each: (lines (20 K, 3), offsets (20 K, 2)), by bisection."""
    rng = np.random.default_rng(seed)
    homography = PHI_DOWN @ homography_of(pose)
    each, offsets = [], []
    for line in lines:
        foot, along = -line[2] * line[:2], np.array([-line[1], line[0]])
        places = foot + rng.uniform(-1.5, 1.5, 20)[:, None] * along
        ideal = sent(homography, places)
        r_ideal, low, high = np.linalg.norm(ideal, axis=1), np.zeros(20), np.full(20, 0.95 * UNIT)
        for _ in range(60):
            r = 0.5 * (low + high)
            far = r / profile.lift(np.column_stack([r, np.zeros(20)]))[:, 2] > r_ideal
            low, high = np.where(far, low, r), np.where(far, r, high)
        offsets.append(ideal * (low / r_ideal)[:, None])
        each.append(np.tile(line, (20, 1)))
    return np.concatenate(each), np.concatenate(offsets)


def some_lines(count: int = 8) -> Array:
    angle = np.linspace(0.1, 3.0, count)
    return np.column_stack([np.cos(angle), np.sin(angle), np.linspace(-1.1, 1.0, count)[::-1]])


def test_homography_of_lines_alone() -> None:
    lines, offsets = lines_seen(VIEWS[0], PROFILE, some_lines(), 3)
    found, distance = fit_lines(lines, PROFILE.lift(offsets), 1)
    assert found is not None
    assert same_up_to_scale(found, PHI_DOWN @ homography_of(VIEWS[0])) < 1e-10  # 1e-13 measured
    assert distance < 1e-10


def test_lines_tell_the_profile() -> None:
    """Only through the right profile are straight lines straight: best rank one of g3 x (1, c)."""
    lines, offsets = lines_seen(VIEWS[0], PROFILE, some_lines(), 3)
    assert profile_from_lines(lines, offsets, UNIT, 2) == pytest.approx(
        PROFILE.coefficients, abs=1e-8
    )  # 3e-11 measured


def test_parallel_lines_do_not_fix_a_homography() -> None:
    """There is a one-parameter family of solutions: the second singular value is as small as the first."""
    parallel = np.column_stack([np.ones(8), np.zeros(8), np.linspace(-1.0, 1.0, 8)])
    lines, offsets = lines_seen(VIEWS[0], PROFILE, parallel, 3)
    assert fit_lines(lines, PROFILE.lift(offsets), 1)[0] is None


def test_a_point_is_two_lines() -> None:
    plane, offsets = seen_through(VIEWS[1], PROFILE)
    found, _ = fit_lines(point_lines(plane), PROFILE.lift(np.vstack([offsets, offsets])), 1)
    assert found is not None
    assert same_up_to_scale(found, PHI_DOWN @ homography_of(VIEWS[1])) < 1e-12  # 2e-15 measured


# ---- phi ------------------------------------------------------------------------------------------------------------


@given(poses, st.floats(300.0, 2000.0))
def test_orthogonality_is_zero_at_the_true_phi(pose: Pose, phi: float) -> None:
    homography = np.diag([phi, phi, 1.0]) @ homography_of(pose)
    assert orthogonality_error(5.0 * homography[None], phi)[0, 0] < 1e-12  # 1e-15 measured


def test_orthogonality_tells_phi_from_tilted_views_only() -> None:
    phi = np.array([0.8, 1.0, 1.25]) * PHI
    tilted = np.stack([PHI_DOWN @ homography_of(pose) for pose in VIEWS])
    frontal = (PHI_DOWN @ homography_of(overhead_pose(0.3, -0.2, 3.0, 0.0, 0.0, 25.0)))[None]
    error = orthogonality_error(tilted, phi)
    assert error.shape == (3, 3)
    assert np.all(error[[0, 2]] > 0.02)  # 0.025 to 0.052 measured
    assert np.all(error[1] < 1e-12)
    assert np.all(orthogonality_error(frontal, phi) < 1e-12)


def test_a_plane_seen_as_a_line_has_no_pose() -> None:
    edge_on = np.array([[[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0]]])
    assert not np.any(np.isfinite(poses_from_homographies(edge_on)[:, :, :3]))
