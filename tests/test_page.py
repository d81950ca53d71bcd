"""The page: its state, its server, and refusals. A real Chromium tests it in test_page_in_chromium.py."""

from __future__ import annotations

import asyncio
import errno
import os
import struct
import sys
import zlib
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

pytest.importorskip("aiohttp", reason="the page is an extra: pip install 'ceres-cal[page]'")

import aiohttp
import numpy as np
from yarl import URL

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import write_json
from ceres_cal.base.transforms import Pose
from ceres_cal.cli import main
from ceres_cal.cli.page.server import serve
from ceres_cal.cli.page.session import KEPT, Session, opened
from ceres_cal.cli.page.state import Change, Click, CommandResults, Drag, PageContext, Place, Region, State, load_state
from ceres_cal.detect.photographs import Clicks, by_hand, load_clicks
from ceres_cal.detect.photographs.by_hand import starts_from_clicks
from ceres_cal.detect.photographs.refit import PointHints
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import targets_by_name

ROOT = Path(__file__).parents[1]
PHOTOGRAPHS = ROOT / "data/ssl_field/photographs"
FIELD = targets_by_name()["ssl-b"]
CORNERS = ("TopLeftCorner", "TopRightCorner", "BottomLeftCorner", "BottomRightCorner")


def session_of(folder: Path, state: State | None = None, count: int = 1) -> Session:
    photographs = tuple(sorted(PHOTOGRAPHS.glob("0*.jpg"))[:count])
    sitting = PageContext(photographs, ((1280, 960),) * count, folder)
    return opened(sitting, state or State(target="ssl-b"))


def drag(name: str, x: float, y: float, **more: Any) -> Drag:
    return Drag(what=more.pop("what", "point"), name=name, x=x, y=y, sigma=3.0, last=more.pop("last", True), **more)


# ---- the camera that follows dragged points -------------------------------------------------------------------------


def truth() -> Camera:
    """A tilted camera above the field, rotated by about 30 degrees."""
    straight = by_hand.guess(FIELD, (1280, 960), "right")
    return straight.at(Pose.exp((0.06, -0.04, 0.2, 0.1, 0.2, 0.5)) @ straight.cam_from_world)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6, 12])
def test_the_model_is_where_it_was_dragged_to(count: int) -> None:
    camera, names = truth(), [*CORNERS, *(name for name in FIELD.points if name not in CORNERS)][:count]
    pixels = camera.project(np.array([FIELD.points[name] for name in names]))
    shown = PointHints.of(FIELD, {name: (*pixel, 3.0) for name, pixel in zip(names, pixels, strict=True)}, [])
    base = by_hand.guess(FIELD, (1280, 960))
    found = by_hand.solved(shown, base, base)
    off_px, _ = by_hand.off(shown, found)
    assert np.max(off_px) < 1.0  # measured: 0.3 px, held by where the others were
    if count >= 6:
        every = found.project(FIELD.point_array) - camera.project(FIELD.point_array)
        assert np.max(np.linalg.norm(every, axis=1)) < 3.0


def test_a_place_of_a_line_draws_the_line() -> None:
    base = by_hand.guess(FIELD, (1280, 960))
    shown = PointHints.of(FIELD, {}, [("HalfwayLine", 700.0, 300.0, 3.0), ("HalfwayLine", 720.0, 700.0, 3.0)])
    assert np.max(by_hand.off(shown, by_hand.solved(shown, base, base))[0]) < 1.0


def test_a_click_that_contradicts_the_others_is_named() -> None:
    camera = truth()
    points = {name: (*camera.project(np.array(FIELD.points[name])), 3.0) for name in list(FIELD.points)[:10]}
    points["TopRightCorner"] = (points["TopRightCorner"][0] + 60.0, points["TopRightCorner"][1], 3.0)
    shown, base = PointHints.of(FIELD, points, []), by_hand.guess(FIELD, (1280, 960))
    _, against = by_hand.judged(shown, by_hand.solved(shown, base, base), base)
    assert list(against) == ["TopRightCorner"] and against["TopRightCorner"] == pytest.approx(60.0, abs=12.0)


def test_places_of_lines_take_part_in_a_start(tmp_path: Path) -> None:
    """Corners with errors of 15 px leave the halfway line 10 px off; two places on it correct this."""
    camera, steps = truth(), np.array([[12.0, -9.0], [-9.0, 12.0], [9.0, 12.0], [-12.0, -9.0]])
    corners = camera.project(np.array([FIELD.points[name] for name in CORNERS])) + steps
    points = {name: tuple(pixel) for name, pixel in zip(CORNERS, corners.tolist(), strict=True)}
    middle = camera.project(np.array([[0.0, 2.0, 0.0], [0.0, -2.0, 0.0]]))
    curves = tuple(("HalfwayLine", x, y) for x, y in middle.tolist() for _ in range(8))
    file = tmp_path / "corners.json"
    write_json(file, {"format": "ceres-cal/corners", "version": 1, "points": points, "curves": curves})

    def off_px(clicks: Clicks) -> float:
        starts, free = starts_from_clicks(clicks, FIELD, (1280, 960))
        assert free.hints is not None and len(free.hints.places) == len(clicks.curves)
        shown = PointHints.of(FIELD, {}, [(name, x, y, 1.0) for name, x, y in curves])
        return float(np.median([np.max(by_hand.off(shown, start)[0]) for start in starts]))

    clicks = load_clicks(file)
    assert clicks == Clicks(points, curves)
    assert off_px(clicks) < 0.6 * off_px(Clicks(points))
    with pytest.raises(InputError, match="curve 'NoLine' is not one of the target's"):
        starts_from_clicks(Clicks(points, (("NoLine", 1.0, 1.0),)), FIELD, (1280, 960))


# ---- the session ----------------------------------------------------------------------------------------------------


def test_undo_redo_and_what_is_kept(tmp_path: Path) -> None:
    session = session_of(tmp_path)
    session.drag(drag("TopLeftCorner", 100.0, 90.0))
    session.drag(drag("HalfwayLine", 600.0, 300.0, what="place"))
    session.change(Change(msgspec.structs.replace(session.state, not_painted=("CenterLine",)), session.revision))
    assert session.state.places == (Place("HalfwayLine", 600.0, 300.0, 3.0),)
    session.step(back=True)
    session.step(back=True)
    assert session.state == State(target="ssl-b", points={"TopLeftCorner": Click(100.0, 90.0, 3.0)})
    session.step(back=False)
    assert load_state(tmp_path / KEPT) == session.state
    assert session_of(tmp_path).state == session.state  # opened again, it continues from there


def test_a_drag_is_no_change_until_it_is_let_go(tmp_path: Path) -> None:
    session = session_of(tmp_path)
    moving = drag("TopLeftCorner", 100.0, 90.0, last=False)
    session.drag(moving)
    assert session.state.points == {}
    assert session.model(moving)["points"]["TopLeftCorner"] == pytest.approx([100.0, 90.0], abs=1.0)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (drag("NoSuchCorner", 1.0, 1.0), "point 'NoSuchCorner' is not one of the target's"),
        (drag("TopLeftCorner", 1.0, 1.0, what="word"), "word 'TopLeftCorner' is not one of the target's"),
        (Change(State(target="ssl-b", not_painted=("NoLine",)), 1), "'NoLine' is not one of the target's"),
        (Change(State(target="ssl-b", lengths={"height_m": 1.0}), 1), "unknown dimension 'height_m'"),
        (Change(State(target="/etc/passwd"), 1), "the field '/etc/passwd' was not named on the command line"),
        (Change(State(), 99), "another window changed it meanwhile"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, asked: Drag | Change, words: str) -> None:
    session = session_of(tmp_path)
    before = session.state, session.revision
    with pytest.raises(InputError, match=words):
        session.drag(asked) if isinstance(asked, Drag) else session.change(asked)
    assert (session.state, session.revision) == before


def test_regions_are_a_mask_and_steps_are_commands(tmp_path: Path) -> None:
    from ceres_cal.cli.open_steps import field_steps, write_inputs
    from ceres_cal.detect.images import read_grey

    points = {name: Click(100.0 + 10.0 * n, 90.0, 3.0) for n, name in enumerate(CORNERS)}
    region = Region("0002.jpg", (30.0, 20.0, 10.0, 40.0))
    state = State(
        target="ssl-b",
        points=points,
        regions=(region,),
        not_painted=("CenterLine",),
        lengths={"line_thickness_m": 0.02},
    )
    session = session_of(tmp_path, state, 3)
    target = session.target(state)
    assert target is not None and target.dimensions["line_thickness_m"] == 0.02
    write_inputs(state, session.sitting, tmp_path, auto=False)
    mask = read_grey(tmp_path / "mask-0002.png")
    assert mask.shape == (960, 1280) and np.count_nonzero(mask == 0) == 21 * 21
    first, second = field_steps(state, target, session.sitting, tmp_path, (), auto=False)
    assert [Path(word).name for word in first.arguments[:2]] == ["0001.jpg", "0003.jpg"]
    assert second.arguments[0].endswith("0002.jpg") and "--mask" in second.arguments and "--mask" not in first.arguments
    assert "--not-painted CenterLine" in first.typed and '"line_thickness_m": 0.02' in first.typed


def test_what_clicks_alone_tell(tmp_path: Path) -> None:
    """With six corners accurate to 0.5 px: phi and height are shown with their large uncertainties."""
    camera, draw = truth(), np.random.default_rng(3)
    names = [*CORNERS, "TopHalfwayCrossing", "LeftFieldLeftPenaltyCorner"]
    pixels = camera.project(np.array([FIELD.points[name] for name in names])) + draw.normal(0.0, 0.5, (6, 2))
    points = {name: Click(x, y, 1.0) for name, (x, y) in zip(names, pixels.tolist(), strict=True)}
    session = session_of(tmp_path, State(target="ssl-b", points=points))
    assert session.everything()["known"] is None and session.weigh()
    known = session.everything()["known"]
    assert [one["name"] for one in known["numbers"]] == ["phi of camera", "height of station"]
    assert known["level"] in ("care", "no") and "advice" not in known and len(known["maps"]) == 2
    session.drag(drag("TopLeftCorner", 100.0, 90.0))
    assert session.everything()["known"] is None  # it belonged to other clicks


# ---- the server -----------------------------------------------------------------------------------------------------

Work = Callable[[aiohttp.ClientSession, str, Session], Awaitable[None]]


def served(session: Session, work: Work) -> None:
    """Serve the page in this process while a client works."""

    async def whole() -> None:
        address: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        serving = asyncio.create_task(serve(session, 0, address.set_result))
        async with aiohttp.ClientSession() as client:
            await work(client, await address, session)
        serving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await serving

    asyncio.run(asyncio.wait_for(whole(), 30.0))


def own(address: str) -> dict[str, str]:
    """Headers of a browser for a page with this address."""
    return {"Origin": address[: address.index("/", 8)]}


def socket(client: aiohttp.ClientSession, address: str, **headers: str) -> Any:
    return client.ws_connect(f"{address}socket", headers={**own(address), **headers})


def test_the_page_its_scripts_and_photographs(tmp_path: Path) -> None:
    async def work(client: aiohttp.ClientSession, address: str, _: Session) -> None:
        assert address.startswith("http://127.0.0.1:")
        for name, kind in (("", "text/html"), ("page.js", "text/javascript"), ("photograph/0", "image/jpeg")):
            async with client.get(address + name) as answer:
                assert (answer.status, answer.content_type) == (200, kind)
                assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
                assert len(await answer.read()) > 1000

    served(session_of(tmp_path), work)


def test_strangers_are_refused(tmp_path: Path) -> None:
    """A foreign Origin, a wrong token, another host's name, and a path outside."""

    async def work(client: aiohttp.ClientSession, address: str, _: Session) -> None:
        root, token = address[: address.index("/", 8)], address.split("/")[3]

        async def status(url: str, **headers: str) -> int:
            async with client.get(URL(url, encoded=True), headers=headers) as answer:
                return int(answer.status)

        assert len(token) >= 32
        assert await status(address) == 200
        assert await status(address, Origin="http://evil.example") == 403
        assert await status(address, Origin="null") == 403
        assert await status(address, Host="evil.example:80") == 403  # a foreign name that resolves to this machine
        assert await status(f"{root}/{token[:-1]}{'y' if token.endswith('x') else 'x'}/") == 403
        assert await status(f"{root}/") in (403, 404)
        for outside in ("..%2f..%2f..%2fetc%2fpasswd", "%2e%2e/server.py", "photograph/1", "photograph/-1", "state.py"):
            assert await status(f"{address}{outside}") in (403, 404)
        for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await socket(client, address, **headers)
            assert refused.value.status == 403
        with pytest.raises(aiohttp.WSServerHandshakeError):  # without an Origin, so not from a browser
            await client.ws_connect(f"{address}socket")

    served(session_of(tmp_path), work)


def test_malformed_and_endless_messages(tmp_path: Path) -> None:
    async def work(client: aiohttp.ClientSession, address: str, session: Session) -> None:
        async with socket(client, address) as window:
            assert (await window.receive_json())["is"] == "state"
            for content in ("", "{", "[]", '{"do":"drag"}', '{"do":"now","what":"rm -rf"}', '{"do":"no"}', '"' * 1000,
                            '{"do":"drag","what":"point","name":"TopLeftCorner","x":1e999,"y":1,"sigma":3}',
                            "[" * 100_000, '{"do":"change","revision":1,"state":{"unheard":1}}'):  # fmt: skip
                await window.send_str(content)
                answer = await window.receive_json()
                assert answer["is"] == "refused" and "\n" not in answer["why"]
            await window.send_bytes(b"\xff\xfe")
            assert (await window.receive_json())["is"] == "refused"
            assert session.state == State(target="ssl-b")
            await window.send_str('"' + "x" * 300_000)
            assert (await window.receive()).type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED)
            assert window.close_code == 1009  # too big
        async with socket(client, address) as window:  # the next one is served
            assert (await window.receive_json())["is"] == "state"

    served(session_of(tmp_path), work)


def test_two_windows_see_the_same_and_overwrite_nothing(tmp_path: Path) -> None:
    async def work(client: aiohttp.ClientSession, address: str, session: Session) -> None:
        async with socket(client, address) as one, socket(client, address) as other:
            first = await one.receive_json()
            assert await other.receive_json() == first
            await one.send_str(msgspec.json.encode(drag("TopLeftCorner", 100.0, 90.0)).decode())
            assert (await one.receive_json())["state"] == (await other.receive_json())["state"]
            stale = Change(State(target="ssl-a"), first["revision"])
            await other.send_str(msgspec.json.encode(stale).decode())
            assert "another window" in (await other.receive_json())["why"]
            assert session.state.points.keys() == {"TopLeftCorner"}

    served(session_of(tmp_path), work)


def test_there_are_not_endlessly_many_windows(tmp_path: Path) -> None:
    async def work(client: aiohttp.ClientSession, address: str, _: Session) -> None:
        windows = [await socket(client, address) for _ in range(8)]
        with pytest.raises(aiohttp.WSServerHandshakeError):
            await socket(client, address)
        await windows[0].close()
        await windows.pop().close()
        await asyncio.sleep(0.1)
        async with socket(client, address) as window:
            assert (await window.receive_json())["is"] == "state"

    served(session_of(tmp_path), work)


def test_a_full_disk_is_said_and_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = session_of(tmp_path)
    session.drag(drag("TopLeftCorner", 100.0, 90.0))
    before = (tmp_path / KEPT).read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    session.drag(drag("TopRightCorner", 900.0, 90.0))
    assert session.message == f"{tmp_path}/{KEPT}: cannot be written: No space left on device"
    assert session.state.points.keys() == {"TopLeftCorner", "TopRightCorner"}  # in the window all is there
    assert [path.name for path in tmp_path.iterdir()] == [KEPT] and (tmp_path / KEPT).read_bytes() == before
    monkeypatch.undo()
    session.drag(drag("TopRightCorner", 901.0, 90.0))
    assert session.message == "" and load_state(tmp_path / KEPT) == session.state


def test_done_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first file without room is named; no file is incomplete."""
    points = {name: Click(100.0 + 10.0 * n, 90.0, 3.0) for n, name in enumerate(CORNERS)}
    session = session_of(tmp_path, State(target="ssl-b", points=points))
    session._now = replace(session._now, made=CommandResults((), {"field.json": b"{}"}, tmp_path / "calibration.json"))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"corners\.json: cannot be written: No space left on device"):
        session.done()
    assert [path.name for path in tmp_path.iterdir()] == [KEPT] and session.written == ()


def test_an_unforeseen_error_is_said_and_the_page_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("division by zero")

    async def work(client: aiohttp.ClientSession, address: str, session: Session) -> None:
        monkeypatch.setattr(session, "find", fail)
        async with socket(client, address) as window:
            await window.receive_json()
            await window.send_str('{"do":"now","what":"find"}')
            assert (await window.receive_json())["busy"]
            said = await window.receive_json()
            assert not said["busy"] and said["message"].startswith("unexpected ZeroDivisionError: division by zero")

    served(session_of(tmp_path), work)


# ---- the command ----------------------------------------------------------------------------------------------------


def png_of(width: int, height: int) -> bytes:
    """The header of a picture that claims to be so large."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 100_000)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["huge.png"], "huge.png: an image of 40000 x 25000 px: would take 3000 MB"),
        (["a.jpg", "small.png"], "small.png: not an image that OpenCV can read"),
        (["none.jpg"], "none.jpg: no such file"),
        (["a.jpg", "--target", "ssl-z"], "there is no target 'ssl-z'"),
        (["a.jpg", "--board", "9"], "board '9'"),
        (["calibration.json"], "calibration.json: a calibration holds no picture: name a photograph, too"),
        (["a.jpg", "more/a.jpg"], "a.jpg: two photographs have this name"),
    ],
)  # fmt: skip
def test_what_is_named_is_looked_at_first(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "huge.png").write_bytes(png_of(40_000, 25_000))  # 1e9 pixels
    (tmp_path / "small.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "calibration.json").write_text("{}")
    (tmp_path / "more").mkdir()
    for folder in (tmp_path, tmp_path / "more"):
        (folder / "a.jpg").write_bytes((PHOTOGRAPHS / "0001.jpg").read_bytes())
    assert main(["open", *arguments, "--no-browser"]) == 2
    assert capsys.readouterr().err.startswith(f"ceres-cal: {words}")


def test_without_the_extra_its_name_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:

    monkeypatch.setitem(sys.modules, "aiohttp", None)
    assert main(["open", str(PHOTOGRAPHS / "0001.jpg"), "--no-browser"]) == 2
    assert capsys.readouterr().err == "ceres-cal: open needs aiohttp: pip install 'ceres-cal[page]'\n"


_TEXTS = {".py", ".js", ".css", ".html", ".svg"}


def test_the_room_is_small() -> None:
    room = ROOT / "src/ceres_cal/cli/page"
    texts = [path for path in room.rglob("*") if path.suffix in _TEXTS]
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in texts}
    python = sum(count for path, count in lines.items() if path.suffix == ".py")
    web = sum(count for path, count in lines.items() if path.parent.name == "web")
    assert python <= 900 and web <= 1200
    text = "".join(path.read_text(encoding="utf-8") for path in (room / "web").iterdir())
    assert "https://" not in text and text.count("http://") == text.count("http://www.w3.org/2000/svg")
