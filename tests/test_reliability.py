"""Malicious files, faults, forks: each ends in one clear line, or in the right answer (docs/reliability.md)."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from select import select
from typing import Any

import cv2
import fuzz
import numpy as np
import photographs
import pytest
import refit_after_move
import watching
from conftest import made_once
from faults import fuzz_commands
from scenery import field_scene, overhead_pose
from scenes import RADIAL

from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.base.files import LIMIT, read_bytes, write_bytes
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main, terminal
from ceres_cal.detect.headers import count_pages
from ceres_cal.detect.images import read_colour, read_grey, read_light
from ceres_cal.formats import LookupTable
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import checkerboard, custom, ssl_field
from ceres_cal.scene.targets.target import MOST_FEATURES
from ceres_cal.simulate import Disturbance, Station, simulate

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "data" / "ssl_field_moved" / "observations.json"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
PROGRAM = [sys.executable, "-c", "import sys; from ceres_cal.cli import main; sys.exit(main())"]


@pytest.fixture(scope="module")
def observations() -> Observations:
    return Observations.load(SAMPLE)


@pytest.fixture(scope="module")
def calibration(observations: Observations) -> Calibration:
    return calibrate(observations, RADIAL)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one good file for each reader, and other inputs of commands: one for each worker."""

    def made() -> Path:
        folder = tmp_path_factory.mktemp("made") / "good"
        folder.mkdir()
        fuzz_commands.corpus(folder)
        return folder

    return Path(shutil.copytree(made_once(tmp_path_factory, "corpus", made), tmp_path_factory.mktemp("fuzz") / "good"))


def program(*arguments: object, **settings: Any) -> subprocess.CompletedProcess[str]:
    """A command as its own process."""
    words = [*PROGRAM, *map(str, arguments)]
    environment = ENVIRONMENT | settings.pop("env", {})
    return subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment, **settings)


def refused(read: Callable[[Path], object], path: Path, words: str, most_s: float = 10.0) -> None:
    """One line that names the file, within a short time."""
    begin = time.process_time()
    with pytest.raises(InputError) as raised:
        read(path)
    text = str(raised.value)
    assert text.startswith(f"{path}") and "\n" not in text and words in text, text
    assert time.process_time() - begin < most_s


# ---- files that are none --------------------------------------------------------------------------------------------


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    pipe, loop = tmp_path / "pipe.json", tmp_path / "loop.json"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    refused(read_bytes, pipe, "it is a pipe or a device: save its content to a file first")
    refused(Observations.load, Path("/dev/zero"), "it is a pipe or a device")
    refused(Observations.load, loop, "Too many levels of symbolic links")
    assert main(["calibrate", str(loop), "-o", str(loop)]) == 2


def test_a_pipe_among_columns_is_refused(tmp_path: Path, good: Path) -> None:
    """NumPy would wait for its writer for ever; and rows in Fortran order are not contiguous."""
    place = tmp_path / "a.columns"
    shutil.copytree(good / "observations.columns", place)
    column = place / "points_pixels.npy"
    pixels = np.load(column)
    np.save(column, np.asfortranarray(pixels))
    with pytest.raises(InputError, match=r"points_pixels.npy: its array is in Fortran order"):
        Observations.load(place)
    column.unlink()
    os.mkfifo(column)
    with pytest.raises(InputError, match=r"points_pixels.npy: cannot be read: it is a pipe"):
        Observations.load(place)


def test_columns_in_fortran_order_are_the_same_observations(tmp_path: Path, good: Path) -> None:
    """The compiled kernels need contiguous rows."""
    with np.load(good / "observations.npz") as archive:
        arrays: dict[str, Any] = {name: np.asfortranarray(archive[name]) for name in archive.files}
    np.savez(tmp_path / "fortran.npz", **arrays)
    here, there = Observations.load(good / "observations.npz"), Observations.load(tmp_path / "fortran.npz")
    assert here.digest == there.digest
    assert there.points.pixels.flags.c_contiguous and there.curves.pixels.flags.c_contiguous


def test_sizes_are_limited_and_the_limit_can_be_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sparse.json"
    with path.open("wb") as stream:
        stream.truncate(10**12)
    refused(
        Observations.load,
        path,
        f"would take 1000000 MB, more than the limit of 512 MB: give less at a time, or set {LIMIT}",
    )
    small = tmp_path / "small.json"
    small.write_bytes(b"[" + b"[]," * 100_000 + b"[]]")
    monkeypatch.setenv(LIMIT, "10")
    refused(Observations.load, small, f"set {LIMIT}=")
    monkeypatch.setenv(LIMIT, "1000")
    refused(Observations.load, small, '"format" must be')
    monkeypatch.setenv(LIMIT, "many")
    with pytest.raises(InputError, match="give a whole number of megabytes"):
        read_bytes(small)


def repacked(archive: Path, place: Path, columns: dict[str, bytes], twice: str = "") -> Path:
    """The archive with other columns in it."""
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as new:
        for name in (*old.namelist(), *(columns.keys() - set(old.namelist())), *([twice] if twice else [])):
            new.writestr(name, columns.get(name) or old.read(name))
    return place


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_archive_that_unpacks_to_gigabytes(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unknown columns are not read, known ones only within the limit, and not more than the archive contains."""
    archive, path = good / "observations.npz", tmp_path / "bomb.npz"
    zeros = bytes(20_000_000)
    refused(Observations.load, repacked(archive, path, {"more.npy": zeros}), "unknown column 'more'")
    monkeypatch.setenv(LIMIT, "10")
    refused(Observations.load, repacked(archive, path, {"points_view.npy": zeros}), "would take 20 MB")
    refused(Observations.load, repacked(archive, path, {}, "points_view.npy"), "a column is there twice")
    text = b"{'descr': '<i4', 'fortran_order': False, 'shape': (100000000000,), }"
    claims = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + text.ljust(117) + b"\n" + bytes(40)
    columns = {"points_view.npy": claims}
    refused(
        Observations.load,
        repacked(archive, path, columns),
        "points_view does not hold as many numbers as its header states",
    )


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    start = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + start + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


def test_images_that_claim_more_than_they_hold(tmp_path: Path) -> None:
    ok, bmp = cv2.imencode(".bmp", np.zeros((4, 4, 3), np.uint8))
    assert ok
    huge = bytearray(bmp.tobytes())
    huge[18:26] = struct.pack("<ii", 30_000, 30_000)
    for name, content, words in (
        ("huge.png", _png(32_000, 32_000), "would take 3072 MB"),
        ("large.png", _png(10_000, 10_000), "10000 x 10000 px cannot be stored in its"),
        ("huge.bmp", bytes(huge), "would take 2700 MB"),
        ("chunk.png", _png(64, 48).replace(struct.pack(">I", 17), b"\xfe\xff\xff\xff"), "not an image"),
        ("none.tif", b"II*\0\x08\0\0\0\x01", "not an image"),
    ):
        (tmp_path / name).write_bytes(content)
        refused(read_grey, tmp_path / name, words)


@pytest.mark.parametrize("second, pages", [((48, 64), 3), ((12, 16), 1)])
def test_pages_of_a_tiff(second: tuple[int, int], pages: int, tmp_path: Path) -> None:
    """OpenCV reads the first page without a word; a preview of it is no page."""
    path, other = tmp_path / "stack.tif", np.zeros(second, np.uint8)
    assert cv2.imwritemulti(str(path), [np.full((48, 64), 9, np.uint8), other, other])
    assert count_pages(path.read_bytes()) == pages
    if pages == 1:
        assert np.all(read_grey(path) == 9)
        return
    for read in (read_grey, read_colour, read_light):
        refused(read, path, "stack.tif: a TIFF of 3 pages, of which one can be read: save each page as a file")


@pytest.mark.parametrize("size", [(1, 1), (15, 400), (60000, 1), (1, 60000)])
def test_pictures_in_which_nothing_can_be_seen(size: tuple[int, int], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros(size[::-1], np.uint8))
    refused(read_grey, tmp_path / "a.png", f"{size[0]} x {size[1]} px is too small: at least 16 px are needed each way")
    command = [
        "detect",
        "field",
        str(tmp_path / "a.png"),
        "--target",
        "ssl-b",
        "--auto",
        "-o",
        str(tmp_path / "o.json"),
    ]
    assert main(command) == 2


def test_targets_have_a_largest_size(tmp_path: Path) -> None:
    data = json.loads(SAMPLE.read_text())
    board = {"kind": "checkerboard", "columns": 9_000_000_000, "rows": 6_000_000_000, "square_m": 0.025}
    path = tmp_path / "huge.json"
    path.write_text(json.dumps(data | {"targets": data["targets"] | {"board": board}}))
    most = f"target 'board': checkerboard: at most {MOST_FEATURES} points and curves, not 54000000000000000000"
    refused(Observations.load, path, most)
    many = {f"board{number}": board | {"columns": 200, "rows": 200} for number in range(100)}
    path.write_text(json.dumps(data | {"targets": data["targets"] | many}))
    refused(Observations.load, path, "targets up to 'board2': at most")
    with pytest.raises(InputError, match="at most"):
        checkerboard(10**10, 10**10, 0.025)


# ---- files that contradict themselves -------------------------------------------------------------------------------


def changed(path: Path, change: Callable[[dict[str, Any]], object], folder: Path) -> Path:
    data = json.loads(path.read_text())
    change(data)
    (folder / "changed.json").write_text(json.dumps(data))
    return folder / "changed.json"


@pytest.mark.parametrize(
    "change, words",
    [
        (
            lambda d: next(iter(d["cameras"].values())).update(phi=float("nan")),
            "nan is not a finite number - at `$.cameras",
        ),
        (lambda d: next(iter(d["stations"].values())).update(rotation=[[1, 0, 0]] * 3), "is not a rotation matrix"),
        (
            lambda d: next(iter(d["stations"].values())).update(position_m=[0, 0, 9]),
            "position_m or euler_rad disagrees",
        ),
        (lambda d: d["options"].update(priors=5), "options.priors: Expected a list"),
        (lambda d: d["options"].update(threads="two"), "Expected a whole number, got a text"),
        (lambda d: d.update(digest="\ud800"), "not valid JSON (cut short?)"),
        (lambda d: d.update(rounds=10**400), "inf is not a finite number"),
        (lambda d: next(iter(d["cameras"].values())).update(phi=10**400), "inf is not a finite number"),
        (lambda d: d["posterior"].update(keys=d["posterior"]["keys"] * 5000), "'phi' of camera 'overhead' twice"),
        (lambda d: d["posterior"]["keys"][0].__setitem__(1, "x"), "posterior.keys names 'phi' of camera 'x', which is"),
        (lambda d: d["posterior"]["keys"][3].__setitem__(2, "k9"), "names 'k9' of camera 'overhead', which is not"),
        (lambda d: d["posterior"].update(placements={"x": [1.0] * 21}), "posterior.placements names 'x' of placement"),
        (lambda d: d["options"].update(threads=10**30), "Expected a whole number, got a number, in threads"),
        (lambda d: d["options"].update(threads=2**40), "threads must be 2147483647 at most, not 1.1e+12"),
    ],
)
def test_calibrations_that_contradict_themselves(
    tmp_path: Path, good: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    refused(Calibration.load, changed(good / "calibration.json", change, tmp_path), words)


def test_what_is_given_twice(tmp_path: Path, good: Path) -> None:
    """Also with another spelling of its name; a parser would silently use the last one."""
    for name, read in (("calibration.json", Calibration.load), ("observations.json", Observations.load)):
        for key in ('"version"', '"versio\\u006e"'):
            path = tmp_path / name
            path.write_text((good / name).read_text().replace("{", "{" + key + ": 1, ", 1))
            refused(read, path, "'version' is given twice in one object")
    path.write_text((good / "observations.json").read_text().replace('"frame":"', '"frame":"a \\" b: {', 1))
    assert Observations.load(path).views[0].frame.startswith('a " b: {')


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda a: a.update(x_px=a["x_px"] * 1.1), "x_px is not evenly spaced"),
        (lambda a: a.update(x_px=a["x_px"][:-1]), "has a shape"),
        (lambda a: a.update(image_size=np.array([64, 10**6])), "x_px does not span the image"),
        (lambda a: a["homography"].fill(np.nan), "a number is not finite"),
        (lambda a: a.update(step_px=np.array(0)), "not evenly spaced"),
        (lambda a: a.update(step_px=np.array([64])), "in 0 dimensions"),
        (lambda a: a.update(error_mm=a["error_mm"][:, :2]), "has a shape"),
        (lambda a: a.update(more=np.zeros(3)), "unknown column 'more'"),
        (lambda a: a.update(station=np.array(object())), "pickled objects"),
    ],
)
def test_tables_that_contradict_themselves(
    tmp_path: Path, good: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    with np.load(good / "table.npz") as archive:
        arrays = {name: archive[name].copy() for name in archive.files}
    change(arrays)
    np.savez(tmp_path / "table.npz", **arrays)
    refused(LookupTable.load, tmp_path / "table.npz", words)


@pytest.mark.parametrize(
    "name, old, new, words",
    [
        ("colmap/frames.txt", rb"0\.7", b"7.0", "is not a rotation matrix"),
        ("colmap/images.txt", b"overhead", b"over\xff", "image 1 is not UTF-8"),
        (
            "opencv.xml",
            rb"(?<=<data>)[^<]*(?=</data></extrinsic_parameters>)",
            b"1e200 0. 0. 0. 0. 0.",
            "must be finite numbers",
        ),
        ("camera.xml", rb"(\"focal length\"[^>]*>\s*)[0-9.,]+", rb"\g<1>5e-324", "is impossible"),
        ("camera.xml", rb"(camera index[^>]*>)[0-9]+", rb"\g<1>1e400", "is not a number"),
        ("opencv.json", rb'"overhead"', rb'"\\ud800"', "stations is not UTF-8"),
        ("geometry.yml", rb"(?<=focal_length: )[0-9.]+", b"1" + b"0" * 400, "too large"),
    ],
)
def test_numbers_of_others_that_cannot_be(
    good: Path, tmp_path: Path, name: str, old: bytes, new: bytes, words: str
) -> None:
    shutil.copytree(good / "colmap", tmp_path / "colmap")
    content, changed = re.subn(old, new, (good / name).read_bytes(), count=1)
    assert changed
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        fuzz_commands.READERS[name](tmp_path / name)


def test_odd_input_before_every_command(good: Path) -> None:
    """A short run of scripts/fuzz.py."""
    counts = fuzz.fuzz(good.parent, fuzz.Goal(range(30)), 1)
    assert sum(counts.values()) == 30
    assert not counts.failures


def test_what_the_fuzzer_counts_as_failures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It detects an exception, a warning, a truncated file, two lines of error and an unknown exit code."""

    def half(_: list[str]) -> int:
        (tmp_path / "half.json").write_text('{"a": ')
        return 0

    def lines(_: list[str]) -> int:
        sys.stderr.write("ceres-cal: a\nceres-cal: b\n")
        return 2

    odd: dict[str, Callable[[list[str]], int]] = {
        "unexpected": lambda _: int("a"),
        "warning": lambda _: int(np.isfinite(np.float64(1e308) * 10)),
        "half written": half,
        "many lines": lines,
        "exit code": lambda _: 7,
        "memory": lambda _: len(bytearray(2**62)),
        "accepted": lambda _: 0,
    }
    monkeypatch.setattr(fuzz_commands, "PROGRAMS", odd)
    for name in odd:
        case = fuzz_commands.Case(name, (), ())
        assert fuzz.outcome(case, tmp_path).what == name
        (tmp_path / "half.json").unlink(missing_ok=True)


# ---- numbers that cannot be right -----------------------------------------------------------------------------------


def test_pixels_far_off_and_another_origin(observations: Observations) -> None:
    pixels = observations.curves.pixels.copy()
    pixels[:9] = (99999.0, -5.0)
    with pytest.raises(InputError, match="lies 10 image diagonals away"):
        calibrate(replace(observations, curves=replace(observations.curves, pixels=pixels)), RADIAL)
    moved = replace(observations.curves, pixels=observations.curves.pixels + 300.0)
    size = next(iter(observations.cameras.values()))
    inside = np.all(moved.pixels < size, axis=1)
    points = replace(observations.points, pixels=observations.points.pixels + 300.0)
    shifted = replace(observations, points=points, curves=moved)
    shifted = shifted.part(np.all(points.pixels < size, axis=1), inside)
    assert any("principal point lies" in line for line in calibrate(shifted, RADIAL).warnings)


@pytest.mark.parametrize(
    "many, said", [(1000.0, "are in mm, it"), (1.0 / 0.3048, "are in ft, it"), (50.0, "over 33 times")]
)
def test_a_field_in_another_unit(many: float, said: str) -> None:
    with pytest.raises(InputError, match=said):
        ssl_field("B", field_length_m=9.0 * many, field_width_m=6.0 * many)
    assert ssl_field("B", field_length_m=9.0 / 0.3048)  # one alone is possible for a long field


@pytest.mark.parametrize("scale", [0.001, 1000.0])
@pytest.mark.parametrize("phi", [100.0, 100_000.0])
def test_scenes_of_a_centimetre_and_of_kilometres(scale: float, phi: float) -> None:
    """9 mm and 9 km wide: errors below 1.7 sd; pytest turns warnings of NumPy into errors."""
    field = ssl_field("B")
    points = {name: (scale * x, scale * y, 0.0) for name, (x, y, _) in field.points.items()}
    centre = (0.75 * phi - 0.5, 0.55 * phi - 0.5)  # where it is fixed
    camera = Camera((round(1.5 * phi), round(1.1 * phi)), phi, centre, Radial((0.0, 0.0)))
    pose = overhead_pose(-0.5 * scale, -1.2 * scale, 6.0 * scale, -14.0, -11.5, 4.0)
    scene = field_scene(custom(points), {"c": camera}, {"c": Station("c", pose)})
    noise_px = 1e-4 * phi
    seen = simulate(scene, Disturbance(noise_px, noise_px)).observations
    found = calibrate(seen, Options(lens="radial", free_principal_point=False))
    assert (scale > 1.0) == any("is 10817 m large: are its numbers" in one for one in found.warnings)
    known = found.uncertainty.verdict("camera", "c", "phi")
    assert abs(known.value - phi) < 4.0 * known.sd < 0.1 * phi


def _nearly_singular(observations: Observations) -> Iterator[Observations]:
    """Few, equal, collinear, exact and useless observations."""
    points, curves = observations.points, observations.curves
    none = np.zeros(len(curves), bool)
    for count in range(1, 9):
        yield observations.part(np.arange(len(points)) < count, none)
    line = np.column_stack([np.linspace(0.0, 900.0, len(points)), np.linspace(0.0, 500.0, len(points))])
    for pixels in (np.full_like(points.pixels, 100.0), line):
        yield replace(observations, points=replace(points, pixels=pixels)).part(np.ones(len(points), bool), none)
    for sigma_px in (1e-12, 1e12):
        yield replace(observations, points=replace(points, sigma_px=np.full(len(points), sigma_px)))


@pytest.mark.parametrize("sigma_px", [1e-200, 1e200])
def test_a_sigma_beyond_all_measure(observations: Observations, sigma_px: float) -> None:
    points = replace(observations.points, sigma_px=np.full(len(observations.points), sigma_px))
    with pytest.raises(InputError, match="its sigma_px must be positive and finite, 1e-12 to 1e12: correct"):
        replace(observations, points=points)


def test_what_is_nearly_singular_is_answered_or_named(observations: Observations) -> None:
    for number, odd in enumerate(_nearly_singular(observations)):
        try:
            found = calibrate(odd, RADIAL)
        except CalibrationError:
            continue
        assert all(np.isfinite(camera.phi) for camera in found.cameras.values()), number


def test_a_table_without_nodes(good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "table.npz"
    assert (
        main(["export", str(good / "calibration.json"), "--to", "table", "--step-px", "100000000", "-o", str(table)])
        == 2
    )
    assert "step_px must be" in capsys.readouterr().err and not table.exists()


# ---- processes ------------------------------------------------------------------------------------------------------


def _phi(path: str) -> bytes:
    found = calibrate(Observations.load(path), RADIAL)
    return b"".join(np.float64(camera.phi).tobytes() for camera in found.cameras.values())


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_children_after_a_calibration_in_the_parent(method: str, calibration: Calibration) -> None:
    """The thread pool belongs to the parent only; and all results are equal to the last bit."""
    mine = _phi(str(SAMPLE))
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(method)) as pool:
        first, second = (answer.result(60) for answer in [pool.submit(_phi, str(SAMPLE)) for _ in range(2)])
    assert first == second == mine


def test_threads_that_calibrate_at_once(calibration: Calibration) -> None:
    with ThreadPoolExecutor(2) as pool:
        assert len({answer.result(60) for answer in [pool.submit(_phi, str(SAMPLE)) for _ in range(2)]}) == 1


@pytest.mark.thorough
def test_sigterm_is_as_clean_as_ctrl_c(tmp_path: Path) -> None:
    """No stack trace of glog, also during native work."""
    image, rng = tmp_path / "noise.jpg", np.random.default_rng(0)
    cv2.imwrite(str(image), cv2.resize(rng.integers(0, 255, (1200, 1600), dtype=np.uint8), (6400, 4800)))
    board = ["detect", "board", str(image), "--columns", "9", "--rows", "6", "--square", "0.02", "-o"]
    for number, code, word in ((signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "interrupted")):
        command = [*PROGRAM, *board, str(tmp_path / "out.json"), "--json"]
        process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        time.sleep(2.0)
        process.send_signal(number)
        begin = time.monotonic()
        out, err = process.communicate(timeout=30)
        assert time.monotonic() - begin < 1.5
        line = f"{word}: nothing was written"
        assert (process.returncode, err, json.loads(out)["error"]) == (code, f"ceres-cal: {line}\n", line)
    late = program(*board, tmp_path / "out.json", "--timeout", "1.5")
    assert late.returncode == 2 and "--timeout: not done after 1.5 s, nothing was written" in late.stderr


def test_sigterm_while_a_library_is_loaded(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Native modules turn any exception during their initialisation into an ImportError."""

    def load(arguments: list[str]) -> None:
        raise ImportError("initialization failed") from terminal.Termination()

    monkeypatch.setattr(terminal, "chosen", load)
    assert (main(["calibrate"]), capsys.readouterr().err) == (143, "ceres-cal: terminated: nothing was written\n")


def test_a_solver_does_not_take_sigterm(tmp_path: Path) -> None:
    code = "import os, signal, ceres_cal.problem; os.kill(os.getpid(), signal.SIGTERM); import time; time.sleep(5)"
    run = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, timeout=60)
    assert (run.returncode, run.stderr) == (-signal.SIGTERM, b"")


# ---- outputs --------------------------------------------------------------------------------------------------------


def test_mode_owner_and_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "new", b"1")
        (tmp_path / "old").write_bytes(b"0")
        (tmp_path / "old").chmod(0o604)
        if os.geteuid() == 0:
            os.chown(tmp_path / "old", 1234, 2345)
        write_bytes(tmp_path / "old", b"1")
    finally:
        os.umask(before)
    old = (tmp_path / "old").stat()
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o640 and old.st_mode & 0o777 == 0o604
    assert os.geteuid() != 0 or (old.st_uid, old.st_gid) == (1234, 2345)


def test_what_killed_runs_left_is_removed(tmp_path: Path) -> None:
    code = (
        "import os, sys; from ceres_cal.base.files import write_bytes\n"
        "os.fsync = lambda handle: os.kill(os.getpid(), 9)\n"
        "write_bytes(sys.argv[1], b'half')"
    )
    place = tmp_path / "a.json"
    place.write_bytes(b"old")
    killed = subprocess.run([sys.executable, "-c", code, str(place)], env=ENVIRONMENT, timeout=60)
    assert killed.returncode == -9 and place.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 2
    write_bytes(place, b"new")
    assert place.read_bytes() == b"new" and len(list(tmp_path.iterdir())) == 1


def test_names_in_other_encodings(tmp_path: Path) -> None:
    """Nothing is lost if a name or a terminal does not use UTF-8."""
    shot = next((ROOT / "data" / "ssl_field_moved" / "photographs").iterdir())
    odd = tmp_path / os.fsdecode(b"caf\xe9.jpg")
    shutil.copy(shot, odd)
    rings = ["detect", "rings", odd, "--radii", "0.01:0.1:0.01", "-o", tmp_path / "r.json", "--json"]
    run = program(*rings, env={"LC_ALL": "C", "PYTHONIOENCODING": "ascii"})
    assert run.returncode in (0, 2) and "unexpected" not in run.stderr and "Traceback" not in run.stderr
    named = tmp_path / "kalibrierung-ä.json"
    run = program(
        "calibrate", SAMPLE, "--lens", "radial", "-o", named, env={"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
    )
    assert run.returncode == 0 and named.exists() and "\\xe4" in run.stdout, run


def test_a_name_that_is_no_utf8_stops_no_batch(tmp_path: Path, good: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The others are calibrated, and it has its line, its file and its entry on the page."""
    rooms = tmp_path / os.fsdecode(b"rooms\xe9")
    rooms.mkdir()
    for name in (b"caf\xe9.json", b"b.json"):
        shutil.copy(good / "custom.json", rooms / os.fsdecode(name))
    (rooms / os.fsdecode(b"\xe9 broken.json")).write_text('{"format": "ceres-cal/observations"')
    command = ["batch", str(rooms), "-o", str(tmp_path / "out"), "--jobs", "1", "--options", "--lens radial", "--json"]
    assert main(command) == 3
    levels = {job["job"]: job["level"] for job in json.loads(capsys.readouterr().out)["jobs"]}
    assert levels.pop("\\udce9 broken") == "failed"
    assert set(levels) == {"b", "caf\\udce9"} and "failed" not in levels.values()
    assert (tmp_path / "out" / "caf\\udce9.json").exists()
    assert main([*command, "--options", "'"]) == 2 and "--options" in capsys.readouterr().err


def test_libraries_say_nothing_of_damaged_images(tmp_path: Path) -> None:
    ok, tiff = cv2.imencode(".tif", np.random.default_rng(0).integers(0, 255, (200, 200), dtype=np.uint8))
    assert ok
    (tmp_path / "a.tif").write_bytes(tiff.tobytes()[: len(tiff) // 2])
    board = [
        "detect",
        "board",
        tmp_path / "a.tif",
        "--columns",
        9,
        "--rows",
        6,
        "--square",
        0.02,
        "-o",
        tmp_path / "o.json",
    ]
    run = program(*board)
    assert run.returncode == 2 and run.stderr.startswith("ceres-cal: ") and run.stderr.count("\n") == 1, run.stderr


def test_real_images_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CERES_CAL_REAL", "/nowhere/real")
    for more in ([], ["--real", "/nowhere/real"]):
        with pytest.raises(SystemExit, match="/nowhere/real"):  # words: exit code 1
            photographs.main(["--case", "real", *more])


# ---- the watch ------------------------------------------------------------------------------------------------------


def test_what_appears_in_a_folder(tmp_path: Path) -> None:
    """Regular files that have stopped growing, once each; other files cause no delay; the folder may disappear."""
    place = tmp_path / "incoming"
    place.mkdir()
    (place / "before.json").touch()
    folder = watching.Folder(place, {".json"})
    os.mkfifo(place / "pipe.json")
    (place / "loop.json").symlink_to(place / "loop.json")
    for name in ("a.json", "b.json", ".hidden.json", "a.txt"):
        (place / name).write_text("{")
    assert folder.look() == []  # they may be growing
    assert {path.name for path in folder.look()} == {"a.json", "b.json"}
    assert folder.again(place / "a.json") and folder.look() == [place / "a.json"]
    assert folder.again(place / "a.json") and folder.look() == [place / "a.json"]
    assert not folder.again(place / "a.json") and folder.look() == []
    os.utime(place / "b.json", (0, 0))  # a clock that was set back
    folder.look()
    assert folder.look() == [place / "b.json"]
    place.rename(tmp_path / "away")
    assert folder.look() == [] and not folder.is_there
    (tmp_path / "away").rename(place)
    (place / "c.json").write_text("{")
    folder.look()
    assert folder.look() == [place / "c.json"] and folder.is_there


def test_a_journal_loses_nothing(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "events.jsonl"
    journal = watching.Journal(log)
    journal.write({"event": 1})
    log.parent.mkdir()
    journal.write({"event": 2})
    assert [json.loads(line)["event"] for line in log.read_text().splitlines()] == [1, 2]


def test_a_watch_that_nobody_reads(good: Path, tmp_path: Path) -> None:
    """Its folder is removed, its output is closed, there are junk and a pipe; a good file is
    answered, SIGTERM ends it.
    """
    incoming, calibration = tmp_path / "incoming", tmp_path / "calibration.json"
    incoming.mkdir()
    shutil.copy(good / "calibration.json", calibration)
    script = [sys.executable, str(ROOT / "scripts" / "refit_after_move.py"), str(calibration), "--watch", str(incoming)]
    process = subprocess.Popen([*script, "--every-s", "0.05"], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    stream, numbers = process.stdout, itertools.count()
    while not select([stream], [], [], 0.1)[0]:  # until it watches
        (incoming / f"first{next(numbers)}.json").write_text("{")

    def answered() -> dict[str, Any]:
        events = (json.loads(line) for line in stream)
        return next(event for event in events if event["event"] != "unreadable")

    shutil.rmtree(incoming)
    assert answered()["event"] == "folder"
    incoming.mkdir()
    assert answered()["event"] == "folder"
    os.mkfifo(incoming / "pipe.json")
    for number in range(50):
        (incoming / f"{number}.json").write_text("{")
    shutil.copy(SAMPLE, incoming / "good.json")
    assert Path(answered()["file"]).name == "good.json"
    process.stdout.close()
    (incoming / "more.json").write_text("{")
    time.sleep(1.0)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


def test_a_watch_refuses_what_it_cannot_do(good: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = [str(good / "calibration.json"), "--watch", str(good)]
    for more in (["--what", "bogus"], ["--every-s", "0"], ["--log", "/nowhere/a.jsonl"]):
        with pytest.raises(SystemExit) as ended:
            refit_after_move.main([*start, *more])
        assert ended.value.code == 2 and capsys.readouterr().err.strip()
