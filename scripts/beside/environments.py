"""An environment for each peer below build/peers, and requests to the peers there."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "build" / "peers"
OURS = "ours"
_WORKER = Path(__file__).with_name("worker.py")
_DEBIAN = "/usr/bin/python3"


@dataclass(frozen=True)
class Peer:
    """How a peer is installed.

    Attributes:
        title: its name. module: the module that is imported. packages: what pip installs, in steps; a step that begins
            with --no-deps is installed without its requirements. debian: packages of Debian for machines where pip
            fails.
        least: the oldest Python that its newest wheel supports. note: remarks on the installation.
    """

    title: str
    module: str
    packages: tuple[tuple[str, ...], ...]
    debian: tuple[str, ...] = ()
    least: tuple[int, int] = (3, 11)
    note: str = ""


PEERS: Mapping[str, Peer] = {
    "opencv": Peer("OpenCV", "cv2", (("opencv-python-headless", "numpy"),)),
    "mrcal": Peer(
        "mrcal", "mrcal",
        (("--no-deps", "mrcal"), ("numpy", "scipy", "numpysane", "gnuplotlib", "shapely", "pyyaml"),
         ("opencv-python-headless",)),
        ("mrcal", "python3-mrcal", "python3-opencv"), (3, 12),
        "its wheel is installed without pyfltk, which draws its windows and needs FLTK 1.4 to be built",
    ),
    "pycolmap": Peer("pycolmap", "pycolmap", (("pycolmap", "opencv-python-headless", "numpy"),)),
    "calibsense": Peer("calibsense", "calibsense", (("--pre", "calibsense"),)),
    "lensboy": Peer("lensboy", "lensboy", (("lensboy",),)),
}  # fmt: skip
TITLES: Mapping[str, str] = {OURS: "ceres-cal", **{name: peer.title for name, peer in PEERS.items()}}
DISTRIBUTIONS = {
    OURS: "ceres-cal", "opencv": "opencv-python-headless", "mrcal": "mrcal", "pycolmap": "pycolmap",
    "calibsense": "calibsense", "lensboy": "lensboy",
}  # fmt: skip


def _pythons() -> Iterator[tuple[tuple[int, int], str]]:
    """Pythons of this machine that run; the newest of those with wheels for most packages come first."""
    found = [shutil.which(f"python3.{minor}") for minor in (12, 13, 11)]
    beside = sorted(Path(sys.base_prefix).parent.glob("3.*/bin/python3"))
    for path in (sys.executable, *found, *map(str, beside)):
        if path:
            code = "import sys; print(*sys.version_info[:2])"
            said = subprocess.run([path, "-c", code], capture_output=True, text=True, check=False)
            if said.returncode == 0:
                major, minor = map(int, said.stdout.split())
                yield (major, minor), path


def _run(*command: str) -> str:
    """The last line of the error message of a command, "" where it succeeds."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in (done.stderr or done.stdout).strip().splitlines() if not line.startswith("WARNING")]
    return "" if done.returncode == 0 else next(iter(lines[-1:]), f"exit code {done.returncode}")


def install(name: str) -> str:
    """Make a peer's environment if it does not exist; returns why it cannot be made, "" on success.

    Debian's package, or one in this Python, is used only where pip fails, since it may be years older.
    """
    peer, folder = PEERS[name], FOLDER / name
    if Path(_in(folder)).exists() and imports(name):
        return ""
    python = next((path for version, path in _pythons() if peer.least <= version), None)
    why = "" if python else f"no Python {peer.least[0]}.{peer.least[1]} or newer is here"
    if python:
        shutil.rmtree(folder, ignore_errors=True)
        why = _run(python, "-m", "venv", str(folder)) or _run(_in(folder), "-m", "pip", "install", "-q", "-U", "pip")
        for packages in peer.packages if not why else ():
            why = why or _run(_in(folder), "-m", "pip", "install", "-q", *packages)
    if not imports(name) and peer.debian:
        shutil.rmtree(folder, ignore_errors=True)
        why = _run("apt-get", "install", "-y", "--no-install-recommends", *peer.debian) or why
    return "" if imports(name) else why or "it cannot be imported"


def _in(folder: Path) -> str:
    return str(folder / "bin" / "python")


def python_of(name: str) -> str:
    """The Python of a peer: that of its environment, Debian's, or this one, whichever exists first."""
    own = _in(FOLDER / name)
    if name == OURS:
        return sys.executable
    if Path(own).exists():
        return own
    return _DEBIAN if PEERS[name].debian else sys.executable


def imports(name: str) -> bool:
    """Whether the peer's Python can import it."""
    return not _run_in(python_of(name), "-c", f"import {PEERS[name].module}")[0]


def _run_in(python: str, *arguments: str) -> tuple[int, str]:
    strange = python != sys.executable
    variables = {k: v for k, v in os.environ.items() if not (strange and k.startswith("PYTHON"))}
    done = subprocess.run([python, *arguments], env=variables, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout if done.returncode == 0 else done.stderr


def version_of(name: str) -> str:
    """Version of the peer in its environment."""
    code, said = _run_in(
        python_of(name), "-c", f"from importlib.metadata import version; print(version({DISTRIBUTIONS[name]!r}))"
    )
    if code == 0:
        return said.strip()
    done = subprocess.run(["dpkg-query", "-W", "-f", "${Version}", name], capture_output=True, text=True, check=False)
    return f"{done.stdout.strip()} (Debian)" if done.returncode == 0 else "unknown"


def ask(name: str, jobs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Answers of a peer to jobs (beside.worker), from a process of its own."""
    if not jobs:
        return []
    with tempfile.TemporaryDirectory() as folder:
        given, answers = Path(folder) / "jobs.json", Path(folder) / "answers.json"
        given.write_text(json.dumps(list(jobs)), encoding="utf-8")
        code, said = _run_in(python_of(name), str(_WORKER), name, str(given), str(answers))
        if code or not answers.exists():
            return [{"refused": f"the process ended with {code}: {said.strip()[-300:]}"} for _ in jobs]
        found: list[dict[str, Any]] = json.loads(answers.read_text(encoding="utf-8"))
    return found
