"""Wrong arguments are reported before a photograph or a video is read, and before anything is solved."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import pyceres
import pytest

from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.cli.command import COMMANDS, flag
from ceres_cal.detect import images, video
from ceres_cal.detect.photographs import field
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.targets import ssl_field

FIELD = Path(__file__).resolve().parents[1] / "data" / "ssl_field"
WRONG = {
    "detect board": [
        ("VIDEO --columns 2 --rows 2 --square 25mm", "needs 3 inner corners a side or more"),
        ("VIDEO --columns 9 --rows 6 --square 100m", "checkerboard: it reaches 943 m from its origin"),
        ("VIDEO --target ssl-b", "boards are detected with a target of kind"),
        ("VIDEO --columns 6 --rows 6 --april-grid 88m --gap 0.3", "april-grid: it reaches"),
        ("VIDEO --columns 6 --rows 6 --april-grid 88mm", "--april-grid needs --gap"),
        ("VIDEO --columns 6 --rows 6 --square 88mm --gap 0.3", "--gap needs --april-grid"),
        ("VIDEO --columns 7 --rows 5 --circles 30m --diameter 20m", "circle-grid: it reaches"),
        ("VIDEO --columns 7 --rows 5 --square 30mm --diameter 20mm", "--diameter needs --circles"),
        ("VIDEO --columns 7 --rows 5 --square 30mm --asymmetric", "--asymmetric needs --circles"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --charuco DICT_4 --marker 30mm", "'DICT_4'"),
        (
            "VIDEO --columns 9 --rows 6 --square 40mm --charuco DICT_4X4_50 --marker 30m",
            "marker_m must be between 0 and",
        ),
        ("VIDEO --columns 9 --rows 6 --square 40mm --legacy", "--legacy needs --charuco"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --frames 0", "'0' is not a whole number of 1 or more"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --timeout 0", "--timeout must be above 0"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --camera ''", "--camera: '' is not a name"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --station ''", "--station: '' is not a name"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --output nowhere/o.json", "there is no folder 'nowhere'"),
        ("VIDEO --columns 9 --rows 6 --square 40mm --output o.csv", "observations are written as .json or .npz"),
    ],
    "detect rings": [
        ("PHOTO --radii 10:360:10", "rings: it reaches 360 m from its origin"),
        ("PHOTO --radii 10mm:360mm:10mm --timeout -1", "--timeout must be above 0"),
        ("PHOTO --radii 10mm:360mm:10mm --camera ''", "is not a name"),
        ("PHOTO --radii 10mm:360mm:10mm --station ''", "is not a name"),
        ("PHOTO --radii 10mm:360mm:10mm --output PHOTO", "is an input"),
    ],
    "detect field": [
        ("VIDEO --auto --target ssl-c", "there is no target 'ssl-c': did you mean 'ssl-b'?"),
        ("VIDEO --auto --target VIDEO", "not valid JSON"),
        ("VIDEO --auto --target MILLIMETRES", "its dimensions are in mm, it seems"),
        ('VIDEO --auto --target \'{"kind": "rings", "radii_m": [0.1]}\'', "no painted curve"),
        ("VIDEO --target ssl-b --start nowhere.json", "nowhere.json: no such file"),
        ("VIDEO --target ssl-b --corner TopLeftCorner=1,2", "4 points are needed to start from"),
        ("VIDEO --target ssl-b --corner A=1,2 --corner B=1,3 --corner C=3,4 --corner D=3,1", "point 'A' is not one of"),
        ("VIDEO --auto --target ssl-b --facing LeftGoalLin=top", "did you mean 'LeftGoalLine'?"),
        ("VIDEO --auto --target ssl-b --facing HalfwayLine=top", "lies in the middle of the field"),
        ("VIDEO --target ssl-b --start CAL --facing LeftGoalLine=top", "--facing needs --auto"),
        ("VIDEO --auto --target ssl-b --keep-start", "--keep-start needs --start or --corner"),
        ("VIDEO --auto --target ssl-b --estimate lenght", "'lenght' is not a dimension"),
        ("VIDEO --auto --target ssl-b --estimate length=9000", "is it in mm? Give metres"),
        ("VIDEO --auto --target ssl-b --estimate goal_width", "no painted line depends on"),
        ("VIDEO --auto --target ssl-b --not-painted Halfway", "did you mean 'HalfwayLine'?"),
        ("VIDEO --auto --target ssl-b --mask nowhere.png", "nowhere.png: no such file"),
        ("VIDEO --auto --target ssl-b --picture nowhere/seen.png", "there is no folder 'nowhere'"),
        ("VIDEO --auto --target ssl-b --picture seen.svg", "pictures are written as .png"),
        ("VIDEO --auto --target ssl-b --camera ''", "is not a name"),
        ("VIDEO --auto --target ssl-b --station ''", "is not a name"),
        ("VIDEO --auto --target ssl-b --timeout nan", "not a finite number"),
        ("VIDEO --auto --target ssl-b --output OUT", "cannot be written: it is a folder"),
    ],
    "run": [
        ("VIDEO --target ssl-c", "did you mean 'ssl-b'?"),
        ("VIDEO --target MILLIMETRES", "its dimensions are in mm, it seems"),
        ("VIDEO --board 9x6x100m", "it reaches 943 m from its origin"),
        ("VIDEO --board 2x2x25mm", "needs 3 inner corners a side or more"),
        ("VIDEO --target ssl-b --facing LeftGoalLine=up", "there is no side 'up'"),
        ("VIDEO --board 9x6x25mm --facing LeftGoalLine=top", "--facing needs --target"),
        ("VIDEO --board 9x6x25mm --not-painted LeftGoalLine", "--not-painted needs --target"),
        ("VIDEO --board 9x6x25mm --estimate length", "--estimate needs --target"),
        ("VIDEO --target ssl-b --estimate length=9000", "is it in mm? Give metres"),
        ("VIDEO --board 9x6x25mm --lens radail", "did you mean 'radial'?"),
        ("VIDEO --target ssl-b --prior height_m=abc:0.1", "'abc' is not a finite number"),
        ("VIDEO --target ssl-b --prior height_m=4020:10", "is it in mm? Give metres"),
        ("VIDEO --target ssl-b --prior north.height_m=4.02:0.01", "name one station before the dot: camera"),
        ("VIDEO --target ssl-b --camera ''", "is not a name"),
        ("VIDEO --target ssl-b --to opencvv", "did you mean 'opencv'?"),
        ("VIDEO --target ssl-b --frames 0", "not a whole number of 1 or more"),
        ("VIDEO --target ssl-b --output PHOTO", "cannot be made: File exists"),
        ("PHOTO COPY --target ssl-b", "0001.png: has the same name as"),
    ],
    "open": [
        ("PHOTO --target ssl-c", "did you mean 'ssl-b'?"),
        ("PHOTO --board 9x6x100m", "it reaches 943 m from its origin"),
        ("PHOTO --prior heigth_m=4:0.01", "did you mean 'height_m'?"),
        ("PHOTO --port 99999", "'99999' is not a whole number from 0 to 65535"),
        ("PHOTO --output PHOTO", "is a file: name a folder"),
    ],
    "check": [
        ("CAL PHOTO --false-alarms 2", "give a share between 0 and 1"),
        ("CAL PHOTO --checks 0", "not a whole number of 1 or more"),
        ("CAL PHOTO --station nobody", "there is no station 'nobody'"),
        ("CAL PHOTO --not-painted Halfway", "'Halfway' is not one of the calibration's"),
        ("BARE PHOTO", "does not say how well it is known"),
    ],
    "refit": [
        ("CAL PHOTO --station nobody", "there is no station 'nobody'"),
        ("CAL PHOTO --not-painted Halfway", "'Halfway' is not one of the calibration's"),
        ("CAL PHOTO --moved nobody", "the photographs are of station 'overhead'"),
        ("CAL PHOTO --prior height_m=4", "write OWNER.NAME=VALUE:SIGMA"),
        ("CAL PHOTO --output nowhere/c.json", "there is no folder 'nowhere'"),
        ("CAL PHOTO --report page.pdf", "a report is written as .html or .htm"),
        ("CAL PHOTO COPY --report OUT/page.html", "0001.png: has the same name as"),
        ("CAL PHOTO --images PHOTO", "--images needs --report"),
        ("BARE PHOTO", "does not say how well it is known"),
    ],
    "calibrate": [
        ("OBS --output nowhere/c.json", "there is no folder 'nowhere'"),
        ("OBS --report page.pdf", "a report is written as .html or .htm"),
        ("OBS --report OUT/page.html --images OBS", "is called like a frame"),
        ("OBS --lens radail", "did you mean 'radial'?"),
        ("OBS --powers 2,x", "give whole numbers between commas"),
        ("OBS --lens brown --terms rationel", "rationel"),
        ("OBS --fix k9=0", "k9"),
        ("OBS --tolerance field.lines_m=10", "the tolerance lines_m of target 'field' is 10 m"),
        ("OBS --prior height_m=4020:10", "is it in mm? Give metres"),
        ("OBS --estimate length=9000", "is it in mm? Give metres"),
        ("OBS --loss-scale 0", "loss_scale"),
        ("OBS --reject-sigma -1", "reject_sigma"),
        ("OBS --max-iterations 0", "--max-iterations"),
        ("OBS --threads -1", "threads"),
        ("OBS --scheduler nowhere", "--scheduler"),
    ],
    "diagnose": [
        ("CAL OBS --output table.txt", "the table is written as .csv, .json or .npz"),
        ("CAL OBS --report page.pdf", "a report is written as .html or .htm"),
        ("CAL OBS --images PHOTO", "--images needs --report"),
        ("CAL OBS --false-alarms 2", "give a share between 0 and 1"),
    ],
    "advise": [
        ("CAL --height-mm tall", "'tall' is not a length"),
        ("CAL --station nobody", "there is no station 'nobody'"),
        ("CAL --good-enough-mm 0", "give a number of millimetres above 0"),
        ("CAL --board 9x6x100m", "it reaches 943 m from its origin"),
        ("BARE", "does not say how well it is known"),
    ],
}
"""For each command that takes long: a wrong value of every option with its own syntax."""


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("early")
    observations = Observations.load(FIELD / "observations.json")
    calibration = calibrate(observations, Options(lens="radial"))
    calibration.save(folder / "calibration.json")
    bare = calibrate(observations, Options(lens="radial", closed_form_only=True))
    bare.save(folder / "bare.json")
    (folder / "game.mp4").write_bytes(b"a video")
    shutil.copy(FIELD / "photographs" / "0001.jpg", folder / "0001.png")
    in_mm = {name: 1e3 * metres for name, metres in ssl_field("B").dimensions.items()}
    return {
        "OBS": str(FIELD / "observations.json"),
        "CAL": str(folder / "calibration.json"),
        "BARE": str(folder / "bare.json"),
        "PHOTO": str(FIELD / "photographs" / "0001.jpg"),
        "COPY": str(folder / "0001.png"),
        "VIDEO": str(folder / "game.mp4"),
        "OUT": str(folder),
        "MILLIMETRES": json.dumps({"kind": "ssl-field", **in_mm}),
    }


@pytest.fixture
def nothing_done(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading a photograph or a video, and solving, fail with errors that are not wrong usage."""

    def fail(*_: Any, **__: Any) -> Any:
        raise AssertionError("work was done before the mistake was said")

    decoded = images._decoded
    monkeypatch.setattr(images, "_decoded", lambda path, how: fail() if Path(path).exists() else decoded(path, how))
    monkeypatch.setattr(video, "_opened", fail)
    monkeypatch.setattr(pyceres, "solve", fail)


@pytest.mark.parametrize("command, typed, said", [(name, *case) for name, cases in WRONG.items() for case in cases])
@pytest.mark.usefixtures("nothing_done")
def test_before_anything_is_searched(
    command: str, typed: str, said: str, names: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        word.replace("OUT", names["OUT"]) if "OUT/" in word else names.get(word, word) for word in shlex.split(typed)
    ]
    has_output = "--output" in words or not any(one.name == "output" for one in fields(COMMANDS[command].arguments))
    output = [] if has_output else ["-o", str(tmp_path / ("made" if command in ("run", "open") else "made.json"))]
    code = main([*command.split(), *words, *output])
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and err.count("\n") == 1 and said in err, err


@pytest.mark.parametrize("command", ["run", "open"])
def test_a_focal_length_in_mm_is_refused_by_the_size_of_the_picture(
    command: str,
    names: dict[str, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One photograph is read, and nothing is searched."""
    monkeypatch.setattr(field, "_looked_for", None)
    ask = [names["PHOTO"], "--target", "ssl-b", "--prior", "phi=4.2:0.1", "-o", str(tmp_path / "made")]
    assert main([command, *ask]) == 2
    assert "the prior on phi is 4.2 px, but must be at least 40 px" in capsys.readouterr().err


@pytest.mark.parametrize("command", WRONG)
def test_every_option_with_a_value_is_among_them(command: str) -> None:
    kind = COMMANDS[command].arguments
    types = get_type_hints(kind)
    open_ = {one.name for one in fields(kind) if types[one.name] not in (bool, bool | None) and "flags" in one.metadata}
    chosen = {name for name in open_ if "Literal" in str(types[name])}
    typed = " ".join(case for case, _ in WRONG[command])
    assert {name for name in open_ - chosen if f"{flag(name)} " not in typed} == set()


def test_every_command_that_takes_long_is_asked() -> None:
    quick = {"join", "score", "compare", "audit", "locate", "project", "export", "export-table", "import", "publish"}
    quick |= {"listen", "targets", "targets print", "targets import", "completion", "simulate"}
    checked_elsewhere = {"batch", "undistort"}  # each job's command; test_cli_undistort
    assert COMMANDS.keys() - quick - checked_elsewhere == WRONG.keys()
