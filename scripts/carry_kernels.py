"""Compile the kernels that the package carries along: python scripts/carry_kernels.py [--help]

For a baseline that every machine of the last ten years has, into a shared library in src/ceres_cal/kernels/carried,
from where wheels take it; what is there already, of the same sources, is not made again. Without a C++ compiler, which
links it, or on a machine without a baseline, they are compiled where they are used.
"""

from __future__ import annotations

import argparse
import logging
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def compile_all() -> int:
    """All that is called from outside of the kernels, and what lenses do for them."""
    from ceres_cal.kernels import KERNELS
    from ceres_cal.kernels.library import library_path
    from ceres_cal.kernels.linking import link
    from ceres_cal.scene.lens import LENSES

    logging.getLogger("ceres_cal").setLevel(logging.ERROR)  # the bar says that it takes time
    lenses = {(lens.prepare, lens.distort_chunk, lens.differentiate_chunk) for lens in LENSES.values()}
    steps = len(KERNELS) + len(lenses)
    for done, _ in enumerate(link(library_path(), list(KERNELS), sorted(lenses, key=str)), 1):
        print(f"\rcompiling the kernels: {done} of {steps}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[1])
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    sys.path[0] = str(ROOT / "src")  # numba would take scripts here for what it may import
    if parser.parse_args().here:
        return compile_all()
    from ceres_cal.kernels.library import BASELINES, library_path
    from ceres_cal.kernels.linking import compiler

    if library_path().is_file():
        return 0
    if platform.machine() not in BASELINES or compiler() is None:
        what = "C++ compiler" if compiler() is None else f"baseline for {platform.machine()}"
        print(f"no {what}: kernels are compiled where they are used", file=sys.stderr)
        return 0
    name, features = BASELINES[platform.machine()]
    shutil.rmtree(library_path().parent, ignore_errors=True)  # what older sources made
    with tempfile.TemporaryDirectory() as cache:
        baseline = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ",".join(f"+{one}" for one in features)}
        environment = {**os.environ, **baseline, "NUMBA_CACHE_DIR": cache}
        subprocess.run([sys.executable, __file__, "--here"], env=environment, check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
