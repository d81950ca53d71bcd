"""The camera: world, rays and pixels are consistent, and NaN is returned where there is no answer."""

from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, DegenerateError, InputError
from ceres_cal.base.transforms import Pose, rotation_exp, rotation_from_euler
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial

quick = settings(deadline=None, max_examples=40)

LENSES: list[Lens] = [
    Radial((-9e-4, 4e-6)),
    Radial((3e-7,), (3,)),
    Brown((-0.28, 0.07, 1e-3, -5e-4, 0.0)),
    KannalaBrandt((0.02, -0.005, 0.001, -2e-4)),
]
DOWN = np.diag([1.0, -1.0, -1.0])  # looks straight down, x to the right
SIZE = (1280, 960)
PIXELS = np.stack(np.meshgrid(np.linspace(-0.5, 1279.5, 17), np.linspace(-0.5, 959.5, 13)), -1).reshape(-1, 2)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """A camera above the field, with pixels that need not be square, tilted by at most 20 degrees."""
    alpha, beta = (draw(st.floats(-0.25, 0.25)) for _ in range(2))
    rotation = rotation_from_euler(np.pi + alpha, beta, draw(st.floats(-np.pi, np.pi)))
    position = draw(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(1.5, 6.0)))
    centre = draw(st.tuples(st.floats(600.0, 680.0), st.floats(440.0, 520.0)))
    lens, aspect = draw(st.sampled_from(LENSES)), draw(st.floats(0.8, 1.25))
    return Camera(SIZE, draw(st.floats(700.0, 1200.0)), centre, lens, aspect, Pose.looking(position, rotation))


def seen_points(camera: Camera, height_m: float = 0.0) -> tuple[Array, Array]:
    """Pixels (N, 2) that see the plane within 20 m, and the points (N, 3) m where they do."""
    xy = camera.locate(PIXELS, height_m)
    near = np.max(np.abs(xy), axis=1) < 20.0
    assert np.mean(near) > 0.5
    return PIXELS[near], np.column_stack([xy[near], np.full(near.sum(), height_m)])


@quick
@given(cameras(), st.floats(-0.5, 0.5))
def test_project_undoes_locate(camera: Camera, height_m: float) -> None:
    pixels, points = seen_points(camera, height_m)
    assert np.abs(camera.project(points) - pixels).max() < 1e-9  # px; measured 1.0e-12


@quick
@given(cameras())
def test_rays_are_where_the_points_are(camera: Camera) -> None:
    pixels, points = seen_points(camera)
    towards = camera.cam_from_world.transform(points)
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    assert np.abs(camera.rays(pixels) - towards / distance).max() < 1e-14  # rad; measured 8.9e-16


@quick
@given(cameras(), st.floats(0.7, 1.4))
def test_a_zoom_enlarges_the_picture_or_leaves_displacements(camera: Camera, ratio: float) -> None:
    rays, middle = (
        np.array([(x, y, 1.0) for x in (-0.3, 0.1, 0.4) for y in (-0.2, 0.0, 0.3)]),
        np.array(camera.principal_point),
    )
    by_angle, by_place = camera.zoomed(ratio * camera.phi)
    own = camera.at(Pose.identity()).project(rays)
    larger = by_angle.at(Pose.identity()).project(rays)
    shown = np.isfinite(own) & np.isfinite(larger)
    assert np.allclose((larger - middle)[shown], ratio * (own - middle)[shown], atol=1e-6)
    assert camera.lens.values in (by_angle.lens.values, by_place.lens.values)
    if camera.lens.acts_on_pixels:
        assert by_place.lens == camera.lens
    else:
        assert by_angle.lens == camera.lens


@given(cameras(), st.floats(0.5, 2.0))
def test_aspect_stretches_the_rows(camera: Camera, factor: float) -> None:
    _, points = seen_points(camera)
    stretched = replace(camera, aspect=factor * camera.aspect)
    offsets = camera.project(points) - camera.principal_point
    off = stretched.project(points) - camera.principal_point - offsets * (1.0, factor)
    assert np.abs(off).max() < 1e-10  # px; measured 3.5e-13
    assert stretched.matrix[1, 1] == pytest.approx(factor * camera.matrix[1, 1], rel=1e-15)
    assert stretched.matrix[0].tolist() == camera.matrix[0].tolist()


@quick
@given(cameras())
def test_without_distortion_it_is_the_matrix(camera: Camera) -> None:
    pinhole = replace(camera, lens=Radial((0.0, 0.0)))
    _, points = seen_points(camera)
    homogeneous = camera.cam_from_world.transform(points) @ pinhole.matrix.T
    off = pinhole.project(points) - homogeneous[:, :2] / homogeneous[:, 2:]
    assert np.abs(off).max() < 1e-10  # px; measured 4.6e-13


@quick
@given(cameras(), st.tuples(*[st.floats(-3.0, 3.0)] * 6))
def test_only_the_pose_between_camera_and_point_counts(camera: Camera, motion: tuple[float, ...]) -> None:
    moved_from_world = Pose.exp(motion)
    _, points = seen_points(camera)
    elsewhere = camera.at(camera.cam_from_world @ moved_from_world.inverse)
    off = elsewhere.project(moved_from_world.transform(points)) - camera.project(points)
    assert np.abs(off).max() < 1e-9  # px; measured 3.5e-12


def test_pixel_convention() -> None:
    # Pixel (0, 0) is the centre of the top-left pixel. With the principal point in the middle of a 4 x 2 image, the ray
    # through the camera's foot passes the point where the four middle pixels meet. x is to the right and y down.
    camera = Camera((4, 2), 10.0, (1.5, 0.5), Radial((0.0, 0.0)), 1.0, Pose.looking([0.0, 0.0, 2.0], DOWN))
    pixels = camera.project([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 1.0]])
    assert pixels == pytest.approx(np.array([[1.5, 0.5], [2.5, 0.5], [1.5, -0.5], [1.5, 0.5]]), abs=1e-15)
    assert camera.corner_radius == pytest.approx(np.hypot(2.0, 1.0), rel=1e-15)
    assert replace(camera, aspect=0.5).corner_radius == pytest.approx(np.hypot(2.0, 2.0), rel=1e-15)
    assert replace(camera, principal_point=(-0.5, -0.5)).corner_radius == pytest.approx(np.hypot(4.0, 2.0), rel=1e-15)
    assert camera.position.tolist() == [0.0, 0.0, 2.0]


# ---- no answer ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.kind)
def test_what_is_not_seen_is_nan(lens: Lens) -> None:
    camera = Camera(SIZE, 800.0, (639.5, 479.5), lens, 1.0, Pose.looking([0.0, 0.0, 2.5], DOWN))
    pixels = camera.project(
        [[0.1, 0.0, 0.0], [0.0, 0.0, 2.6], [np.nan, 0.0, 0.0], [0.1, 0.0, 2.49], [0.0, 0.0, np.inf]]
    )
    assert np.isfinite(pixels[[0, 3]]).all()  # the second of them is far outside the image: nothing is cut off
    assert not np.all((pixels[3] > 0.0) & (pixels[3] < SIZE))
    assert np.isnan(pixels[[1, 2, 4]]).all()
    assert np.isnan(camera.rays([[np.nan, 3.0], [np.inf, 3.0]])).all()
    assert np.isnan(camera.locate([[np.nan, 3.0]])).all()


def test_rays_that_miss_the_plane_are_nan() -> None:
    # Looks along +y, the horizon in row 479.5.
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    camera = Camera(SIZE, 800.0, (639.5, 479.5), Radial((0.0, 0.0)), 1.0, Pose.looking([0.0, 0.0, 2.0], level))
    pixels = [[639.5, 480.5], [639.5, 479.5], [700.0, 479.5], [639.5, 400.0]]
    below, on, beside, above = camera.locate(pixels)
    assert below == pytest.approx([0.0, 1600.0], rel=1e-12)
    assert np.isnan([on, beside, above]).all()
    assert np.isnan(camera.locate(pixels, height_m=2.0)).all()  # the plane through the camera
    assert camera.locate(pixels, height_m=3.0)[3] == pytest.approx([0.0, 800.0 / 79.5], rel=1e-12)
    with pytest.raises(DegenerateError, match=r"lies in the plane z = 2.0 m, edge-on: ask for another height"):
        camera.inverse_homography(2.0)


@pytest.mark.parametrize(
    "lens", [Radial((-1e-7,), (3,)), Brown((-0.3, 0.0, 0.0, 0.0, 0.0)), KannalaBrandt((-0.3, 0.0, 0.0, 0.0))]
)
def test_a_lens_that_folds_inside_the_image(lens: Lens) -> None:
    end = lens.monotone_radius(800.0)
    small, large = int(2.0 * end) - 4, int(2.0 * end) + 4
    for width, folds in ((small, False), (large, True)):
        camera = Camera((width, 2), 800.0, ((width - 1) / 2.0, 0.5), lens)
        corners = np.array([[-0.5, -0.5], [width - 0.5, 1.5]])
        assert camera.folds == folds == (0.0 < camera.folded_edge < 1.0)
        assert np.isnan(camera.rays(corners)).all() == folds
    with pytest.raises(InputError) as raised:
        camera.require_monotone("overhead")
    text = str(raised.value)
    assert text.startswith(
        f"camera 'overhead': the {lens.kind} lens folds over at {end:.1f} px from the principal point"
    )
    assert f"its corner is at {camera.corner_radius:.1f} px" in text and "\n" not in text
    Camera((small, 2), 800.0, ((small - 1) / 2.0, 0.5), lens).require_monotone("overhead")


# ---- bad input ------------------------------------------------------------------------------------------------------

CAMERA = Camera(SIZE, 800.0, (639.5, 479.5), Radial((0.0, 0.0)), 1.0, Pose.looking([0.0, 0.0, 2.5], DOWN))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: CAMERA.project([1.0, 2.0]), r"points_world must have shape \(N, 3\), not \(1, 2\)"),
        (lambda: CAMERA.project(np.zeros((4, 2))), r"points_world must have shape \(N, 3\), not \(4, 2\)"),
        (lambda: CAMERA.rays(np.zeros((4, 3))), r"pixels must have shape \(N, 2\), not \(4, 3\)"),
        (lambda: CAMERA.locate(np.zeros((1, 4, 2))), r"pixels must have shape \(N, 2\), not \(1, 4, 2\)"),
    ],
)
def test_wrong_shapes_are_refused(call: Callable[[], Array], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_no_rows_are_no_trouble() -> None:
    assert CAMERA.project(np.empty((0, 3))).shape == CAMERA.locate(np.empty((0, 2))).shape == (0, 2)
    assert CAMERA.rays(np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"image_size": (0, 960)}, "two positive whole numbers"),
        ({"phi": 0.0}, "phi and aspect positive: phi 0.0"),
        ({"phi": np.nan}, "intrinsics must be finite"),
        ({"aspect": -1.0}, "phi and aspect positive: phi 800.0, aspect -1.0"),
        ({"principal_point": (np.inf, 0.0)}, r"principal point \(inf, 0.0\)"),
        ({"lens": Radial((np.nan, 0.0))}, "'a2': nan"),
    ],
)
def test_what_is_no_camera_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        replace(CAMERA, **change)  # type: ignore[arg-type]
    assert isinstance(raised.value, CalibrationError) and raised.value.exit_code == 2
    assert "\n" not in str(raised.value)


def test_a_camera_is_frozen_and_made_of_plain_numbers() -> None:
    camera = Camera((np.int64(640), 480), np.float64(800.0), np.array([320.0, 240.0]), Brown(), 1)  # type: ignore[arg-type]
    assert [type(v) for v in (*camera.image_size, camera.phi, camera.aspect, *camera.principal_point)] == [int] * 2 + [
        float
    ] * 4
    with pytest.raises(FrozenInstanceError):
        camera.phi = 3.0  # type: ignore[misc]
    assert camera.cam_from_world == Pose.identity()
    turned = camera.at(Pose(rotation_exp([0.0, 0.1, 0.0]), np.zeros(3)))
    assert turned.lens is camera.lens and turned != camera


def test_an_error_is_one_line_whatever_it_names() -> None:
    assert str(InputError("view 'a\nb'\r\nis odd")) == "view 'a b' is odd"
