"""Odd scenes that once gave a wrong answer without a warning: `scripts/accuracy/odd_scenes.py` has the full samples."""

from __future__ import annotations

import pytest
from accuracy.odd_scenes import BESIDE, BY_DEFAULT, MOST_RADII, MOST_SIGMAS, ODD, outcome
from thorough import partly

# Largest error of a "known" number in sigmas, and of a place in radii: before, and measured now.
_MENDED = {
    ("one board", "kannala-brandt", 16): "17780 sd: no lens on the way back from phi 70 px; refused",
    ("one board", "brown", 248): "7.3 sd: a second place of the valley along phi; none known",
    ("one board", "brown", 530): "9.2 sd: bent; none known",
    ("frontal", "brown", 2292): "5.4 sd, 2.9 radii: a runaway phi; 1.9, 0.02",
    ("frontal", "kannala-brandt", 116): "8 sd: two places of the valley; 1.3, 0.3",
    ("points and few line points", "radial", 122): "17 sd, 24 radii: a good point was taken out; 1.1, 1.1",
    ("few line points", "kannala-brandt", 2297): "6.1 sd, 3.4 radii: another minimum; 0, 0.7",
    ("few line points", "kannala-brandt", 1673): "5.6 radii: the map bends; 0.9, 0.6",
    ("few points", "kannala-brandt", 760): "3.9 radii: the map bends; 0, 0.1",
    ("few points", "kannala-brandt", 40): "divided by 0: without the prior nothing says anything of a number; 1.5, 0.5",
    ("points and few line points", "brown", 1978): "7.6 sd, 4.2 radii: another minimum costs less; 1.4, 0.5",
    ("few line points", "radial", 1609): "a traceback: beside its phi nothing can be solved for; refused",
}


@pytest.mark.parametrize("scene", partly(_MENDED, [*_MENDED][:6]), ids=str)
def test_no_silent_wrong_answer(scene: tuple[str, str, int]) -> None:
    """Refused, or no "known" number beyond 5 sd and no place beyond 2.5 radii."""
    kind, lens, seed = scene
    found = outcome(kind, ODD[kind], lens, seed)
    assert found.sigmas < MOST_SIGMAS and found.radii < MOST_RADII


@pytest.mark.parametrize("seed", partly(range(2), [0]))
@pytest.mark.parametrize("lens", ["radial", "brown", "kannala-brandt"])
def test_few_points_beside_lines(lens: str, seed: int) -> None:
    """A few points, through which the fit nearly passes, and some 150 line points."""
    found = outcome("5 to 8 points beside lines", BESIDE["5 to 8 points beside lines"], lens, seed)
    assert not found.refused
    assert found.sigmas < MOST_SIGMAS and found.radii < MOST_RADII


def test_a_wide_lens_above_a_field_by_default() -> None:
    """The lens that predicts best by default has one coefficient; its phi had an error of 5.3 sd, now 2.0."""
    found = outcome("above a field", BY_DEFAULT["above a field"], "kannala-brandt", 64)
    assert found.sigmas < MOST_SIGMAS and found.radii < MOST_RADII
