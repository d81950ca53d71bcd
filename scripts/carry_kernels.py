"""Compile the kernels that the package carries along: python scripts/carry_kernels.py [--help]

For a baseline that every machine of the last ten years has, into src/ceres_cal/kernels/carried, from where wheels take
them; what is there already, of the same sources, is not made again. Which kernels: those that the commands below call.
A kernel that is not among them is compiled where it is used.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SAMPLE, MOVED = (ROOT / "data" / name / "observations.json" for name in ("ssl_field", "ssl_field_moved"))


def commands(folder: Path) -> list[list[str]]:
    """As they are typed."""
    from ceres_cal.scene.lens import LENSES

    sample = ["calibrate", str(SAMPLE), "--quiet"]
    found = [[*sample, "--output", str(folder / "sample.json")]]
    found += [[*sample, "--lens", lens, "--free-aspect"] for lens in LENSES]
    found += [[*sample, "--closed-form-only"], ["calibrate", str(MOVED), "--quiet"]]
    found += [["diagnose", str(folder / "sample.json"), str(SAMPLE)]]
    found += [["refit", str(folder / "sample.json"), str(MOVED), "--output", str(folder / "moved.json")]]
    found += [["check", str(folder / "sample.json"), str(MOVED)], ["advise", str(folder / "sample.json")]]
    return found


def compile_all() -> int:
    """Run the commands in this process, which compiles what they call; a command that says no has called it too."""
    from ceres_cal.cli import main

    with tempfile.TemporaryDirectory() as folder:
        every = commands(Path(folder))
        for number, command in enumerate(every, 1):
            print(f"\rcompiling the kernels: {number} of {len(every)}", end="", file=sys.stderr, flush=True)
            with redirect_stdout(StringIO()):
                code = main(command)
            if code not in (0, 1):
                print(f"  (code {code}: {' '.join(command[:4])})", file=sys.stderr)
    print(file=sys.stderr)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[1])
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    sys.path.insert(0, str(ROOT / "src"))
    if parser.parse_args().here:
        return compile_all()
    from ceres_cal.kernels.store import BASELINES, CARRIED_FOLDER, digest

    stamp = CARRIED_FOLDER / "sources"  # the lenses' own kernels lie elsewhere than the folder is named after
    package = ROOT / "src" / "ceres_cal"
    sources = digest([*package.glob("kernels/*.py"), *package.glob("scene/lens/*.py")])

    if platform.machine() not in BASELINES:
        print(f"no baseline for {platform.machine()}: kernels are compiled where they are used", file=sys.stderr)
        return 0
    if stamp.is_file() and stamp.read_text() == sources:
        return 0
    name, features = BASELINES[platform.machine()]
    shutil.rmtree(CARRIED_FOLDER.parent, ignore_errors=True)  # or its kernels would be taken instead of compiled
    with tempfile.TemporaryDirectory() as cache:
        baseline = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ",".join(f"+{one}" for one in features)}
        environment = {**os.environ, **baseline, "NUMBA_CACHE_DIR": cache}
        subprocess.run([sys.executable, __file__, "--here"], env=environment, check=True)
        (compiled,) = Path(cache).glob(f"ceres-cal/*/{name}-*")
        shutil.copytree(compiled, CARRIED_FOLDER)
        stamp.write_text(sources)
    return 0


if __name__ == "__main__":
    sys.exit(main())
