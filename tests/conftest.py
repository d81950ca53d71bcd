"""What several test modules share. Nothing is imported before it is needed: most modules ask for little of it."""

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
    from ceres_cal.detect.boards import BoardDetections
    from ceres_cal.detect.photographs import FieldDetections

# Hypothesis' profile for it: the same examples every time, and no deadline. Its option would import it for all modules.
os.environ["CI"] = "true"

_T = TypeVar("_T")

# A shell's background jobs get SIGINT ignored, and hand it on; the tests of Ctrl-C want it as it comes at a terminal.
signal.signal(signal.SIGINT, signal.default_int_handler)


if sys.dont_write_bytecode:  # a suite's many processes compile what they import once, beside pytest's own cache
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(Path(__file__).parents[1] / ".pytest_cache" / "bytecode")
    os.environ |= {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": sys.pycache_prefix}


def pytest_collection() -> None:
    """All that is imported and collected stays: nobody needs to look through it for garbage."""
    gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    gc.freeze()
    gc.enable()
    if "hypothesis" not in sys.modules:  # which its plugin would import at the end all the same
        session.config.pluginmanager.unregister(name="hypothesispytest")


@pytest.fixture(autouse=True)
def _signals_kept() -> Iterator[None]:
    """Whatever a test runs, signals go where they went: the next one's processes inherit what is ignored."""
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
    """What takes long to make: the first of the run's workers makes it, and the others read it."""
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
    """What a script prints, run in a folder, with arguments; in this process, which has imported all that it needs."""

    def run(script: Path, *arguments: object, folder: Path) -> str:
        monkeypatch.chdir(folder)
        monkeypatch.setattr("sys.argv", [str(script), *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(script), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture
def words_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without their pictures, which take most of the time, for tests that ask what is said."""
    monkeypatch.setattr("ceres_cal.report.page.to_svg", lambda *_: "<svg></svg>")


def _boards(
    factory: pytest.TempPathFactory, name: str, folder: Path, which: str, board: tuple[int, int, float]
) -> BoardDetections:
    from ceres_cal.detect.boards import detect_boards
    from ceres_cal.scene.targets import checkerboard

    return made_once(factory, name, lambda: detect_boards(sorted(folder.glob(which)), checkerboard(*board)))


@pytest.fixture(scope="session")
def sony_boards(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> BoardDetections:
    """What is detected in BoofCV's 13 photographs."""
    return _boards(tmp_path_factory, "sony", real_data / "boofcv_sony_chess", "*.jpg", (4, 6, 0.03))


@pytest.fixture(scope="session")
def tigers_field(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FieldDetections]:
    """A real photograph of a field, and what is detected in it."""
    from photos.shots import real_detection

    return made_once(tmp_path_factory, "tigers", lambda: real_detection(real_data))


@pytest.fixture(scope="session")
def gopro_boards(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> BoardDetections:
    """What is detected in the 36 wide-angle photographs; the size of a square is not known."""
    return _boards(tmp_path_factory, "gopro", real_data / "udacity_gopro_wide", "GOPR*.jpg", (8, 6, 1.0))


@pytest.fixture(scope="session")
def files_of_a_move(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to copy: a calibration (old.json), observations from before (same.json) and after a move (after.json),
    and such that nothing explains (mirrored.json).
    """
    from accuracy.moves import DAY, HOME, MOVED, calibrated, seen

    from ceres_cal.moves.refit_plan import relabelled
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
