"""The script for copying, and a test that a refit killed at any moment leaves a complete calibration."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import refit_after_move
from accuracy.moves import MOVED, NOISE, seen
from faults import week

from ceres_cal.calibration import Calibration
from ceres_cal.moves.checks import check

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src")}


@pytest.fixture
def place(files_of_a_move: Path, tmp_path: Path) -> Path:
    """A folder with a calibration, observations from before and after a move, unexplainable ones,
    and a damaged file.
    """
    shutil.copytree(files_of_a_move, tmp_path, dirs_exist_ok=True)
    (tmp_path / "old.json").rename(tmp_path / "calibration.json")
    (tmp_path / "broken.json").write_text('{"format": "ceres-cal/obs')
    return tmp_path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, list[dict[str, object]]]:
    code = refit_after_move.main([str(argument) for argument in arguments])
    return code, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_one_file_after_the_other(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration = place / "calibration.json"
    before = calibration.read_bytes()
    names = ["same.json", "mirrored.json", "mirrored.json", "after.json", "after.json", "broken.json"]
    code, events = run(capsys, calibration, *(place / name for name in names))
    kinds = ["holds", "suspected", "refused", "refitted", "holds", "unreadable"]
    assert [event["event"] for event in events] == kinds
    assert code == 3  # of the last one
    assert "mirrored labels" in str(events[2]["reason"]) and "not valid JSON" in str(events[5]["reason"])
    assert Path(str(events[3]["kept"])).read_bytes() == before
    after = Calibration.load(calibration)
    assert after.refitted is not None
    assert check(after, seen(MOVED, NOISE, 5).observations).holds


def test_it_asks_twice(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One file changes nothing; the false alarm rate over all checks is that of two in a row."""
    calibration, log = place / "calibration.json", place / "events.jsonl"
    before = calibration.read_bytes()
    code, events = run(capsys, calibration, place / "after.json", place / "same.json", place / "after.json")
    assert [event["event"] for event in events] == ["suspected", "holds", "suspected"] and code == 3
    assert calibration.read_bytes() == before and "asked again" in str(events[0]["reason"])
    stated = events[0]["false_alarms"]
    assert isinstance(stated, dict) and stated["refits"] == 0.01 and stated["in"] == 720
    assert 720 * stated["of_this_check"] ** 2 == pytest.approx(0.01)
    for _ in range(2):  # two runs, with a log between them
        assert run(capsys, calibration, place / "after.json", "--log", log)[1] == []
    kinds = [json.loads(line)["event"] for line in log.read_text().splitlines()]
    assert kinds == ["suspected", "refitted"]


def test_what_is_known_too_little_is_not_used(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (place / "calibration.json").read_bytes()
    files = [place / "after.json"] * 2
    code, events = run(capsys, place / "calibration.json", *files, "--limit-mm", 0.1)
    assert code == 3 and events[1]["event"] == "refused" and "asked for are 0.1 mm" in str(events[1]["reason"])
    assert (place / "calibration.json").read_bytes() == before and not (place / "previous").exists()


def test_a_folder_is_watched(place: Path) -> None:
    incoming = place / "incoming"
    incoming.mkdir()
    log = place / "events.jsonl"
    script = [sys.executable, str(ROOT / "scripts" / "refit_after_move.py"), str(place / "calibration.json")]
    watching = [*script, "--watch", str(incoming), "--every-s", "0.05", "--log", str(log)]
    process = subprocess.Popen(watching, env=ENVIRONMENT)
    try:
        time.sleep(0.5)
        (incoming / "new.json").write_bytes((place / "after.json").read_bytes())
        deadline = time.monotonic() + 120.0  # other tests run at the same time
        while time.monotonic() < deadline and not (log.exists() and log.read_text().count("\n") >= 2):
            (incoming / "new.json").touch()  # it may have come before the watch began
            time.sleep(0.3)
        events = [json.loads(line) for line in log.read_text().splitlines()]
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(120) in (0, -signal.SIGINT)
    assert [event["event"] for event in events[:2]] == ["suspected", "refitted"]


@pytest.mark.thorough
def test_a_week_in_fast_motion(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A move, a missing folder and a full disk, each with damaged files among good ones."""
    for name, value in (("HEAP", 10), ("KINDS", 3), ("MOVE_EVERY", 30), ("AWAY_EVERY", 20), ("FULL_EVERY", 40)):
        monkeypatch.setattr(week, name, value)
    assert week.main(["--runs", "60", "--json"]) == 0
    figures = {row["what"]: row["value"] for row in json.loads(capsys.readouterr().out)}
    assert figures["files that were lost"] == 0 and "refits that are not one of 1 moves" in figures


@pytest.mark.thorough
def test_a_killed_refit_leaves_a_whole_calibration(place: Path) -> None:
    """Killed at random moments, and, in a loop that only writes, at random moments of writing."""
    calibration, rng = place / "calibration.json", random.Random(0)
    old = calibration.read_bytes()
    refit = ["-c", "import sys; from ceres_cal.cli import main; sys.exit(main(sys.argv[1:]))", "refit"]
    arguments = [*refit, str(calibration), str(place / "after.json"), "-o", str(calibration), "--json"]
    whole, left = {old}, set()
    for _ in range(2):
        calibration.write_bytes(old)
        process = subprocess.Popen([sys.executable, *arguments], env=ENVIRONMENT, stdout=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.3, 1.5))
        process.kill()
        process.wait()
        left.add(calibration.read_bytes())
    calibration.write_bytes(old)
    subprocess.run([sys.executable, *arguments], env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=True)
    whole.add(calibration.read_bytes())
    assert len(whole) == 2 and left <= whole
    code = (
        "import sys; from ceres_cal.calibration import Calibration\n"
        "both = [Calibration.load(path) for path in sys.argv[1:3]]\n"
        "print('ready', flush=True)\n"
        "while True:\n"
        "    for one in both: one.save(sys.argv[3])\n"
    )
    for name, content in zip(("a.json", "b.json"), sorted(whole), strict=True):
        (place / name).write_bytes(content)
    seen_contents = set()
    for _ in range(4):
        process = subprocess.Popen(
            [sys.executable, "-c", code, str(place / "a.json"), str(place / "b.json"), str(calibration)],
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
        )
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        time.sleep(rng.uniform(0.0, 0.05))
        process.kill()
        process.communicate()
        seen_contents.add(calibration.read_bytes())
    assert seen_contents <= whole
