"""Cases for scripts/fuzz.py: a corpus of good files, commands for them, and changes of their words."""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import shlex
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from data.built_in_scenes import scene_to_json
from ssl_settings_file import settings

from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.files import write_json
from ceres_cal.base.words import printable
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main as cli
from ceres_cal.cli.command import COMMANDS, Parser
from ceres_cal.detect.images import read_colour, read_grey
from ceres_cal.detect.photographs.by_hand import load_clicks
from ceres_cal.formats import LookupTable, export, make_lookup_table, read_foreign
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.targets import TARGET_KINDS, target_from_spec, targets_from_specs
from ceres_cal.simulate import built_in_scene, load_scene, simulate
from faults.fuzz_mutations import NUMBERS, OTHERS, TEXTS, Rng, mutated, one_of, tree_changed, word_changed

DATA = Path(__file__).resolve().parents[2] / "data"
Reader = Callable[[Path], object]


# ---- what is read ---------------------------------------------------------------------------------------------------


def _image(path: Path) -> None:
    read_grey(path)
    read_colour(path)


def _foreign(form: str, **options: Any) -> Reader:
    return lambda path: read_foreign(path, form, **options)


def _model(path: Path) -> object:
    return read_foreign(path.parent, "colmap")


EXPORTED = {"opencv.yml": "opencv", "opencv.xml": "opencv", "opencv.json": "opencv", "ros.yaml": "ros"}
EXPORTED |= {"chain.yaml": "kalibr", "own.cameramodel": "mrcal", "paper.txt": "paper"}
EXPORTED |= {"geometry.pb": "ssl-vision", "geometry.yml": "vision-processor"}
BOARD: dict[str, Any] = {"columns": 2, "rows": 2, "square": 0.1, "image_size": "640x480"}
IMAGES = tuple(f"image{ending}" for ending in (".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm", ".ppm", ".jp2"))
MODEL = tuple(f"colmap/{part}.txt" for part in ("cameras", "frames", "images", "rigs"))
READERS: dict[str, Reader] = {
    **{name: _foreign(form) for name, form in EXPORTED.items()},
    "corners.vnl": _foreign("corners-vnl", **BOARD),
    "table.csv": _foreign("csv", target="ssl-b", image_size="640x480"),
    "columns.npz": _foreign("npz-columns", image_size="640x480"),
    "boards.cameramodel": _foreign("mrcal-observations"),
    "camera.xml": _foreign("ssl-vision-xml"),
    **dict.fromkeys(MODEL, _model),
    "observations.json": Observations.load,
    "observations.npz": Observations.load,
    "calibration.json": Calibration.load,
    "table.npz": LookupTable.load,
    "scene.json": load_scene,
    "corners.json": load_clicks,
    **dict.fromkeys(IMAGES, _image),
}
FORMATS: dict[str, Reader] = {
    "ceres-cal/observations": Observations.load,
    "ceres-cal/calibration": Calibration.load,
}
"""Our readers must accept what our own commands write."""
OTHER_FILES = {
    "corners.vnl": b"# filename x y level\n" + b"".join(b"a.png %d 20 %d\n" % (10 * n, n % 2) for n in range(4)),
    "table.csv": b"frame,point,curve,x_px,y_px,sigma_px\n1,TopLeftCorner,,9,5,0.3\n1,,TopTouchLine,12,5,\n",
    "pixels.csv": b"640,480\n100.5,100\n",
    "plan.csv": b"name,command,arguments\na,calibrate,custom.json --lens brown\nb,check,calibration.json custom.json\n",
    "plan.jsonl": b'{"name": "a", "command": "calibrate", "arguments": ["custom.json", "--lens", "radial"]}\n',
    "plan.toml": b'[[job]]\nname = "a"\ncommand = "refit"\narguments = "calibration.json observations.json"\n',
}


def _custom() -> dict[str, Any]:
    """Points, a line, an arc and a pole, with priors, seen by a camera of 640 x 480 px."""
    corners = {f"p{x}{y}": [float(x), float(y), 0.0] for x in range(4) for y in range(3)}
    line = {"from": [0.0, 0.0, 0.0], "to": [3.0, 0.0, 0.0], "width_m": 0.02}
    arc = {"centre": [1.0, 1.0, 0.0], "radius_m": 0.5, "from_rad": 0.0, "to_rad": 3.0, "width_m": 0.02}
    target = {
        "kind": "custom",
        "points": corners | {"pole": [1.0, 2.0, 0.5]},
        "segments": {"s": line},
        "arcs": {"a": arc},
    }
    depth, phi = 4.0, 500.0

    def seen(x: float, y: float, z: float = 0.0) -> list[float]:
        return [320.0 + phi * (x - 1.4) / (depth - z), 240.0 - phi * (y - 1.1) / (depth - z + 0.1 * y)]

    shown = {"features": [*corners, "pole"], "pixels": [seen(*p) for p in [*corners.values(), (1.0, 2.0, 0.5)]]}
    on_line = [seen(x, 0.0) for x in np.linspace(0.0, 3.0, 9).tolist()]
    curves = {"features": ["s"], "counts": [9], "pixels": on_line, "side": "centre", "sigma_px": [0.3] * 9}
    view = {"frame": "1", "camera": "c", "station": "s", "target": "field", "points": shown, "curves": curves}
    return {
        "format": "ceres-cal/observations",
        "version": 1,
        "targets": {"field": target},
        "cameras": {"c": {"image_size": [640, 480]}},
        "views": [view],
        "priors": [{"station": "s", "height_m": [4.0], "sigma_m": 0.05}],
    }


def _few_boards() -> dict[str, Any]:
    """The field and four boards of the sample."""
    data: dict[str, Any] = json.loads((DATA / "ssl_field" / "observations.json").read_text())
    views = data["views"]
    boards = [view for view in views if view["target"] != "field"][:4]
    for view in boards:
        view["points"]["features"] = view["points"]["features"][::2]
        view["points"]["pixels"] = view["points"]["pixels"][::2]
    return data | {"views": [view for view in views if view["target"] == "field"][:1] + boards}


def corpus(folder: Path) -> None:
    """One good file for each reader, and the other inputs of commands."""
    observations = Observations.load(DATA / "ssl_field_moved" / "observations.json")
    for ending in (".json", ".npz", ".columns"):
        observations.save(folder / f"observations{ending}")
    calibration = calibrate(observations, Options(lens="radial"))
    calibration.save(folder / "calibration.json")
    x, y = np.array([-4.5, 4.5]), np.array([-3.0, 3.0])
    station = next(iter(calibration.stations))
    make_lookup_table(calibration.stations[station], station, x, y, step_px=128).save(folder / "table.npz")
    exact = calibrate(observations, Options(lens="brown"))  # OpenCV has the same lens, so that exports are exact
    for name, form in EXPORTED.items():
        of_league = "geometry" in name or form == "paper"
        options: dict[str, Any] = {"camera_id": "0"} if "geometry" in name else {}
        export(calibration if of_league else exact, form, folder / name, [station], **options)
    export(exact, "colmap", folder / "colmap", [station])
    (folder / "camera.xml").write_text(settings(cameras=1))
    _foreign_observations(folder)
    write_json(folder / "scene.json", scene_to_json(*built_in_scene("ssl-field")))
    corners = {name: [10.0 * number, 20.0] for number, name in enumerate("abcd")}
    write_json(folder / "corners.json", {"format": "ceres-cal/corners", "version": 1, "points": corners})
    _pictures(folder)
    _of_commands(folder)


def _of_commands(folder: Path) -> None:
    write_json(folder / "custom.json", _custom())
    write_json(folder / "few_boards.json", _few_boards())
    markers = {"7": {"at_m": [0.0, 0.0], "side_m": 0.1}}
    write_json(folder / "markers.json", {"kind": "markers", "dictionary": "DICT_4X4_50", "markers": markers})
    two = simulate(*built_in_scene("two-cameras"), seed=0).observations
    rows = np.arange(len(two.points)) % 4 == 0, np.arange(len(two.curves)) % 4 == 0
    two.part(*rows).save(folder / "two.json")
    calibrate(Observations.load(folder / "two.json"), Options(lens="radial")).save(folder / "two_cameras.json")
    above = Observations.load(DATA / "field_2004" / "field.json")
    found = calibrate(above, Options(lens="radial"))
    found.save(folder / "from_above.json")
    target, camera = above.targets["field"], next(iter(found.stations.values()))
    write_json(folder / "field.json", target.spec)
    seen = dict(zip(target.point_names, camera.project(np.array(list(target.points.values()))).tolist(), strict=True))
    clicked = {name: place for name, place in seen.items() if 0 < place[0] < 780 and 0 < place[1] < 580}
    write_json(folder / "clicks.json", {"format": "ceres-cal/corners", "version": 1, "points": clicked})


def _pictures(folder: Path) -> None:
    photograph = next((DATA / "ssl_field_moved" / "photographs").iterdir())
    shutil.copyfile(photograph, folder / "0001.jpg")
    small = cv2.resize(read_colour(photograph), (64, 48))
    for name in IMAGES:
        cv2.imwrite(str(folder / name), small if not name.endswith(".pgm") else small[:, :, 0])
    places = {"photograph.jpg": "field_2004/photographs/0001.jpg", "rings.jpg": "field_2004/photographs/rings.jpg"}
    places["board.jpg"] = "ssl_field/photographs/board_01.jpg"
    for name, place in places.items():
        image = read_colour(DATA / place)
        cv2.imwrite(str(folder / name), image if name == "photograph.jpg" else cv2.resize(image, None, fx=0.5, fy=0.5))


def _foreign_observations(folder: Path) -> None:
    for name, content in OTHER_FILES.items():
        (folder / name).write_bytes(content)
    x, y = np.arange(4.0), np.ones(4)
    np.savez(folder / "columns.npz", x_px=x, y_px=y, X_m=x, Y_m=y)
    stream, sizes = io.BytesIO(), np.array([[640, 480]])
    inputs: dict[str, Any] = {"observations_board": np.ones((1, 2, 2, 3)), "calibration_object_spacing": np.array(0.1)}
    indices = np.array([[0, 0, -1]])
    np.savez(stream, **inputs, imagersizes=sizes, indices_frame_camintrinsics_camextrinsics=indices)
    packed = {"optimization_inputs": base64.b85encode(stream.getvalue())}
    (folder / "boards.cameramodel").write_text(repr(packed))


# ---- what is run ----------------------------------------------------------------------------------------------------


def round_trip(loaded: object, path: Path) -> bool:
    """Whether an accepted object is the same, to the last byte, after it is saved and loaded again."""
    if not isinstance(loaded, Observations | Calibration | LookupTable):
        return True
    ending = ".npz" if path.suffix == ".npz" else ".json"
    again = [path.with_name(f".again{number}{ending}") for number in (1, 2)]
    loaded.save(again[0])
    type(loaded).load(again[0]).save(again[1])
    same = again[0].read_bytes() == again[1].read_bytes()
    for place in again:
        place.unlink()
    return same


def read(words: list[str]) -> int:
    """A reader without a command, called from Python: `read KIND FILE`; a refusal must begin with the file's name."""
    path = Path(words[1])
    try:
        loaded = READERS[words[0]](path)
    except CalibrationError as error:
        # For a model of several files the message names its folder, or the wrong file.
        named, folder = (" ".join(printable(str(one)).split()) for one in (path, path.parent))  # as in messages
        if not str(error).startswith((named, f"{folder}:", f"{folder}/")):
            raise AssertionError(f"a refusal that does not name its file: {error}") from None
        raise
    if not round_trip(loaded, path):
        raise AssertionError("what was accepted does not come back from a file of its own")
    return 0


def options_of_python(words: list[str]) -> int:
    """`options NAME=JSON ...`: options given in Python, of any type."""
    given = dict(word.split("=", 1) for word in words)
    Options(**{name: json.loads(value) for name, value in given.items()})
    return 0


def target_of_python(words: list[str]) -> int:
    """`target JSON`: a target given in Python."""
    for word in words:
        target_from_spec(json.loads(word), "a target")
        targets_from_specs({"field": json.loads(word)})
    return 0


PROGRAMS: Mapping[str, Callable[[list[str]], int]] = {
    "read": read,
    "options": options_of_python,
    "target": target_of_python,
}
COMMAND_LINES: tuple[tuple[float, str], ...] = (
    *((0.6, f"read {name} {name}") for name in READERS),
    (2, "options"),
    (1, "target"),
    (6, "calibrate custom.json -o out.json --lens radial"),
    (3, "calibrate observations.json -o out.json --lens radial --prior height_m=4.02:0.02 --json"),
    (2, "calibrate observations.json -o out.json"),
    (2, "calibrate observations.npz -o out.json --lens radial"),
    (2, "calibrate observations.columns -o out.json --lens radial"),
    (2, "calibrate few_boards.json -o out.json --lens brown --fix k3=0 --tolerance field.lines_m=0.01"),
    (0.5, "calibrate two.json -o out.json --lens radial --report page.html"),
    (3, "join few_boards.json -o out.json"),
    (3, "join two.json -o out.npz --same-frame index"),
    (2, "diagnose calibration.json observations.json -o out.csv"),
    (1, "diagnose calibration.json observations.json --report page.html --images 0001.jpg"),
    (0.4, "advise from_above.json --board 9x6x100 --good-enough-mm 1"),
    (3, "refit calibration.json observations.json -o out.json --prior overhead.height_m=4.02:0.02"),
    (1, "refit two_cameras.json two.json -o out.json --moved left --hold-others"),
    (3, "check calibration.json observations.json --json"),
    (0.7, "check from_above.json photograph.jpg"),
    (2, "score calibration.json observations.json"),
    (2, "compare calibration.json calibration.json"),
    (2, "audit opencv.yml --observations observations.json --image-size 1280x960"),
    (1, "audit calibration.json --observations observations.json"),
    (1, "batch plan.csv -o out --jobs 1 --quiet"),
    (1, "batch plan.toml -o out --jobs 1 --options '--lens radial'"),
    (1, "batch plan.jsonl -o out --jobs 1 --json"),
    (4, "locate calibration.json 640,480 100,100 --height-mm 150"),
    (2, "locate calibration.json --file pixels.csv --json"),
    (3, "project calibration.json -2.5,1.0 -2.5,1.0,0.15"),
    (2, "locate two_cameras.json 640,480 --station left"),
    (1, "undistort from_above.json photograph.jpg -o out --size 100x80"),
    (1, "undistort from_above.json photograph.jpg -o out --top-view --mm-per-px 50 --area -1,-1,1,1"),
    (1, "undistort from_above.json photograph.jpg -o out --overlay --before from_above.json"),
    (1, "undistort from_above.json photograph.jpg -o out --whole --angle 100 --format jpg"),
    *((0.7, f"export calibration.json --to {form} -o {name}") for name, form in EXPORTED.items()),
    (0.7, "export calibration.json --to colmap -o model --max-loss-mm 5"),
    (0.7, "export calibration.json --to ssl-vision-xml -o camera.xml --camera-id 0"),
    (1, "export-table calibration.json -o table.npz --step-px 64"),
    *((0.7, f"import {name} -o out.json") for name in EXPORTED),
    (1, "import opencv.yml -o out.json --image-size 1280x960 --camera a"),
    (1, "import corners.vnl -o out.json --columns 2 --rows 2 --square 0.1 --image-size 640x480"),
    (1, "import table.csv -o out.json --target ssl-b --image-size 640x480"),
    (1, "import columns.npz --from npz-columns -o out.npz --image-size 640x480 --moves true"),
    (1, "import boards.cameramodel --from mrcal-observations -o out.json"),
    (1, "import camera.xml -o out.json --image-size 1280x960"),
    (1, "import colmap -o out.json"),
    (1, "targets import geometry.yml -o out.json"),
    (0.5, "targets import camera.xml -o out.json"),
    (1, "publish calibration.json --camera-id 0 --geometry geometry.yml ;; --once --interface 127.0.0.1"),
    (0.5, "listen -o out.json ;; --seconds 0.05 --interface 127.0.0.1"),
    (1.5, "simulate scene.json -o out --seed 3"),
    (0.3, "simulate rings-2004 -o out --images png"),
    (1, "targets ssl-b --picture out.svg"),
    (1, "targets custom.json"),
    (1, 'targets print \'{"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.025}\' -o out.pdf'),
    (0.5, "completion bash"),
    (0.7, "detect board board.jpg --columns 9 --rows 6 --square 100mm -o out.json --timeout 10"),
    (0.3, "detect board board.jpg --target markers.json -o out.json --timeout 10"),
    (0.5, "detect rings rings.jpg --radii 0.01:0.36:0.01 -o out.json --timeout 10"),
    (0.7, "detect field photograph.jpg --start from_above.json -o out.json --timeout 10"),
    (0.7, "detect field photograph.jpg --target field.json --start clicks.json -o out.json --timeout 10"),
    (
        0.2,
        "detect field photograph.jpg --start from_above.json --auto -o out.json --timeout 10",
    ),
    (0.05, "run photograph.jpg --target field.json --facing LeftGoalLine=left -o out --to opencv --lens radial"),
)
"""Weight and command line; the part after ;; is never changed, so that commands without an end stop."""
PLAUSIBLE: dict[str, tuple[str, ...]] = {
    "--prior": ("height_m=4.02:0.02", "phi=812:5", "position_m=0,0,4:1,1,0.1", "k1=0:1e-3", "aspect=1:0.01"),
    "--tolerance": ("field.lines_m=0.01", "field.points_m=0.005", "board.warp_m=0.002"),
    "--fix": ("phi=800", "k3=0", "a2=0", "cx=640", "skew=0", "aspect=1"),
    "--estimate": ("length", "width=5.5", "length,width=5.50:20mm", "field_length_m"),
    "--powers": ("2,3", "3", "3,5", "2,3,4,5"),
    "--lens": ("auto", "radial", "brown", "kannala-brandt", "?"),  # a spline takes seconds
    "--terms": ("rational", "prism", "tangential", "surface"),
    "--jobs": ("1", "-1"),  # other processes are tested by scripts/faults/week.py
    "--scheduler": ("tcp://127.0.0.1:1", "x"),
    "--same-frame": ("index", "within:0.01", "left*,right*", "*"),
    "--corner": ("TopLeftCorner=102,88", "CenterMark=10,10"),
    "--radii": ("0.01:0.1:0.01", "0.05,0.1"),
    "--size": ("100x80", "1x1"),
    "--board": ("9x6x100", "2x2x1"),
    "--station": ("overhead", "left"),
    "--camera": ("overhead", "left", "c"),
    "--from": (*EXPORTED.values(), "csv", "npz-columns"),
    "--mask": ("image.png", "photograph.jpg"),
    "--images": ("photograph.jpg", "image.png"),
    "--observations": ("observations.json", "custom.json"),
    "--before": ("from_above.json",),
    "--geometry": ("geometry.pb", "geometry.yml"),
    "--file": ("pixels.csv",),
    "--target": ("ssl-b", "field.json", '{"kind": "ssl-field", "division": "A"}', '{"kind": "checkerboard"}'),
    "--address": ("127.0.0.1", "224.5.23.2"),
    "--interface": ("127.0.0.1",),
    "--seconds": ("0.1",),
}


@dataclass(frozen=True)
class Case:
    """One command: its words, some of which are files in the folder where it runs; and the changes that were made."""

    program: str
    words: tuple[str, ...]
    changes: tuple[str, ...]

    @property
    def name(self) -> str:
        known = [" ".join(self.words[:count]) for count in (2, 1)]
        return next((name for name in known if name in COMMANDS), self.program)

    def run(self) -> int:
        """Its exit code; exceptions are not caught, since they are what is looked for."""
        if not self.program:
            return cli(list(self.words))
        return PROGRAMS[self.program](list(self.words))


# ---- changes --------------------------------------------------------------------------------------------------------


def make_case(good: Path, place: Path, rng: Rng) -> Case:
    """A command in an empty folder with copies of the good files that it names, with one to three changes."""
    weights = np.array([weight for weight, _ in COMMAND_LINES])
    line = COMMAND_LINES[int(rng.choice(len(weights), p=weights / weights.sum()))][1]
    changing, _, kept = line.partition(" ;; ")
    words = shlex.split(changing)
    program = words.pop(0) if words[0] in PROGRAMS else ""
    if program in ("options", "target"):
        return Case(program, tuple(_of_python(program, rng)), ())
    files = {word for word in words[1:] if (good / word).exists()}
    for name in {*files, *(("custom.json", "calibration.json", "observations.json") if "batch" in words else ())}:
        _copy(good / name, place / name)
    changes = []
    for _ in range(int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))):
        of_words = _FILES if program == "read" else _CHANGES
        chosen = of_words[int(rng.choice(len(of_words), p=_shares(of_words)))][1]
        words = chosen(words, good, place, rng)
        changes.append(chosen.__name__.strip("_"))
    return Case(program, (*words, *shlex.split(kept)), tuple(changes))


def _shares(changes: tuple[tuple[float, Any], ...]) -> Any:
    weights = np.array([weight for weight, _ in changes])
    return weights / weights.sum()


def _copy(source: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.exists() or place.is_symlink():
        return
    if source.is_dir():
        shutil.copytree(source, place)
        return
    if source.parent.name == "colmap":  # the other files of a model stay unchanged
        shutil.copytree(source.parent, place.parent, dirs_exist_ok=True)
    shutil.copyfile(source, place)


def _files_in(place: Path) -> list[Path]:
    return sorted(path for path in place.rglob("*") if path.is_file() and not path.is_symlink())


def content_changed(words: list[str], good: Path, place: Path, rng: Rng) -> list[str]:
    """Changes the content of one of the files."""
    if files := _files_in(place):
        path = one_of(files, rng)
        name = str(path.relative_to(place))
        source = good / name
        path.write_bytes(mutated(name, source.read_bytes() if source.is_file() else path.read_bytes(), rng))
    return words


def file_exchanged(words: list[str], good: Path, place: Path, rng: Rng) -> list[str]:
    """Replaces one file by another."""
    names = sorted(str(path.relative_to(good)) for path in _files_in(good))
    if files := _files_in(place):
        shutil.copyfile(good / one_of(names, rng), one_of(files, rng))
    return words


def file_odd(words: list[str], good: Path, place: Path, rng: Rng) -> list[str]:
    """Replaces a file by something that is no file or no file of ours, or gives it an odd name."""
    files = _files_in(place)
    if not files:
        return words
    path, kind = one_of(files, rng), rng.integers(0, 9)
    if kind >= 7:
        odd = one_of(["\udce9", "a\nb", " ", "-x", "'", "x" * 240, "é", "*", "[a]"], rng)
        odd = f"{odd}{path.suffix}"
        name = str(path.relative_to(place))
        path.rename(place / odd)
        first = _first(words)
        return [*words[:first], *(odd if word == name else word for word in words[first:])]
    path.unlink()
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    elif kind == 2:
        path.symlink_to(path)
    elif kind == 3:
        path.touch()
    elif kind == 4:
        with path.open("wb") as stream:
            stream.truncate(10**10)
    elif kind == 5:
        path.symlink_to(one_of(["/dev/zero", "/dev/null", "/dev/full", "/proc/self/mem", place], rng))
    return words  # for other kinds the file is missing


def word_odd(words: list[str], good: Path, place: Path, rng: Rng) -> list[str]:
    """Changes or replaces one of the words after the command's name."""
    first = _first(words)
    at = int(rng.integers(first, max(len(words), first + 1)))
    if at < len(words):
        return [*words[:at], word_changed(words[at], rng), *words[at + 1 :]]
    return words


def words_odd(words: list[str], good: Path, place: Path, rng: Rng) -> list[str]:
    """Removes or repeats a word, or exchanges two."""
    first = _first(words)
    if len(words) <= first:
        return words
    (a, b), kind = (int(rng.integers(first, len(words))) for _ in range(2)), rng.integers(0, 3)
    if kind == 0:
        return [*words[:a], *words[a + 1 :]]
    if kind == 1:
        return [*words, words[a]]
    words[a], words[b] = words[b], words[a]
    return words


def option_added(words: list[str], good: Path, place: Path, rng: Rng) -> list[str]:
    """Adds an option of the command, with a plausible value or an odd one."""
    options = _options(" ".join(words[: _first(words)]))
    if not options:
        return words
    option = options[one_of(sorted(options), rng)]
    name = one_of(option.option_strings, rng)
    if option.nargs == 0:
        return [*words, name]
    plausible = PLAUSIBLE.get(option.option_strings[-1]) or tuple(option.choices or ()) or ("1", "0.5", "10")
    value = str(one_of(plausible, rng))
    if option.option_strings[-1] not in ("--jobs", "--seconds") and rng.random() < 0.3:
        value = word_changed(value, rng)
    elif (good / value).exists():
        _copy(good / value, place / value)
    return [*words, f"{name}={value}" if name.startswith("--") else f"{name}{value}"]


@cache
def _options(command: str) -> dict[str, argparse.Action]:
    if command not in COMMANDS:
        return {}
    parser = Parser(add_help=False)
    COMMANDS[command].fill(parser)
    return {action.option_strings[-1]: action for action in parser._actions if action.option_strings}


def _first(words: list[str]) -> int:
    """Number of words of the command's name; for a reader, one: its kind."""
    return 2 if " ".join(words[:2]) in COMMANDS else 1


def _of_python(program: str, rng: Rng) -> list[str]:
    """Options and targets of odd types."""
    if program == "target":
        kinds = [
            _custom()["targets"]["field"],
            *(t.spec for kind in TARGET_KINDS.values() for t in kind.examples().values()),
        ]
        return [tree_changed(json.dumps(one_of(kinds, rng)).encode(), rng).decode()]
    names = sorted(Options.__dataclass_fields__)
    values = (
        *NUMBERS,
        *OTHERS,
        *TEXTS,
        "radial",
        "brown",
        "auto",
        "x",
        ["k1"],
        {"k1": 0.0},
        {"phi": "x"},
        {"phi": None},
    )
    lens = ['lens="brown"'] if rng.random() < 0.5 else []
    return [*lens, f"{one_of(names, rng)}={json.dumps(one_of(values, rng))}"]


_FILES = ((6, content_changed), (0.5, file_exchanged), (0.5, file_odd))
_CHANGES = (*_FILES, (1.5, word_odd), (0.5, words_odd), (4, option_added))
