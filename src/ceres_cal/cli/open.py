"""`ceres-cal open`: photographs and their calibration in the browser, to see, drag and check."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from ceres_cal import cli, detect
from ceres_cal.base import InputError, image_files, plural
from ceres_cal.cli.arguments import board_option, output_option, prior_option
from ceres_cal.cli.command import argument, command, option, switch, whole
from ceres_cal.cli.files import json_object, require_folder, require_shown
from ceres_cal.report.document import Document, Section


@command(
    "open",
    "see photographs with the model on them, drag it, and calibrate: a page in the browser",
    "0001.png --target ssl-b -o camera/",
    "photographs/ --target ssl-b --board 9x6x25mm --prior height_m=4.02:20mm -o camera/",
    "calibration.json new.png",
    "old.json calibration.json new.png",
)
def _run(
    files: tuple[str, ...] = argument(
        "PHOTO|CALIBRATION",
        "photographs of one camera at one station, or folders of them; and a calibration to start from, or two to be "
        "compared over one picture",
    ),
    target: str | None = option("the field, as for `detect field`; the page has a list of them, too", "TARGET"),
    board: str | None = board_option("a chessboard, as for `run`"),
    prior: tuple[str, ...] = prior_option(),
    output: Path = output_option("what is made", Path("camera"), "FOLDER"),
    port: int = option("of the page's address; default: one that is free", "N", 0, read=whole(0, 65535)),
    browser: bool = switch("print the address alone, and open no browser", default=True, flags=("--no-browser",)),
) -> Document:
    try:
        import aiohttp  # noqa: F401 what `ceres_cal.cli.page.server` serves with
    except ImportError:
        raise InputError("open needs aiohttp: pip install 'ceres-cal[page]'") from None
    require_shown((), target, board, prior)
    require_folder(output)
    sitting = _sitting(files, output, target or "")
    require_shown(sitting.photographs, None, None, prior)

    state = cli.State(target=target or "", board=board or "", priors=prior)
    session = cli.opened(sitting, state)
    _serve(session, port, browser)
    return Document(tuple(_sections(session)))


def _serve(session: cli.Session, port: int, browser: bool) -> None:
    import asyncio
    import webbrowser

    def show(address: str) -> None:
        print(f"{address} (Ctrl-C ends it)", file=sys.stderr, flush=True)
        if browser:
            webbrowser.open(address)

    try:
        asyncio.run(cli.serve(session, port, show))
    except KeyboardInterrupt as end:  # quiet: Ctrl-C is how a page is ended, but SIGTERM is not
        if type(end) is not KeyboardInterrupt:
            raise


def _sitting(files: Sequence[str], folder: Path, target: str) -> cli.PageContext:
    """Return the named files, each once: no other file is read later."""
    most_calibrations = 2

    named = image_files(files)
    calibrations = [path for path in named if path.suffix.lower() == ".json"]
    photographs = tuple(dict.fromkeys(path for path in named if path not in calibrations))
    for path in calibrations:
        json_object(path)
    if len(calibrations) > most_calibrations:
        raise InputError(f"{calibrations[most_calibrations]}: compare at most two calibrations over one picture")
    if not photographs:
        raise InputError(f"{calibrations[0]}: a calibration holds no picture: name a photograph, too")
    names = [path.name for path in photographs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{twice}: two photographs have this name: give the images of one folder")
    sizes = tuple((image.shape[1], image.shape[0]) for image in map(detect.read_colour, photographs))
    if different := next((n for n, size in enumerate(sizes) if size != sizes[0]), None):
        (a, b), (c, d) = sizes[different], sizes[0]
        raise InputError(f"{photographs[different]}: {a} x {b} px, and the first has {c} x {d}: one camera at a time")
    return cli.PageContext(photographs, sizes, folder, target, *calibrations)


def _sections(session: cli.Session) -> Iterator[Section]:
    folder = session.sitting.folder
    yield Section("", [], {"folder": str(folder), "commands": list(session.written)})
    if not session.written:
        yield Section("written", [f"only the points placed by hand: {folder}/page.json"])
        return
    yield Section("written", [f"{folder}/, by {plural(len(session.written), 'command')}:"])
    yield Section("", session.written)
