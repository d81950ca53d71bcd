"""The lens models: there and back, where they end, and the same numbers as OpenCV, COLMAP and ssl-vision."""

from collections.abc import Callable

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ceres_cal.errors import InputError
from ceres_cal.lens import LENS_KINDS, Brown, KannalaBrandt, Lens, Radial, make_lens
from ceres_cal.transforms import Array

quick = settings(deadline=None, max_examples=60)

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
    kind = draw(st.sampled_from(LENS_KINDS))
    if kind == "radial":
        powers = draw(st.sampled_from([(2, 3), (3,), (3, 5), (2, 3, 4, 5)]))
        return radial_in_units(draw(coefficients(*[0.7] * len(powers))), powers, phi), phi
    if kind == "brown":
        return Brown(draw(coefficients(0.5, 0.3, decentring, decentring, 0.1))), phi
    return KannalaBrandt(draw(coefficients(0.2, 0.1, 0.03, 0.01))), phi


def valid_radius(lens: Lens, phi: float) -> float:
    """How far (px) a test may go: nearly to where the lens ends, and 56 degrees off the axis for one that never does."""
    return min(0.97 * lens.monotone_radius(phi), 1.5 * phi)


# ---- there and back -------------------------------------------------------------------------------------------------


@quick
@given(lenses())
def test_round_trip_over_the_valid_image(drawn: tuple[Lens, float]) -> None:
    lens, phi = drawn
    offsets = polar(np.linspace(0.0, valid_radius(lens, phi), 60))
    rays = lens.undistort(offsets, phi)
    assert np.abs(np.linalg.norm(rays, axis=1) - 1.0).max() < 1e-15  # NaN fails, too
    assert np.abs(lens.distort(rays, phi) - offsets).max() < 1e-9  # px


@quick
@given(lenses(), st.floats(0.1, 10.0))
def test_round_trip_from_rays_of_any_length(drawn: tuple[Lens, float], length: float) -> None:
    lens, phi = drawn
    rays = lens.undistort(polar(np.linspace(0.0, 0.9 * valid_radius(lens, phi), 30)), phi)
    back = lens.undistort(lens.distort(length * rays, phi), phi)
    assert np.abs(back - rays).max() < 1e-12  # rad


# A lens for which Newton once ran in a circle, and one for which it once ended half way when it started at the rim.
CIRCLING = Brown((0.3696602911999488, 0.23772868894562144, -0.001024502834884153, 0.0009761263523310101, -0.0283)), 1000.0
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
    assert off.max() < 1e-3  # px; the square root of rounding times the radius, at the very rim of `radial`


@quick
@given(lenses(decentring=2e-2), st.integers(0, 2**32))
@example(CIRCLING, 0)
@example(RIM, 0)
def test_a_ray_has_its_own_pixel_or_none(drawn: tuple[Lens, float], seed: int) -> None:
    lens, phi = drawn
    rays = np.random.default_rng(seed).normal(size=(2000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if lens.kind != "kannala-brandt":
        rays = rays[rays[:, 2] > 0.1]  # 84 degrees from the axis: a power of 7 of what is farther out is no picture
    offsets = lens.distort(rays, phi)
    rays, offsets = rays[np.isfinite(offsets[:, 0])], offsets[np.isfinite(offsets[:, 0])]
    back = lens.undistort(offsets, phi)
    found = np.isfinite(back[:, 0])
    assert np.all(found | (np.hypot(*offsets.T) > 0.9 * lens.monotone_radius(phi)))  # Newton may give up at the rim
    assert np.abs(back - rays)[found].max(initial=0.0) < 1e-5  # rad; the square root of rounding at the rim
