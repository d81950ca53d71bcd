"""The page in a real Chromium: opened, dragged, detected, written; skipped where there is none."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import Browser, browser

from ceres_cal.calibration import Calibration
from ceres_cal.cli import main
from ceres_cal.detect.images import read_colour
from ceres_cal.observations import Observations

pytest.importorskip("aiohttp", reason="the page is an extra: pip install 'ceres-cal[page]'")

ROOT = Path(__file__).parents[1]
PHOTOGRAPH = ROOT / "data/ssl_field/photographs/0001.jpg"
AROUND_PX = ((5.7, -5.7), (-8.0, 0.0), (0.0, 8.0), (-5.7, -5.7))  # 8 px off


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def photos3(real_data: Path) -> Path:
    """Folder of rendered photographs for which --auto is not tried here, beside the real ones."""
    folder = real_data.parent / "photos3"
    if not folder.is_dir():
        pytest.skip(f"no rendered photographs: {folder} is not there (it lies beside $CERES_CAL_REAL)")
    return folder


@contextmanager
def opened(folder: Path, *arguments: str | Path) -> Iterator[str]:
    """The address of the page that `ceres-cal open` serves; it is ended by Ctrl-C, and must end with success."""
    command = [sys.executable, "-c", "from ceres_cal.cli import main; raise SystemExit(main())", "open"]
    words = [*map(str, arguments), "-o", str(folder), "--no-browser"]
    process = subprocess.Popen([*command, *words], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        said = process.stderr.readline()
        address = re.search(r"http://127\.0\.0\.1:\d+/\S+/", said)
        assert address, said + process.stderr.read()
        yield address[0]
    finally:
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    assert process.returncode == 0 and error == ""


def shown(window: Browser, address: str, width: int = 1400) -> None:
    window.open(address, width)
    window.wait_for("window.page?.now && page.view.picture")


def screen(window: Browser, place: str) -> tuple[float, float]:
    """Position in the window of a place of the photograph, according to the page."""
    x, y = window.run(
        "(() => { const box = page.view.canvas.getBoundingClientRect(), "
        f"[x, y] = page.view.screen({place}); return [x + box.left, y + box.top]; }})()"
    )
    return x, y


def drag(window: Browser, start: str, end: tuple[float, float], steps: int = 5) -> None:
    """Drag from a place (JavaScript) to a pixel of the photograph, and wait until the page shows the answer."""
    (x, y), (u, v) = screen(window, start), screen(window, json.dumps(end))
    before = window.run("page.now.revision")
    window.mouse("Moved", x, y)
    window.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
    for step in range(1, steps + 1):
        window.mouse("Moved", x + (u - x) * step / steps, y + (v - y) * step / steps, button="left", buttons=1)
    window.mouse("Released", u, v, button="left", clickCount=1)
    window.wait_for(f"page.now.revision > {before}")


def drag_corners(window: Browser, corners: Mapping[str, tuple[float, float]]) -> None:
    for name, pixel in corners.items():
        drag(window, f"page.now.model.points.{name}", pixel)


def press(window: Browser, button: str) -> None:
    """Press a button, and wait until the work is done."""
    before = window.run("page.now.revision")
    window.run(f"document.getElementById('{button}').click()")
    window.wait_for(f"!page.now.busy && page.now.revision > {before} || page.now.message")
    assert window.run("page.now.message") == ""


def keep(window: Browser, name: str) -> None:
    """A screenshot, if CERES_CAL_PICTURES names a folder for it."""
    if folder := os.environ.get("CERES_CAL_PICTURES"):
        window.screenshot(Path(folder) / f"{name}.png")


def test_the_sample_found_by_itself(window: Browser, tmp_path: Path) -> None:
    """A click on the goal resolves the symmetry; two boards are used."""
    folder = PHOTOGRAPH.parent
    photographs = (PHOTOGRAPH, folder / "board_01.jpg", folder / "board_05.jpg")
    with opened(tmp_path / "page", *photographs, "--target", "ssl-b", "--board", "9x6x100mm") as address:
        shown(window, address)
        assert window.run("[...document.querySelectorAll('[role=tab]')].map(tab => tab.textContent)") == [
            path.name for path in photographs
        ]
        window.run("document.getElementById('goal').click()")
        x, y = screen(window, "[640, 30]")
        window.mouse("Pressed", x, y, button="left", clickCount=1)
        window.mouse("Released", x, y, button="left", clickCount=1)
        window.wait_for("page.now.state.facing")
        assert window.run("page.now.state.facing") == "LeftGoalLine=top"
        press(window, "auto")
        keep(window, "page")
        assert window.run("page.now.photographs.map(one => one.board)") == [False, True, True]
        assert window.run("page.now.known.level") == "good"
        window.run("document.querySelectorAll('[role=tab]')[1].click()")
        window.wait_for("page.view.picture && page.view.layers[0].lines.length == 15")  # of the board
        keep(window, "6-board")
        window.run("page.change({exports: ['opencv']})")
        window.wait_for("page.now.state.exports.length && page.now.found")  # the detections stay
        press(window, "done")
        assert (tmp_path / "page/opencv.yml").exists()
    assert window.complaints == []

    old = tmp_path / "page/calibration.json"
    step, moved = np.array([[1.0, 0.002, 4.0], [-0.002, 1.0, -3.0]]), tmp_path / "moved.png"
    image = cv2.warpAffine(read_colour(folder / "0002.jpg"), step, (1280, 960), borderMode=cv2.BORDER_REPLICATE)
    cv2.imwrite(str(moved), image)
    with opened(tmp_path / "look", old, moved) as address:
        shown(window, address)
        press(window, "check")
        held, beside = window.run("page.now.said")
        assert held.startswith("camera: no longer holds: ")
        assert 2.0 < float(beside.split(" px")[0].split()[-1]) < 6.0  # median across the lines; the shift is 5 px
        window.wait_for("page.view.strokes.length > 100")
        keep(window, "7-moved")


def test_four_corners_of_a_photograph_that_is_not_found_by_itself(
    window: Browser, photos3: Path, tmp_path: Path
) -> None:
    """This field has lines of another sport; the corners are dragged to places with errors of 8 px."""
    photograph = photos3 / "extra0.jpg"
    truth = json.loads((photos3 / "extra0.truth.json").read_text())
    true, height = truth["corners_px"], f"height_m={truth['camera_position_m'][2]:.3f}:100mm"
    names = ("TopLeftCorner", "TopRightCorner", "BottomLeftCorner", "BottomRightCorner")
    corners = {name: (true[name][0] + x, true[name][1] + y) for name, (x, y) in zip(names, AROUND_PX, strict=True)}
    with opened(tmp_path / "page", photograph, "--target", "ssl-b") as address:
        shown(window, address)
        keep(window, "1-opened")
        drag_corners(window, corners)
        keep(window, "2-dragged")
        window.run(f"page.change({{priors: ['{height}']}})")  # with an open height every map takes long
        window.wait_for("page.now.state.priors.length")
        press(window, "find")
        keep(window, "3-found")
        assert window.run("document.querySelector('.verdict').textContent") == window.run("page.now.known.headline")
        window.wait_for("page.now.known.advice && document.querySelector('.advice')")
        window.run("document.querySelector('.advice').click()")
        places = ("a board here", "a pole here", "measure the height here")
        assert window.run("page.view.shapes.map(one => one.label)")[0] in places
        keep(window, "3b-advised")
        shown(window, address)  # reload keeps it
        assert set(window.run("Object.keys(page.now.state.points)")) == set(names)
        press(window, "done")
        keep(window, "4-done")
        commands = window.run("page.now.written")
        assert window.complaints == [] and all(
            url.startswith(("http://127", "ws://127", "blob:")) for url in window.requests
        )
    made = {path.name for path in (tmp_path / "page").iterdir()}
    assert made == {"calibration.json", "corners.json", "field.json", "page.json", "report.html"}
    assert [command.split()[1] for command in commands] == ["detect", "calibrate"]

    given = [word for name, (x, y) in corners.items() for word in ("--corner", f"{name}={x},{y}")]
    field = tmp_path / "field.json"
    assert main(["detect", "field", str(photograph), "--target", "ssl-b", *given, "-o", str(field), "--quiet"]) == 0
    by_page, by_command = (Observations.load(path) for path in (tmp_path / "page/field.json", field))
    assert len(by_page.curves) == len(by_command.curves)
    assert np.allclose(by_page.curves.pixels, by_command.curves.pixels, atol=0.01)  # measured: 0.000
    calibration = Calibration.load(tmp_path / "page/calibration.json")
    assert calibration.digest == by_page.digest and calibration.options.priors[0].value == (float(height[9:14]),)


def test_a_real_photograph(window: Browser, real_data: Path, tmp_path: Path) -> None:
    """A frame of another league's overhead camera: the model from corners alone agrees approximately with its lines."""
    corners = {
        "TopLeftGoalAreaCorner": (152.0, 169.0),
        "BottomLeftGoalAreaCorner": (145.0, 531.0),
        "TopRightGoalAreaCorner": (789.0, 156.0),
        "BottomRightGoalAreaCorner": (781.0, 526.0),
    }
    photograph = real_data / "vss_overhead_robocin/image.png"
    with opened(tmp_path / "page", photograph, "--target", "vss-3") as address:
        shown(window, address)
        drag_corners(window, corners)
        keep(window, "5-real")
        middle = window.run("page.now.model.points.CenterMark")
        assert middle == pytest.approx([465.0, 348.0], abs=6.0)  # by eye


def test_a_killed_browser_and_the_keyboard(window: Browser, tmp_path: Path) -> None:
    """Chromium is killed during a drag; the next one continues with the keyboard only."""
    with opened(tmp_path / "page", PHOTOGRAPH, "--target", "ssl-b") as address:
        with browser() as other:
            shown(other, address)
            drag(other, "page.now.model.points.TopLeftCorner", (150.0, 120.0))
            x, y = screen(other, "page.now.model.points.TopRightCorner")
            other.mouse("Moved", x, y)
            other.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
            other.mouse("Moved", x + 40.0, y + 40.0, button="left", buttons=1)
            other.kill()
        shown(window, address, 800)
        keep(window, "8-narrow")
        assert window.run("Object.keys(page.now.state.points)") == ["TopLeftCorner"]  # the point that was released

        window.run("document.getElementById('view').focus()")
        for key in ("n", "n"):  # the second corner
            window.key(key, text=key)
        assert window.run("document.getElementById('hint').textContent").startswith("Click where TopRightCorner is")
        before = window.run("page.now.model.points.TopRightCorner")
        for _ in range(3):
            window.key("ArrowRight", modifiers=8)
        window.wait_for("'TopRightCorner' in page.now.state.points")
        after = window.run("page.now.state.points.TopRightCorner")
        assert [after["x"], after["y"]] == pytest.approx([before[0] + 30.0, before[1]], abs=1e-6)
        window.key("Delete")
        window.wait_for("!('TopRightCorner' in page.now.state.points)")
        window.key("z", modifiers=2)
        window.wait_for("'TopRightCorner' in page.now.state.points")
        window.key("z", modifiers=10)
        window.wait_for("!('TopRightCorner' in page.now.state.points)")
        scale = window.run("page.view.scale")
        window.key("+", text="+")
        assert window.run("page.view.scale") > scale
        window.key("?", text="?")
        assert window.run("document.getElementById('keys').open")
        window.key("Escape")


def test_parts_are_said_on_the_right(window: Browser, tmp_path: Path) -> None:
    """Lines that are not painted, a region, a dimension, a dragged line, a height; two windows show the same."""
    with opened(tmp_path / "page", PHOTOGRAPH, "--target", "ssl-b") as address:
        shown(window, address)
        window.run("document.querySelector('#painted input').click()")
        window.wait_for("page.now.state.not_painted.length")
        assert window.run("page.now.state.not_painted") == ["TopTouchLine"]
        window.run("document.getElementById('mask').click()")
        (x, y), (u, v) = screen(window, "[100, 100]"), screen(window, "[300, 200]")
        window.mouse("Moved", x, y)
        window.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
        window.mouse("Moved", u, v, button="left", buttons=1)
        window.mouse("Released", u, v, button="left", clickCount=1)
        window.wait_for("page.now.state.regions.length")
        assert window.run("page.now.state.regions[0].box") == pytest.approx([100.0, 100.0, 300.0, 200.0], abs=1.0)
        set_to = "(() => {{ const one = {0}; one.value = {1}; one.dispatchEvent(new Event('change')); }})()"
        window.run(set_to.format("document.querySelector('#dimensions input[type=number]')", "8.6"))
        window.wait_for("page.now.target.dimensions.field_length_m == 8.6")
        window.run("document.querySelector('#dimensions input[type=checkbox]').click()")
        window.wait_for("page.now.state.solved.length")
        window.run(set_to.format("document.getElementById('height')", "4.02"))
        window.wait_for("page.now.state.priors.length")
        assert window.run("page.now.state.priors") == ["height_m=4.02:20mm"]
        drag(window, "page.now.model.lines.HalfwayLine[20]", (700.0, 400.0))
        place = window.run("page.now.state.places[0]")
        assert place["curve"] == "HalfwayLine" and [place["x"], place["y"]] == pytest.approx([700.0, 400.0], abs=1.0)
        assert np.linalg.norm(np.subtract(window.run("page.now.model.feet[0]"), (700.0, 400.0))) < 2.0
        drag(
            window,
            "page.now.state.places[0] && [page.now.state.places[0].x, page.now.state.places[0].y]",
            (680.0, 420.0),
        )
        assert window.run("page.now.state.places.length") == 1  # the same one, again
        choose = "document.getElementById('choose')"
        window.run(f"{choose}.value = 'CenterMark'; {choose}.dispatchEvent(new Event('change'))")
        x, y = screen(window, "[640, 700]")  # where nothing of the model is
        window.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
        window.mouse("Released", x, y, button="left", clickCount=1)
        window.wait_for("'CenterMark' in page.now.state.points")
        x, y = screen(window, "page.now.model.points.RightPenaltyMark")
        for _ in range(2):  # chosen, and confirmed
            window.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
            window.mouse("Released", x, y, button="left", clickCount=1)
        window.wait_for("'RightPenaltyMark' in page.now.state.points")
        for _ in range(9):
            before = window.run("page.now.revision")
            window.run("document.getElementById('undo').click()")
            window.wait_for(f"page.now.revision > {before}")
        assert window.run("page.now.undo") == 0 and window.run("page.now.state.regions") == []
        window.run("document.getElementById('end').click()")  # the page ends on request
        window.wait_for("document.body.classList.contains('ended')")
        assert window.complaints == []


def test_the_model_follows_within_100_ms(window: Browser, tmp_path: Path) -> None:
    """With a photograph of 2448 x 2048 px."""
    photograph = tmp_path / "large.png"
    cv2.imwrite(str(photograph), cv2.resize(read_colour(PHOTOGRAPH), (2448, 2048)))
    with opened(tmp_path / "page", photograph, "--target", "ssl-b") as address:
        shown(window, address)
        window.run("page.latencies.length = 0")
        for name, pixel in (("TopLeftCorner", (300, 300)), ("TopRightCorner", (2100, 330)),
                            ("BottomLeftCorner", (310, 1700)), ("BottomRightCorner", (2050, 1650))):  # fmt: skip
            drag(window, f"page.now.model.points.{name}", pixel, 20)
        latencies = window.run("page.latencies")
        assert len(latencies) > 20
        assert np.median(latencies) <= 100.0  # measured: 19 ms, until the model is drawn
