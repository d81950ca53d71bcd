"""The target as built: effects of its numbers, and recovery of painted offsets and bent boards."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenery import board_scene, field_scene, join, overhead_pose
from thorough import partly

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import diagnose
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import EXACT, WARP, Tolerance, make_structure
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Arc, Curve, Segment, Target, checkerboard, custom, ssl_field
from ceres_cal.simulate import Disturbance, Station, simulate

CAMERA = Camera((1280, 960), 868.0, (651.3, 468.9), Radial((-5.2e-5, 6.1e-7)))
NOISE = Disturbance(0.3, 0.3)
FIELD = ssl_field("B")


def painted(offsets_m: dict[str, float]) -> Target:
    """The field with each line moved to its left."""
    curves: dict[str, Curve] = {}
    for name, curve in FIELD.curves.items():
        if isinstance(curve, Arc):
            curves[name] = curve
            continue
        along = np.subtract(curve.end, curve.start)
        left = offsets_m[name] * np.array([-along[1], along[0], 0.0]) / np.linalg.norm(along)
        start, end = np.add(curve.start, left), np.add(curve.end, left)
        curves[name] = Segment((start[0], start[1], 0.0), (end[0], end[1], 0.0), curve.width_m)
    return custom({}, curves)


def as_drawn(observations: Observations) -> Observations:
    """The same pixels with the field as drawn as target."""
    built = observations.targets["field"]
    index = np.array([FIELD.curve_names.index(name) for name in built.curve_names], dtype=np.int32)
    curves = observations.curves
    on_field = np.array([observations.views[i].target == "field" for i in curves.view])
    feature = np.where(on_field, index[np.minimum(curves.feature, len(index) - 1)], curves.feature).astype(np.int32)
    return replace(
        observations,
        targets={**observations.targets, "field": FIELD},
        curves=replace(curves, feature=feature),
    )


def from_six_stations(seed: int) -> tuple[dict[str, float], Observations]:
    rng = np.random.default_rng(seed)
    offsets = {name: rng.normal(0.0, 0.008) for name, c in FIELD.curves.items() if isinstance(c, Segment)}
    places = [(-1.8, -0.8), (0.0, -0.9), (1.7, -0.5), (1.6, 0.9), (-0.2, 0.8), (-1.7, 0.6)]
    stations = {
        f"s{i}": Station("a", overhead_pose(x, y, 4.6, rng.uniform(-15, 15), rng.uniform(-15, 15), 60.0 * i))
        for i, (x, y) in enumerate(places)
    }
    scene = field_scene(painted(offsets), {"a": CAMERA}, stations, points=(), spacing_m=0.1)
    boards = board_scene(checkerboard(9, 6, 0.1), {"a": CAMERA}, {"s0": stations["s0"]}, count=10, seed=seed)
    return offsets, as_drawn(simulate(join(scene, boards), NOISE, seed).observations)


def left_over(errors: dict[str, float]) -> Array:
    """Errors of the lines' offsets after shift, rotation and scale of the whole field are removed."""
    rows = []
    for name in errors:
        curve = FIELD.curves[name]
        assert isinstance(curve, Segment)
        along = np.subtract(curve.end, curve.start)[:2]
        left = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        middle = 0.5 * np.add(curve.start, curve.end)[:2]
        rows.append([*left, left @ [-middle[1], middle[0]], left @ middle])
    basis, values = np.array(rows), np.array(list(errors.values()))
    return np.asarray(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0])


@pytest.mark.parametrize("seed", partly(range(3), [0]))
def test_painted_offsets_come_back(seed: int) -> None:
    offsets, observations = from_six_stations(seed)
    calibration = calibrate(observations, Options(lens="radial", tolerances={"field": Tolerance(lines_m=0.01)}))
    structure = calibration.estimate.structure
    found = dict(zip(structure.names, structure.values, strict=True))
    errors = left_over({name: found[f"field/{name}"] - offset for name, offset in offsets.items()})
    assert np.max(np.abs(errors)) < 1e-3  # 0.3 to 0.6 mm; painted: up to 20 mm
    assert calibration.fit.curve_scale == pytest.approx(1.0, abs=0.06)  # 1.02; 1.6 to 2.8 with the field as drawn
    assert not calibration.rejected


@pytest.mark.parametrize("named", [False, True])
def test_a_bent_board_is_straightened(named: bool) -> None:
    """Bowed, twisted and wavy; a checkerboard, or a board of named points."""
    board = checkerboard(9, 6, 0.1)
    if named:
        board = custom({f"p{n}": place for n, place in enumerate(board.points.values())}, movable=True)
    half = 0.5 * np.ptp(board.point_array[:, :2], axis=0)
    u, v = ((board.point_array[:, :2] - half) / half).T
    bow = 0.004 * (1.0 - u**2) - 0.002 * (1.0 - v**2) + 0.003 * u * v - 0.002 * 1.5 * np.sqrt(3.0) * v * (1.0 - v**2)
    bent = custom({n: (x, y, float(z)) for (n, (x, y, _)), z in zip(board.points.items(), bow, strict=True)})
    stations = {"a": Station("a", overhead_pose(0.0, 0.0, 4.0, 0.0, 0.0, 0.0))}
    seen = simulate(board_scene(bent, {"a": CAMERA}, stations, count=12, seed=3), NOISE, 3).observations
    observations = replace(seen, targets={"board": board})
    calibration = calibrate(observations, Options(lens="radial", tolerances={"board": Tolerance(warp_m=0.01)}))
    assert calibration.estimate.structure.names == tuple(f"board/{part}" for part in WARP)
    assert calibration.estimate.structure.values == pytest.approx([0.004, -0.002, 0.003, 0.0, -0.002], abs=3e-4)  # 1e-4
    assert calibration.fit.points_rms_px < 0.44  # 0.41; 0.6 with a flat board
    findings = diagnose(calibrate(observations, Options(lens="radial", as_built="as drawn")), observations).findings
    (bent_board,) = (one for one in findings if one.kind == "board bent")
    assert "twisted by +" in bent_board.sentence and "along y of -" in bent_board.sentence


def test_a_warp_of_before_is_bowed_alone(tmp_path: Path) -> None:
    """Files of 0.1 contain two bows."""
    board = checkerboard(9, 6, 0.1)
    stations = {"a": Station("a", overhead_pose(0.0, 0.0, 4.0, 0.0, 0.0, 0.0))}
    observations = simulate(board_scene(board, {"a": CAMERA}, stations, count=6, seed=3), NOISE, 3).observations
    path = tmp_path / "calibration.json"
    calibrate(observations, Options(lens="radial", tolerances={"board": Tolerance(warp_m=0.01)})).save(path)
    content = json.loads(path.read_text())
    content["structure_m"] = {"board/bow.x": 0.001, "board/bow.y": 0.002}
    path.write_text(json.dumps(content))
    assert Calibration.load(path).estimate.structure.values.tolist() == [0.001, 0.002, 0.0, 0.0, 0.0]
    del content["structure_m"]["board/bow.x"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="structure_m does not fit"):
        Calibration.load(path)


def test_the_file_keeps_the_corrections(tmp_path: object) -> None:
    _, observations = from_six_stations(0)
    calibration = calibrate(observations, Options(lens="radial", tolerances={"field": Tolerance(lines_m=0.01)}))
    path = f"{tmp_path}/calibration.json"
    calibration.save(path)
    again = Calibration.load(path)
    assert again.estimate.structure.names == calibration.estimate.structure.names
    assert np.array_equal(again.estimate.structure.values, calibration.estimate.structure.values)
    assert again.options == calibration.options


def test_what_each_number_moves() -> None:
    _, observations = from_six_stations(1)
    sights = gather_sights(observations)
    structure = make_structure(observations.targets, {"field": Tolerance(lines_m=0.01)})
    assert len(structure.names) == 12 + 3
    for number, name in enumerate(structure.names):
        values = np.zeros(len(structure.names))
        values[number] = 0.005
        moved = structure.with_values(values).tracks(sights) - sights.tracks
        feature, _, part = name.removeprefix("field/").partition(".")
        touched = np.flatnonzero(np.any(moved != 0.0, axis=(1, 2)))
        first = len(FIELD.curves) * np.arange(3) + FIELD.curve_names.index(feature)
        assert touched.tolist() == first.tolist()  # the paint's centre and both its edges
        size = np.linalg.norm(moved[touched], axis=(1, 2))
        assert size == pytest.approx(0.005 * (np.sqrt(2.0) if part == "radius" else 1.0))


@pytest.mark.parametrize(
    "tolerances, message",
    [
        ({"pitch": Tolerance(lines_m=0.01)}, "a tolerance: there is no target 'pitch'"),
        ({"field": Tolerance(warp_m=0.01)}, "warp_m, heights_m and stretch_m are for checkerboards"),
        ({"field": Tolerance(heights_m=0.01)}, "is of kind"),
    ],
)
def test_tolerances_that_do_not_fit(tolerances: dict[str, Tolerance], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_structure({"field": FIELD}, tolerances)


@pytest.mark.parametrize("sigma", [-0.01, float("nan"), float("inf")])
def test_sigmas_that_are_none(sigma: float) -> None:
    with pytest.raises(InputError, match="tolerance lines_m"):
        Tolerance(lines_m=sigma)


def test_nothing_moves_without_a_tolerance() -> None:
    assert make_structure({"field": FIELD}, {"field": Tolerance()}) is EXACT
    points, tracks = EXACT.built({"field": FIELD})["field"]
    assert np.array_equal(points, FIELD.point_array)
    assert np.array_equal(tracks, FIELD.tracks)
