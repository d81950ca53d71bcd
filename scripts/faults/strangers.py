"""Every command for photographs from elsewhere, as a new user types them: python scripts/run.py strangers

Each picture is given to `run` with only its target. The result is given to all commands that accept it, and is exported
to all formats and imported again. Counted are lines not meant for users (an unexpected error, nan, inf). Exits with 1
where there are any; the folders are ../photos and ../photos3 beside $CERES_CAL_REAL.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from photos.real_data import real_folder
from runner import Row, script

from ceres_cal.formats import EXPORT_FORMATS, IMPORT_FORMATS

PROGRAM = (sys.executable, "-c", "import sys; from ceres_cal.cli import main; sys.exit(main())")
_ODD = re.compile(r"unexpected|Traceback|[a-z]Warning|\bnan\b|\binf\b|\bNaN\b")


def odd_words(*arguments: object) -> list[str]:
    """Lines of a command's output that are not meant for users."""
    ran = subprocess.run([*PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=600)
    said = [line for line in (ran.stdout + ran.stderr).splitlines() if _ODD.search(line)]
    said += [] if ran.returncode in (0, 1, 2, 3) else [f"exit code {ran.returncode}"]
    return [f"{arguments[0]}: {line.strip()}" for line in said]


def commands(folder: Path, picture: Path) -> Iterator[tuple[object, ...]]:
    """The commands that accept the result of `run` for a picture."""
    made, seen = folder / "calibration.json", folder / "field.json"
    yield from ((name, made, seen) for name in ("diagnose", "check", "score"))
    yield from (("audit", made, "--observations", seen), ("refit", made, seen, "-o", folder / "new.json"))
    yield from (("compare", made, made), ("advise", made), ("project", made, "0,0"))
    yield from (("locate", made, "100,100", "--height-mm", height) for height in (0, 150))
    yield ("undistort", made, picture, "-o", folder / "straight.png")
    there_and_back = (form for form in EXPORT_FORMATS.values() if form.name in IMPORT_FORMATS and not form.edits)
    for name, endings in ((form.name, form.endings) for form in there_and_back):
        file = folder / f"as_{name}{next(iter(endings), '')}"
        yield ("export", made, "--to", name, "-o", file)
        yield ("import", file, "--from", name, "-o", folder / f"{name}.json")
        yield ("compare", made, folder / f"{name}.json")


def rows(folder: str, runs: int) -> Iterator[Row]:
    """The figure for the first so many pictures of a folder."""
    truths = sorted((real_folder().parent / folder).glob("*.truth.json"))[:runs]
    said: list[str] = []
    with tempfile.TemporaryDirectory() as place:
        for path in truths:
            asked: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            picture, out = path.parent / asked["picture"], Path(place) / path.stem
            said += odd_words("run", picture, "--target", asked["asked_as"], "--facing", asked["facing"], "-o", out)
            if (out / "calibration.json").exists():
                said += [f"{picture.name}, {line}" for one in commands(out, picture) for line in odd_words(*one)]
    print("\n".join(said), file=sys.stderr)
    yield Row(folder, "words not meant for people", len(said), most=0.0, note=f"{len(truths)} pictures")


_cases = {name: partial(rows, name) for name in ("photos", "photos3")}
main = script(_cases, __doc__, (100, "pictures of each folder, the first"))
