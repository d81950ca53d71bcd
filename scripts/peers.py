"""Comparison with other calibrators on the same observations: python scripts/peers.py [--help]

Installs each peer into its own environment below build/peers, asks all of them and ceres-cal the same questions, prints
a table for each question, and stores the answers in docs/peers.json, from which docs/peers.md is made. Real sets are
read from $CERES_CAL_REAL, or shared/real beside the repository; the set in data/opencv_left is always available.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from beside import boards, fields, lies, page, speed
from beside.environments import OURS, PEERS, ROOT, imports, install, version_of
from beside.sets import SAMPLE, SOURCES, is_there, real_corners
from runner import over_processes

STORED = ROOT / "docs" / "peers.json"
PAGE = ROOT / "docs" / "peers.md"
QUESTIONS = ("truth", "prediction", "lies", "fields", "speed")
_KEYS = {
    "truth": ("set", "peer", "setting"), "prediction": ("set", "peer", "setting"), "lies": ("fault", "peer"),
    "ssl": ("scene", "noise", "method"), "soccernet": ("method",), "corners": ("frames", "peer", "setting"),
    "photographs": ("set", "method"),
}  # fmt: skip
_QUICK_SETTINGS = ("default", "OPENCV")
_QUICK_FAULTS = ("sound", "repeated picture")


def measured(given: argparse.Namespace, peers: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """The rows of each requested table."""
    found: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as name, over_processes(given.jobs):
        folder = Path(name)
        on_boards = {"truth", "prediction"} & set(given.questions)
        sets = {one: real_corners(one) for one in given.sets} if on_boards else {}
        for question in given.questions:
            found |= _MEASURED[question](given, peers, sets, folder)
            _print(found, question)
    return found


def _asked(given: argparse.Namespace, tasks: Iterable[boards.Task]) -> list[boards.Task]:
    """All tasks, or for --quick those with default settings."""
    return [one for one in tasks if not given.quick or one.setting in _QUICK_SETTINGS]


def _truth(given: argparse.Namespace, peers: Sequence[str], sets: Any, folder: Path) -> dict[str, Any]:
    tasks = _asked(given, boards.truth_tasks(sets, peers, given.splits, folder))
    return {"truth": boards.truth_rows(tasks, boards.answers(tasks, given.jobs))}


def _prediction(given: argparse.Namespace, peers: Sequence[str], sets: Any, folder: Path) -> dict[str, Any]:
    tasks = _asked(given, boards.prediction_tasks(sets, peers, folder))
    return {"prediction": boards.prediction_rows(tasks, boards.answers(tasks, given.jobs))}


def _lies(given: argparse.Namespace, peers: Sequence[str], sets: Any, folder: Path) -> dict[str, Any]:
    tasks = list(lies.tasks(peers, folder, _QUICK_FAULTS if given.quick else tuple(lies.FAULTS)))
    return {"lies": lies.rows(tasks, boards.answers(tasks, given.jobs))}


def _fields(given: argparse.Namespace, peers: Sequence[str], sets: Any, folder: Path) -> dict[str, Any]:
    return {
        "ssl": fields.ssl_rows(given.runs) if given.runs else [],
        "soccernet": fields.soccernet_rows(given.frames) if given.frames else [],
    }


def _speed(given: argparse.Namespace, peers: Sequence[str], sets: Any, folder: Path) -> dict[str, Any]:
    found = {"corners": speed.corner_rows(peers, given.sizes, given.turns) if given.sizes else []}
    return found | {"photographs": [] if given.no_photographs else speed.photograph_rows(peers, given.turns)}


_MEASURED: Mapping[str, Callable[..., dict[str, Any]]] = {
    "truth": _truth, "prediction": _prediction, "lies": _lies, "fields": _fields, "speed": _speed
}  # fmt: skip


def _print(found: Mapping[str, Sequence[Mapping[str, Any]]], question: str) -> None:
    for table in page.TABLES[question]:
        for line in table(found):
            print(line)
    print(flush=True)


def merged(before: dict[str, Any], found: Mapping[str, Sequence[dict[str, Any]]]) -> dict[str, Any]:
    """The stored rows, with new rows replacing old ones with the same key."""
    after = dict(before)
    for name, rows in found.items():
        key = _KEYS[name]
        new = {tuple(row[k] for k in key): row for row in rows}
        old = {tuple(row[k] for k in key): row for row in before.get(name, [])}
        after[name] = list((old | new).values())
    return after


def written(stored: Mapping[str, Any]) -> str:
    """JSON with a line for each row, and with five digits."""

    def short(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.5g}") if value == value else None  # NaN is no JSON
        if isinstance(value, dict):
            return {key: short(one) for key, one in value.items()}
        return [short(one) for one in value] if isinstance(value, (list, tuple)) else value

    parts = []
    for name, rows in stored.items():
        if isinstance(rows, list):
            lines = ",\n".join("  " + json.dumps(short(row), ensure_ascii=False) for row in rows)
            parts.append(f' "{name}": [\n{lines}\n ]')
        else:
            parts.append(f' "{name}": {json.dumps(short(rows), ensure_ascii=False)}')
    return "{\n" + ",\n".join(parts) + "\n}\n"


def environment(peers: Sequence[str], reasons: Mapping[str, str]) -> dict[str, Any]:
    return {
        "versions": {name: version_of(name) for name in peers},
        "missing": {name: why for name, why in reasons.items() if why},
        "python": platform.python_version(), "machine": platform.machine(), "cores": os.cpu_count(),
    }  # fmt: skip


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[1], allow_abbrev=False)
    parser.add_argument("--questions", nargs="+", default=list(QUESTIONS), choices=QUESTIONS, help="default: all")
    parser.add_argument("--timing", action="store_true", help="speed and memory, and no more")
    parser.add_argument("--sets", nargs="+", choices=list(SOURCES), help="real sets of boards (default: all at hand)")
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS), help="default: all")
    parser.add_argument("--splits", type=int, default=3, help="random halves of each set (default %(default)s)")
    parser.add_argument("--runs", type=int, default=8, help="seeds of each field (default %(default)s)")
    parser.add_argument("--frames", type=int, default=400, help="of SoccerNet (default %(default)s)")
    parser.add_argument("--turns", type=int, default=5, help="of what is timed: the best counts (default %(default)s)")
    parser.add_argument(
        "--sizes", type=int, nargs="*", default=speed.FRAMES, help="frames of what is timed (default %(default)s)"
    )
    parser.add_argument("--no-photographs", action="store_true", help="time no photographs")
    parser.add_argument("--jobs", type=int, default=2, help="processes of what is not timed (default %(default)s)")
    parser.add_argument(
        "--sample", action="store_true", help="truth, prediction and lies on the set that is in the repository"
    )
    parser.add_argument("--quick", action="store_true", help="the same by what this Python has, nothing installed")
    parser.add_argument("--json", type=Path, help="store the answers there (with --quick or --sample: nowhere else)")
    parser.add_argument("--page", action="store_true", help="only make docs/peers.md of docs/peers.json")
    return parser


def main(arguments: Sequence[str]) -> int:
    given = options().parse_args(arguments)
    if given.page:
        PAGE.write_text(page.made(json.loads(STORED.read_text(encoding="utf-8"))), encoding="utf-8")
        return 0
    some = given.sample or given.quick
    if some:
        given.sets, given.questions = given.sets or [SAMPLE], ["truth", "prediction", "lies"]
    if given.timing:
        given.questions = ["speed"]
    given.sets = given.sets or [name for name in SOURCES if is_there(name)]
    here = "is not in this Python"
    reasons = {one: ("" if imports(one) else here) if given.quick else install(one) for one in given.peers}
    peers = [OURS, *(name for name, why in reasons.items() if not why)]
    found = measured(given, peers)
    path = given.json or (None if some else STORED)
    if path:
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        after = {"environment": environment(peers, reasons)} | merged(before, found)
        if not some and len(peers) <= len(before.get("environment", {}).get("versions", {})):
            after["environment"]["versions"] = before["environment"]["versions"] | after["environment"]["versions"]
        path.write_text(written(after), encoding="utf-8")
        if path == STORED:
            PAGE.write_text(page.made(after), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
