"""The table of target kinds: new kinds do all that the built-in ones do."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data.built_in_scenes import scene_to_json
from scenery import board_scene, field_scene, join, overhead_pose
from scenes import camera

from ceres_cal import Calibration, InputError, Observations, Options, calibrate, painted_field, write_report
from ceres_cal.base.files import convert
from ceres_cal.calibration.renaming import relabelled
from ceres_cal.cli import main
from ceres_cal.diagnostics import diagnose
from ceres_cal.diagnostics.advice import advise
from ceres_cal.moves.refit_plan import mistaken_targets
from ceres_cal.problem.structure import Tolerance
from ceres_cal.report.pictures.frames import frame_by_name
from ceres_cal.scene.curves import Arc, Curve, Segment
from ceres_cal.scene.symmetry import TURNED, turns_of
from ceres_cal.scene.targets import TARGET_KINDS, Grid, Target, TargetKind, target_from_spec, targets_by_name
from ceres_cal.simulate import Disturbance, Simulation, Station, scene_from_json, simulate


def court(size_m: float) -> Target:
    """A field of a new kind: a square with a circle in the middle."""
    half, sizes = 0.5 * size_m, {"near": (-1, -1), "right": (1, -1), "far": (1, 1), "left": (-1, 1)}
    corners = {name: (x * half, y * half, 0.0) for name, (x, y) in sizes.items()}
    ends = list(corners.values())
    curves: dict[str, Curve] = {
        f"from_{name}": Segment(ends[i], ends[(i + 1) % 4], 0.02) for i, name in enumerate(corners)
    }
    curves["circle"] = Arc((0.0, 0.0, 0.0), 0.2 * size_m, width_m=0.02)
    other = {"kind": "court", "size_m": 4.0 if size_m == 6.0 else 6.0}
    return Target({"kind": "court", "size_m": size_m}, corners, curves, mistaken_for={"the other court": other})


def dots(columns: int, rows: int, spacing_m: float) -> Target:
    """A board of dots, which cannot be detected but can be placed anywhere and bowed."""
    spec = {"kind": "dots", "columns": columns, "rows": rows, "spacing_m": spacing_m}
    places = {f"dot_{r}_{c}": (c * spacing_m, r * spacing_m, 0.0) for r in range(rows) for c in range(columns)}
    return Target(spec, places, {}, movable=True, bows=True, grid=Grid(columns, rows, spacing_m))


def dots_from_spec(spec: dict[str, Any], where: str) -> Target:
    numbers = convert({name: value for name, value in spec.items() if name != "kind"}, dict[str, float], where)
    return dots(int(numbers["columns"]), int(numbers["rows"]), numbers["spacing_m"])


COURT = TargetKind(
    "court",
    "a square court",
    "size_m",
    "sides and corners",
    lambda: {"centre-court": court(6.0)},
    lambda spec, where: court(convert(spec.get("size_m"), float, f"{where}.size_m")),
)
DOTS = TargetKind(
    "dots", "a board of dots", "columns, rows, spacing_m", "dot_ROW_COLUMN", lambda: {"dots": dots(5, 4, 0.1)},
    dots_from_spec,
)  # fmt: skip


@pytest.fixture(autouse=True)
def in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TARGET_KINDS, "court", COURT)
    monkeypatch.setitem(TARGET_KINDS, "dots", DOTS)


def observed() -> Simulation:
    cameras = {"overhead": camera("radial-2-3")}
    stations = {"overhead": Station("overhead", overhead_pose(-0.3, -0.4, 5.0, tilt_x_deg=-8.0, tilt_y_deg=-6.5))}
    field = field_scene(court(6.0), cameras, stations, frames=2, spacing_m=0.1)
    boards = board_scene(dots(7, 6, 0.1), cameras, stations, count=5, seed=1)
    scene = join(field, boards)
    again, _ = scene_from_json(json.loads(json.dumps(scene_to_json(scene))), "scene")
    assert again.targets == scene.targets
    return simulate(scene, Disturbance(points_sigma_px=0.2, curves_sigma_px=0.2), seed=3)


@pytest.mark.usefixtures("words_alone")
def test_a_kind_of_one_s_own_goes_all_the_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    observed().observations.save(tmp_path / "observations.json")
    observations = Observations.load(tmp_path / "observations.json")
    assert {target.kind for target in observations.targets.values()} == {"court", "dots"}
    bowed = next(name for name, target in observations.targets.items() if target.bows)
    options = Options(lens="radial", tolerances={bowed: Tolerance(warp_m=0.001)})
    calibration = calibrate(observations, options)
    assert calibration.converged and calibration.fit.point_scale == pytest.approx(1.0, rel=0.1)
    assert np.max(np.abs(calibration.estimate.structure.values)) < 0.001  # the boards were flat

    calibration.save(tmp_path / "calibration.json")
    loaded = Calibration.load(tmp_path / "calibration.json")
    assert loaded.targets == calibration.targets
    assert loaded.estimate.stations["overhead"].cam_from_world.position[2] == pytest.approx(5.0, abs=0.01)
    diagnosis = diagnose(loaded, observations)
    assert not any(finding.is_model_error for finding in diagnosis.findings)
    noise = {one.kind: one for one in diagnosis.noise}
    assert np.isfinite(noise["points"].correlation)  # the grid's neighbours, and those along a line
    write_report(tmp_path / "report.html", loaded, observations, diagnosis)
    assert "overhead" in (tmp_path / "report.html").read_text()

    assert advise(loaded).station == "overhead"
    assert loaded.uncertainty.map_sd_mm().x_m[[0, -1]] == pytest.approx([-3.0, 3.0])  # the court, not the board
    assert frame_by_name(loaded, "overhead", "photograph").shown[0][1] is None
    again = ["calibrate", str(tmp_path / "observations.json"), "--lens", "radial", "-o", str(tmp_path / "again.json")]
    assert main(again) == 0
    assert Calibration.load(tmp_path / "again.json").targets == calibration.targets
    capsys.readouterr()


def test_the_command_line_offers_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["targets"]) == 0
    said = capsys.readouterr().out
    assert "court: a square court" in said and '{"kind": "dots", "columns": 5' in said
    for name, feature in (("court", "from_near"), ("centre-court", "circle"), ("dots", "dot_3_4")):
        assert main(["targets", name]) == 0
        assert feature in capsys.readouterr().out
    assert main(["targets", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split()).replace("- ", "-")  # however the lines are wrapped
    assert "court" in said and "centre-court" in said
    assert {"ssl-a", "ssl-b", "vss-3", "centre-court"} <= set(targets_by_name())
    field = ["detect", "field", str(tmp_path / "no.png"), "--auto", "-o", str(tmp_path / "o.json")]
    assert main([*field, "--target", "outfield"]) == 2
    assert main([*field, "--target", "centre-court"]) == 2  # there is no such photograph
    assert "no.png" in capsys.readouterr().err.splitlines()[-1]


def test_what_is_asked_of_a_target_is_its_own() -> None:
    observations = observed().observations
    turned = relabelled(observations, TURNED)
    assert turned is not None
    names = observations.targets["field"].curve_names
    first = observations.curves.feature[0]
    assert names[first] == "from_near" and names[turned.curves.feature[0]] == "from_far"
    assert len(turns_of(court(6.0), court(6.0).curve_names)) == 4
    smaller = mistaken_targets(observations)["the other court"]
    assert smaller.targets["field"] == court(4.0)
    with pytest.raises(InputError, match="is of kind"):
        calibrate(observations, Options(lens="radial", tolerances={"field": Tolerance(warp_m=0.001)}))
    with pytest.raises(InputError, match=r"here.size_m: Expected a number, got a text"):
        target_from_spec({"kind": "court", "size_m": "6"}, "here")


def test_what_is_mistaken_for_another_field_keeps_its_names() -> None:
    """The two smallest fields number their features differently; not all features of a larger one exist."""
    small, large = painted_field("vss-field", "3v3"), painted_field("vss-field", "5v5")
    both = [name for name in small.point_names if name in large.points]
    assert any(small.point_names.index(name) != large.point_names.index(name) for name in both)
    pixels = np.where([[name in both] for name in large.point_names], [[9.0, 9.0]], np.nan)
    seen = Observations.from_points(pixels, large, (640, 480))
    as_small = mistaken_targets(seen)["a 3v3 field"]
    assert [small.point_names[one] for one in as_small.points.feature] == [
        large.point_names[one] for one in seen.points.feature
    ]
    every = Observations.from_points(np.full((len(large.points), 2), 9.0), large, (640, 480))
    assert not mistaken_targets(every)


def test_half_circles_that_change_places() -> None:
    halves: dict[str, Curve] = {
        "upper": Arc((0.0, 0.0, 0.0), 1.0, 0.0, np.pi, 0.05),
        "lower": Arc((0.0, 0.0, 0.0), 1.0, np.pi, 2.0 * np.pi, 0.05),
    }
    kind = {"kind": "court", "size_m": 1.0}
    observations = observed().observations
    target = Target(kind, observations.targets["field"].points, {**halves, **_lines(3)})
    seen = replace(
        observations,
        targets={**observations.targets, "field": target},
        curves=replace(observations.curves, feature=observations.curves.feature % 2),
    )
    turned = relabelled(seen, TURNED)
    assert turned is not None and np.array_equal(turned.curves.feature, 1 - seen.curves.feature)


def _lines(count: int) -> dict[str, Curve]:
    return {f"line_{i}": Segment((-1.0, 0.1 * i, 0.0), (1.0, 0.1 * i, 0.0)) for i in range(count)}
