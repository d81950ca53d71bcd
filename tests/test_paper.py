"""Errors of the paper, and what is right in it (docs/mathematics.md): its lens, its matrices, its sign."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose, rotation_from_euler
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial

A1, A2, A3 = 1.07761103142178, -0.00096240306505, 0.00000401304361  # section 2, to the last digit printed

quick = settings(deadline=None, max_examples=40)


@st.composite
def overhead_cameras(draw: st.DrawFn) -> Camera:
    """A camera above the field that looks down, tilted by up to 30 degrees, with any yaw."""
    alpha, beta = (draw(st.floats(-0.5, 0.5)) for _ in range(2))
    position = draw(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(1.0, 6.0)))
    rotation = rotation_from_euler(np.pi + alpha, beta, draw(st.floats(-np.pi, np.pi)))
    lens, phi = Radial.from_paper(A1, A2, A3, draw(st.floats(600.0, 1200.0)))
    return Camera((780, 580), phi, (389.5, 289.5), lens, 1.0, Pose.looking(position, rotation))


def undistorted(camera: Camera, pixels: Array) -> Array:
    """Homogeneous (x'', y'', 1) of the image plane at depth 1."""
    rays = camera.rays(pixels)
    return rays / rays[:, 2:]


PIXELS = np.stack(np.meshgrid(np.linspace(-0.5, 779.5, 9), np.linspace(-0.5, 579.5, 7)), -1).reshape(-1, 2)


# ---- section 2: radial distortion -----------------------------------------------------------------------------------


def test_the_printed_polynomial_is_that_of_the_radius() -> None:
    # d_r = a1 r + a2 r^2 + a3 r^3 is printed as the factor. As a factor it would be 0 at the centre and 655.7 at
    # 450 px.
    as_printed = np.polyval([A3, A2, A1, 0.0], 450.0)
    assert as_printed == pytest.approx(655.7, abs=0.05)
    lens, _ = Radial.from_paper(A1, A2, A3, 800.0)
    assert A1 * lens.ideal_radius(450.0) == pytest.approx(as_printed, rel=1e-15)  # px; figure 3 shows some 700
    assert lens.measured_radius(as_printed / A1) == pytest.approx(450.0, rel=1e-14)


def test_the_true_factor_is_1_at_the_centre() -> None:
    lens, phi = Radial.from_paper(A1, A2, A3, 800.0)
    rays = lens.undistort(np.array([[0.0, 0.0], [1e-6, 0.0]]), phi)
    assert rays[0].tolist() == [0.0, 0.0, 1.0]
    assert rays[1, 0] / rays[1, 2] * phi == pytest.approx(1e-6, rel=2e-9)  # d_r = 1 + a2 r / a1 there


def test_the_papers_lens_never_folds() -> None:
    lens, phi = Radial.from_paper(A1, A2, A3, 800.0)
    assert lens.monotone_radius(phi) == np.inf
    lens, phi = Radial.from_paper(A1, 4.0 * A2, A3, 800.0)  # a lens that folds
    slope_vanishes = np.roots([3.0 * A3, 2.0 * 4.0 * A2, A1])
    assert lens.monotone_radius(phi) == pytest.approx(slope_vanishes.real.min(), rel=1e-13)  # px; measured 2e-16


@quick
@given(overhead_cameras(), st.floats(0.2, 5.0))
def test_a_common_factor_of_a1_a2_a3_and_phi_changes_nothing(camera: Camera, factor: float) -> None:
    lens, phi = Radial.from_paper(factor * A1, factor * A2, factor * A3, factor * A1 * camera.phi)
    scaled = Camera(camera.image_size, phi, camera.principal_point, lens, 1.0, camera.cam_from_world)
    points = np.column_stack([camera.locate(PIXELS), np.zeros(len(PIXELS))])
    points = points[np.max(np.abs(points), axis=1) < 20.0]
    off = scaled.project(points) - camera.project(points)
    assert np.abs(off).max() < 1e-9  # px; measured 2.3e-13
    printed = lens.paper_coefficients(A1)
    assert printed == pytest.approx((A1, A2, A3), rel=1e-15)


# ---- sections 3.1, 3.4 and 4: homographies --------------------------------------------------------------------------


@quick
@given(overhead_cameras(), st.sampled_from([0.0, 0.15]))
def test_homography_project_and_locate_agree(camera: Camera, height_m: float) -> None:
    xy = camera.locate(PIXELS, height_m)
    xy = xy[np.max(np.abs(xy), axis=1) < 20.0]  # m; a tilted camera sees the horizon, and above it
    assert len(xy) > 0
    pixels = camera.project(np.column_stack([xy, np.full(len(xy), height_m)]))
    image = undistorted(camera, pixels)

    mapped = np.column_stack([xy, np.ones(len(xy))]) @ camera.homography(height_m).T
    assert np.abs(mapped[:, :2] / mapped[:, 2:] - image[:, :2]).max() < 1e-13  # measured 1.2e-15
    back = image @ camera.inverse_homography(height_m).T
    assert np.abs(back[:, :2] / back[:, 2:] - xy).max() < 1e-12  # m; measured 4.6e-14


@quick
@given(overhead_cameras(), st.sampled_from([0.0, 0.15]))
def test_columns_of_the_homography(camera: Camera, height_m: float) -> None:
    # Section 3: H = (r1 r2 -Rt); section 3.3: r3 = r1 x r2 and t = -R^-1 h3.
    H, R = camera.homography(), camera.cam_from_world.rotation
    assert np.array_equal(H[:, :2], R[:, :2])
    assert np.abs(np.cross(H[:, 0], H[:, 1]) - R[:, 2]).max() < 1e-15  # measured 2.3e-16
    assert np.abs(-R.T @ H[:, 2] - camera.position).max() < 1e-14  # m; measured 0
    off = camera.homography(height_m) - H - np.outer(height_m * R[:, 2], [0.0, 0.0, 1.0])
    assert np.abs(off).max() < 2e-15  # measured 4.2e-16


def test_sign_of_section_4() -> None:
    # A camera at 2.5 m looks straight down at a point 0.15 m high, 0.934 m beside its foot. Printed: H' = H - r3 l.
    pose, height_m, x = Pose.looking([0.0, 0.0, 2.5], np.diag([1.0, -1.0, -1.0])), 0.15, 0.934
    camera = Camera((780, 580), 800.0, (389.5, 289.5), Radial((0.0, 0.0)), 1.0, pose)
    seen = undistorted(camera, camera.project([[x, 0.0, height_m]]))[0]
    in_third_column = height_m * np.outer(pose.rotation[:, 2], [0.0, 0.0, 1.0])
    assert np.array_equal(camera.homography(height_m), camera.homography() + in_third_column)
    right, printed = (
        camera.homography(height_m) @ [x, 0.0, 1.0],
        (camera.homography() - in_third_column) @ [x, 0.0, 1.0],
    )
    assert right[0] / right[2] == pytest.approx(seen[0], rel=1e-15)
    assert seen[0] - printed[0] / printed[2] == pytest.approx(0.045, abs=1e-5)
