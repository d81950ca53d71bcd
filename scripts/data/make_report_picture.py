"""Draws the README's picture of the report: three parts of the sample field's page, as Chromium shows them.

Run: python scripts/run.py make_report_picture [OUT.png]
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from ceres_cal import Observations, calibrate
from ceres_cal.report import make_report

ROOT = Path(__file__).parents[2]
NAMES = ("chromium", "chromium-browser", "google-chrome")
PLACES = ("", "#radius-0", "#maps")  # anchors in the page; "" is its top
WIDTH_PX, HEIGHT_PX, GAP_PX = 1040, 1160, 28  # of each part, in the page's own pixels
SMALLER = 0.5  # the smallest scale that Chromium accepts


def chromium() -> str | None:
    """Path of the program; None where there is none."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


def beside_each_other(page: Path) -> str:
    """A page that shows the parts of another one beside each other."""
    style = (
        f"body {{margin: 0; background: #cbd0d4; display: flex; gap: {GAP_PX}px; padding: {GAP_PX}px}}"
        f"iframe {{width: {WIDTH_PX}px; height: {HEIGHT_PX}px; border: 0; background: #fff; flex: none}}"
    )
    frames = "".join(f'<iframe scrolling="no" src="{page.as_uri()}{place}"></iframe>' for place in PLACES)
    return f"<!doctype html><style>{style}</style>{frames}"


def main(arguments: Sequence[str]) -> int:
    out = Path(arguments[0]) if arguments else ROOT / "docs" / "report.png"
    program = chromium()
    if program is None:
        print("no chromium here (Debian, Ubuntu: apt install chromium)", file=sys.stderr)
        return 2
    observations = Observations.load(ROOT / "data" / "ssl_field" / "observations.json")
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        page, shown = Path(folder) / "page.html", Path(folder) / "shown.html"
        page.write_text(make_report(calibrate(observations), observations), encoding="utf-8")
        shown.write_text(beside_each_other(page), encoding="utf-8")
        width, height = len(PLACES) * (WIDTH_PX + GAP_PX) + GAP_PX, HEIGHT_PX + 2 * GAP_PX
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"]
        flags += [f"--user-data-dir={folder}/profile", f"--force-device-scale-factor={SMALLER}"]
        flags += [f"--window-size={width},{height}", f"--screenshot={folder}/shown.png"]
        subprocess.run([program, *flags, shown.as_uri()], check=True, capture_output=True)
        Image.open(f"{folder}/shown.png").quantize().save(out, optimize=True)
    print(f"{out}: {out.stat().st_size / 1024:.0f} KiB")
    return 0
