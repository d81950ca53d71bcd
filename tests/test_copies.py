"""Repeated observations: found, counted once, and reported."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import RADIAL, SCENES
from thorough import partly

from ceres_cal.base.arrays import AnyArray
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import diagnose
from ceres_cal.moves.checks import check
from ceres_cal.moves.refits import refit
from ceres_cal.observations import NO_CURVES, Observations, Points, View, combine, taken
from ceres_cal.observations.validation import find_copies
from ceres_cal.simulate import Disturbance, simulate


@cache
def seen(name: str = "radial-2-3/field-boards") -> Observations:
    """Two frames of a field and six boards."""
    return simulate(SCENES[name](), Disturbance(0.3, 0.3)).observations


@cache
def calibrated(name: str = "radial-2-3/field-boards") -> Calibration:
    return calibrate(seen(name), RADIAL)


def again(observations: Observations, name: str = "again") -> Observations:
    """The same pictures with other names, as a second detector run with copied files would give them."""
    views = [replace(view, frame=f"{view.frame} {name}") for view in observations.views]
    views = [v if v.placement is None else replace(v, placement=f"{v.placement} {name}") for v in views]
    return replace(observations, views=tuple(views))


def assert_same(one: Calibration, other: Calibration) -> None:
    """The same numbers with the same uncertainty, to the last bit."""
    assert one.station() == other.station() and one.fit == other.fit
    assert dict(one.placements) == dict(other.placements)
    assert one.posterior is not None and other.posterior is not None
    assert one.posterior.keys == other.posterior.keys
    assert np.array_equal(one.posterior.sd, other.posterior.sd)


def test_one_file_given_twice_counts_once() -> None:
    twice = calibrate(combine([seen(), seen()]), RADIAL)
    assert_same(twice, calibrated())
    assert twice.remarks == (
        "936 observations of frame '0001', '0002', 'board_01' and 5 more are repeated: counted once",
        *calibrated().remarks,
    )
    assert len(twice.rejected) == 936 + len(calibrated().rejected)
    assert twice.outliers == calibrated().rejected
    assert {entry.reason for entry in twice.rejected if entry.frame == "0001"} == {"a copy of frame '0001'"}


@pytest.mark.parametrize("times", partly([1, 99], [1]))
def test_frames_under_other_names_count_once(times: int) -> None:
    """The boards in them, too; their placements are not solved for."""
    many = calibrate(combine([seen(), *(again(seen(), f"again {n}") for n in range(times))]), RADIAL)
    assert_same(many, calibrated())
    others = f", and so do {8 * times - 1} other frames"
    assert many.remarks[0] == f"frame '0001 again 0' repeats frame '0001' far within the noise{others}: counted once"
    copies = [entry for entry in many.rejected if entry.frame == "0002 again 0"]
    assert copies and {entry.reason for entry in copies} == {"a copy of frame '0002'"}


def test_rows_twice_in_one_frame_count_once() -> None:
    points = taken(seen().points, np.sort(np.concatenate([np.arange(len(seen().points)), np.arange(5, 17)])))
    doubled = calibrate(replace(seen(), points=points), RADIAL)
    assert_same(doubled, calibrated())
    assert doubled.remarks[0] == "12 observations of frame '0001' are repeated: counted once"
    assert [entry.row for entry in doubled.rejected] == list(range(6, 30, 2))


def test_files_diagnosis_and_moves_count_them_once_too(tmp_path: Path) -> None:
    double = combine([seen(), again(seen())])
    calibration = calibrate(double, RADIAL)
    calibration.save(tmp_path / "calibration.json")
    loaded = Calibration.load(tmp_path / "calibration.json")
    found, expected = diagnose(loaded, double), diagnose(calibrated(), seen())
    assert found.noise == expected.noise and found.degrees_of_freedom == expected.degrees_of_freedom
    assert found.findings == expected.findings
    assert np.count_nonzero(found.table.columns()["reason"] == "a copy of another") == 936
    assert np.count_nonzero(found.table.outlier) == np.count_nonzero(expected.table.outlier)
    diagnose(calibrated(), double, new_data=True)
    new = simulate(SCENES["radial-2-3/field-boards"](), Disturbance(0.3, 0.3), seed=1).observations
    once, twice = (refit(calibrated(), one) for one in (new, combine([new, again(new)])))
    assert_same(once, twice)
    tests = [check(calibrated(), one)["overhead"] for one in (new, combine([new, again(new)]))]
    assert tests[0].words == tests[1].words and tests[0].misfit == tests[1].misfit
    assert tests[0].statistic == tests[1].statistic


# ---- what is a copy, and what is not --------------------------------------------------------------------------------


def views_of(*frames: str) -> list[View]:
    return [View(frame, "a", "a", "board", frame) for frame in frames]


def points_of(*pixels: AnyArray) -> Points:
    """A view for each array of pixels; feature 0 first."""
    sizes = [len(rows) for rows in pixels]
    features = np.concatenate([np.arange(size) for size in sizes])
    return Points(np.repeat(np.arange(len(sizes)), sizes), features, np.concatenate(pixels), np.ones(sum(sizes)))


PIXELS = np.random.default_rng(0).uniform(0.0, 900.0, (6, 2))


def sources(views: list[View], points: Points) -> list[int]:
    """The view that each row is a copy of."""
    return [int(view) for view in find_copies(views, points, NO_CURVES).points]


def test_a_view_is_a_copy_whatever_the_order_of_its_rows() -> None:
    points = points_of(PIXELS, PIXELS)
    rows = np.concatenate([np.arange(6), np.random.default_rng(1).permutation(6) + 6])
    assert sources(views_of("1", "2"), taken(points, rows)) == [-1] * 6 + [0] * 6
    assert sources(views_of("1", "2"), replace(points, sigma_px=np.arange(1.0, 13.0))) == [-1] * 6 + [0] * 6


@given(st.integers(0, 2**31), st.integers(1, 6), st.booleans())
def test_copies_of_any_number_in_any_order_leave_the_first(seed: int, times: int, whole: bool) -> None:
    """Two frames, repeated several times with their rows in another order: only their own rows count."""
    rng = np.random.default_rng(seed)
    own = rng.uniform(0.0, 900.0, (2, 6, 2))
    own = np.round(own) if whole else own
    numbers = np.concatenate([[0, 1], rng.integers(0, 2, times)])
    points = points_of(*own[numbers])
    mixed = np.concatenate([6 * view + (rng.permutation(6) if view > 1 else np.arange(6)) for view in range(times + 2)])
    again = np.repeat(numbers[2:], 6).tolist()
    assert sources(views_of(*map(str, range(times + 2))), taken(points, mixed)) == [-1] * 12 + again


@given(st.integers(0, 2**31))
def test_a_static_camera_of_whole_pixels_sees_other_frames(seed: int) -> None:
    """Most of its rows occur in some other frame, but its frames do not repeat each other."""
    seen = np.round(
        np.repeat(10.0 * PIXELS[None], 20, axis=0) + np.random.default_rng(seed).normal(0.0, 2.0, (20, 6, 2))
    )
    assert len(np.unique(seen.reshape(20, -1), axis=0)) == 20
    assert sources(views_of(*map(str, range(20))), points_of(*seen)) == [-1] * 120


def test_what_differs_by_far_less_than_the_noise_counts_once() -> None:
    """Noise of 1 px is stated: independent errors differ by 1.4 px, and half of the noise shows that most is shared."""
    views, rng = views_of("1", "2"), np.random.default_rng(0)
    for differs_px, counts in ((1e-9, False), (0.2, False), (0.3, False), (1.0, True)):
        other = PIXELS + differs_px * rng.standard_normal(PIXELS.shape)
        assert sources(views, points_of(PIXELS, other)) == [-1] * 6 + [-1 if counts else 0] * 6
    fixed = [replace(view, placement=None) for view in views]  # a field, which is in the same place each time
    assert sources(fixed, points_of(PIXELS, PIXELS + 0.1)) == [-1] * 12
    most = points_of(PIXELS, PIXELS[1:] + 0.1)  # one corner of six was not found again
    most = replace(most, feature=np.concatenate([np.arange(6), np.arange(1, 6)]))
    assert sources(views, most) == [-1] * 6 + [0] * 5


def test_what_moves_slowly_counts_again_where_it_has_moved() -> None:
    """A board that moves by 0.2 px from frame to frame: every third frame is another view."""
    points = points_of(*(PIXELS + np.array([0.2 * number, 0.0]) for number in range(8)))
    kept = np.reshape(sources(views_of(*map(str, range(8))), points), (8, 6))
    assert kept[:, 0].tolist() == [-1, 0, 0, 0, -1, 4, 4, 4] and np.all(kept == kept[:, :1])


def test_a_board_held_still_tells_no_more_than_one_picture_of_it() -> None:
    """Three frames of each view with the same errors: the standard deviations fell by 1.7, without any reason."""
    one, rng = simulate(SCENES["radial-2-3/boards"](), Disturbance(0.3, 0.3)).observations, np.random.default_rng(0)
    sizes = np.bincount(one.points.view)
    rows = np.concatenate([np.tile(np.flatnonzero(one.points.view == view), 3) for view in range(len(sizes))])
    shown = np.repeat(np.arange(3 * len(sizes)), np.repeat(sizes, 3))
    again_px = 0.03 * (shown % 3 > 0)[:, None] * rng.standard_normal((len(rows), 2))
    points = replace(taken(one.points, rows), view=shown.astype(np.int32), pixels=one.points.pixels[rows] + again_px)
    names = [(view, f"{view.frame} {time}") for view in one.views for time in range(3)]
    views = tuple(replace(view, frame=name, placement=name) for view, name in names)
    held, once = calibrate(replace(one, views=views, points=points), RADIAL), calibrate(one, RADIAL)
    assert held.estimate.cameras == once.estimate.cameras
    assert held.posterior is not None and once.posterior is not None
    assert np.array_equal(held.posterior.sd, once.posterior.sd)
    assert len(held.rejected) == len(once.rejected) + 2 * len(one.points)


def test_other_features_stations_and_targets_are_no_copies() -> None:
    points = points_of(PIXELS, PIXELS)
    shifted = replace(points, feature=np.concatenate([np.arange(6), np.arange(1, 7)]))
    one, two = views_of("1", "2")
    assert sources([one, two], shifted) == [-1] * 12
    for other in (replace(two, station="b"), replace(two, target="other"), replace(two, placement=None)):
        assert sources([one, other], points) == [-1] * 12


def test_few_whole_pixels_may_agree() -> None:
    """Three rows are not enough for a copy of another frame; in the same frame a single one is."""
    assert sources(views_of("1", "2"), points_of(PIXELS[:3], PIXELS[:3])) == [-1] * 6
    assert sources(views_of("1", "2"), points_of(PIXELS[:4], PIXELS[:4])) == [-1] * 4 + [0] * 4
    assert sources(views_of("1", "1"), points_of(PIXELS, PIXELS[:1])) == [-1] * 6 + [0]


def test_what_a_view_adds_counts() -> None:
    """A frame that was given twice, the second time with more rows."""
    assert sources(views_of("1", "1"), points_of(PIXELS[:4], PIXELS)) == [-1] * 4 + [0] * 4 + [-1] * 2


def test_the_two_sides_of_a_line_are_not_one_another() -> None:
    lines = simulate(SCENES["radial-2-3/lines-arcs"](), Disturbance(0.3, 0.3)).observations
    pixels = np.repeat(lines.curves.pixels[:1], 3, axis=0)
    curves = type(lines.curves)([0] * 3, [0] * 3, pixels, [1.0] * 3, [0, 1, -1])  # type: ignore[arg-type]
    assert np.all(find_copies(lines.views, points_of(np.empty((0, 2))), curves).curves == -1)


def test_a_thousand_frames_cost_milliseconds() -> None:
    pixels = np.random.default_rng(0).uniform(0.0, 900.0, (1000, 54, 2))
    views, points = views_of(*map(str, range(1000))), points_of(*pixels)
    seconds = []
    for _ in range(5):
        start = process_time()
        assert not np.any(find_copies(views, points, NO_CURVES).points >= 0)
        seconds.append(process_time() - start)
    assert min(seconds) < 0.01  # 0.4 to 0.6 ms measured
