"""Look-up tables, and many pixels at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accuracy.moves import CAMERA, HOME

from ceres_cal.base.errors import InputError
from ceres_cal.formats import LookupTable, make_lookup_table
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial

X_M, Y_M = np.array([-4.5, 4.5]), np.array([-3.0, 3.0])
LENSES = [CAMERA.lens, Brown((-0.24, 0.082, 4e-4, -3e-4, -0.011)), KannalaBrandt((-0.012, 0.004, -0.003, 0.0006))]


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.kind)
def test_the_error_is_what_is_stated(lens: Lens, tmp_path: Path) -> None:
    camera = replace(CAMERA, lens=lens).at(HOME)
    make_lookup_table(camera, "overhead", X_M, Y_M, 0.2).save(tmp_path / "table.npz")
    table = LookupTable.load(tmp_path / "table.npz")
    pixels = np.random.default_rng(0).uniform((-0.5, -0.5), (1279.5, 959.5), (20_000, 2))
    for height_m in (0.0, 0.07, 0.15, 1.0):
        true = camera.locate(pixels, height_m)
        on_field = np.all((np.abs(true) <= (4.5, 3.0)), axis=1)
        off = 1e3 * np.linalg.norm(table.locate(pixels, height_m) - true, axis=1)[on_field]
        stated = table.error_mm[0.15 if height_m == 0.15 else 0.0][1]
        assert (
            stated <= 0.2 and np.max(off) < 1.02 * stated
        )  # a random pixel is never worse than half way between nodes
        assert np.max(off) > 0.3 * stated


def test_nodes_are_exact_and_the_third_column_is_the_paper_s() -> None:
    camera = CAMERA.at(HOME)
    table = make_lookup_table(camera, "overhead", X_M, Y_M, step_px=32)
    nodes = np.array([[64.0, 96.0], [640.0, 480.0], [1248.0, 928.0]])
    np.testing.assert_allclose(table.locate(nodes, 0.3), camera.locate(nodes, 0.3), atol=1e-12)
    expected = camera.homography(0.3)
    np.testing.assert_allclose(table.homography[:, 2] + 0.3 * table.third_column, expected[:, 2], atol=1e-12)
    assert np.isnan(table.locate([[-500.0, 0.0]])).all()


def test_a_smaller_error_takes_a_finer_grid() -> None:
    steps = [make_lookup_table(CAMERA.at(HOME), "overhead", X_M, Y_M, error).step_px for error in (20.0, 2.0, 0.2)]
    assert steps == sorted(steps, reverse=True) and len(set(steps)) == 3
    small = replace(CAMERA, image_size=(64, 48), principal_point=(31.5, 23.5), phi=40.0, lens=Radial((0.0, 0.0)))
    with pytest.raises(InputError, match="allow a larger error"):
        make_lookup_table(small.at(HOME), "overhead", X_M, Y_M, 1e-7)
    with pytest.raises(InputError, match="step_px"):
        make_lookup_table(CAMERA.at(HOME), "overhead", X_M, Y_M, step_px=0)


def test_what_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not an NPZ file"):
        LookupTable.load(tmp_path / "a.npz")
