"""Options, and the layout of the solver's numbers: free, shared, fixed or anchored."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st
from scenes import RADIAL

from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.observations import NO_CURVES, Observations, Points, Prior, View
from ceres_cal.observations.sights import SightKey
from ceres_cal.problem.parameters import (
    LOSSES,
    Estimate,
    Layout,
    Options,
    Station,
    anchored_stations,
    intrinsic_names,
    intrinsics_scales,
    intrinsics_vector,
    make_layout,
    unit_px,
    with_intrinsics,
)
from ceres_cal.problem.structure import make_structure
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Radial, make_lens
from ceres_cal.scene.targets import checkerboard

BOARD = checkerboard(3, 2, 0.1)

ALONE: dict[str, Any] = {"usual_camera": False}
"""No priors on usual cameras."""

each_lens = pytest.mark.parametrize("lens", scenes.LENSES)


def watched(*views: tuple[str, str | None], cameras: dict[str, str] | None = None) -> Observations:
    """One point in each view of (station, placement); by default every station has a camera with its own name."""
    owner = cameras or {}
    entries = tuple(
        View(str(number), owner.get(station, station), station, "board", placement)
        for number, (station, placement) in enumerate(views)
    )
    count = len(entries)
    return Observations(
        {"board": BOARD},
        {entry.camera: (640, 480) for entry in entries},
        entries,
        Points(np.arange(count, dtype=np.int32), np.zeros(count, np.int32), np.full((count, 2), 100.0), np.ones(count)),
        NO_CURVES,
    )


# ---- options --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given, message",
    [
        ({"lens": "glass"}, "there is no lens 'glass': choose one of auto, radial, brown, kannala-brandt"),
        ({"lens": "fisheye"}, "there is no lens 'fisheye': here it is 'kannala-brandt'"),
        ({"loss": "l2"}, "there is no loss 'l2': choose one of trivial, huber, soft_l1, cauchy, tukey"),
        ({"noise_scale": "guess"}, "noise_scale must be 'estimate' or 'stated', not 'guess'"),
        ({"lens": "radial", "fixed": {"k3": 0.0}}, "cannot fix 'k3': the radial lens has phi, aspect, cx, cy, a2, a3"),
        ({"lens": "brown", "fixed": {"a2": 0.0}}, "cannot fix 'a2': the brown lens has .*k1, k2, p1, p2, k3"),
        ({"fixed": {"phi": np.nan}}, "cannot fix phi at nan: give a finite number"),
        ({"fixed": {"cx": np.inf}}, "cannot fix cx at inf"),
        ({"loss_scale": 0.0}, "loss_scale must be 0.001 to 1e\\+09 sigmas, not 0.0"),
        ({"loss_scale": np.nan}, "loss_scale must be 0.001 to .* not nan"),
        ({"reject_sigma": -1.0}, "reject_sigma must be 0.001 to"),
        ({"max_iterations": 0}, "max_iterations must be above 0"),
        ({"threads": -1}, "threads must be 0 .* or above, not -1"),
        ({"powers": (1,)}, "powers of the radial lens"),
        ({"powers": (2, 2)}, "powers of the radial lens"),
    ],
)
def test_options_that_make_no_sense(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Options(**given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("loss", LOSSES)
def test_every_loss_is_an_option(loss: str) -> None:
    assert Options(lens="radial", loss=loss).loss == loss


def test_blank_lens_holds_the_fixed_coefficients() -> None:
    assert Options(lens="radial").blank_lens == Radial((0.0, 0.0))
    assert Options(powers=(3, 5), fixed={"a5": 1e-13, "phi": 800.0}).blank_lens == Radial((0.0, 1e-13), (3, 5))
    assert Options(lens="brown", fixed={"k3": -0.01}).blank_lens == Brown((0.0, 0.0, 0.0, 0.0, -0.01))
    assert Options(lens="kannala-brandt").blank_lens == KannalaBrandt((0.0,) * 4)


# ---- the vector of a camera -----------------------------------------------------------------------------------------


@each_lens
def test_vector_and_camera_are_one(lens: str) -> None:
    camera = replace(scenes.camera(lens), aspect=1.02, skew=1e-3)
    vector = intrinsics_vector(camera)
    assert len(vector) == len(intrinsic_names(camera.lens)) == len(intrinsics_scales(camera))
    back = with_intrinsics(camera, vector)
    assert intrinsics_vector(back) == pytest.approx(vector, rel=1e-15)
    assert back.lens.values == pytest.approx(camera.lens.values, rel=1e-15)
    assert back.principal_point == camera.principal_point
    assert (back.phi, back.aspect, back.skew) == (camera.phi, camera.aspect, 1e-3)
    assert vector[4:-1] / intrinsics_scales(camera)[4:-1] == pytest.approx(camera.lens.values, rel=1e-15)


@each_lens
def test_scaled_coefficients_are_of_order_one(lens: str) -> None:
    """The paper's coefficients in px are 1e-4 to 1e-13; the solver's are scaled."""
    assert 1e-4 < np.max(np.abs(intrinsics_vector(scenes.camera(lens))[4:])) < 10.0


@given(st.integers(1, 8000), st.integers(1, 8000))
def test_unit_is_half_the_diagonal(width: int, height: int) -> None:
    camera = Camera((width, height), 500.0, (0.0, 0.0), make_lens("radial"))
    assert unit_px(camera) == pytest.approx(np.hypot(width, height) / 2.0)


def test_radial_coefficients_scale_with_their_power() -> None:
    """a_k r^k over r at r = half the diagonal: the effect of the lens in the corner."""
    camera = Camera((600, 800), 700.0, (300.0, 400.0), Radial((1e-4, 2e-7), (2, 3)))
    assert intrinsics_vector(camera)[4:-1] == pytest.approx([1e-4 * 500.0, 2e-7 * 500.0**2], rel=1e-15)


# ---- layout ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, free",
    [
        (Options(**ALONE, lens="radial"), ["phi", "cx", "cy", "a2", "a3"]),
        (Options(**ALONE, lens="radial", free_aspect=True), ["phi", "aspect", "cx", "cy", "a2", "a3"]),
        (Options(**ALONE, lens="radial", free_principal_point=False), ["phi", "a2", "a3"]),
        (Options(**ALONE, lens="radial", fixed={"phi": 800.0, "cy": 200.0}), ["cx", "a2", "a3"]),
        (
            Options(**ALONE, lens="radial", free_aspect=True, fixed={"aspect": 1.0}),
            ["phi", "cx", "cy", "a2", "a3"],
        ),
        (
            Options(**ALONE, lens="brown", fixed={"p1": 0.0, "p2": 0.0}),
            ["phi", "cx", "cy", "k1", "k2", "k3"],
        ),
        (Options(**ALONE, powers=(3,)), ["phi", "cx", "cy", "a3"]),
        (Options(lens="radial"), ["phi", "aspect", "cx", "cy", "a2", "a3"]),
        (Options(lens="radial", free_skew=True), ["phi", "aspect", "cx", "cy", "a2", "a3", "skew"]),
    ],
)
def test_free_numbers(options: Options, free: list[str]) -> None:
    layout = make_layout(watched(("a", None), ("b", None)), options)
    names = intrinsic_names(options.blank_lens)
    for camera in ("a", "b"):
        assert [names[i] for i in layout.free[camera]] == free
    assert layout.size == 2 * len(free) + 2 * 6


def test_layout_counts_every_pose_once() -> None:
    """A camera with two stations, a board at two placements, one of which is seen twice."""
    seen = watched(("a1", None), ("a2", None), ("a1", "p"), ("a2", "p"), ("a1", "q"), cameras={"a1": "a", "a2": "a"})
    layout = make_layout(seen, RADIAL)
    assert layout == Layout(layout.free, frozenset({"a1", "a2"}), frozenset({"p", "q"}))
    assert layout.size == 5 + 2 * 6 + 2 * 6


@pytest.mark.parametrize(
    "views, anchored",
    [
        ([("a", None)], set()),
        ([("a", "p")], {"a"}),
        ([("a", "p"), ("a", "q")], {"a"}),
        ([("a", "p"), ("b", "p")], {"a"}),  # one gauge freedom for both
        ([("a", "p"), ("b", "q")], {"a", "b"}),  # two separate worlds
        ([("a", "p"), ("b", "q"), ("c", "p"), ("c", "q")], {"a"}),  # ... tied by a third station
        ([("a", "p"), ("b", "p"), ("b", None)], set()),
        ([("a", "p"), ("b", "p"), ("b", "q"), ("c", "q"), ("c", None)], set()),
        ([("a", None), ("b", "p")], {"b"}),
        ([("d", "s"), ("c", "r"), ("b", "r"), ("b", "s"), ("e", "t"), ("a", None)], {"d", "e"}),
    ],
)
def test_one_station_of_each_group_that_nothing_ties_to_the_world(
    views: list[tuple[str, str | None]], anchored: set[str]
) -> None:
    observations = watched(*views)
    assert anchored_stations(observations) == anchored
    assert make_layout(observations, RADIAL).stations == {station for station, _ in views} - anchored


def test_views_without_observations_count_for_nothing() -> None:
    """A field that was not found ties nothing to the world; a placement that is not seen is no unknown."""
    seen = watched(("a", "p"))
    empty = (View("7", "a", "a", "board"), View("8", "a", "a", "board", "q"), View("9", "a", "a2", "board", "p"))
    layout = make_layout(replace(seen, views=(*seen.views, *empty)), RADIAL)
    assert anchored_stations(replace(seen, views=(*seen.views, *empty))) == {"a"}
    assert not layout.stations and layout.placements == {"p"}
    assert layout.size == make_layout(seen, RADIAL).size == 5 + 6


# ---- estimate -------------------------------------------------------------------------------------------------------


def test_poses_chain_from_frame_to_camera() -> None:
    station, placement = Pose.exp((0.3, -0.2, 0.1, 1.0, 2.0, 3.0)), Pose.exp((-0.5, 0.4, 0.9, 0.1, 0.2, -0.3))
    camera = scenes.camera("brown")
    structure = make_structure({"board": BOARD}, {})
    estimate = Estimate({"lens": camera}, {"up": Station("lens", station)}, {"there": placement}, structure)
    assert estimate.camera_at("up") == camera.at(station)
    assert estimate.camera_at("up", "there") == camera.at(station @ placement)
    stack = estimate.pose_stack([SightKey("lens", "up", "there"), SightKey("lens", "up", None)])
    for matrix, pose in zip(stack, (station @ placement, station), strict=True):
        assert np.max(np.abs(matrix - np.column_stack([pose.rotation, pose.translation]))) < 1e-15


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"priors": "x"}, r"Options\(priors=\.\.\.\): Expected a list, got a text"),
        ({"coefficients": "k1"}, r"Options\(coefficients=\.\.\.\): Expected a list or nothing"),
        ({"lens": None}, r"Options\(lens=\.\.\.\): Expected a text, got nothing"),
        ({"fixed": {"phi": "x"}}, r"Options\(fixed=\.\.\.\): Expected a number, got a text"),
        ({"tolerances": {"field": 0.01}}, r"Options\(tolerances=\.\.\.\): Expected names with values"),
        ({"free_skew": 1}, r"Options\(free_skew=\.\.\.\): Expected true or false"),
        ({"reject_sigma": 1e300}, "reject_sigma must be 0.001 to 1e\\+09 sigmas, not 1e\\+300"),
        ({"reject_sigma": 1e10}, "reject_sigma must be 0.001 to"),  # infinity, which JSON does not have
        ({"loss_scale": 1e-300}, "loss_scale must be 0.001 to 1e\\+09 sigmas, not 1e-300"),
        ({"threads": 10**30}, "threads must be 2147483647 at most, not 1e\\+30"),
        ({"max_iterations": 2**31}, "max_iterations must be 2147483647 at most"),
    ],
)
def test_options_of_another_type_are_named(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Options(**given)


def test_numbers_of_numpy_are_numbers() -> None:
    given: dict[str, Any] = {"powers": np.array([2, 3]), "fixed": {"phi": np.float32(800.0)}}
    options = Options(loss_scale=np.float64(2.0), **given)
    assert (options.powers, options.fixed) == ((2, 3), {"phi": 800.0}) and type(options.powers[0]) is int
    prior = Prior("station", "s", "height_m", np.array([4.0]), [np.int64(1)])  # type: ignore[arg-type]
    assert (prior.value, prior.sigma) == ((4.0,), (1.0,))
    with pytest.raises(InputError, match=r"Prior\(value=\.\.\.\): Expected a number, got a text"):
        Prior("station", "s", "height_m", "x", (1.0,))  # type: ignore[arg-type]


def test_a_prior_of_one_number_takes_a_number() -> None:
    """As files do. It was "Expected a list, got a number"."""
    height = Prior("station", "s", "height_m", 4.6, 0.01)  # type: ignore[arg-type]
    assert height == Prior("station", "s", "height_m", (4.6,), (0.01,))
    position = Prior("station", "s", "position_m", (1.0, 2.0, 4.6), 0.01)  # type: ignore[arg-type]
    assert position.sigma == (0.01, 0.01, 0.01)
    with pytest.raises(InputError, match="give 3 numbers and 3 sigmas"):
        Prior("station", "s", "position_m", 4.6, 0.01)  # type: ignore[arg-type]
