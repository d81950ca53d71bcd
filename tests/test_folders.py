"""Observations in a folder of columns: the same to the last bit, with at most one block in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import two_cameras
from test_competing import NOISE, half_field

from ceres_cal.base.errors import InputError
from ceres_cal.base.threads import at_most
from ceres_cal.observations import Observations, columns
from ceres_cal.simulate import simulate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stored") / "day.columns"
    simulate(two_cameras("radial-2-3"), NOISE, 1).observations.save(path)
    return path


def test_every_number_comes_back_and_stays_in_its_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "_BLOCK", 37)
    given, back = simulate(two_cameras("radial-2-3"), NOISE, 1).observations, Observations.load(folder)
    for one, other in ((given.points, back.points), (given.curves, back.curves)):
        for name, array in vars(one).items():
            stored = getattr(other, name)
            assert isinstance(stored, np.memmap), name
            np.testing.assert_array_equal(stored, array)
    assert back.digest == given.digest
    assert back.views == given.views


def test_it_is_joined_from_other_files_and_read_like_them(folder: Path, tmp_path: Path) -> None:
    Observations.load(folder).save(tmp_path / "day.npz")
    assert Observations.load(tmp_path / "day.npz").digest == Observations.load(folder).digest


def test_a_folder_that_is_there_is_kept(folder: Path) -> None:
    with pytest.raises(InputError, match=r"day.columns: exists already: remove it"):
        Observations.load(folder).save(folder)


@pytest.mark.parametrize(
    ("column", "content", "words"),
    [
        ("points_view", None, "column points_view is missing"),
        ("curves_pixels", b"nonsense", "curves_pixels.npy: cannot be read"),
        ("curves_side", "short", "curves_side.npy: cannot be read: it is cut short"),
    ],
)
def test_what_is_broken_is_named(
    column: str, content: bytes | str | None, words: str, folder: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.columns"
    broken.mkdir()
    for file in folder.iterdir():
        (broken / file.name).write_bytes(file.read_bytes())
    file = broken / f"{column}.npy"
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content if isinstance(content, bytes) else file.read_bytes()[:-5])
    with pytest.raises(InputError, match=words):
        Observations.load(broken)


def test_wrong_rows_are_named_whatever_block_they_are_in(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = simulate(half_field(2), NOISE, 1).observations
    monkeypatch.setattr(columns, "_BLOCK", 50)
    for row in (49, 50, 120):
        pixels = sound.curves.pixels.copy()
        pixels[row] = np.nan
        name = sound.feature_name("curve", row)
        with pytest.raises(InputError, match=f"'{name}': its pixel is not finite"):
            _with_curves(sound, pixels=pixels)
    with pytest.raises(InputError, match="not in the order of their views"):
        _with_curves(sound, view=np.r_[np.full(50, 1), np.zeros(len(sound.curves) - 50)].astype(np.int32))


def test_blocks_that_threads_look_at_say_what_one_says(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = simulate(half_field(2), NOISE, 1).observations
    pixels, twice = sound.curves.pixels.copy(), sound.curves.pixels.copy()
    pixels[[30, 260]], twice[271] = np.nan, twice[270]
    copied = _with_curves(sound, pixels=twice, feature=np.full(len(twice), sound.curves.feature[0]))
    counts, copies = [np.diff(own) for own in sound.ends], copied.copies.curves
    monkeypatch.setattr(columns, "_BLOCK", 50)
    monkeypatch.setattr(columns, "_ROW_NS", 1e5)
    with at_most(4):
        for now, then in zip(replace(sound).ends, counts, strict=True):
            np.testing.assert_array_equal(np.diff(now), then)
        assert np.flatnonzero(copies >= 0).tolist() == [271]
        np.testing.assert_array_equal(replace(copied).copies.curves, copies)
        with pytest.raises(InputError, match=f"'{sound.feature_name('curve', 30)}': its pixel is not finite"):
            _with_curves(sound, pixels=pixels)


def _with_curves(observations: Observations, **changed: object) -> Observations:
    return replace(observations, curves=replace(observations.curves, **changed))  # type: ignore[arg-type]
