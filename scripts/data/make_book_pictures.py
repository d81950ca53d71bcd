"""Draws the pictures of the book that commands make: python scripts/run.py make_book_pictures [FOLDER]

These are the fields, the model in a photograph, and the difference of two calibrations; default folder docs/pictures.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2

from ceres_cal.cli import main as ceres_cal

ROOT = Path(__file__).resolve().parents[2]
HOME, MOVED = (ROOT / "data" / name / "photographs" for name in ("ssl_field", "ssl_field_moved"))
SMALLER, QUALITY = 0.75, 85
FIELDS = ("ssl-b", "vss-3", "vss-5", "spl", "humanoid-kid", "football", "basketball", "tennis", "tape-grid")


def run(*arguments: object) -> None:
    code = ceres_cal([str(argument) for argument in arguments])
    if code:
        raise SystemExit(code)


def draw(to: Path, folder: Path) -> None:
    """Draws all pictures; `folder` is for temporary files."""
    for name in FIELDS:
        run("targets", name, "--picture", to / f"field_{name}.svg", "--json")
    field, camera, new = folder / "field.json", folder / "camera.json", folder / "new.json"
    images = sorted(HOME.glob("000*.jpg"))
    found = ("--target", "ssl-b", "--auto", "--facing", "LeftGoalLine=top", "-o", field, "--quiet")
    run("detect", "field", *images, *found)
    run("calibrate", field, "--prior", "height_m=4.02:0.01", "-o", camera, "--quiet")
    run("undistort", camera, images[0], "-o", folder, "--overlay", "--quiet")
    drawn = cv2.imread(str(folder / "0001-overlay.png"))
    assert drawn is not None
    drawn = cv2.resize(drawn, None, fx=SMALLER, fy=SMALLER, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(to / "overlay.jpg"), drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    run("refit", camera, MOVED / "0001.jpg", "-o", new, "--quiet")
    run("compare", camera, new, "--picture", folder / "moved.svg")
    shutil.copy(folder / "moved.svg", to / "moved.svg")


def main(arguments: Sequence[str]) -> int:
    with tempfile.TemporaryDirectory() as temporary:
        draw(Path(arguments[0]) if arguments else ROOT / "docs" / "pictures", Path(temporary))
    return 0
