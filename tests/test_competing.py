"""Whole lines, frames and placements that are wrong: found, named, rejected as one; none in correct scenes."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from accuracy.diagnostic_scenes import held_boards
from scenery import field_scene, overhead_pose
from scenes import RADIAL, boards, lines_and_arcs
from thorough import partly

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.effects.aside import FeatureGroups, Offsets, groups_of
from ceres_cal.effects.evidence import VIEW_ASIDE, RandomEffects
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import difference
from ceres_cal.robust import competing
from ceres_cal.robust.robust import solve_robustly
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import Segment
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import custom, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, ViewPlan, simulate

NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
LINES = ("TopTouchLine", "BottomTouchLine", "HalfwayLine", "CenterLine", "LeftPenaltyStretch")


@cache
def half_field(frames: int = 1) -> Scene:
    """One camera above half of a division B field."""
    cameras = {"overhead": Camera((1280, 960), 868.0, (646.5, 473.8), Radial((-5.2e-5, 6.1e-7), (2, 3)))}
    pose = overhead_pose(-2.27, -0.12, 4.02, tilt_x_deg=6.8, tilt_y_deg=-2.4, yaw_deg=90.6)
    stations = {"overhead": Station("overhead", pose)}
    return field_scene(ssl_field("B"), cameras, stations, frames=frames, spacing_m=0.2)


def rows_of(observations: Observations, line: str, frame: str | None = None) -> Mask:
    """The curve observations of a line, in one frame or in all."""
    curves = observations.curves
    there = np.array([frame in (None, view.frame) for view in observations.views])
    return np.asarray(there[curves.view] & (curves.feature == observations.targets["field"].curve_names.index(line)))


def moved_aside(observations: Observations, line: str, aside_px: float, frame: str | None = None) -> Observations:
    """A whole line displaced along its normal in the image."""
    rows, curves = rows_of(observations, line, frame), observations.curves
    away = curves.pixels[rows] - np.mean(curves.pixels[rows], axis=0)
    normal = np.linalg.eigh(away.T @ away)[1][:, 0]
    pixels = curves.pixels.copy()
    pixels[rows] = np.clip(pixels[rows] + aside_px * normal, 0.0, (1279.0, 959.0))
    return replace(observations, curves=replace(curves, pixels=pixels))


def wholes(calibration: Calibration) -> set[str]:
    """The features that were rejected as a whole, without numbers."""
    return {one.reason.partition(":")[0] for one in calibration.rejected if one.is_of_whole}


def error_sd(calibration: Calibration, scene: Scene) -> Array:
    """Errors of all shared numbers, in stated standard deviations."""
    estimate, posterior = calibration.estimate, calibration.uncertainty.posterior
    truth = replace(estimate, cameras=scene.cameras, stations=scene.stations)
    return np.asarray(difference(estimate, truth, posterior.keys) / posterior.sd)


# ---- lines ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("aside_px", partly([3.0, -15.0], [3.0]))
def test_line_aside_in_the_only_frame_is_named_and_taken_out(line: str, aside_px: float) -> None:
    sound = simulate(half_field(), NOISE, 1).observations
    observations = moved_aside(sound, line, aside_px)
    calibration = calibrate(observations, RADIAL)
    assert wholes(calibration) == {f"the whole of line {line!r} in frame '0001'"}
    assert not np.any(calibration.inlier_masks(observations)[1][rows_of(observations, line)])
    assert len(calibration.rejected) == np.count_nonzero(rows_of(observations, line))
    without = calibrate(sound.part(np.ones(len(sound.points), bool), ~rows_of(sound, line)), RADIAL)
    phi, reference = (one.cameras["overhead"].phi for one in (calibration, without))
    assert phi == pytest.approx(reference, rel=3e-4)  # 1.5e-4 measured, of an sd of 1e-2: that without the line
    assert np.max(np.abs(error_sd(calibration, half_field()))) < 5.0  # 2.9 measured


@pytest.mark.parametrize("line", LINES)
def test_line_a_little_aside_is_taken_out_or_named_in_doubt(line: str) -> None:
    """1.2 px: four times the noise of one observation; standard deviations then hold for both explanations."""
    calibration = calibrate(moved_aside(simulate(half_field(), NOISE, 2).observations, line, 1.2), RADIAL)
    about = [warning for warning in calibration.warnings if f"line {line!r} in frame '0001'" in warning]
    assert len(about) == 1
    assert np.max(np.abs(error_sd(calibration, half_field()))) < 5.0  # 3.2 measured


@pytest.mark.parametrize("aside_px", [1.2, 6.0, 40.0])
def test_line_aside_in_all_frames_is_one_whole(aside_px: float) -> None:
    observations = moved_aside(simulate(half_field(4), NOISE, 3).observations, "HalfwayLine", aside_px)
    assert wholes(calibrate(observations, RADIAL)) == {"the whole of line 'HalfwayLine' in all 4 frames"}


def test_line_aside_in_one_of_four_frames_leaves_the_others_in() -> None:
    observations = moved_aside(simulate(half_field(4), NOISE, 4).observations, "BottomTouchLine", 3.0, "0002")
    calibration = calibrate(observations, RADIAL)
    assert wholes(calibration) == {"the whole of line 'BottomTouchLine' in frame '0002'"}
    assert len(calibration.rejected) == np.count_nonzero(rows_of(observations, "BottomTouchLine", "0002"))


@pytest.mark.parametrize("pair", [("HalfwayLine", "LeftPenaltyStretch"), ("TopTouchLine", "HalfwayLine")])
def test_two_lines_aside_do_not_hide_each_other(pair: tuple[str, str]) -> None:
    observations = simulate(half_field(), NOISE, 28).observations
    for line, aside_px in zip(pair, (6.0, -6.0), strict=True):
        observations = moved_aside(observations, line, aside_px)
    assert wholes(calibrate(observations, RADIAL)) == {f"the whole of line {line!r} in frame '0001'" for line in pair}


@pytest.mark.parametrize("frame", partly([None, "0017"], ["0017"]))
def test_of_very_many_observations_a_part_is_asked_and_all_of_a_whole_is_taken_out(
    frame: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    observations = moved_aside(simulate(half_field(24), NOISE, 4).observations, "HalfwayLine", 4.0, frame)
    of_all = calibrate(observations, RADIAL)
    monkeypatch.setattr(competing, "_MOST_ASKED", 1_000)
    monkeypatch.setattr(competing, "_FEWEST_ASKED", 4)
    parts: list[competing.Subproblem] = []

    compared_part = competing.compared_part

    def spied(every: competing.Subproblem) -> competing.Subproblem:
        parts.append(compared_part(every))
        return parts[0]

    monkeypatch.setattr(competing, "compared_part", spied)
    of_some = calibrate(observations, RADIAL)
    assert len(parts[0].problem.observations.curves) < 0.9 * len(observations.curves)
    where = "all 24 frames" if frame is None else f"frame {frame!r}"
    assert wholes(of_some) == wholes(of_all) == {f"the whole of line 'HalfwayLine' in {where}"}
    assert [entry.row for entry in of_some.rejected] == [entry.row for entry in of_all.rejected]
    phi, reference = (one.cameras["overhead"].phi for one in (of_some, of_all))
    assert phi == pytest.approx(reference, rel=1e-9)


# ---- frames and placements ------------------------------------------------------------------------------------------


def test_frame_of_a_camera_that_was_elsewhere_is_taken_out() -> None:
    scene = half_field(5)
    turned = Pose.exp((0.0, np.deg2rad(0.3), 0.0, 0.0, 0.0, 0.0)) @ scene.stations["overhead"].cam_from_world
    (plan,) = scene.views
    plans = replace(plan, frames=plan.frames[:-1]), replace(plan, frames=plan.frames[-1:], station="turned")
    stations = {**scene.stations, "turned": Station("overhead", turned)}
    seen = simulate(replace(scene, stations=stations, views=plans), NOISE, 5).observations
    seen = replace(seen, views=tuple(replace(view, station="overhead") for view in seen.views))
    assert wholes(calibrate(seen, RADIAL)) == {"the whole of frame '0005'"}


def test_board_that_is_not_its_drawing_is_taken_out() -> None:
    """Labels and pose are right, but its squares are a tenth longer one way, which its own pose cannot absorb."""
    scene = held_boards(Radial((-5.2e-5, 6.1e-7), (2, 3)), count=10)
    observations = simulate(scene, NOISE, 6).observations
    view = observations.views[3]
    assert view.placement is not None
    own = observations.points.view == 3
    places = scene.targets[view.target].point_array[observations.points.feature[own]] * (1.1, 1.0, 1.0)
    pixels = observations.points.pixels.copy()
    seen = scene.camera_at(view.station).project(scene.placements[view.placement].transform(places))
    pixels[own] = seen + 0.3 * np.random.default_rng(6).standard_normal(seen.shape)
    observations = replace(observations, points=replace(observations.points, pixels=pixels))
    calibration = calibrate(observations, RADIAL)
    assert wholes(calibration) == {f"the whole of placement {view.placement!r}"}
    assert len(calibration.rejected) == np.count_nonzero(own)
    assert np.max(np.abs(error_sd(calibration, scene))) < 4.0  # 1.9 measured; 5.3 with the board in


# ---- what belongs ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("make", [half_field, lambda: lines_and_arcs("radial-2-3"), lambda: boards("brown")])
def test_sound_scenes_lose_nothing(make: object, seed: int) -> None:
    """0 of 200 in one frame of half a field, and none reported as uncertain."""
    calibration = calibrate(simulate(make(), NOISE, seed).observations, RADIAL)  # type: ignore[operator]
    assert not wholes(calibration)
    assert not any("belongs" in warning for warning in calibration.warnings)


@pytest.mark.parametrize("seed", partly(range(4), [0]))
@pytest.mark.parametrize("length_m", [0.1, 0.5, 2.0])
def test_errors_that_agree_along_lines_take_no_line_out(length_m: float, seed: int) -> None:
    """All lines then scatter, none more than the others. In 200 scenes with 2 m one loses a line."""
    truth, spacing_m = simulate(half_field(), Disturbance(), 0).observations.curves, 0.2
    near = np.exp(-spacing_m / length_m)
    noise = np.random.default_rng(seed).standard_normal((len(truth.view), 2))
    for row in range(1, len(noise)):
        if truth.feature[row] == truth.feature[row - 1]:
            noise[row] = near * noise[row - 1] + np.sqrt(1.0 - near**2) * noise[row]
    observations = simulate(half_field(), replace(NOISE, curves_sigma_px=0.0), seed).observations
    pixels = np.clip(truth.pixels + 0.3 * noise, 0.0, (1279.0, 959.0))
    curves = replace(observations.curves, pixels=pixels, sigma_px=np.full(len(noise), 0.3))
    assert not wholes(calibrate(replace(observations, curves=curves), RADIAL))


def test_outliers_that_lie_here_and_there_are_taken_out_one_by_one() -> None:
    gross = replace(NOISE, outliers=0.3)
    for seed in range(3):
        assert not wholes(calibrate(simulate(half_field(), gross, seed).observations, RADIAL))


# ---- words, files and numbers ---------------------------------------------------------------------------------------


def test_rejected_warning_and_screen_say_which_and_how_far(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    observations = moved_aside(simulate(half_field(), NOISE, 7).observations, "CenterLine", 6.0)
    calibration = calibrate(observations, RADIAL)
    reason = "the whole of line 'CenterLine' in frame '0001': 25 rows, "
    assert {one.reason[: len(reason)] for one in calibration.rejected} == {reason}
    aside_px = float(calibration.rejected[0].reason.removeprefix(reason).removesuffix(" px off"))
    assert aside_px == pytest.approx(6.0, abs=0.3)  # 0.1 measured
    assert any(warning.startswith(reason) for warning in calibration.warnings)
    again = Calibration.from_file(calibration.to_file())
    assert again.rejected == calibration.rejected
    observations.save(tmp_path / "seen.json")
    assert main(["calibrate", str(tmp_path / "seen.json"), "-o", str(tmp_path / "calibration.json")]) == 0
    screen = capsys.readouterr().out
    assert "25  the whole of line 'CenterLine' in frame '0001'" in screen
    assert "taken out together" in " ".join(screen.split())


def test_a_suspect_without_which_nothing_is_determined_stays_in() -> None:
    """Three lines and few points in one frame: there is nothing to compare a line with."""
    seen = simulate(half_field(), NOISE, 8).observations
    kept = np.zeros(len(seen.curves), dtype=bool)
    for line in ("TopTouchLine", "HalfwayLine"):
        kept |= rows_of(seen, line)
    few = seen.part(np.ones(len(seen.points), bool), kept)
    assert not wholes(calibrate(moved_aside(few, "HalfwayLine", 0.3), RADIAL))


def test_covariance_is_widened_by_what_is_in_doubt() -> None:
    keys = (Key("camera", "c", "phi", "px"), Key("camera", "c", "cx", "px"))
    matrix, step = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([0.5, -2.0])
    widened = np.linalg.inv(Information(keys, matrix).widened(0.2**0.5 * step[None]).matrix)
    np.testing.assert_allclose(widened, np.linalg.inv(matrix) + 0.2 * np.outer(step, step), rtol=1e-12)


def offsets(values: Array) -> Offsets:
    """Ten groups with one mode each; all directions are equally well determined."""
    size = np.full(len(values), 20.0)
    effects = RandomEffects(size, values, np.eye(len(values)), 200.0, 200 + len(values))
    modes = np.sqrt(20.0) * np.eye(len(values))[:, :, None]
    return Offsets(effects, modes, VIEW_ASIDE)


@pytest.mark.parametrize(("scatter", "is_wrong"), [(1.0, True), (5.0, False), (25.0, False)])
def test_an_offset_is_judged_by_how_the_others_scatter(scatter: float, is_wrong: bool) -> None:
    """In standard deviations of independent errors: 40 is wrong beside offsets of 1, and usual beside offsets of 25."""
    values = scatter * np.random.default_rng(3).standard_normal(10)
    values[4] = 40.0
    evidence = offsets(values)
    odds = evidence.log_evidence_with_each() - evidence.log_evidence()
    assert (odds[4] > 3.0) == is_wrong  # 9.9, -3.6, -7.7 measured
    assert np.all(np.delete(odds, 4) < 0.0)


def test_evidence_of_a_pair_does_not_depend_on_the_order() -> None:
    values = np.random.default_rng(4).standard_normal(10)
    values[[2, 7]] = 30.0, -35.0
    evidence = offsets(values)
    assert evidence.log_evidence((2, 7)) == pytest.approx(evidence.log_evidence((7, 2)), abs=1e-9)
    assert evidence.log_evidence_with_each((2,))[7] == pytest.approx(evidence.log_evidence((2, 7)), abs=1e-9)
    assert evidence.log_evidence((2, 7)) > max(evidence.log_evidence((2,)), evidence.log_evidence(()))


def test_solving_without_a_line_needs_the_placements_that_are_left() -> None:
    """The problem with some observations must not free a placement that they do not show."""
    scene = boards("radial-3")
    observations = simulate(scene, NOISE, 0).observations
    calibration = calibrate(observations, RADIAL)
    problem: Problem = calibration.problem(observations)
    kept = observations.points.view != 0
    others = problem.used(kept, np.zeros(0, dtype=bool))
    others = replace(others, layout=others.layout.of(others.sights.keys))
    end = solve_robustly(others, calibration.estimate)
    assert observations.views[0].placement not in end.problem.layout.placements


def test_many_features_are_competed_with_in_bounded_time() -> None:
    """All together took time cubic in their number: 1350 points in three frames took 25 s."""
    places = {
        f"p{column}_{row}": (0.1 * column - 2.0, 0.1 * row - 1.5, 0.0) for column in range(40) for row in range(15)
    }
    line = Segment((-2.0, 0.05, 0.0), (2.0, 0.05, 0.0), 0.01)
    cameras = {"overhead": Camera((1280, 960), 868.0, (646.5, 473.8), Radial((-5.2e-5, 6.1e-7), (2, 3)))}
    stations = {"overhead": Station("overhead", overhead_pose(0.1, -0.2, 4.0, tilt_x_deg=9.0, tilt_y_deg=4.0))}
    scene = field_scene(custom(places, {"line": line}), cameras, stations, frames=3, spacing_m=0.1)
    observations = simulate(scene, NOISE, seed=0).observations
    points = observations.points
    pixels = points.pixels.copy()
    pixels[points.feature == observations.targets["field"].point_names.index("p7_3")] += (1.1, 0.6)
    start = time.process_time()
    calibration = calibrate(replace(observations, points=replace(points, pixels=pixels)), RADIAL)
    assert time.process_time() - start < 6.0  # measured 1.3
    assert wholes(calibration) == {"the whole of point 'p7_3' in all 3 frames"}
    assert np.max(np.abs(error_sd(calibration, scene))) < 4.0  # measured 1.3


def test_features_of_different_targets_are_different_wholes() -> None:
    """Each target counts its features from 0. The tops of three poles and a corner were one whole, and were rejected
    together, with all observations that determine phi.
    """
    scene = half_field(2)
    poles = {f"pole_{x}": custom({"top": (x, 0.3, 1.0)}) for x in (-3.0, -2.0, -1.0)}
    views = tuple(ViewPlan((f"{name}_1", f"{name}_2"), "overhead", name) for name in poles)
    every = replace(scene, targets={**scene.targets, **poles}, views=(*scene.views, *views))
    observations = simulate(every, NOISE, seed=0).observations
    target = np.array([view.target for view in observations.views])
    owner = target[np.concatenate([observations.points.view, observations.curves.view])]
    kinds = [one for one in groups_of(gather_sights(observations)) if isinstance(one, FeatureGroups)]
    assert len(kinds) == 2
    for wholes in kinds:
        assert all(len(set(owner[wholes.of == number])) == 1 for number in set(wholes.of.tolist()) - {-1})
