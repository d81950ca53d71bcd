"""Typical mistakes, in Python and on the command line: each ends in one line that names the object and the remedy."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ceres_cal as cc
from ceres_cal.cli import main
from ceres_cal.cli.command import COMMANDS, Parser

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "data/ssl_field/observations.json"
PHOTOGRAPHS = ROOT / "data/ssl_field/photographs"
BOARD = cc.checkerboard(9, 6, 0.1)
FIELD = cc.ssl_field("B")
SIZE = (1280, 960)


@pytest.fixture(scope="module")
def observations() -> cc.Observations:
    return cc.Observations.load(SAMPLE)


@pytest.fixture(scope="module")
def calibration(observations: cc.Observations) -> cc.Calibration:
    return cc.calibrate(observations, cc.Options(lens="radial", powers=(2, 3)))


# ---- in Python ------------------------------------------------------------------------------------------------------

any_cc: Any = cc
Mistake = Callable[[cc.Calibration, cc.Observations], object]
IN_PYTHON: list[tuple[Mistake, str]] = [
    (lambda c, o: any_cc.calibrate("field.json"), "observations must be an Observations, not str 'field.json': read"),
    (lambda c, o: any_cc.calibrate([o]), "observations must be an Observations, not a list"),
    (lambda c, o: any_cc.calibrate(o, {"lens": "brown"}), "options must be an Options, not a dict"),
    (lambda c, o: any_cc.calibrate(o, option=cc.Options()), "did you mean 'options'?"),
    (lambda c, o: any_cc.Options(lense="radial"), "Options has no field 'lense': did you mean 'lens'?"),
    (lambda c, o: cc.Options(lens="radail"), "there is no lens 'radail': did you mean 'radial'?"),
    (lambda c, o: cc.Options(loss="hubre"), "there is no loss 'hubre': did you mean 'huber'?"),
    (lambda c, o: any_cc.Options(lens="radial", powers=2), "Options(powers=...): Expected a list, got a whole number"),
    (lambda c, o: any_cc.check(o, c), "calibration must be a Calibration, not an Observations: exchange calibration"),
    (lambda c, o: any_cc.refit("old.json", o), "read the file with Calibration.load"),
    (lambda c, o: any_cc.refit(c, o, "zom"), "what must be 'auto' or 'pose' or 'pose-only'"),
    (lambda c, o: any_cc.compare(c, "b.json"), "b must be a Calibration, not str 'b.json': read the file"),
    (lambda c, o: any_cc.score(o, c), "exchange calibration and observations"),
    (lambda c, o: any_cc.diagnose(c, "o.json"), "observations must be an Observations"),
    (lambda c, o: any_cc.join(o, "left.json"), "join(): give Observations, one or more: read files with"),
    (lambda c, o: c.station("overhaed"), "there is no station 'overhaed': did you mean 'overhead'?"),
    (lambda c, o: c.station().locate([[1.0, 2.0, 3.0]]), "pixels must have shape (N, 2), not (1, 3)"),
    (lambda c, o: c.station().locate("640,480"), "pixels must be numbers, not str '640,480'"),
    (lambda c, o: c.station().locate([[640, 480]], 150), "for 150 mm give 0.15"),
    (lambda c, o: c.station().locate([[640, 480]], float("nan")), "height_m must be a number of metres, such as 0.15"),
    (lambda c, o: c.station().locate(np.array([[1j, 2.0]])), "pixels must be numbers, not ndarray array([[0.+1.j"),
    (lambda c, o: any_cc.Camera.undistort_maps(c.station(), 600.0), "matrix must be K (3, 3) of a camera, which has"),
    (lambda c, o: c.station().undistort_maps(np.zeros((3, 3))), "matrix must be K (3, 3) of a camera, which has"),
    (lambda c, o: any_cc.Camera.undistort_maps(c.station(), None, np.array([4, 0])), "size must be (width, height)"),
    (lambda c, o: c.station().project([[1.0, 2.0]]), "points_world must have shape (N, 3), not (1, 2)"),
    (lambda c, o: any_cc.Camera.from_opencv(1280, np.eye(3), np.zeros(5)), "image_size must be (width, height) in px"),
    (lambda c, o: cc.Observations.from_points(np.ones((53, 2)), BOARD, SIZE), "53 pixels for 54 points: give one for"),
    (lambda c, o: any_cc.Observations.from_points(np.ones((54, 2)), BOARD, 1280), "two positive whole numbers"),
    (lambda c, o: any_cc.Observations.from_points(None, BOARD, SIZE), "pixels must be an array (N, 2), or a list or"),
    (lambda c, o: cc.Observations.from_curves({"HalfwayLin": [[1, 2]]}, FIELD, SIZE), "did you mean 'HalfwayLine'?"),
    (lambda c, o: cc.Observations.from_curves({"HalfwayLine": [1, 2]}, FIELD, SIZE), "line 'HalfwayLine': pixels must"),
    (lambda c, o: any_cc.Observations.from_curves([[1, 2]], FIELD, SIZE), "pixels must be a Mapping, not a list"),
    (lambda c, o: boards() + boards(), "both show target 'board' in frame '0' of camera 'camera': give the frames"),
    (lambda c, o: any_cc.checkerboard(9.5, 6, 0.1), "columns must be a whole number, not float 9.5"),
    (lambda c, o: cc.ssl_field("C"), "unknown division 'C': A or B"),
    (lambda c, o: any_cc.detect_field("x.png", FIELD, facing={"LeftGoalLin": "top"}), "did you mean 'LeftGoalLine'?"),
    (lambda c, o: cc.detect_field("x.png", FIELD, facing={"LeftGoalLine": "up"}), "there is no side 'up': choose one"),
    (lambda c, o: cc.detect_field("x.png", FIELD, not_painted=["Halfway"]), "did you mean 'HalfwayLine'?"),
    (lambda c, o: cc.detect_board("nowhere/", BOARD), "nowhere/: no such file"),
    (lambda c, o: cc.export(c, "opencvv", "camera.yml"), "there is no export format 'opencvv': did you mean 'opencv'?"),
    (lambda c, o: cc.Calibration.load(SAMPLE), "it holds observations, where a calibration must be given"),
    (lambda c, o: any_cc.Calibration.load(None), "path must be a path, not NoneType"),
    (lambda c, o: any_cc.write_report(c, o, "x.html"), "path must be a text or a path, not a Calibration"),
    (lambda c, o: cc.Pose(np.eye(2), np.zeros(3)), "rotation must have shape (3, 3), not (2, 2)"),
    (lambda c, o: c.station().plot("residuals"), "ax must be Matplotlib's Axes, not str"),
]


def boards() -> cc.Observations:
    return cc.Observations.from_points(100.0 + np.random.default_rng(1).uniform(0.0, 500.0, (54, 2)), BOARD, SIZE)


@pytest.mark.parametrize("mistake, said", IN_PYTHON, ids=range(len(IN_PYTHON)))
def test_in_python(calibration: cc.Calibration, observations: cc.Observations, mistake: Mistake, said: str) -> None:
    with pytest.raises(cc.InputError) as raised:
        mistake(calibration, observations)
    assert said in str(raised.value) and "\n" not in str(raised.value)


def test_a_misspelled_name_of_the_package() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'calibrat': did you mean 'calibrate'"):
        any_cc.calibrat  # noqa: B018


# ---- on the command line --------------------------------------------------------------------------------------------

ON_THE_COMMAND_LINE = [
    ("x" * 300, "see `ceres-cal --help`"),
    ("PHOTO", "a command comes first, such as `ceres-cal run` before photographs"),
    ("calibrat OBS", "there is no command 'calibrat': did you mean 'calibrate'?"),
    ("detect boards x.png", "detect what: did you mean 'detect board'?"),
    ("detect", "detect what: one of detect board, detect rings, detect field?"),
    ("calibrate OBS --lense radial", "did you mean '--lens'?"),
    ("calibrate OBS --auto", "--auto, which is an option of `detect field`: leave it out"),
    ("calibrate OBS --force", "unrecognized arguments: --force: see `ceres-cal calibrate --help`"),
    ("calibrate OBS --lens radial --lens brown", "argument --lens: it is given twice, radial and brown: leave one out"),
    ("calibrate ''", "argument OBS: '' is not a file"),
    ("calibrate OBS --threads -1", "argument --threads: '-1' is not a whole number of 0 or more"),
    ("calibrate OBS --max-iterations 0", "argument --max-iterations: '0' is not a whole number of 1 or more"),
    ("publish CAL --port 0", "argument --port: '0' is not a whole number from 1 to 65535"),
    ("detect board PHOTO -o OUT.json --board 9x6x25mm", "--board 9x6x25mm: here it is --target"),
    ("detect board PHOTO -o OUT.json --columns 1.5", "argument --columns: '1.5' is not a whole number"),
    ("run PHOTOS --columns 9 -o OUT", "--columns 9: here it is --board"),
    ("export CAL --format opencv --to opencv -o OUT", "--format opencv: here it is --to"),
    ("batch nowhere.json -o OUT", "nowhere.json: no such file"),
    ("batch README -o OUT", "README.md: a plan is a folder, or a table in .jsonl, .csv or .toml"),
    ("publish CAL --geometry OBS --once", "observations.json: not a SSL_WrapperPacket"),
    ("listen -o OUT.json --seconds nan", "argument --seconds: 'nan' is not a finite number"),
    ("calibrate OBS -o -", "argument -o/--output: '-' is not a file: give its name (./- where that is -)"),
    ("calibrate OBS --lens radail", "did you mean 'radial'?"),
    ("calibrate OBS --loss hubre", "did you mean 'huber'?"),
    ("calibrate nowhere.json", "nowhere.json: no such file"),
    ("calibrate CAL", "it holds a calibration, where observations must be given: were two arguments exchanged?"),
    ("check OBS CAL", "it holds observations, where a calibration must be given: were two arguments exchanged?"),
    ("locate OBS 1,2", "it holds observations, where a calibration must be given"),
    ("locate CAL 640", "give 2 numbers with commas between, such as 640,480"),
    ("locate CAL 640,480 --station overhaed", "there is no station 'overhaed': did you mean 'overhead'?"),
    ("locate CAL 640,480 --height-mm 15x", "'15x' is not a length: write a number of mm, or 5m, 150mm"),
    ("calibrate OBS --prior heigth_m=4:0.01", "there is no quantity 'heigth_m': did you mean 'height_m'?"),
    ("calibrate OBS --prior height_m=4", "write OWNER.NAME=VALUE:SIGMA, such as overhead.height_m=4.02:0.01"),
    (
        "calibrate OBS --tolerance field.line_m=0.01",
        "write TARGET.lines_m|points_m|warp_m|heights_m|stretch_m=SIGMA, such as",
    ),
    ("calibrate OBS --fix k3", "--fix 'k3': write NAME=VALUE, such as k3=0"),
    ("calibrate OBS -o nowhere/c.json", "there is no folder 'nowhere': make it first"),
    ("calibrate OBS --report page.pdf", "page.pdf: a report is written as .html or .htm: give one of these endings"),
    ("run PHOTOS --target ssl-c -o OUT", "there is no target 'ssl-c': did you mean 'ssl-b'?"),
    ("run PHOTOS --target ssl-b --facing LeftGoalLin=top -o OUT", "did you mean 'LeftGoalLine'?"),
    ("run PHOTOS --target ssl-b --facing LeftGoalLine=up -o OUT", "there is no side 'up': choose one of left, right"),
    ("run PHOTOS --target ssl-b --not-painted Halfway -o OUT", "there is no line 'Halfway': did you mean"),
    ("run PHOTOS --target pitch -o OUT", "(or a board such as 9x6x25mm, or a file)"),
    (
        "run PHOTOS --target 4x6x30mm --facing LeftGoalLine=top -o OUT",
        "boards and markers are found by `detect board`, or `run --board 9x6x25mm`",
    ),
    ("run PHOTOS --target pitch.json -o OUT", "pitch.json: no such file"),
    ("run PHOTOS --board 9x6 -o OUT", "board '9x6': write COLUMNSxROWSxSQUARE, such as 9x6x25mm"),
    ("run PHOTOS --board 9x6x25mm --to opencvv -o OUT", "there is no export format 'opencvv': did you mean 'opencv'?"),
    ("run PHOTOS --board 9x6x25mm --lens radail -o OUT", "did you mean 'radial'?"),
    ("run PHOTOS --board 9x6x25mm --prior heigth_m=3:0.1 -o OUT", "did you mean 'height_m'?"),
    ("run PHOTOS -o OUT", "say what the photographs show: --target ssl-b, --board 9x6x25mm, or both"),
    ("detect field PHOTO --target ssl-b --auto --not-painted LeftGoalLin -o OUT.json", "did you mean 'LeftGoalLine'?"),
    ("detect board PHOTO -o OUT.json", "--columns N and --rows N, or --target TARGET: say what the board is"),
    ("export CAL --to opencvv -o camera.yml", "there is no export format 'opencvv': did you mean 'opencv'?"),
    ("targets ssl-c", "there is no target 'ssl-c': did you mean 'ssl-b'?"),
    ("targets print ssl-b -o OUT.pdf", "is not printed on paper: print a board, circles or rings"),
    ("undistort CAL PHOTO --camera overhaed -o OUT", "there is no camera 'overhaed': did you mean 'overhead'?"),
    ("simulate ssl-feild -o OUT", "there is no scene 'ssl-feild': did you mean 'ssl-field'?"),
    ("calibrate INCHES", "'inches' cannot be read: give the file in 'metres, radians, pixels', in units"),
    ("import CAL -o OUT.json", "a file of ceres-cal, not of another program: give it without an import"),
    ("locate README 1,2", "no calibration of ceres-cal: `ceres-cal import` makes one of another program's"),
    ("export CAL --to ssl-vision -o OUT.pb --camera-id -1", "give overhead a whole number from 0 on, no two alike"),
    ("targets print 900x600x25mm -o OUT.pdf", "at most 100000 points and curves, not 540000: split it"),
    ("calibrate PHOTOS", "not observations (.json, .npz or a folder .columns): `ceres-cal import` makes them of a CSV"),
    ("calibrate LATIN", "latin.json: not valid JSON: byte 1 is not UTF-8: save it"),
    ("""detect board PHOTO --target '{"kind": "chekerboard"}' -o OUT.json""", "did you mean 'checkerboard'?"),
    ("detect board PHOTO --target UTF16 -o OUT.json", "utf16.json: unknown kind 'ringz': did you mean 'rings'?"),
    ("calibrate NO_FRAME", "'frame' is missing (name of the photograph) in views[3]"),
    ("calibrate NO_SIZE", "'image_size' is missing (width and height in px) in cameras.overhead"),
]


@pytest.fixture(scope="module")
def names(calibration: cc.Calibration, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("mistakes")
    calibration.save(folder / "calibration.json")
    sample = json.loads(SAMPLE.read_text(encoding="utf-8"))
    frame = sample["views"][3].pop("frame")
    (folder / "no_frame.json").write_text(json.dumps(sample), encoding="utf-8")
    sample["views"][3]["frame"] = frame
    del sample["cameras"]["overhead"]["image_size"]
    (folder / "no_size.json").write_text(json.dumps(sample), encoding="utf-8")
    (folder / "latin.json").write_bytes('"é"'.encode("latin-1"))
    (folder / "utf16.json").write_text('{"kind": "ringz"}', encoding="utf-16")
    (folder / "inches.json").write_text(json.dumps({**sample, "units": "inches"}), encoding="utf-8")
    return {
        "INCHES": str(folder / "inches.json"),
        "LATIN": str(folder / "latin.json"),
        "UTF16": str(folder / "utf16.json"),
        "OBS": str(SAMPLE),
        "CAL": str(folder / "calibration.json"),
        "PHOTOS": str(PHOTOGRAPHS),
        "PHOTO": str(PHOTOGRAPHS / "0001.jpg"),
        "OUT": str(folder / "out"),
        "OUT.json": str(folder / "out.json"),
        "README": str(ROOT / "README.md"),
        "OUT.pb": str(folder / "out.pb"),
        "OUT.pdf": str(folder / "out.pdf"),
        "NO_FRAME": str(folder / "no_frame.json"),
        "NO_SIZE": str(folder / "no_size.json"),
    }


@pytest.mark.parametrize("typed, said", ON_THE_COMMAND_LINE)
def test_on_the_command_line(capsys: pytest.CaptureFixture[str], names: dict[str, str], typed: str, said: str) -> None:
    code = main([names.get(word, word) for word in shlex.split(typed)])
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and err.count("\n") == 1 and said in err, err


READS_A_FILE = (
    "advise NO, audit NO --observations OBS, audit CAL --observations NO, batch NO -o OUT, calibrate NO -o OUT.json, "
    "check NO OBS, check CAL NO, compare NO CAL, compare CAL NO, detect board NO --target 9x6x25mm -o OUT.json, "
    "detect field NO --target ssl-b --auto -o OUT.json, detect rings NO --radii 1:2:1 -o OUT.json, diagnose NO OBS, "
    "diagnose CAL NO, export NO --to opencv -o OUT.yml, export-table NO -o OUT.npz, import NO -o OUT.json, "
    "join NO OBS -o OUT.json, locate NO 1_2, locate CAL --file NO, open NO, project CAL --file NO, publish NO --once, "
    "refit NO OBS -o OUT.json, refit CAL NO -o OUT.json, run NO --target ssl-b -o OUT, score NO OBS, score CAL NO, "
    "simulate NO -o OUT, targets NO, targets import NO -o OUT.json, targets print NO -o OUT.pdf, "
    "undistort NO PHOTO -o OUT, undistort CAL NO -o OUT"
)


@pytest.mark.parametrize("typed", READS_A_FILE.split(", "))
@pytest.mark.parametrize("missing", ["nowhere.json", "nowhere.xyz"])
def test_a_file_that_is_missing_is_named(
    capsys: pytest.CaptureFixture[str], names: dict[str, str], typed: str, missing: str
) -> None:
    assert main([{**names, "NO": missing, "1_2": "1,2"}.get(word, word) for word in typed.split()]) == 2
    assert f"{missing}: no such file" in capsys.readouterr().err


def test_options_elsewhere_are_those_of_other_commands() -> None:
    parsers = {name: Parser(add_help=False) for name in COMMANDS}
    for name, parser in parsers.items():
        COMMANDS[name].fill(parser)
    for name, parser in parsers.items():
        for option, own in parser.elsewhere.items():
            owners = [one for one, other in parsers.items() if option in other._option_string_actions]
            assert own in parser._option_string_actions and owners and name not in owners, (name, option)


def test_thirty_of_each() -> None:
    assert min(len(IN_PYTHON), len(ON_THE_COMMAND_LINE)) >= 30


def test_quiet_is_one_line(capsys: pytest.CaptureFixture[str], names: dict[str, str], tmp_path: Path) -> None:
    assert main(["calibrate", names["OBS"], "--quiet", "-o", str(tmp_path / "c.json")]) == 0
    out, err = capsys.readouterr()
    assert err == "" and out.count("\n") == 1 and out.startswith("This calibration can be trusted: to ")
    assert main(["check", names["CAL"], names["OBS"], "--quiet"]) == 0
    assert capsys.readouterr().out == "The calibration holds (1 % false alarms).\n"


def test_a_board_is_printed_as_it_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["targets", "print", "9x6x35mm", "-o", str(tmp_path / "board.pdf"), "--json"]) == 0
    spec = json.loads(capsys.readouterr().out)["spec"]
    assert spec == {"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.035}
