"""The result and its file: exact round trip, and one clear line for every file that is not right."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scenes import SCENES

from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import rotation_from_euler
from ceres_cal.calibration import Calibration, Fit
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.simulate import Disturbance, simulate

WORKDAY = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3, outliers=0.04)
NAMES = ["radial-2-3/field-boards", "radial-3-5/corners", "brown/two-cameras", "kannala-brandt/several-stations"]


@cache
def calibrated(name: str, **more: Any) -> Calibration:
    scene = SCENES[name]()
    lens = next(iter(scene.cameras.values())).lens
    camera, station = next(iter(scene.cameras)), next(iter(scene.stations))
    priors = (
        Prior("camera", camera, "principal_point", (650.0, 470.0), (9.0, 8.0)),
        Prior("station", station, "height_m", (5.1 if lens.kind != "kannala-brandt" else 3.2,), (0.5,)),
    )
    options = Options(lens=lens.kind, powers=getattr(lens, "powers", (2, 3)), priors=priors, **more)
    return calibrate(simulate(scene, WORKDAY, 1).observations, options)


def content(calibration: Calibration) -> dict[str, Any]:
    """Every field as plain, comparable data."""
    fields = {name: getattr(calibration, name) for name in calibration.__dataclass_fields__ if name != "estimate"}
    posterior = fields.pop("posterior")
    estimate = calibration.estimate
    return fields | {
        "cameras": dict(estimate.cameras),
        "stations": {name: (s.camera, s.cam_from_world.log().tolist()) for name, s in estimate.stations.items()},
        "placements": {name: pose.log().tolist() for name, pose in estimate.placements.items()},
        "structure": (estimate.structure.names, estimate.structure.values.tolist()),
        "options": asdict(calibration.options),
        "phi_from": dict(calibration.phi_from),
        "versions": dict(calibration.versions),
        "targets": dict(calibration.targets),
        "posterior": posterior
        and (posterior.keys, posterior.information.matrix.tolist(), posterior.degrees_of_freedom),
        "placements known": posterior and {name: known.matrix.tolist() for name, known in posterior.placements.items()},
    }


# ---- the file -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_number_survives_a_round_trip(name: str, tmp_path: Path) -> None:
    calibration = calibrated(name)
    path = tmp_path / "calibration.json"
    calibration.save(path)
    back = Calibration.load(path)
    assert content(back) == content(calibration)
    for station, camera in calibration.stations.items():
        assert back.station(station) == camera
    again = tmp_path / "again.json"
    back.save(again)
    assert again.read_bytes() == path.read_bytes()


def test_a_baseline_can_be_kept_too(tmp_path: Path) -> None:
    """The paper's closed form minimises nothing: no history, no cost."""
    calibration = calibrated("radial-2-3/field-boards", closed_form_only=True)
    assert calibration.history == () and not calibration.converged
    calibration.save(tmp_path / "baseline.json")
    assert content(Calibration.load(tmp_path / "baseline.json")) == content(calibration)


def test_the_file_tells_people_where_the_camera_is(tmp_path: Path) -> None:
    """Position and the paper's angles are stored beside the pose that determines them."""
    calibration = calibrated("brown/two-cameras")
    calibration.save(tmp_path / "calibration.json")
    data = json.loads((tmp_path / "calibration.json").read_text())
    assert data["units"] == "metres, radians, pixels" and data["pixel_origin"] == "centre of the top-left pixel"
    for name, camera in calibration.stations.items():
        entry = data["stations"][name]
        assert entry["position_m"] == camera.position.tolist()
        assert rotation_from_euler(*entry["euler_rad"]) == pytest.approx(camera.cam_from_world.rotation, abs=1e-14)
    assert data["cameras"]["west"]["lens"] == {
        "kind": "brown",
        "coefficients": calibration.cameras["west"].lens.coefficients,
    }


def broken(change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    data = json.loads(msgspec.json.encode(calibrated("radial-2-3/field-boards").to_file()))
    change(data)
    return dict(data)


def put(*path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (put("format", value="ceres-cal/observations"), "it holds observations, where a calibration must be given"),
        (put("version", value=99), "version 99 is not known here"),
        (put("stations", "overhead", "camera", value="gone"), "station 'overhead' names camera 'gone'.*not there"),
        (put("cameras", "overhead", "phi", value=-1.0), "phi and aspect positive"),
        (put("cameras", "overhead", "lens", "coefficients", value={"k1": 0.1}), "no coefficient 'k1'.*a2, a3"),
        (
            put("cameras", "overhead", "lens", "coefficients", value={"a2": 0.0, "a3": -1e-6}),
            "'overhead'.*folds over at",
        ),
        (put("cameras", "overhead", "lens", "kind", value="fisheye"), "there is no lens 'fisheye'"),
        (put("cameras", "overhead", "sensor", value=1), "there is no field 'sensor'"),
        (put("stations", "overhead", "rotation", value=[[1.0, 0.0], [0.0, 1.0]]), "rotation"),
        (put("options", "loss", value="l2"), "there is no loss 'l2'"),
        (put("options", "fixed", value={"k9": 1.0}), "cannot fix 'k9'"),
        (put("options", "priors", value=[{"station": "overhead"}]), "prior"),
        (lambda data: data.pop("fit"), "'fit' is missing"),
        (lambda data: data["posterior"]["information"].pop(), "posterior.information has .* numbers, not .*"),
        (put("posterior", "placements", "board_01", value=[1.0]), "placements.board_01 has 1 numbers, not 21"),
    ],
)
def test_files_that_are_not_right(change: Callable[[dict[str, Any]], Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(broken(change)))
    with pytest.raises(InputError, match=message) as caught:
        Calibration.load(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\x00\xff", b'{"format": "ceres-cal/calibration"'])
def test_files_that_are_none(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "none.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match=r"none\.json: ") as caught:
        Calibration.load(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.json: no such file"):
        Calibration.load(tmp_path / "gone.json")
    with pytest.raises(InputError, match=r"cannot be written"):
        calibrated(NAMES[0]).save(tmp_path / "no folder" / "calibration.json")


# ---- reading it -----------------------------------------------------------------------------------------------------


def test_stations_by_name() -> None:
    one, three = calibrated("radial-2-3/field-boards"), calibrated("kannala-brandt/several-stations")
    assert one.station() == one.station("overhead") == one.stations["overhead"]
    assert one.station().cam_from_world == one.estimate.stations["overhead"].cam_from_world
    assert list(three.stations) == ["first", "second", "third"] and list(three.cameras) == ["overhead"]
    with pytest.raises(InputError, match=r"which station\? Name one of first, second, third \(--station NAME\)"):
        three.station()
    with pytest.raises(InputError, match=r"there is no station .frist.: did you mean .first."):
        three.station("frist")


def test_placements_by_name() -> None:
    calibration = calibrated("radial-2-3/field-boards")
    assert list(calibration.placements) == [f"board_{number:02d}" for number in range(1, 7)]


def test_rms_of_points_and_curves_together() -> None:
    fit = Fit(points=30, curves=70, points_rms_px=0.5, curves_rms_px=0.2, point_scale=1.0, curve_scale=1.0, unknowns=11)
    assert fit.rms_px == pytest.approx(np.sqrt((30 * 0.25 + 70 * 0.04) / 100))
    assert replace(fit, points=0, curves=0).rms_px == 0.0
    assert calibrated(NAMES[0]).rms_px == calibrated(NAMES[0]).fit.rms_px


def test_where_it_came_from() -> None:
    calibration = calibrated("radial-2-3/field-boards")
    scene = SCENES["radial-2-3/field-boards"]()
    assert calibration.digest == simulate(scene, WORKDAY, 1).observations.digest
    assert calibration.digest != simulate(scene, WORKDAY, 2).observations.digest
    assert set(calibration.versions) == {"ceres-cal", "pyceres", "numpy"}
    assert calibration.versions["numpy"] == np.__version__
    assert calibration.converged and calibration.termination and calibration.rounds >= 2
