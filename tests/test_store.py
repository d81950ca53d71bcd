"""The kernels' machine code: a library that wheels carry along, and files of what is compiled here."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import time
import venv
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import TypingError

from ceres_cal import kernels
from ceres_cal.base.arrays import AnyArray
from ceres_cal.kernels import Loss
from ceres_cal.kernels.library import library_path

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data" / "ssl_field" / "observations.json"
WHEEL_MB = 25.0  # 1.1
FIRST_S = 10.0  # 1.5 on two busy cores; compiling takes 45
_OURS = ("PYTHONPATH", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
BARE = {name: value for name, value in os.environ.items() if name not in _OURS}

needs_library = pytest.mark.skipif(not library_path().is_file(), reason="nothing is carried: scripts/carry_kernels.py")
MODULE = """
from ceres_cal.kernels.jit import jit

@jit
def halved(x):
    if x < 0.0:
        raise ValueError("negative")
    return 0.5 * x

@jit
def quarter(x):
    return halved(halved(x))

print(quarter(8.0), sum(quarter.stats.cache_misses.values()) + sum(halved.stats.cache_misses.values()))
try:
    quarter(-1.0)
except ValueError as error:
    print(error)
"""


def test_kernels_are_found_again_or_made_anew(tmp_path: Path) -> None:
    """Also where one whose callee was read from a file is compiled: then its bitcode is wanted after all."""
    module, folder = tmp_path / "module.py", tmp_path / "cache"
    module.write_text(MODULE)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}

    def run() -> tuple[list[str], str]:
        found = subprocess.run([sys.executable, module], env=environment, capture_output=True, text=True, check=True)
        return found.stdout.split(), found.stderr

    said, warned = run()
    assert said == ["2.0", "2", "negative"]
    assert warned.startswith("ceres-cal: compiling kernels for this machine") and warned.count("\n") == 1
    assert run() == (["2.0", "0", "negative"], "")
    (outer,) = folder.rglob("quarter-*.nbc")
    outer.unlink()
    assert run()[0] == ["2.0", "1", "negative"]
    outer.write_bytes(b"\x80\x04damaged")
    assert run()[0] == ["2.0", "1", "negative"]
    assert run() == (["2.0", "0", "negative"], "")


@needs_library
@pytest.mark.parametrize("odd", [False, True])
def test_the_library_answers_as_numba_does(odd: bool) -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(600 + odd, 3))
    products, bounds, squared = points.T @ points, np.array([0, 200, 600 + odd]), rng.chisquare(2, 600 + odd)
    loss = Loss(kernels.LOSS_CODES["huber"], 1.5)
    for kernel, given, shape in (
        (kernels.cholesky, (products,), (3, 3)),
        (kernels.grouped_scatter, (points, bounds), (2, 3, 3)),
        (kernels.usual_by_radius, (squared, np.abs(points[:, 0])), squared.shape),
        (kernels.loss_weights, (loss, squared), squared.shape),
    ):
        found, expected = np.full(shape, np.nan), np.zeros(shape)
        assert kernel(*given, found)
        kernel.compiled(*given, expected)
        np.testing.assert_array_equal(found, expected)


@needs_library
def test_only_what_is_laid_out_as_the_library_wants_goes_there(tmp_path: Path) -> None:
    """Anything else is compiled for, or refused as numba does: never read as what it is not."""
    loss, squared = Loss(kernels.LOSS_CODES["huber"], 1.0), np.array([0.25, 4.0, 16.0])
    expected = [1.0, 0.5, 0.25]

    def weights(values: AnyArray) -> list[float]:
        found = np.empty(3)
        kernels.loss_weights(loss, values, found)
        return found.tolist()

    mapped = np.memmap(tmp_path / "values", dtype=float, mode="w+", shape=3)
    mapped[:] = squared
    strided = np.repeat(squared, 2)[::2]
    for values in (squared, mapped, strided, squared.astype(np.float32), squared.astype(int) + squared % 1):
        assert weights(values) == expected
    frozen = np.zeros(3)
    frozen.flags.writeable = False
    with pytest.raises(TypingError, match="readonly"):
        kernels.loss_weights(loss, squared, frozen)
    for given in (1.0, "squared", None):
        with pytest.raises(TypingError):
            kernels.loss_weights(loss, given, np.empty(3))
    with pytest.raises(TypeError):
        kernels.loss_weights(loss, squared)


def test_a_wheel_in_a_clean_environment_calibrates_without_compiling(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stat().st_size < 1e6 * WHEEL_MB
    home, clean = tmp_path / "home", tmp_path / "clean"
    home.mkdir()
    home.joinpath(".cache").write_text("")  # nothing can be kept there: what is carried must do
    venv.create(clean)
    site = next((clean / "lib").glob("python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True, capture_output=True)
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # they are not what is tested here
    code = "import sys, ceres_cal; from ceres_cal.cli import main; print(ceres_cal.__file__); main(sys.argv[1:]); "
    code += "print({'numba', 'llvmlite'} & sys.modules.keys())"
    command = [str(clean / "bin" / "python"), "-c", code, "calibrate", str(SAMPLE), "--quiet"]
    start = time.perf_counter()
    found = subprocess.run(command, env={**BARE, "HOME": str(home)}, cwd=home, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    assert found.returncode == 0 and found.stderr == "", found
    assert found.stdout.startswith(str(site)) and "verdict" in found.stdout
    assert found.stdout.endswith("\nset()\n")  # loading the compiler takes longer than most solves
    assert seconds < FIRST_S
