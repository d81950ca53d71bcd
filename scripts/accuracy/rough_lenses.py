"""Wide lenses that are rougher than any formula, with many boards: python scripts/run.py rough_lenses [--help]

The lens is stereographic to 84 degrees over 6016 x 4016 px. Added are a wave along the radius, decentring, and waves of
random directions with a given size, px, and length (one over the wave number, px). There are 186 views of a board of
10 x 10 corners that is bowed by 1 mm, with 0.4 px of independent noise, 0.12 px of noise that is correlated over a
board, and 2 % outliers. Everything is calibrated with default options. The first row is the estimated noise over the
true one, the second the error of rays over the stated standard deviation (as in other_lenses.py), the others the
difference between random halves of the views over what both state (as in halves.py). Exits with 1 when a figure is
missed by more than two standard errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from halves import agreement, halves, seen_grid
from runner import Row, mean_and_error, root_and_error, script

from accuracy.other_lenses import board_views, off_over_stated
from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import rotation_exp
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.scene.targets import checkerboard

_SIZE, _CENTRE, _PHI, _REACH_DEG = (6016, 4016), np.array([3021.3, 1997.8]), 1900.0, 86.0
_BOARD = checkerboard(10, 10, 0.0588)
_VIEWS, _NOISE_PX, _TOGETHER_PX, _OUTLIERS, _LEAST_CORNERS, _MARGIN_PX = 186, 0.4, 0.12, 0.02, 25, 4.0
_WAVES = 400  # whose sum is a random displacement


@dataclass(frozen=True)
class RoughLens:
    """A lens: amplitude of its wave along the radius, px, and number of periods to the corner; amplitude of its random
    waves, px, and their length (one over the wave number, px).
    """

    along_px: float
    turns: float
    across_px: float
    length_px: float

    def shown(self, places: Array, seed: int) -> Array:
        """Directions (N, 3) -> pixels (N, 2)."""
        rng = np.random.default_rng(seed)
        across = np.linalg.norm(places[:, :2], axis=1)
        angle, corner_px = np.arctan2(across, places[:, 2]), 0.5 * float(np.hypot(*_SIZE))
        radius = 2.0 * np.tan(0.5 * angle) * _PHI / corner_px
        along = self.along_px * radius**2 * np.sin(2.0 * np.pi * self.turns * radius + 0.7)
        bent = radius * corner_px - 30.0 * radius**3 + 12.0 * radius**5 + along
        offsets = places[:, :2] * (bent / np.maximum(across, 1e-12))[:, None]
        x, y = (offsets / corner_px).T
        square = x * x + y * y
        offsets += np.column_stack([3.0 * x * y - square - 2.0 * x * x, 1.5 * (square + 2.0 * y * y) - 2.0 * x * y])
        numbers, phases = rng.standard_normal((_WAVES, 2)) / self.length_px, rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES))
        size = self.across_px * np.sqrt(2.0 / _WAVES)
        waves = [size * np.sum(np.cos(offsets @ numbers.T + phase), axis=1) for phase in phases]
        return np.asarray(_CENTRE + offsets + np.column_stack(waves))


LENSES = {
    "smooth": RoughLens(0.0, 0.0, 0.0, 1000.0),
    "long waves": RoughLens(2.0, 1.5, 0.4, 1500.0),
    "waves": RoughLens(3.0, 2.5, 0.4, 800.0),
    "short waves": RoughLens(3.0, 4.0, 0.3, 450.0),
    "waves along the radius": RoughLens(1.5, 7.0, 0.0, 1000.0),
}


def _bowed() -> Array:
    places = _BOARD.point_array - _BOARD.point_array.mean(axis=0)
    x, y = (places[:, :2] / np.abs(places[:, :2]).max(axis=0)).T
    return np.asarray(places + np.outer(1e-3 * (1.0 - x * x) - 0.5e-3 * (1.0 - y * y), (0.0, 0.0, 1.0)))


def observed(lens: RoughLens, seed: int) -> Observations:
    """The corners of the board in all views."""
    rng, places = np.random.default_rng(seed), _bowed()
    apart = places[:, None, :2] - places[None, :, :2]
    agree = np.exp(-0.5 * np.sum(apart**2, axis=2) / (3.0 * 0.0588) ** 2) + 1e-9 * np.eye(len(places))
    pixels, features = zip(
        *(_view(lens, seed, places, np.linalg.cholesky(agree), rng) for _ in range(_VIEWS)), strict=True
    )
    return board_views(_BOARD, _SIZE, pixels, features)


def _view(lens: RoughLens, seed: int, board: Array, agree: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pixels and numbers of the visible corners of a random view that shows enough of them."""
    while True:
        axis = rng.standard_normal(3)
        turn = rotation_exp(axis / np.linalg.norm(axis) * np.deg2rad(rng.uniform(5.0, 45.0)))
        angle, around = np.deg2rad(_REACH_DEG) * np.sqrt(rng.uniform(0.0, 0.75)), rng.uniform(0.0, 2.0 * np.pi)
        towards = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
        facing = rotation_exp(np.array([-np.sin(around), np.cos(around), 0.0]) * angle * rng.uniform(0.4, 1.1))
        places = board @ turn.T @ facing.T + rng.uniform(0.35, 1.1) * towards
        ahead = np.flatnonzero(places[:, 2] > 0.035 * np.linalg.norm(places, axis=1))
        pixels = lens.shown(places[ahead], seed)
        inside = np.all((pixels > _MARGIN_PX) & (pixels < np.array(_SIZE) - _MARGIN_PX), axis=1)
        if np.count_nonzero(inside) >= _LEAST_CORNERS:
            shown = ahead[inside]
            noise = (
                _NOISE_PX * rng.standard_normal((len(shown), 2))
                + _TOGETHER_PX * (agree @ rng.standard_normal((len(agree), 2)))[shown]
            )
            wrong = rng.uniform(size=len(shown)) < _OUTLIERS
            noise[wrong] += 1.5 * rng.standard_t(2, size=(np.count_nonzero(wrong), 2))
            return pixels[inside] + noise, shown.astype(np.int32)


def rows(name: str, runs: int) -> Iterator[Row]:
    """The figures of one lens."""
    lens, scales, off, apart, chosen = LENSES[name], [], [], [], Counter[str]()
    for seed in range(runs):
        seen = observed(lens, seed)
        whole, pixels = calibrate(seen), seen_grid(seen)
        chosen[" ".join([whole.options.lens, *whole.options.terms])] += 1
        scales.append(whole.fit.point_scale)
        off.append(off_over_stated(whole, partial(lens.shown, seed=seed), seen))
        one, other = (calibrate(half) for half in halves(seen, seed))
        apart.append(agreement(one, other, pixels))
    note = ", ".join(f"{term} {count}" for term, count in chosen.most_common())
    noise = float(np.hypot(_NOISE_PX, _TOGETHER_PX))
    yield Row(name, "noise found over true", *mean_and_error(np.array(scales) / noise), 0.95, 1.05, note)
    yield Row(name, "error over stated, rms", *root_and_error(off), 0.5, 1.25, note)
    for what in ("intrinsics", "projections"):
        squares = [value for one in apart if np.isfinite(value := getattr(one, what))]  # halves with other lenses: none
        if squares:
            yield Row(name, f"halves, {what} over stated", *root_and_error(squares), 0.4, 1.25, note)


main = script({name: partial(rows, name) for name in LENSES}, __doc__, (6, "scenes of each lens"), 2)
