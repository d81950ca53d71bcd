"""A smoke run on each Python, with the oldest and newest allowed dependencies: python scripts/versions.py [--help]

uv builds a wheel for each Python, and installs it with its dependencies into build/versions. Each environment detects,
calibrates, diagnoses, reports and exports; the numbers must agree between all of them. `scripts/test --versions` runs
this script. Exits with 1 where one fails or differs.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "versions"
PYTHONS = ("3.11", "3.12", "3.13")
RESOLUTIONS = ("lowest-direct", "highest")
HOME = ROOT / "data" / "ssl_field"
AGREEMENT = 1e-6  # relative, of phi; solves end with a tolerance of 5e-8


def uv(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run uv from its own environment."""
    program = FOLDER / "uv" / "bin" / "uv"
    if not program.is_file():
        subprocess.run([sys.executable, "-m", "venv", FOLDER / "uv"], check=True)
        subprocess.run(
            [FOLDER / "uv" / "bin" / "pip", "install", "--quiet", "uv"], check=True, stderr=subprocess.DEVNULL
        )
    others = sorted(Path.home().glob(".pyenv/versions/*/bin"))  # its shims know only one version
    path = os.pathsep.join([*map(str, others), os.environ["PATH"]])
    own = {**os.environ, "PATH": path}
    return subprocess.run([program, *arguments], env=own, capture_output=True, text=True)


def interpreter(version: str) -> Path | None:
    """A Python of the machine, or one that uv installs; None where there is none."""
    for _ in range(2):
        found = uv("python", "find", "--no-project", version)
        if found.returncode == 0:
            return Path(found.stdout.strip())
        uv("python", "install", version)
    return None


def environment(python: Path, version: str, resolution: str) -> Path:
    """A Python with the package and its dependencies, binary wheels only; RuntimeError where there are none."""
    place = FOLDER / f"{version}-{resolution}"
    python_there = place / "bin" / "python"
    shutil.rmtree(place, ignore_errors=True)
    wheels = FOLDER / f"wheels-{version}"
    steps: list[list[str | Path]] = [["venv", "--no-project", "--python", python, place]]
    if not list(wheels.glob("*.whl")):
        steps.append(["build", "--wheel", "--python", python, "--out-dir", wheels, ROOT])
    for step in steps:
        _done(uv(*step))
    (wheel,) = wheels.glob("*.whl")
    binary = ["--only-binary", ":all:", "--resolution", resolution]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    # Named explicitly: "lowest-direct" applies to direct requirements only, not to those of the wheel.
    _done(uv("pip", "install", "--python", python_there, *binary, wheel, *project["dependencies"]))
    return python_there


def _done(step: subprocess.CompletedProcess[str]) -> None:
    if step.returncode:
        raise RuntimeError(step.stderr.strip().replace("\n", " "))


def smoke(python: Path) -> dict[str, float]:
    """Results of the commands on the sample; RuntimeError where one fails or warns."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)

        def command(*arguments: str | Path, codes: Sequence[int] = (0,)) -> str:
            code = "import sys; from ceres_cal.cli import main; sys.exit(main())"
            own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
            done = subprocess.run(
                [python, "-W", "error::RuntimeWarning", "-c", code, *arguments], env=own, capture_output=True, text=True
            )
            said = done.stderr.splitlines()
            if done.returncode not in codes or said:
                raise RuntimeError(f"{arguments[0]}: exit code {done.returncode}: {' '.join(said)[-300:]}")
            return done.stdout

        board = ["--columns", "9", "--rows", "6", "--square", "0.1"]
        boards = sorted((HOME / "photographs").glob("board_*.jpg"))
        command("detect", "board", *boards, *board, "-o", out / "board.json", "--camera", "overhead", "--quiet")
        command("calibrate", out / "board.json", "-o", out / "from_board.json", "--quiet")
        observations = HOME / "observations.json"
        command("calibrate", observations, "-o", out / "calibration.json", "--report", out / "page.html", "--quiet")
        command("diagnose", out / "calibration.json", observations, codes=(0, 1))
        command("export", out / "calibration.json", "--to", "opencv", "-o", out / "opencv.yml")
        command("locate", out / "calibration.json", "640,480")
        phi, of_boards = (
            float(json.loads((out / name).read_text())["cameras"]["overhead"]["phi"])
            for name in ("calibration.json", "from_board.json")
        )
        return {"phi": phi, "phi_of_boards": of_boards}


def difference(one: dict[str, float], other: dict[str, float]) -> float:
    """Largest relative difference of the focal lengths of two environments."""
    return max(abs(one[name] / other[name] - 1.0) for name in ("phi", "phi_of_boards"))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--python", action="append", choices=PYTHONS, help="only this; repeatable")
    given = parser.parse_args(arguments)
    FOLDER.mkdir(parents=True, exist_ok=True)
    for stale in FOLDER.glob("wheels-*"):
        shutil.rmtree(stale)
    first: dict[str, float] | None = None
    failures = 0
    for version in given.python or PYTHONS:
        python = interpreter(version)
        if python is None:
            print(f"{version}: not on this machine, and not to be installed here: left out")
            continue
        for resolution in RESOLUTIONS:
            try:
                found = smoke(environment(python, version, resolution))
            except RuntimeError as error:
                failures += 1
                print(f"{version} {resolution}: {error}")
                continue
            first = first or found
            off = difference(found, first)
            failures += off > AGREEMENT
            numbers = f"phi {found['phi']:.6f}, of boards {found['phi_of_boards']:.6f}"
            print(f"{version} {resolution}: {numbers}, off {off:.1e}", flush=True)
    if first is None:
        print("nothing was run", file=sys.stderr)
    return 1 if failures or first is None else 0


if __name__ == "__main__":
    sys.exit(main())
