"""Damaged files before every reader: scripts/fuzz.py [--files N | --minutes N] [--seed N] [--keep FOLDER]

Files of a small corpus, made of what the package ships, are mutated: bytes, numbers and names of JSON, columns of
archives, headers of images. A reader must refuse in one line that names the file, or accept; what is accepted must
survive being written and read again. Counted as failures: other exceptions, warnings, over 10 s of processor time or
60 s on the wall, over 1 GiB more than before, deaths of the process, and what does not come back. Exits with 1 when
there is one; --keep keeps the files that did it.
"""

from __future__ import annotations

import argparse
import base64
import faulthandler
import io
import json
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ssl_settings_file import settings

from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.files import write_json
from ceres_cal.calibrating import calibrate
from ceres_cal.calibration import Calibration
from ceres_cal.detect.images import read_colour, read_grey
from ceres_cal.formats import LookupTable, export, make_lookup_table, read_foreign
from ceres_cal.observations import Observations
from ceres_cal.photographs.clicks import load_clicks
from ceres_cal.simulate import built_in_scene, load_scene
from ceres_cal.simulate.files import scene_to_json

DATA = Path(__file__).resolve().parents[1] / "data"
LONGEST_S, LONGEST_WAIT_S, MOST_MB = 10, 60, 1024
TRACE = "where.txt"  # a process that took too long was
FAILURES = ("unexpected", "warning", "changed", "many lines", "slow", "died", "memory")
TOKENS = b'0 -1 1 2 1e400 -0.0 1e308 5e-324 NaN -Infinity 9000000000 1e24 null true [] {} "" "a"'.split()
TOKENS += [b'"\\ud800"', b'"\\u0000"', b'"' + b"x" * 300 + b'"', b"[" * 500, b"1" + b"0" * 400, b"[[1,2],[3]]"]
WORDY = (".json", ".yml", ".yaml", ".xml", ".cameramodel", ".txt", ".vnl", ".csv")
NUMBER = re.compile(rb"-?[0-9]+(\.[0-9]+)?(e-?[0-9]+)?")
WORD = re.compile(rb'"(?:[^"\\]|\\.)*"|-?[0-9][0-9.eE+-]*|true|false|null|[\[\]{}:,]')

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
OTHERS = {
    "corners.vnl": b"# filename x y level\n" + b"".join(b"a.png %d 20 %d\n" % (10 * n, n % 2) for n in range(4)),
    "table.csv": b"frame,point,curve,x_px,y_px,sigma_px\n1,TopLeftCorner,,9,5,0.3\n1,,TopTouchLine,12,5,\n",
}
READERS: dict[str, Reader] = {
    **{name: _foreign(form) for name, form in EXPORTED.items()},
    "corners.vnl": _foreign("corners-vnl", **BOARD),
    "table.csv": _foreign("csv", target="ssl-b", image_size="640x480"),
    "columns.npz": _foreign("npz-columns", image_size="640x480"),
    "boards.cameramodel": _foreign("mrcal-observations"),
    "camera.xml": _foreign("ssl-vision-xml"),
    **{f"colmap/{part}.txt": _model for part in ("cameras", "frames", "images", "rigs")},
    "observations.json": Observations.load,
    "observations.npz": Observations.load,
    "calibration.json": Calibration.load,
    "table.npz": LookupTable.load,
    "scene.json": load_scene,
    "corners.json": load_clicks,
    **{f"image{ending}": _image for ending in (".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm", ".ppm", ".jp2")},
}


def corpus(folder: Path) -> None:
    """One good file for each reader."""
    observations = Observations.load(DATA / "ssl_field_moved" / "observations.json")
    observations.save(folder / "observations.json")
    observations.save(folder / "observations.npz")
    calibration = calibrate(observations)
    calibration.save(folder / "calibration.json")
    x, y = np.array([-4.5, 4.5]), np.array([-3.0, 3.0])
    station = next(iter(calibration.stations))
    make_lookup_table(calibration.stations[station], station, x, y, step_px=128).save(folder / "table.npz")
    for name, form in EXPORTED.items():
        options: dict[str, Any] = {"camera_id": "0"} if "geometry" in name else {}
        export(calibration, form, folder / name, [station], **options)
    export(calibration, "colmap", folder / "colmap", [station])
    (folder / "camera.xml").write_text(settings(cameras=1))
    foreign_observations(folder)
    write_json(folder / "scene.json", scene_to_json(*built_in_scene("ssl-field")))
    corners = {name: [10.0 * number, 20.0] for number, name in enumerate("abcd")}
    write_json(folder / "corners.json", {"format": "ceres-cal/corners", "version": 1, "points": corners})
    photograph = next((DATA / "ssl_field_moved" / "photographs").iterdir())
    small = cv2.resize(read_colour(photograph), (64, 48))
    for ending in (".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm", ".jp2", ".pgm"):
        cv2.imwrite(str(folder / f"image{ending}"), small if ending != ".pgm" else small[:, :, 0])


def foreign_observations(folder: Path) -> None:
    for name, content in OTHERS.items():
        (folder / name).write_bytes(content)
    x, y = np.arange(4.0), np.ones(4)
    np.savez(folder / "columns.npz", x_px=x, y_px=y, X_m=x, Y_m=y)
    stream, sizes = io.BytesIO(), np.array([[640, 480]])
    inputs: dict[str, Any] = {"observations_board": np.ones((1, 2, 2, 3)), "calibration_object_spacing": np.array(0.1)}
    indices = np.array([[0, 0, -1]])
    np.savez(stream, **inputs, imagersizes=sizes, indices_frame_camintrinsics_camextrinsics=indices)
    packed = {"optimization_inputs": base64.b85encode(stream.getvalue())}
    (folder / "boards.cameramodel").write_text(repr(packed))


def round_trip(loaded: object, path: Path) -> bool:
    """Whether what was accepted comes back from a file of its own, to the last byte."""
    if not isinstance(loaded, Observations | Calibration | LookupTable):
        return True
    ending = ".npz" if path.suffix == ".npz" else ".json"
    again = [path.with_name(f"again{number}{ending}") for number in (1, 2)]
    loaded.save(again[0])
    type(loaded).load(again[0]).save(again[1])
    return again[0].read_bytes() == again[1].read_bytes()


# ---- mutations ------------------------------------------------------------------------------------------------------


def bytes_changed(content: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        at, length = int(rng.integers(0, len(out) + 1)), int(rng.integers(1, 40))
        kind = rng.integers(0, 6)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            out[at : at + length] = rng.bytes(length)
        elif kind == 2:
            del out[at : at + length]
        elif kind == 3:
            out[at:at] = out[at : at + length]
        elif kind == 4:
            out[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f"])
        else:
            del out[at:]
    return bytes(out)


def words_changed(content: bytes, rng: np.random.Generator) -> bytes:
    """JSON with some of its words exchanged, doubled, left out or replaced by odd ones."""
    places = [match.span() for match in WORD.finditer(content)]
    for _ in range(int(rng.integers(1, 4))):
        first, last = places[int(rng.integers(0, len(places)))]
        other = content[slice(*places[int(rng.integers(0, len(places)))])]
        if NUMBER.fullmatch(content[first:last]):
            other = repr(float(content[first:last]) * rng.choice([-1.0, 0.0, 0.5, 1e-9, 1e3, 1e9, 1e200])).encode()
        word = [TOKENS[int(rng.integers(0, len(TOKENS)))], other, b"", content[first:last] * 2][int(rng.integers(0, 4))]
        content = content[:first] + word + content[last:]
        places = [(a, b) for a, b in places if b <= first] or places[:1]
    return content


def columns_changed(content: bytes, rng: np.random.Generator) -> bytes:
    """An archive whose columns are other ones: bytes, headers, numbers; its own checks agree with them."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        chosen = names[int(rng.integers(0, len(names)))]
        for name in names:
            column = old.read(name)
            if name == chosen:
                column = bytes_changed(column, rng) if rng.integers(0, 2) else header_changed(column, rng)
            new.writestr(name, column)
    return stream.getvalue()


def header_changed(column: bytes, rng: np.random.Generator) -> bytes:
    words = [
        b"<f8",
        b"<i8",
        b"|O",
        b"<U9",
        b"True",
        b"(1000000000000,)",
        b"(-1,)",
        b"()",
        b"(0,)",
        b"(2, 2)",
        b"<M8[s]",
    ]
    old = re.findall(rb"'[<|>][a-zA-Z][0-9]*'|False|\([0-9, ]*\)", column[:120]) or [b"{"]
    chosen, word = old[int(rng.integers(0, len(old)))], words[int(rng.integers(0, len(words)))]
    return column.replace(chosen, word if word[:1] in b"(T" else b"'" + word + b"'", 1)


def mutated(name: str, content: bytes, rng: np.random.Generator) -> bytes:
    special = columns_changed if name.endswith(".npz") else words_changed if name.endswith(WORDY) else None
    return (special if special is not None and rng.random() < 0.7 else bytes_changed)(content, rng)


# ---- work -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Goal:
    """So many files, or until a time of the clock."""

    files: int
    end: float

    def after(self, files: int) -> Goal | None:
        """What is left after so many files; None where nothing is."""
        left = replace(self, files=self.files - files)
        return left if left.files > 0 and time.time() < self.end else None

    def __iter__(self) -> Iterator[int]:
        return takewhile(lambda _: time.time() < self.end, range(self.files))


def outcome(reader: Reader, path: Path) -> tuple[str, str]:
    """What a reader made of a file, and in which words."""
    try:
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            loaded = reader(path)
            whole = round_trip(loaded, path)
    except CalibrationError as error:
        text = str(error)
        named = text.startswith((f"{path}", f"{path.parent}:"))  # a model of several files goes by its folder
        return ("refused" if "\n" not in text and named else "many lines"), text
    except Exception as error:
        return "unexpected", repr(error)
    if heard:
        return "warning", str(heard[0].message)
    return ("accepted" if whole else "changed"), ""


def work(folder: Path, names: Sequence[str], seed: int, goal: Goal, keep: Path | None, answers: Any) -> None:
    """Mutate and read until the goal is reached; each answer is (reader, outcome, words, seconds, MB)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what image libraries say
    trace = (folder / TRACE).open("w")
    for number in (signal.SIGALRM, signal.SIGPROF):
        faulthandler.register(number, trace, all_threads=True, chain=True)
    rng, before_mb = np.random.default_rng(seed), _peak_mb()  # a fork begins with what its parent has
    contents = {name: (folder / name).read_bytes() for name in names}
    place = Path(tempfile.mkdtemp(dir=folder))
    shutil.copytree(folder / "colmap", place / "colmap")
    for _ in goal:
        name = names[int(rng.integers(0, len(names)))]
        path = place / name
        path.write_bytes(mutated(name, contents[name], rng))
        answers.send((name, "begun", str(path), 0.0, 0.0))
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S + 5)  # ends this process, even in native code
        signal.alarm(LONGEST_WAIT_S)  # the same for one that sleeps
        begin = time.process_time()
        what, words = outcome(READERS[name], path)
        seconds = time.process_time() - begin
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.alarm(0)
        peak_mb = _peak_mb() - before_mb
        what = "slow" if seconds > LONGEST_S else "memory" if peak_mb > MOST_MB else what
        if what in FAILURES:
            put_aside(path, keep, what, name)
        path.write_bytes(contents[name])  # the others of a model are whole
        answers.send((name, what, words, seconds, peak_mb))
        if what == "memory":  # whose peak would be that of all that follow
            return


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fuzz(folder: Path, goal: Goal, seed: int, keep: Path | None, names: Sequence[str] = ()) -> Counter[tuple[str, str]]:
    """How often each reader came to each outcome."""
    names = names or tuple(READERS)
    counts: Counter[tuple[str, str]] = Counter()
    slowest_s = peak_mb = 0.0
    context = multiprocessing.get_context("fork")
    while (left := goal.after(sum(counts.values()))) is not None:
        answers, theirs = context.Pipe(duplex=False)
        worker = context.Process(target=work, args=(folder, names, seed, left, keep, theirs))
        worker.start()
        theirs.close()
        name = path = ""
        try:
            while True:
                name, what, words, seconds, megabytes = answers.recv()
                if what == "begun":
                    path = words
                    continue
                counts[name, what] += 1
                slowest_s, peak_mb = max(slowest_s, seconds), max(peak_mb, megabytes)
                if what in FAILURES:
                    print(f"{name}: {what}: {words[:300]}", flush=True)
                name = ""
        except EOFError:
            worker.join()
        if worker.exitcode and not name:
            raise SystemExit(f"a worker ended with exit code {worker.exitcode} before it read anything")
        if worker.exitcode:
            counts[name, "died"] += 1
            where = (folder / TRACE).read_text()
            print(f"{name}: died: exit code {worker.exitcode}\n{where}", end="", flush=True)
            put_aside(Path(path), keep, "died", name)
        seed += 1
    print(f"slowest {slowest_s:.2f} s, peak {peak_mb:.0f} MB", flush=True)
    return counts


def put_aside(path: Path, keep: Path | None, what: str, name: str) -> None:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        (keep / f"{what} {time.time_ns()} {name}".replace(" ", "-").replace("/", "-")).write_bytes(path.read_bytes())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    how_many = parser.add_mutually_exclusive_group()
    how_many.add_argument("--minutes", type=float, default=1.0)
    how_many.add_argument("--files", type=int, metavar="N", help="so many, however long it takes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for files that were not handled well")
    parser.add_argument("--reader", action="append", default=[], choices=tuple(READERS), help="only this; repeatable")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        corpus(Path(folder))
        goal = Goal(given.files or sys.maxsize, np.inf if given.files else time.time() + 60.0 * given.minutes)
        counts = fuzz(Path(folder), goal, given.seed, given.keep, given.reader)
    failures = sum(count for (_, what), count in counts.items() if what in FAILURES)
    if given.json:
        print(json.dumps({f"{name}: {what}": count for (name, what), count in sorted(counts.items())}))
    else:
        for (name, what), count in sorted(counts.items()):
            print(f"{name:18} {what:10} {count:8}")
    print(f"{sum(counts.values())} files, {failures} failures", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
