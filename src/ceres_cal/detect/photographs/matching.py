"""Assignment of lines in a photograph to lines of a target, for a floor known except for place, size and quarter turns.

Two parallel lines of the floor assigned to two of the target determine the camera's height and one coordinate of its
place, and one line across determines the other: every such choice, in all four turns, is a hypothesis. Its score is how
much likelier it makes the paint that was found than lines laid anywhere. Mirrored hypotheses do not arise: the camera
stands above a floor whose z points up, and a rotation mirrors nothing.
"""

from __future__ import annotations

from math import gcd

import numpy as np

from ceres_cal.base import Array, Frozen, Mask, Pose, cached_property, replace
from ceres_cal.detect.photographs.grid import LineGrid, places_along
from ceres_cal.detect.photographs.upright import Upright
from ceres_cal.detect.registration import REDUCED, Nearness
from ceres_cal.detect.strokes import Strokes, alone
from ceres_cal.kernels import lines_near

# Width of a peak of strokes in position across a line, in camera heights: the accuracy of a straightened stroke.
_PEAK = 0.012
_MOST_PEAKS, _LEAST_PEAK = 9, 0.015  # largest number of lines in one direction; least share of all strokes in one line
# Largest sine of the angle between a stroke and its line: 9 degrees, as lens and tilt are still rough.
_PARALLEL = 0.15
# Distance within which two hypotheses are one, in camera heights.
_CELL = 0.03
# Least number of choices of two lines one way that are tried with each line across, to save time.
_PAIRS = 120
_FEW, _MANY = 60, 300  # number of places on the target at which all hypotheses, and the best ones, are scored
# Least share of the places on the target that are in view: a camera that shows less is too near.
_LEAST_IN_VIEW = 0.03
CROWDED = 0.12  # distance in half diagonals, within which a target hardly ever has parallel lines
_QUARTERS = np.array([[[c, -s, 0], [s, c, 0], [0, 0, 1]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))], dtype=float)


class StrokeMap(Frozen):
    """The strokes of a photograph, how near each pixel is to them, the image's size, and the lens's centre (2,) px."""

    strokes: Strokes
    near: Nearness
    image_size: tuple[int, int]
    centre: Array

    @property
    def unit_px(self) -> float:
        """Half the image's diagonal, px."""
        return 0.5 * float(np.hypot(*self.image_size))

    @property
    def ends(self) -> Array:
        """(N, 2, 2) the strokes' ends relative to the centre, in half image diagonals."""
        return np.asarray((self.strokes.ends - self.centre) / self.unit_px)

    @cached_property
    def weights(self) -> Array:
        """(N,) length of each stroke, px, times how much it may be a line of its own."""
        return self.strokes.length_px * alone(self.strokes, CROWDED * self.unit_px)

    @cached_property
    def paint_px(self) -> float:
        """Length of lines that strokes can cover, px; on worn lines they cover the gaps, too."""
        return max(self.near.length_px, 1.0)

    @cached_property
    def _by_chance(self) -> float:
        """Share of any line that strokes cover by chance."""
        return float(np.clip(np.mean(self.near.plane), 1e-3, 0.5))

    def likelihood(self, covered_px: Array, shown_px: Array) -> Array:
        """How much likelier a target is than lines laid anywhere, given the length that it shows and what strokes cover
        of it.

        The log-likelihood ratio of so many successes at any share of paint, divided by its value if the target were the
        strokes: from 0 to about 1.
        """
        chance = self._by_chance
        covered_px = np.minimum(covered_px, self.paint_px)
        share = np.clip(covered_px / np.maximum(shown_px, 1e-9), chance, 1.0 - 1e-9)
        return np.asarray(shown_px * divergence(share, chance) / max(-self.paint_px * np.log(chance), 1e-9))


def divergence(share: Array | float, other: Array | float) -> Array:
    """Kullback-Leibler divergence of two probabilities: the expected log-likelihood ratio of one trial."""
    share, other = (np.clip(one, 1e-6, 1.0 - 1e-6) for one in (share, other))
    return np.asarray(share * np.log(share / other) + (1.0 - share) * np.log((1.0 - share) / (1.0 - other)))


class FloorLines(Frozen):
    """Positions of lines on the floor, ascending: x of those along y, and y of those along x.

    The unit is the camera's height; the origin is below the camera.
    """

    x: Array
    y: Array

    def turned(self, quarters: int) -> FloorLines:
        """Return the lines in axes that are rotated by quarter turns, counter-clockwise."""
        lines = self
        for _ in range(quarters):
            lines = FloorLines(lines.y, -lines.x[::-1])
        return lines


def lines_seen(upright: Upright, stroke_map: StrokeMap) -> FloorLines:
    """Return the lines on which most strokes lie."""
    ends, weights = stroke_map.ends, stroke_map.weights
    floor = np.stack([upright.floor(ends[:, 0]), upright.floor(ends[:, 1])], axis=1)
    on_floor = np.all(np.isfinite(floor), axis=(1, 2))
    floor, weights = floor[on_floor], weights[on_floor]
    along = np.diff(floor, axis=1)[:, 0]
    slope = np.abs(along / np.linalg.norm(along, axis=1, keepdims=True))
    middle = floor.mean(axis=1)
    across = (slope < _PARALLEL).T
    parts = zip(middle.T, across, strict=True)
    return FloorLines(*(_peaks(places[rows], weights[rows], float(weights.sum())) for places, rows in parts))


def match(
    upright: Upright, stroke_map: StrokeMap, grid: LineGrid, lines: FloorLines, least: float
) -> list[tuple[float, Pose]]:
    """Return the best hypotheses for these lines: the score and the target's pose in the camera, the best first, down
    to the share `least` of the best score.
    """
    kept = 250
    few, many = (places_along(grid, count) for count in (_FEW, _MANY))
    scored: list[tuple[float, Array, Array]] = []
    for quarters in range(4 // gcd(4, len(grid.turns))):
        turned = replace(upright, rotation=upright.rotation @ _QUARTERS[quarters])
        hypotheses = _hypotheses(lines.turned(quarters), grid)
        score = _scores(stroke_map, turned, hypotheses, few)
        best = np.argsort(-score)[:kept]
        score = _scores(stroke_map, turned, hypotheses[best], many)
        scored += [(float(value), hypotheses[row], turned.rotation) for value, row in zip(score, best, strict=True)]
    scored.sort(key=lambda one: -one[0])
    turn = np.eye(3)
    turn[:2, :2] = grid.turn
    return [
        (score, Pose.looking(turn @ place[[1, 2, 0]], rotation @ turn.T))
        for score, place, rotation in scored[:kept]
        if score >= least * scored[0][0]
    ]


# ---- hypotheses -----------------------------------------------------------------------------------------------------


def _hypotheses(lines: FloorLines, grid: LineGrid) -> Array:
    """(K, 3) camera height and place x, y in the grid that put two lines one way and one across on lines of it."""
    x, y = lines.x, lines.y
    height_y, place_y = _pairs(y, grid.along)
    height_x, place_x = _pairs(x, grid.across)
    parts = [_crossed(height_y, place_y, x, grid.across)[:, [0, 2, 1]], _crossed(height_x, place_x, y, grid.along)]
    every = np.concatenate(parts)
    every = every[every[:, 0] > 0.0]
    cells = np.round(np.column_stack([np.log(every[:, 0]), every[:, 1:] / every[:, :1]]) / _CELL)
    order = np.lexsort(cells.T[::-1])  # same as np.unique, which compares rows one by one
    return every[order[np.any(np.diff(cells[order], axis=0, prepend=np.nan), axis=1)]]


def _pairs(peaks: Array, lines: Array) -> tuple[Array, Array]:
    """Camera height and place for every two lines seen when assigned to two lines of the grid, in the same order."""
    i, j = np.triu_indices(len(peaks), 1)
    a, b = np.triu_indices(len(lines), 1)
    height = (lines[b] - lines[a])[None] / (peaks[j] - peaks[i])[:, None]
    place = lines[a][None] - height * peaks[i][:, None]
    return _telling(height.ravel(), place.ravel(), peaks, lines)


def _telling(height: Array, place: Array, peaks: Array, lines: Array) -> tuple[Array, Array]:
    """Keep the hypotheses that put most of the lines seen on lines of the grid; all of them where many are equally
    good.
    """
    if len(height) <= _PAIRS:
        return height, place
    where = (lines - place[:, None]) / height[:, None]
    near = np.min(np.abs(where[:, None] - peaks[:, None]), axis=2) < 2.0 * _PEAK
    count = np.count_nonzero(near, axis=1)
    kept = count >= np.sort(count)[-_PAIRS]
    return height[kept], place[kept]


def _crossed(height: Array, place: Array, peaks: Array, lines: Array) -> Array:
    """(K, 3) each height and place, and the place across for each line seen when assigned to each line of the grid."""
    other = lines[None, None] - height[:, None, None] * peaks[None, :, None]
    count = len(peaks) * len(lines)
    return np.column_stack([np.repeat(height, count), np.repeat(place, count), other.ravel()])


def _peaks(values: Array, weights: Array, total: float) -> Array:
    """Return the positions where most strokes lie, ascending."""
    chosen: list[float] = []
    left = weights.copy()
    for _ in range(_MOST_PEAKS):
        density = np.exp(-(((values[:, None] - values) / _PEAK) ** 2)) @ left if len(values) else left
        if not len(density) or np.max(density) < _LEAST_PEAK * total:
            break
        near = np.abs(values - values[np.argmax(density)]) < 2.0 * _PEAK
        chosen.append(float(np.average(values[near], weights=left[near] + 1e-9)))
        left[near] = 0.0
    return np.sort(np.array(chosen))


# ---- their scores --------------------------------------------------------------------------------------------------


def _scores(stroke_map: StrokeMap, upright: Upright, hypotheses: Array, places: tuple[Array, Mask]) -> Array:
    """(K,) score of each hypothesis, from 0 to 1."""
    there, first = places
    optics = upright.bend, upright.phi, stroke_map.unit_px, *stroke_map.centre, *stroke_map.image_size
    # Rays from the camera are in metres, as they may have any length.
    along, feet = upright.rotation[:, :2] @ there.T, hypotheses[:, [1, 2, 0]] @ upright.rotation.T
    sums = np.empty((len(hypotheses), 3))
    near = stroke_map.near
    lines_near(near.plane, REDUCED, optics, along.astype(np.float32), ~first, feet.astype(np.float32), sums)
    covered, shown, inside = sums.T
    return np.where(inside >= _LEAST_IN_VIEW, stroke_map.likelihood(covered, shown), 0.0)
