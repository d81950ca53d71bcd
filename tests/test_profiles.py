"""The fit of edges and painted lines to raw pixels: no bias by blur, slope and light, and honest sigmas."""

from types import SimpleNamespace

import numpy as np
import pytest
from thorough import partly

from ceres_cal.base.arrays import Array, Array32
from ceres_cal.detect.blur import blur_of, no_blur
from ceres_cal.detect.profiles import EdgeShape, cut_windows, fit_profiles, fit_shape
from ceres_cal.kernels import normal_cdf

WIDTH_PX = 2.4
COUNT = 200


def stripe(
    normal: Array, offset: float, blur: float, left: float = 40.0, right: float = 40.0, slope: float = 0.0
) -> Array:
    """(61, 61) grey levels of a bright stripe, sampled finely and averaged over each square pixel."""
    fine = 9
    axis = (np.arange(61 * fine) + 0.5) / fine - 0.5 - 30.0
    t = axis[None, :] * normal[0] + axis[:, None] * normal[1] - offset
    # The averaging adds the pixel's own square, and also the small squares with a variance of 1 / 12 / fine^2.
    s = np.sqrt(blur**2 - 1.0 / 12.0 / fine**2)
    light = left + slope * t
    light += (190.0 - left) * normal_cdf((t + 0.5 * WIDTH_PX) / s)
    light += (right - 190.0) * normal_cdf((t - 0.5 * WIDTH_PX) / s)
    return np.asarray(light.reshape(61, fine, 61, fine).mean(axis=(1, 3)))


def fitted(image: Array, normal: Array, blur: float) -> tuple[float, float]:
    """Offset and sigma of one stripe through the centre."""
    edges = 0.5 * WIDTH_PX * np.array([[-1.0, 1.0]])
    windows = cut_windows(image.astype(np.float32), np.array([[30.0, 30.0]]), normal[None], np.zeros(1), 6.0, 3)
    found = fit_profiles(windows, edges, np.hypot(blur, 12**-0.5), 2.0)
    return float(found.offset_px[0]), float(found.sigma_px[0])


@pytest.mark.parametrize("angle_deg", partly([0.0, 13.0, 45.0, 77.0, 90.0, 160.0], [0.0, 13.0, 77.0, 160.0]))
@pytest.mark.parametrize("blur", partly([0.4, 0.7, 1.3], [0.4, 1.3]))
def test_neither_blur_nor_slope_nor_light_pulls(angle_deg: float, blur: float) -> None:
    normal = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    for offset in (-0.7, -0.25, 0.0, 0.4):
        for light in ({}, {"left": 20.0, "right": 70.0}, {"slope": 1.5}):
            found, _ = fitted(stripe(normal, offset, blur, **light), normal, blur)
            assert found == pytest.approx(offset, abs=0.015)  # 0.012 px at blur 0.4, 0.003 px from 0.7 on


def test_an_unknown_blur_moves_nothing_and_is_found() -> None:
    normal = np.array([0.28, 0.96])
    image = stripe(normal, 0.3, 0.9)
    for wrong in (0.5, 1.1):
        assert fitted(image, normal, wrong)[0] == pytest.approx(0.3, abs=0.01)  # 0.004 px
    windows = cut_windows(image.astype(np.float32), np.array([[30.0, 30.0]]), normal[None], np.zeros(1), 6.0, 3)
    shape = fit_shape(windows, 0.5 * WIDTH_PX * np.array([[-1.0, 1.0]]), EdgeShape(1.0))
    assert shape.blur_px == pytest.approx(np.hypot(0.9, 12**-0.5), rel=0.03)
    assert shape.stretch == pytest.approx(1.0, abs=0.03)
    wider = fit_shape(windows, 0.5 * 0.6 * WIDTH_PX * np.array([[-1.0, 1.0]]), EdgeShape(1.0))
    assert wider.stretch == pytest.approx(1.0 / 0.6, rel=0.05)


def test_a_smear_is_found_and_moves_nothing() -> None:
    normal, edges = np.array([0.28, 0.96]), 0.5 * WIDTH_PX * np.array([[-1.0, 1.0]])
    image = np.mean([stripe(normal, 0.3 + along, 0.6) for along in np.linspace(-3.0, 3.0, 61)], axis=0)
    noisy = image + np.random.default_rng(3).normal(0.0, 2.0, image.shape)
    windows = cut_windows(noisy.astype(np.float32), np.array([[30.0, 30.0]]), normal[None], np.zeros(1), 9.0, 3)
    shape = fit_shape(windows, edges, EdgeShape(0.8, 1.0, 4.0))
    assert shape.smear_px == pytest.approx(6.0, rel=0.1)  # 0.03
    found = fit_profiles(windows, edges, shape.blur_px, 1.5, shape.smear_px)
    assert abs(found.offset_px[0] - 0.3) < 3.0 * found.sigma_px[0] < 0.1  # 0.027 and 0.077 px
    as_gaussian = fit_profiles(windows, edges, fit_shape(windows, edges, EdgeShape(1.0)).blur_px, 1.5)
    assert as_gaussian.sigma_px[0] > 2.0 * found.sigma_px[0]  # 3.3


@pytest.mark.parametrize("lean", partly([1.0, -1.0], [-1.0]))
def test_coma_is_found_and_moves_nothing(lean: float) -> None:
    normal, edges = np.array([0.28, 0.96]), 0.5 * WIDTH_PX * np.array([[-1.0, 1.0]])
    share = np.linspace(0.0, 1.0, 61)
    along = 5.0 * lean * (share - np.average(share, weights=1.0 - share))
    image = np.average([stripe(normal, 0.3 + one, 0.6) for one in along], axis=0, weights=1.0 - share)
    noisy = image + np.random.default_rng(3).normal(0.0, 2.0, image.shape)
    windows = cut_windows(noisy.astype(np.float32), np.array([[30.0, 30.0]]), normal[None], np.zeros(1), 9.0, 3)
    even = fit_profiles(windows, edges, fit_shape(windows, edges, EdgeShape(1.0)).blur_px, 1.5)
    assert abs(even.offset_px[0] - 0.3) > 0.1
    shape = fit_shape(windows, edges, EdgeShape(0.8, 1.0, 3.0), along=np.array([lean]))
    assert shape.smear_px == pytest.approx(5.0, rel=0.1)
    found = fit_profiles(windows, edges, shape.blur_px, 1.5, shape.smear_px, lean)
    assert abs(found.offset_px[0] - 0.3) < 0.03


def test_sigma_is_the_scatter() -> None:
    rng, normal = np.random.default_rng(1), np.array([0.6, 0.8])
    clean = stripe(normal, 0.1, 0.8)
    errors, sigmas = [], []
    for _ in range(COUNT):
        found, sigma = fitted(clean + rng.normal(0.0, 6.0, clean.shape), normal, 0.8)
        errors.append(found - 0.1)
        sigmas.append(sigma)
    assert np.std(errors) / np.mean(sigmas) == pytest.approx(1.0, abs=0.12)  # 2.4 standard errors of 200
    assert abs(np.mean(errors)) < 3.0 * np.std(errors) / np.sqrt(COUNT)


def test_curves_bend() -> None:
    y, x = np.indices((61, 61)) - 30.0
    radius = np.hypot(x, y + 40.0)  # a circle of 40 px radius whose lowest point is the image's centre
    image: Array32 = (200.0 * normal_cdf((41.3 - radius) / 0.8)).astype(np.float32)
    normal = np.array([[0.0, 1.0]])
    bent = cut_windows(image, np.array([[30.0, 30.0]]), normal, np.array([-1.0 / 40.0]), 5.0, 4)
    straight = cut_windows(image, np.array([[30.0, 30.0]]), normal, np.zeros(1), 5.0, 4)
    edge = np.zeros((1, 1))
    assert fit_profiles(bent, edge, 0.8, 2.5).offset_px[0] == pytest.approx(1.3, abs=0.005)
    assert fit_profiles(straight, edge, 0.8, 2.5).offset_px[0] < 1.3 - 0.05


def test_windows_at_the_border_and_without_light_tell_nothing() -> None:
    flat = np.full((61, 61), 80.0, np.float32)
    normal = np.array([[0.0, 1.0], [0.0, 1.0]])
    windows = cut_windows(flat, np.array([[30.0, 30.0], [30.0, 2.0]]), normal, np.zeros(2), 5.0, 3)
    assert windows.inside.tolist() == [True, False]
    found = fit_profiles(windows, np.array([[-1.0, 1.0], [-1.0, 1.0]]), 0.8, 2.0)
    assert np.isnan(found.offset_px[1]) and np.max(np.abs(found.heights)) < 1e-3


def test_a_blur_is_told_where_nothing_is_bright() -> None:
    """All places are darker than their surroundings, so that half of a negative quantile is above all of them."""
    image = 255.0 - stripe(np.array([1.0, 0.0]), 0.0, 1.0)
    places = np.column_stack([np.full(40, 30.0), np.linspace(12.0, 48.0, 40)])
    normals = np.tile([1.0, 0.0], (40, 1))
    windows = cut_windows(image.astype(np.float32), places, normals, np.zeros(40), 6.0, 3)
    course = SimpleNamespace(normals=normals, edges=np.tile(0.5 * WIDTH_PX * np.array([[-1.0, 1.0]]), (40, 1)))
    for bright in (np.linspace(-90.0, -10.0, 40), np.zeros(40), np.linspace(10.0, 90.0, 40)):
        found = blur_of(windows, course, bright, no_blur(40))  # type: ignore[arg-type]
        assert np.all(np.isfinite(found.blur_px))
