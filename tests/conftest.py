"""Shared parts of several test modules. Imports are delayed, since most modules need few of them."""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import runpy
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import pytest

if TYPE_CHECKING:
    from photos.shots import Shot

    from ceres_cal.calibration import Calibration
    from ceres_cal.detect.boards import BoardDetections
    from ceres_cal.detect.photographs import FieldDetections

# This selects Hypothesis' profile for CI: the same examples every time, and no deadline. Its option would import it.
os.environ["CI"] = "true"

_T = TypeVar("_T")

# A shell's background jobs ignore SIGINT, and so do their children; the tests of Ctrl-C need Python's default handler.
signal.signal(signal.SIGINT, signal.default_int_handler)


if sys.dont_write_bytecode:  # compiled modules are shared by all processes, beside pytest's cache
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(Path(__file__).parents[1] / ".pytest_cache" / "bytecode")
    os.environ |= {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": sys.pycache_prefix}


def pytest_collection() -> None:
    """Imported and collected objects stay, so that the garbage collector need not search them."""
    gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)  # parsed sources make a million objects, which are no garbage
    gc.enable()
    if "hypothesis" not in sys.modules:  # its plugin would import it at the end
        session.config.pluginmanager.unregister(name="hypothesispytest")


@pytest.fixture(autouse=True)
def _signals_kept() -> Iterator[None]:
    """After each test the signal handlers are unchanged, since the processes of the next test
    inherit ignored signals.
    """
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images and calibrations: $CERES_CAL_REAL, or shared/real beside the repository."""
    from photos.real_data import real_place

    folder = real_place()
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is not there (set CERES_CAL_REAL to its place)")
    return folder


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[], _T]) -> _T:
    """An object that takes long to make: the first worker of the run makes it, and the others read it."""
    own = factory.getbasetemp()
    path = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / name
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            path.write_bytes(pickle.dumps(make()))
    made: _T = pickle.loads(path.read_bytes())
    return made


@pytest.fixture
def as_script(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The output of a script, run in a folder with arguments, in this process, which has its imports already."""

    def run(script: Path, *arguments: object, folder: Path) -> str:
        monkeypatch.chdir(folder)
        monkeypatch.setattr("sys.argv", [str(script), *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(script), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture
def words_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without pictures, which take most of the time, for tests of their text."""
    monkeypatch.setattr("ceres_cal.report.page.to_svg", lambda *_: "<svg></svg>")


def _boards(
    factory: pytest.TempPathFactory, name: str, folder: Path, which: str, board: tuple[int, int, float]
) -> BoardDetections:
    from ceres_cal.detect.boards import detect_boards
    from ceres_cal.scene.targets import checkerboard

    return made_once(factory, name, lambda: detect_boards(sorted(folder.glob(which)), checkerboard(*board)))


@pytest.fixture(scope="session")
def sony_boards(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> BoardDetections:
    """The boards that are detected in BoofCV's 13 photographs."""
    return _boards(tmp_path_factory, "sony", real_data / "boofcv_sony_chess", "*.jpg", (4, 6, 0.03))


@pytest.fixture(scope="session")
def tigers_field(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FieldDetections]:
    """A real photograph of a field, and the lines detected in it."""
    from photos.shots import real_detection

    return made_once(tmp_path_factory, "tigers", lambda: real_detection(real_data))


@pytest.fixture(scope="session")
def tigers_calibration(
    tigers_field: tuple[Path, FieldDetections], tmp_path_factory: pytest.TempPathFactory
) -> Calibration:
    """The camera that took the real photograph of a field."""
    from photos.shots import real_calibration

    return made_once(tmp_path_factory, "tigers_calibration", lambda: real_calibration(tigers_field[1]))


@pytest.fixture(scope="session")
def plain_shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """A photograph of a field in good light, with robots."""
    from photos.shots import take

    return made_once(tmp_path_factory, "plain_shot", lambda: take(0))


@pytest.fixture(scope="session")
def gopro_boards(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> BoardDetections:
    """The boards that are detected in the 36 wide-angle photographs; the size of a square is unknown."""
    return _boards(tmp_path_factory, "gopro", real_data / "udacity_gopro_wide", "GOPR*.jpg", (8, 6, 1.0))


@pytest.fixture(scope="session")
def files_of_a_move(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to copy: a calibration (old.json), observations from before (same.json) and after a move (after.json),
    and observations that nothing explains (mirrored.json).
    """
    from accuracy.moves import DAY, HOME, MOVED, calibrated, seen

    from ceres_cal.calibration.renaming import relabelled
    from ceres_cal.scene.symmetry import MIRRORED

    folder = tmp_path_factory.mktemp("move")
    calibrated(0).save(folder / "old.json")
    seen(HOME, DAY, 1000).observations.save(folder / "same.json")
    after = seen(MOVED, DAY, 1001).observations
    after.save(folder / "after.json")
    mirrored = relabelled(after, MIRRORED)
    assert mirrored is not None
    mirrored.save(folder / "mirrored.json")
    return folder
