"""Concentric rings read from photographs: the paper's polynomial, and observations with honest sigmas."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendering.photograph import photograph
from rendering.photography import Photography
from scenes import RADIAL, camera, rings_and_field
from thorough import partly

from ceres_cal.base.arrays import Array, Image8
from ceres_cal.base.errors import InputError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.detect.rings import RingsDetection, detect_rings
from ceres_cal.observations import Observations, combine
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target, rings
from ceres_cal.simulate import Scene, built_in_scene, simulate

RADII = tuple(i / 100 for i in range(1, 37))
HARSH = Photography(blur_px=1.1, vignetting=0.4, unevenness=0.4, read_noise=4.0, jpeg_quality=80)


@cache
def image_of_rings(how: Photography) -> Image8:
    scene, _ = built_in_scene("rings-2004")
    return photograph(scene, "overhead", "rings", how).image


def taken(folder: Path, how: Photography) -> Path:
    """A photograph of data/field_2004's rings."""
    path = folder / "rings.png"
    cv2.imwrite(str(path), image_of_rings(how))
    return path


def before_sheet() -> Camera:
    """The camera in the frame of the sheet."""
    scene, _ = built_in_scene("rings-2004")
    posed = scene.camera_at("overhead")
    return posed.at(posed.cam_from_world @ scene.placements["rings"])


def errors_px(observations: Observations) -> Array:
    """Distance of each edge outside its ring, px."""
    posed, edges = before_sheet(), observations.curves
    place = posed.locate(edges.pixels)
    radius = np.hypot(*place.T)
    true = place * (np.array(RADII)[edges.feature] / radius)[:, None]
    away = edges.pixels - posed.project(np.column_stack([true, np.zeros(len(true))]))
    return np.asarray(np.linalg.norm(away, axis=1) * np.sign(radius - np.array(RADII)[edges.feature]))


def polynomial_error_px(found: RingsDetection) -> float:
    """Largest error of the paper's polynomial with a1 = 1 over the whole image."""
    posed = before_sheet()
    radius = np.linspace(0.0, posed.corner_radius, 200)
    polynomial = found.polynomial / found.polynomial[0]
    return float(np.max(np.abs(np.power.outer(radius, [1, 2, 3]) @ polynomial - posed.lens.ideal_radius(radius))))  # type: ignore[attr-defined]


def test_in_the_dark_it_asks_for_light(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"too dark, from black to white \d grey levels .*expose longer"):
        detect_rings(taken(tmp_path, Photography(exposure=6.0, read_noise=1.5)), RADII)


@pytest.mark.parametrize("how", partly([Photography(), HARSH], [HARSH]), ids=["good light", "bad light"])
def test_the_papers_rings(tmp_path: Path, how: Photography) -> None:
    found = detect_rings(taken(tmp_path, how), RADII)
    assert found.rings == 36 and len(found.observations.curves) > 4000
    assert polynomial_error_px(found) < 0.3  # 0.13 and 0.14 px
    error = errors_px(found.observations)
    pull = error / found.observations.curves.sigma_px
    assert abs(np.mean(error)) < 0.01  # -0.002 and -0.005 px
    assert np.std(pull) == pytest.approx(1.0, abs=0.1)  # 1.02
    assert found.blur_px == pytest.approx(np.hypot(how.blur_px, 12**-0.5), rel=0.05)
    centre = before_sheet().project([[0.0, 0.0, 0.0]])[0]
    assert found.centre == pytest.approx(centre, abs=0.1)


@pytest.mark.thorough
def test_calibrates_from_photographed_rings_and_the_field(tmp_path: Path) -> None:
    found = detect_rings(taken(tmp_path, Photography()), RADII, camera="overhead")
    field = simulate(*built_in_scene("field-2004"), seed=2).observations
    calibration = calibrate(combine([found.observations, field]), RADIAL)
    truth = before_sheet()
    radius = np.linspace(0.0, 420.0, 100)
    solved = calibration.cameras["overhead"].lens.ideal_radius(radius)  # type: ignore[attr-defined]
    assert np.max(np.abs(solved - truth.lens.ideal_radius(radius))) < 0.1  # type: ignore[attr-defined]  # 0.02 px
    assert calibration.fit.curve_scale == pytest.approx(1.0, abs=0.1)


def shifted_rings(target: Target) -> tuple[Scene, str]:
    scene = rings_and_field("kannala-brandt")
    return replace(scene, targets={**scene.targets, "rings": target}), scene.views[0].frames[0]


@pytest.mark.thorough
def test_few_wide_rings_through_a_fisheye(tmp_path: Path) -> None:
    radii = [0.05, 0.12, 0.2, 0.3, 0.33, 0.42]
    scene, frame = shifted_rings(rings(radii))
    cv2.imwrite(str(tmp_path / "few.png"), photograph(scene, "overhead", frame, Photography(blur_px=0.8)).image)
    found = detect_rings(tmp_path / "few.png", radii)
    assert found.rings == 6
    posed = camera("kannala-brandt").at(scene.camera_at("overhead").cam_from_world @ scene.placements["rings"])
    place = posed.locate(found.observations.curves.pixels)
    error_m = np.hypot(*place.T) - np.array(radii)[found.observations.curves.feature]
    assert np.sqrt(np.mean(error_m**2)) * posed.phi < 0.02  # 0.008 px: the sheet is 1 m away


def test_a_hand_in_the_picture_shifts_no_ring(tmp_path: Path) -> None:
    path = taken(tmp_path, Photography())
    image = cv2.imread(str(path))
    assert image is not None
    cv2.ellipse(image, (570, 330), (130, 60), 20.0, 0.0, 360.0, (120, 140, 180), -1)
    cv2.imwrite(str(path), image)
    found = detect_rings(path, RADII)
    error = errors_px(found.observations)
    assert found.rings == 36 and np.max(np.abs(error)) < 0.5  # 0.2 px, where the hand ends
    assert polynomial_error_px(found) < 0.3


def test_a_hand_over_the_middle_is_told(tmp_path: Path) -> None:
    path = taken(tmp_path, Photography())
    image = cv2.imread(str(path))
    assert image is not None
    cv2.circle(image, (394, 290), 60, (120, 140, 180), -1)
    cv2.imwrite(str(path), image)
    with pytest.raises(InputError, match="do not have these radii"):
        detect_rings(path, RADII)


@pytest.mark.parametrize(
    ("radii", "message"),
    [
        (RADII[:20], r"more than 20 rings found, for 20 radii"),
        ((*RADII[:9], *RADII[19:]), r"more than 26 rings found"),
        ((0.01, 0.02, 0.03, *(0.0301 + i / 1000 for i in range(33))), r"do not have these radii"),
    ],
)
def test_other_radii_are_told(tmp_path: Path, radii: tuple[float, ...], message: str) -> None:
    path = taken(tmp_path, Photography())
    with pytest.raises(InputError, match=message) as raised:
        detect_rings(path, radii)
    assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)


def test_rings_that_are_missing_are_told(tmp_path: Path) -> None:
    scene, frame = shifted_rings(rings([0.05, 0.1, 0.15, 0.2]))
    cv2.imwrite(str(tmp_path / "four.png"), photograph(scene, "overhead", frame).image)
    with pytest.raises(InputError, match="4 rings found, but 6 radii were given"):
        detect_rings(tmp_path / "four.png", [0.05, 0.1, 0.15, 0.2, 0.25, 0.3])


def test_pictures_without_rings(tmp_path: Path) -> None:
    flat, noise = np.full((200, 300), 90, np.uint8), np.random.default_rng(1).integers(0, 255, (200, 300))
    stripes = np.tile(np.repeat([30, 220], 10), (200, 15)).astype(np.uint8)
    for name, image in {"flat": flat, "noise": noise.astype(np.uint8), "stripes": stripes}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
        with pytest.raises(InputError, match=r"no .*rings found|rings found around"):
            detect_rings(tmp_path / f"{name}.png", RADII)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = taken(tmp_path, Photography()), tmp_path / "obs.json"
    assert main(["detect", "rings", str(path), "--radii", "0.01:0.36:0.01", "-o", str(out)]) == 0
    assert "36 of 36 rings around (395." in capsys.readouterr().out
    assert main(["detect", "rings", str(path), "--radii", "0.01:0.36:0.01", "-o", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["rings"] == 36 and answer["observations"] == len(Observations.load(out).curves)
    assert answer["lens"]["a2"] == pytest.approx(-8.93e-4, rel=0.02)
    for radii, message in (("0.01:0.36", "FROM:TO:STEP"), ("1:0:1", "FROM must be above 0"), ("a", "a finite number")):
        assert main(["detect", "rings", str(path), "--radii", radii, "-o", str(out)]) == 2
        assert message in capsys.readouterr().err
    assert main(["detect", "rings", str(out), "--radii", "0.1,0.2", "-o", str(tmp_path / "x.json")]) == 2
    assert "not an image" in capsys.readouterr().err
