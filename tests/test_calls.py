"""Calls of the compiled kernels: valid and invalid arguments, both builds, lenses in Python only, and the wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from test_kernels import looked_at, matrix, normal_equations, take

from ceres_cal import kernels
from ceres_cal.base.arrays import AnyArray, Array
from ceres_cal.base.errors import InputError
from ceres_cal.kernels import Loss, Unknowns
from ceres_cal.problem.residuals import camera_optics
from ceres_cal.scene.lens import Brown

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data" / "ssl_field" / "observations.json"
HUBER = Loss(kernels.LOSS_CODES["huber"], 1.0)


def test_arrays_to_read_may_lie_in_any_way(tmp_path: Path) -> None:
    squared = np.array([0.25, 4.0, 16.0])
    mapped = np.memmap(tmp_path / "values", dtype=float, mode="w+", shape=3)
    mapped[:] = squared
    strided, backwards = np.repeat(squared, 2)[::2], squared[::-1].copy()[::-1]
    frozen = squared.copy()
    frozen.flags.writeable = False
    every: tuple[AnyArray, ...] = (
        squared,
        mapped,
        strided,
        backwards,
        frozen,
        squared.astype(np.float32),
        np.array([0, 4, 16]),
    )
    for values in every:
        found = np.empty(3)
        kernels.loss_weights(HUBER, values, found)
        assert found[1:].tolist() == [0.5, 0.25]


def test_arrays_to_fill_must_be_right_as_they_are() -> None:
    """Otherwise a copy would be filled instead."""
    squared, frozen = np.array([0.25, 4.0, 16.0]), np.zeros(3)
    frozen.flags.writeable = False
    filled: tuple[AnyArray, ...] = (frozen, np.zeros(6)[::2], np.zeros(3, np.float32), np.zeros((3, 1)))
    for wrong in filled:
        with pytest.raises(TypeError):
            kernels.loss_weights(HUBER, squared, wrong)
        assert not wrong.any()
    refused: tuple[Any, ...] = (1.0, "squared", None)
    for given in refused:
        with pytest.raises(TypeError):
            kernels.loss_weights(HUBER, given, np.empty(3))
    with pytest.raises(ValueError, match=r"squared and weights are \(N,\)"):
        kernels.loss_weights(HUBER, squared, np.empty(4))


def test_rows_that_are_not_there_are_refused() -> None:
    """They are never read, since memory behind an array is not its own."""
    camera, seen = looked_at("brown")
    points, curves = take(seen, points=slice(None), curves=slice(None))
    optics, poses = camera_optics(camera), matrix(camera.cam_from_world)[None]
    count = len(points.pixels)
    of_points = partial(kernels.point_residuals, 0, 1, optics, poses)
    found = np.empty((count, 2))
    for wrong, words in (
        (points._replace(bounds=np.array([0, count + 1])), "fewer observations"),
        (points._replace(bounds=np.array([3, 1])), "must not fall"),
        (points._replace(places=points.places[1:]), "places are"),
    ):
        with pytest.raises(ValueError, match=words):
            of_points(wrong, np.arange(count), found)
    with pytest.raises(ValueError, match="fewer residuals"):
        of_points(points, np.arange(count) + 1, found)
    with pytest.raises(ValueError, match="fewer sights"):
        kernels.point_residuals(0, 2, optics, np.repeat(poses, 2, axis=0), points, np.arange(count), found)
    with pytest.raises(ValueError, match="fewer tracks"):
        kernels.curve_residuals(optics, poses, curves._replace(track=curves.track + 99), np.empty(len(curves.pixels)))
    normals = np.empty((1, 8, 8))
    for unknowns in (Unknowns(np.array([99]), 0), Unknowns(np.arange(3), -1)):
        with pytest.raises(ValueError, match="unknowns"):
            kernels.sight_normals(0, 1, optics, unknowns, points, curves, HUBER, poses, np.ones(8), normals)
    other = optics._replace(form=np.array([50.0, 0.0]))
    with pytest.raises(ValueError, match="fewer numbers than its kind"):
        kernels.point_residuals(0, 1, other, poses, points, np.arange(count), found)


def test_groups_and_coefficients_that_are_not_there_are_refused() -> None:
    shares, rows, bounds = np.array([0.5]), np.zeros((3, 2, 8)), np.array([0, 2])
    strands = partial(kernels.strands_left, np.ones((1, 3)))
    assert strands(bounds, np.array([0, 1]), rows, shares, np.zeros(1), np.zeros((1, 2, 2))) == 0
    for own_bounds, group, room, words in (
        (np.array([0, 3]), np.array([0, 1]), 2, "fewer observations"),
        (bounds, np.array([0, -1]), 2, "from 0 on"),
        (bounds, np.array([0]), 2, "group"),
        (bounds, np.array([0, 1]), 3, "left"),
    ):
        with pytest.raises(ValueError, match=words):
            strands(own_bounds, group, rows, shares, np.zeros(1), np.zeros((1, room, room)))
    plane, errors = np.zeros((6, 2)), np.zeros(6)
    for whole, terms, words in ((np.array([1, 6]), 2, "begin with 0"), (np.array([0, 6]), 5, "one to four")):
        with pytest.raises(ValueError, match=words):
            kernels.radial_alignment(whole, plane, plane, 1.0, 1, np.zeros(terms), errors, errors.copy())


@pytest.mark.parametrize("lens", scenes.EVERY_LENS)
def test_both_builds_answer_alike(lens: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The build for every processor, and the one for processors with AVX2, if the machine has it."""
    camera, seen = looked_at(lens)
    cost, normal = normal_equations(camera, seen, "huber", 1.5)
    monkeypatch.setattr("test_kernels.core", lambda: import_module("ceres_cal.kernels._core"))
    other, plain = normal_equations(camera, seen, "huber", 1.5)
    assert other == pytest.approx(cost, rel=1e-12)  # 1e-15 measured
    size = np.sqrt(np.diag(normal))
    shown = size > 0.0
    error = np.abs(normal - plain)[np.ix_(shown, shown)] / np.outer(size, size)[np.ix_(shown, shown)]
    assert np.max(error) < 1e-8  # 1e-10 measured: a foot is searched to 1e-9 px


@pytest.mark.parametrize("lens", ["radial-2-3", "brown", "kannala-brandt", "spline"])
def test_a_lens_that_python_has_alone_is_solved_as_a_compiled_one(lens: str) -> None:
    """The same formulas under another name, with derivatives by differences."""
    camera, seen = looked_at(lens)
    cost, normal = normal_equations(camera, seen, "huber", 1.5)

    class OwnLens(type(camera.lens)):  # type: ignore[misc]
        kind = "of one's own"

    own = replace(camera, lens=OwnLens(*(getattr(camera.lens, one.name) for one in fields(camera.lens))))
    assert camera_optics(own).kind == ""
    other, plain = normal_equations(own, seen, "huber", 1.5)
    assert other == pytest.approx(cost, rel=1e-9)  # 2e-13 measured
    kept = [k for k in range(len(normal)) if not (lens == "spline" and k == 4)]  # its knots are no unknown
    size = np.sqrt(np.diag(normal))
    error = (np.abs(normal - plain) / np.outer(size, size))[np.ix_(kept, kept)]
    assert np.max(error) < 1e-7


@dataclass(frozen=True)
class BrokenLens(Brown):
    kind = "broken"

    def _distort(self, rays: Array, phi: float) -> Array:
        raise InputError("a lens that cannot be asked")


def test_what_a_lens_raises_is_said() -> None:
    camera, seen = looked_at("brown")
    with pytest.raises(InputError, match="cannot be asked"):
        normal_equations(replace(camera, lens=BrokenLens()), seen)


def test_what_needs_no_kernel_loads_none(tmp_path: Path) -> None:
    calibration = tmp_path / "calibration.json"
    code = (
        "import sys, ceres_cal; from ceres_cal.cli import main\n"
        "loaded = lambda: any('kernels._core' in name for name in sys.modules)\n"
        "assert main(['targets']) == 0 and main(['targets', 'ssl-field']) == 0 and not loaded()\n"
        f"main(['calibrate', {str(SAMPLE)!r}, '-o', {str(calibration)!r}, '--quiet'])\n"
        "assert loaded()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


WHEEL_MB = 2.0
_OURS = ("PYTHONPATH", "XDG_CACHE_HOME")
BARE = {name: value for name, value in os.environ.items() if name not in _OURS}


def test_a_wheel_in_a_clean_environment_calibrates(tmp_path: Path) -> None:
    """Files compiled by scripts/setup are in build/, so that only changes are compiled."""
    pytest.importorskip("scikit_build_core")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path), str(ROOT)]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    subprocess.run(build, check=True, capture_output=True, env={**os.environ, "PATH": path})
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stat().st_size < 1e6 * WHEEL_MB
    clean = tmp_path / "clean"
    venv.create(clean)
    site = next((clean / "lib").glob("python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True, capture_output=True)
    assert not list(site.rglob("*.hpp"))
    web = ROOT / "src/ceres_cal/cli/page/web"
    assert {path.name for path in (site / "ceres_cal/cli/page/web").iterdir()} == {path.name for path in web.iterdir()}
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # they are not what is tested here
    code = "import sys, ceres_cal; from ceres_cal.cli import main; print(ceres_cal.__file__); main(sys.argv[1:])"
    command = [str(clean / "bin" / "python"), "-c", code, "calibrate", str(SAMPLE), "--quiet"]
    found = subprocess.run(command, env=BARE, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert found.returncode == 0 and found.stderr == "", found
    assert found.stdout.startswith(str(site)) and "This calibration can be trusted" in found.stdout
