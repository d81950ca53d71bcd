"""The lens models: inverse maps, limits, and the same numbers as OpenCV, COLMAP and ssl-vision."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.kernels import Optics, lens_images
from ceres_cal.scene.lens import LENSES, Brown, KannalaBrandt, Lens, Radial, make_lens

quick = settings(deadline=None, max_examples=40)

phis = st.floats(200.0, 3000.0)


def polar(radii: Array, turns: int = 24) -> Array:
    """Offsets (N, 2) at each radius in `turns` directions."""
    angles = np.arange(turns) * (2.0 * np.pi / turns) + 0.1
    return (np.stack([np.cos(angles), np.sin(angles)], -1) * radii[:, None, None]).reshape(-1, 2)


def coefficients(*sizes: float) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[st.floats(-size, size) for size in sizes])


def radial_in_units(values: tuple[float, ...], powers: tuple[int, ...], unit_px: float) -> Radial:
    """A radial lens whose coefficients are of order one when radii are counted in `unit_px`."""
    return Radial(tuple(v / unit_px ** (p - 1) for v, p in zip(values, powers, strict=True)), powers)


@st.composite
def lenses(draw: st.DrawFn, decentring: float = 2e-3) -> tuple[Lens, float]:
    """A lens of any kind with its phi."""
    phi = draw(phis)
    kind = draw(st.sampled_from(list(LENSES)))
    if kind == "radial":
        powers = draw(st.sampled_from([(2, 3), (3,), (3, 5), (2, 3, 4, 5)]))
        lens = radial_in_units(draw(coefficients(*[0.7] * len(powers))), powers, phi)
        across = draw(st.sampled_from([(), draw(coefficients(decentring, decentring))]))
        return Radial((*lens.values, *across), powers, ("tangential",) if across else ()), phi
    if kind == "brown":
        plain = coefficients(0.5, 0.3, decentring, decentring, 0.1)
        if draw(st.booleans()):
            return Brown(draw(plain)), phi
        rational, prism = coefficients(0.5, 0.3, 0.1), coefficients(decentring, decentring, decentring, decentring)
        return Brown((*draw(plain), *draw(rational), *draw(prism)), ("rational", "prism")), phi
    if draw(st.booleans()):
        return KannalaBrandt(draw(coefficients(0.2, 0.1, 0.03, 0.01))), phi
    every = coefficients(0.2, 0.1, 0.03, 0.01, decentring, decentring)
    return KannalaBrandt(draw(every), ("tangential",)), phi


def valid_radius(lens: Lens, phi: float) -> float:
    """The largest radius (px) of a test: nearly up to where the lens ends, or 1.5 phi for one that never does."""
    return min(0.97 * lens.monotone_radius(phi), 1.5 * phi)


# ---- there and back -------------------------------------------------------------------------------------------------


def test_decentring_of_the_papers_lens_is_browns_own() -> None:
    """From the measured to the ideal point, like the radial part, by Brown's formula; the compiled
    map is its inverse.
    """
    lens, phi, unit = Radial((2e-4, 1e-6, 0.006, -0.008), (2, 3), ("tangential",)), 390.0, 486.0
    measured = polar(np.linspace(5.0, 400.0, 30))
    (x, y), r = measured.T, np.linalg.norm(measured, axis=1)
    ideal = measured * (1.0 + 2e-4 * r + 1e-6 * r**2)[:, None]
    ideal[:, 0] -= (2.0 * 0.006 * x * y - 0.008 * (r**2 + 2.0 * x**2)) / phi
    ideal[:, 1] -= (0.006 * (r**2 + 2.0 * y**2) - 2.0 * 0.008 * x * y) / phi
    rays = np.column_stack([ideal / phi, np.ones(len(ideal))])
    assert np.max(np.abs(lens.distort(rays, phi) - measured)) < 1e-9
    images, scaled = np.empty((2, 4, len(rays))), np.asarray(lens.values) * lens.scales(unit)
    optics = Optics(lens, "radial", lens.form, np.array([phi, 1.0, 0.0, 0.0, *scaled, 0.0]), unit)
    lens_images(optics, rays, images)
    assert np.max(np.abs(images[:, 0].T - measured)) < 1e-9
    for axis, step in enumerate(1e-4 * np.eye(3)):
        slope = (lens.distort(rays + step, phi) - lens.distort(rays - step, phi)) / 2e-4
        assert np.max(np.abs(images[:, 1 + axis].T - slope)) < 1e-3  # of 390


@quick
@given(lenses())
def test_round_trip_over_the_valid_image(drawn: tuple[Lens, float]) -> None:
    lens, phi = drawn
    offsets = polar(np.linspace(0.0, valid_radius(lens, phi), 60))
    rays = lens.undistort(offsets, phi)
    assert np.abs(np.linalg.norm(rays, axis=1) - 1.0).max() < 1e-15  # measured 3.4e-16; NaN fails, too
    assert np.abs(lens.distort(rays, phi) - offsets).max() < 1e-9  # px; measured 7.4e-11


@quick
@given(lenses(), st.floats(0.1, 10.0))
def test_round_trip_from_rays_of_any_length(drawn: tuple[Lens, float], length: float) -> None:
    lens, phi = drawn
    rays = lens.undistort(polar(np.linspace(0.0, 0.9 * valid_radius(lens, phi), 30)), phi)
    back = lens.undistort(lens.distort(length * rays, phi), phi)
    assert np.abs(back - rays).max() < 1e-14  # rad; measured 2.0e-15


# A lens for which Newton's method once did not end, and one for which it stopped half way when started at the rim.
CIRCLING = (
    Brown((0.3696602911999488, 0.23772868894562144, -0.001024502834884153, 0.0009761263523310101, -0.0283)),
    1000.0,
)
# Near its pole a place is accurate to the last digit earlier than its image.
POLE = Brown((-0.0116, 0.1295, 0.0094, 1e-5, 0.0, 0.0094, -0.1616, 3e-4, 1e-5, 0.0123, 0.0, 0.0), ("rational", "prism"))
RIM = Radial((8.528542732914017e-06, -1.274056190889818e-10), (3, 5)), 202.0


@quick
@given(lenses(decentring=2e-2))
@example(CIRCLING)
@example(RIM)
def test_a_pixel_has_its_own_ray_or_none(drawn: tuple[Lens, float]) -> None:
    lens, phi = drawn
    end = min(lens.monotone_radius(phi), 2.5 * phi)
    radii = np.concatenate([np.linspace(0.0, 1.2 * end, 60), end * (1.0 - np.logspace(-9, -1, 20))])
    offsets = polar(radii)
    back = lens.distort(lens.undistort(offsets, phi), phi)
    off = np.abs(back - offsets)[np.isfinite(back[:, 0])]
    assert off.max() < 1e-3  # px; the square root of rounding times the radius at the rim of `radial`, measured 1.4e-4


@quick
@given(lenses(decentring=2e-2), st.integers(0, 2**32))
@example(CIRCLING, 0)
@example(RIM, 0)
@example((POLE, 572.5), 0)
def test_a_ray_has_its_own_pixel_or_none(drawn: tuple[Lens, float], seed: int) -> None:
    lens, phi = drawn
    rays = np.random.default_rng(seed).normal(size=(2000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if lens.kind != "kannala-brandt":
        rays = rays[rays[:, 2] > 0.1]  # 84 degrees from the axis: with a power of 7 there is no picture beyond
    offsets = lens.distort(rays, phi)
    rays, offsets = rays[np.isfinite(offsets[:, 0])], offsets[np.isfinite(offsets[:, 0])]
    back = lens.undistort(offsets, phi)
    found = np.isfinite(back[:, 0])
    assert np.all(found | (np.hypot(*offsets.T) > 0.9 * lens.monotone_radius(phi)))  # it may fail at the rim
    off = np.abs(back - rays)[found]
    assert off.max(initial=0.0) < 1e-7  # rad; the square root of rounding at the rim, measured 9e-10


# ---- where a lens ends ----------------------------------------------------------------------------------------------

ENDING: list[tuple[Lens, float, float]] = [  # lens, phi, the radius at which the derivative vanishes, in closed form
    (Radial((-1e-7,), (3,)), 800.0, np.sqrt(1.0 / 3e-7)),
    (Radial((-2e-4, -1e-7)), 800.0, (-4e-4 + np.sqrt(16e-8 + 12e-7)) / 6e-7),
    (Radial((0.0, 0.0, 3e-3, 4e-3), (2, 3), ("tangential",)), 800.0, 800.0 / 0.03),  # r - 3 |p| r^2
    (Brown((-0.2, 0.0, 0.0, 0.0, 0.0)), 800.0, 800.0 * np.sqrt(1.0 / 0.6) * (2.0 / 3.0)),
    (Brown((0.0, 0.0, 3e-3, 4e-3, 0.0)), 800.0, 800.0 / 0.06),  # r - 3 |p| r^2 in the worst direction
    (KannalaBrandt((-0.1, 0.0, 0.0, 0.0)), 300.0, 300.0 * np.sqrt(1.0 / 0.3) * (2.0 / 3.0)),
    (KannalaBrandt((0.0, 0.0, 0.0, 0.0)), 300.0, 300.0 * np.pi),  # not beyond the direction straight behind
]


@pytest.mark.parametrize("lens, phi, radius", ENDING)
def test_monotone_radius_is_where_the_derivative_vanishes(lens: Lens, phi: float, radius: float) -> None:
    assert lens.monotone_radius(phi) == pytest.approx(radius, rel=1e-14)  # measured 2e-16


@pytest.mark.parametrize("lens, phi, radius", ENDING)
def test_there_is_no_answer_beyond_it(lens: Lens, phi: float, radius: float) -> None:
    inside, beyond = polar(np.array([0.0, 0.5, 0.999999]) * radius), polar(np.array([1.000001, 2.0, 1e9]) * radius)
    assert np.all(np.isfinite(lens.undistort(inside, phi)))
    if lens.kind != "brown" or not any(
        lens.values[2:4]
    ):  # with decentring, other directions than the worst reach farther
        assert np.all(np.isnan(lens.undistort(beyond, phi)))


@pytest.mark.parametrize("kind", ["brown", "kannala-brandt"])
def test_decentred_lenses_have_an_answer_everywhere_inside(kind: str) -> None:
    """In every direction, up to the limit of the map; one in forty had none."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        across = rng.normal(0.0, 0.003, 2)
        if kind == "brown":
            lens: Lens = Brown((*rng.normal(0.0, [0.3, 0.15]), *across, rng.normal(0.0, 0.05)))
        else:
            lens = KannalaBrandt((*rng.normal(0.0, [0.05, 0.05, 0.02, 0.005]), *across), ("tangential",))
        radius = lens.monotone_radius(300.0)
        if np.isfinite(radius):
            turn, inside = rng.uniform(0.0, 2.0 * np.pi, 40), radius * (1.0 - 10.0 ** rng.uniform(-9.0, -3.0, 40))
            pixels = inside[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
            assert np.all(np.isfinite(lens.undistort(pixels, 300.0)))


@quick
@given(lenses())
def test_the_radius_grows_up_to_there(drawn: tuple[Lens, float]) -> None:
    lens, phi = drawn
    assume(lens.monotone_radius(phi) < 4.0 * phi)
    direction = np.array([0.6, -0.8])
    measured = np.linspace(0.0, lens.monotone_radius(phi) * (1.0 - 1e-9), 400)
    rays = lens.undistort(measured[:, None] * direction, phi)
    angle = np.arctan2(rays[:, :2] @ direction, rays[:, 2])
    assert np.all(np.diff(angle) > 0.0)
    # Rays at larger angles have no pixel.
    over = angle[-1] + np.linspace(1e-3, 0.3, 50)
    over = over[over < np.pi]
    pixels = lens.distort(np.column_stack([np.sin(over)[:, None] * direction, np.cos(over)]), phi)
    if not any(value for name, value in lens.coefficients.items() if name[0] in "ps"):
        assert np.all(np.isnan(pixels))


@pytest.mark.parametrize("values, powers", [((0.0, 0.0), (2, 3)), ((2e-4, 3e-7), (2, 3)), ((-9e-4, 4e-6), (2, 3))])
def test_a_lens_that_always_grows_has_no_end(values: tuple[float, ...], powers: tuple[int, ...]) -> None:
    assert Radial(values, powers).monotone_radius(800.0) == np.inf
    assert Brown((0.1, 0.02, 0.0, 0.0, 0.0)).monotone_radius(800.0) == np.inf


@pytest.mark.parametrize("tiny", [1e-18, -1e-18, 1e-30, -1e-300, 5e-324])
def test_a_coefficient_of_next_to_nothing_moves_no_end(tiny: float) -> None:
    # A root finder that divides by the leading coefficient misses the end at 500 px, or fails.
    assert Radial((-1e-3, tiny)).monotone_radius(800.0) == pytest.approx(500.0, rel=1e-11)
    assert Brown((-0.2, 0.0, 0.0, 0.0, tiny)).monotone_radius(1.0) == pytest.approx(np.sqrt(20.0 / 27.0), rel=1e-12)


@pytest.mark.parametrize("lens", [Radial((-9e-4, 4e-6)), Brown((-0.28, 0.07, 1e-3, -5e-4, 0.0)), KannalaBrandt()])
def test_nonsense_has_no_answer(lens: Lens) -> None:
    odd = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 1e-320, 1e300, -1e308])
    rays = np.stack(np.meshgrid(odd, odd, odd), -1).reshape(-1, 3)
    pixels = lens.distort(rays, 800.0)
    assert np.all(np.isnan(pixels).all(1) | np.isfinite(pixels).all(1))
    assert np.all(np.isnan(pixels[~np.isfinite(rays[:, :2]).all(1) | np.isnan(rays[:, 2]) | ~rays.any(1)]))
    unit = lens.undistort(np.stack(np.meshgrid(odd, odd), -1).reshape(-1, 2), 800.0)
    length = np.linalg.norm(unit, axis=1)
    assert np.all(np.isnan(unit).all(1) | (np.abs(length - 1.0) < 1e-15))  # measured 2e-16
    assert lens.distort(np.empty((0, 3)), 800.0).shape == (0, 2)
    assert lens.undistort(np.empty((0, 2)), 800.0).shape == (0, 3)


@pytest.mark.parametrize("lens", [Radial((-9e-4, 4e-6)), Brown((-0.28, 0.07, 1e-3, -5e-4, 0.0))])
def test_nothing_is_seen_behind_the_camera(lens: Lens) -> None:
    rays = np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    assert np.all(np.isnan(lens.distort(rays, 800.0)))


def test_kannala_brandt_sees_behind_the_camera() -> None:
    lens = KannalaBrandt()  # angle times phi: all directions but straight behind
    angle = np.radians([0.0, 60.0, 90.0, 120.0, 179.0])
    pixels = lens.distort(np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)]), 300.0)
    assert pixels[:, 0] == pytest.approx(300.0 * angle, rel=1e-15)  # measured 0
    assert np.all(np.isnan(lens.distort([[0.0, 0.0, -1.0]], 300.0)))


# ---- the same numbers as others -------------------------------------------------------------------------------------

ACROSS = np.stack(np.meshgrid(np.linspace(-1.1, 1.1, 23), np.linspace(-0.9, 0.9, 19)), -1).reshape(
    -1, 2
)  # x / z, y / z
RAYS = np.column_stack([ACROSS, np.ones(len(ACROSS))]) * np.linspace(0.5, 3.0, len(ACROSS))[:, None]
PHI, CENTRE = 600.0, np.array([640.3, 481.7])
BROWN = [(-0.28, 0.07, 0.0, 0.0, 0.0), (-0.28, 0.09, 1e-3, -5e-4, -0.009), (0.1, -0.02, -2e-3, 1e-3, 0.003)]
FISHEYE = [(0.0, 0.0, 0.0, 0.0), (0.02, -0.005, 0.001, -2e-4), (-0.03, 0.01, -0.004, 0.0006)]


def colmap(model: str, *distortion: float) -> pycolmap.Camera:
    """COLMAP has (0.5, 0.5) at the centre of the top-left pixel, we (0, 0)."""
    return pycolmap.Camera(model=model, width=1280, height=960, params=[PHI, PHI, *(CENTRE + 0.5), *distortion])


def opencv(project: Callable[..., Any], distortion: tuple[float, ...]) -> Array:
    K = np.array([[PHI, 0.0, CENTRE[0]], [0.0, PHI, CENTRE[1]], [0.0, 0.0, 1.0]])
    pixels, _ = project(RAYS.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array(distortion))
    return np.asarray(pixels).reshape(-1, 2)


def assert_same_rays(camera: pycolmap.Camera, rays: Array, pixels: Array) -> None:
    assert np.abs(np.asarray(camera.img_from_cam(rays)) - 0.5 - pixels).max() < 1e-9  # px; measured 4.6e-13
    theirs = np.asarray(camera.cam_from_img(pixels + 0.5))
    assert np.abs(rays[:, :2] / rays[:, 2:] - theirs).max() * PHI < 1e-7  # px; their iteration's tolerance is 2.8e-8


@pytest.mark.parametrize("values", BROWN)
def test_brown_is_opencvs_and_colmaps(values: tuple[float, ...]) -> None:
    pixels = Brown(values).distort(RAYS, PHI) + CENTRE
    assert np.abs(pixels - opencv(cv2.projectPoints, values)).max() < 1e-9  # px; measured 4.6e-13
    theirs = [colmap("FULL_OPENCV", *values, 0.0, 0.0, 0.0)]
    if values[4] == 0.0:
        theirs.append(colmap("OPENCV", *values[:4]))
    for camera in theirs:
        assert np.abs(pixels - camera.img_from_cam(RAYS) + 0.5).max() < 1e-9  # px; measured 4.6e-13
        assert_same_rays(camera, Brown(values).undistort(pixels - CENTRE, PHI), pixels)


@pytest.mark.parametrize("values", FISHEYE)
def test_kannala_brandt_is_opencvs_and_colmaps(values: tuple[float, ...]) -> None:
    pixels = KannalaBrandt(values).distort(RAYS, PHI) + CENTRE
    assert np.abs(pixels - opencv(cv2.fisheye.projectPoints, values)).max() < 1e-9  # px; measured 2.3e-13
    camera = colmap("OPENCV_FISHEYE", *values)
    assert np.abs(pixels - camera.img_from_cam(RAYS) + 0.5).max() < 1e-9  # px; measured 2.3e-13
    assert_same_rays(camera, KannalaBrandt(values).undistort(pixels - CENTRE, PHI), pixels)


@quick
@given(st.floats(-0.2, 0.4), phis)
def test_radial_with_power_3_is_ssl_visions(distortion: float, phi: float) -> None:
    lens = Radial((distortion / phi**2,), (3,))
    measured = polar(np.linspace(0.0, min(1.0, 0.99 * lens.monotone_radius(phi) / phi), 20))
    ideal = measured * (1.0 + distortion * np.sum(measured**2, axis=1, keepdims=True))  # ssl-vision, in units of phi
    rays = lens.undistort(measured * phi, phi)
    assert np.abs(rays[:, :2] / rays[:, 2:] - ideal).max() < 1e-14  # measured 7e-16


# ---- coefficients ---------------------------------------------------------------------------------------------------


@quick
@given(coefficients(0.5, 0.5), phis, st.floats(0.5, 2.0))
def test_scaling_the_papers_triple_with_phi_changes_nothing(values: tuple[float, ...], phi: float, a1: float) -> None:
    lens = radial_in_units(values, (2, 3), phi)
    first, second, third = lens.paper_coefficients(a1)
    back, phi_back = Radial.from_paper(first, second, third, phi * a1)
    assert phi_back == pytest.approx(phi, rel=1e-15)
    assert back.values == pytest.approx(lens.values, rel=1e-15, abs=1e-300)
    offsets = polar(np.linspace(0.0, 0.9 * valid_radius(lens, phi), 10))
    assert np.abs(back.undistort(offsets, phi_back) - lens.undistort(offsets, phi)).max() < 1e-14  # rad; measured 1e-15


def test_radii_of_any_shape() -> None:
    lens = Radial((-9e-4, 4e-6))
    radii = np.array([[0.0, 100.0, 450.0], [20.0, 1.0, 1e4]])
    assert lens.ideal_radius(450.0) == pytest.approx(450.0 - 9e-4 * 450.0**2 + 4e-6 * 450.0**3, rel=1e-15)
    assert lens.measured_radius(lens.ideal_radius(radii)) == pytest.approx(radii, rel=1e-14)  # measured 5e-16
    assert lens.measured_radius(lens.ideal_radius(450.0)).shape == ()


@pytest.mark.parametrize("lens", [Radial((-9e-4, 4e-6, 1e-12), (2, 3, 5)), Brown(), KannalaBrandt()])
def test_scales_make_coefficients_of_order_one(lens: Lens) -> None:
    scaled = lens.scales(800.0) * lens.values
    if isinstance(lens, Radial):
        s = 450.0 / 800.0
        ideal = s + sum(c * s**p for c, p in zip(scaled, lens.powers, strict=True))
        assert 800.0 * ideal == pytest.approx(float(lens.ideal_radius(450.0)), rel=1e-15)
    else:
        assert np.array_equal(scaled, lens.values)


def test_a_name_that_another_program_gives_to_a_lens_belongs_to_one_lens() -> None:
    names = [name for lens in LENSES.values() for name in (lens.kind, *lens.also_called)]
    assert len({*names}) == len(names) and all(name == name.lower().replace("_", "-") for name in names)


def test_lenses_by_name() -> None:
    assert make_lens("radial", (3, 5), {"a5": 1e-12}) == Radial((0.0, 1e-12), (3, 5))
    assert make_lens("brown", coefficients={"p2": 1e-3}) == Brown((0.0, 0.0, 0.0, 1e-3, 0.0))
    assert make_lens("kannala-brandt").coefficients == {"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    assert [make_lens(kind).kind for kind in LENSES] == list(LENSES)
    assert Brown().with_values(np.arange(5.0)) == Brown((0.0, 1.0, 2.0, 3.0, 4.0))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: make_lens("glass"), "there is no lens 'glass': choose one of radial, brown, kannala-brandt"),
        (lambda: make_lens("brow"), "there is no lens 'brow': did you mean 'brown'"),
        (lambda: make_lens("Plumb_Bob"), "there is no lens 'Plumb_Bob': here it is 'brown'"),
        (
            lambda: make_lens("brown", coefficients={"k7": 0.1}),
            "lens 'brown' has no coefficient 'k7': it has k1, k2, p1",
        ),
        (lambda: make_lens("radial", (2, 3), {"a5": 0.1}), "lens 'radial' has no coefficient 'a5': it has a2, a3"),
        (lambda: make_lens("radial", ()), "powers of the radial lens must be different whole numbers from 2 to 30"),
        (lambda: make_lens("radial", (1, 2)), "different whole numbers from 2 to 30"),
        (lambda: make_lens("radial", (31,)), "different whole numbers from 2 to 30"),
        (lambda: make_lens("radial", (10**30,)), "different whole numbers from 2 to 30"),
        (lambda: make_lens("radial", (3, 3)), "different whole numbers from 2 to 30"),
        (lambda: Radial((0.1,), (2.5,)), "different whole numbers from 2 to 30"),  # type: ignore[arg-type]
        (lambda: Radial((0.1,)), "lens 'radial' has coefficients a2, a3: give 2 numbers, not 1"),
        (lambda: Radial.from_paper(0.0, 1e-4, 1e-6, 800.0), "a1 of the paper's polynomial must be positive"),
    ],
)
def test_what_is_no_lens_is_refused(make: Callable[[], Lens], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()
