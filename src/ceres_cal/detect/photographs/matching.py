"""Which line of a target is which in a photograph whose floor is known but for place, size and quarter turns.

Two parallel lines of the floor taken for two of the target tell the camera's height and one coordinate of its place,
one line across tells the other: every such choice, in all four turns, is a hypothesis. Its score is how much likelier
it makes the paint that was found than lines laid anywhere. Mirrored choices do not arise: the camera stands above a
floor whose z points up, and a rotation mirrors nothing.
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

# Of lines on the floor, in camera heights: how well a straightened stroke tells its place.
_PEAK = 0.012
_MOST_PEAKS, _LEAST_PEAK = 9, 0.015  # of lines in one direction; of all strokes, in one line
# Sine of the angle by which a stroke may be off the direction of its line: 9 degrees, as lens and tilt are rough yet.
_PARALLEL = 0.15
# Within which two hypotheses are one, in camera heights.
_CELL = 0.03
# Choices of two lines one way, at least, that are tried with each one across: it only saves time.
_PAIRS = 120
_FEW, _MANY = 60, 300  # places on the target at which all, and the best, are tried
# Of the places on the target: a camera nearer than that sees too little of it.
_LEAST_IN_VIEW = 0.03
CROWDED = 0.12  # half diagonals within which lines of a target hardly ever run beside each other
_QUARTERS = np.array([[[c, -s, 0], [s, c, 0], [0, 0, 1]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))], dtype=float)


class StrokeMap(Frozen):
    """The strokes of a photograph, how near each pixel is to them, and the lens's centre (2,) px."""

    strokes: Strokes
    near: Nearness
    image_size: tuple[int, int]
    centre: Array

    @property
    def unit_px(self) -> float:
        """Half the image's diagonal."""
        return 0.5 * float(np.hypot(*self.image_size))

    @property
    def ends(self) -> Array:
        """(N, 2, 2) the strokes' ends from the centre, in half image diagonals."""
        return np.asarray((self.strokes.ends - self.centre) / self.unit_px)

    @cached_property
    def weights(self) -> Array:
        """(N,) px of each stroke, as far as it may be a line."""
        return self.strokes.length_px * alone(self.strokes, CROWDED * self.unit_px)

    @cached_property
    def paint_px(self) -> float:
        """The length of any lines that strokes can cover: of worn lines they cover the gaps, too."""
        return max(self.near.length_px, 1.0)

    @cached_property
    def _by_chance(self) -> float:
        """The share of any line that strokes cover by chance."""
        return float(np.clip(np.mean(self.near.plane), 1e-3, 0.5))

    def likelihood(self, covered_px: Array, shown_px: Array) -> Array:
        """How much likelier a target is than lines laid anywhere, by how much of what it shows strokes cover.

        The log-likelihood ratio of so many successes, at whatever share of the paint is left, over what it would be if
        the target were the strokes: from 0 to about 1.
        """
        chance = self._by_chance
        covered_px = np.minimum(covered_px, self.paint_px)
        share = np.clip(covered_px / np.maximum(shown_px, 1e-9), chance, 1.0 - 1e-9)
        return np.asarray(shown_px * divergence(share, chance) / max(-self.paint_px * np.log(chance), 1e-9))


def divergence(share: Array | float, other: Array | float) -> Array:
    """Kullback and Leibler's, of two probabilities: what a trial tells of the first against the second."""
    share, other = (np.clip(one, 1e-6, 1.0 - 1e-6) for one in (share, other))
    return np.asarray(share * np.log(share / other) + (1.0 - share) * np.log((1.0 - share) / (1.0 - other)))


class FloorLines(Frozen):
    """Where lines lie on the floor, in increasing order: x of those that run along y, and y of those along x.

    In camera heights from the place below the camera.
    """

    x: Array
    y: Array

    def turned(self, quarters: int) -> FloorLines:
        """The same in axes that are turned by quarters, counter-clockwise."""
        lines = self
        for _ in range(quarters):
            lines = FloorLines(lines.y, -lines.x[::-1])
        return lines


def lines_seen(upright: Upright, stroke_map: StrokeMap) -> FloorLines:
    """The lines on which most strokes lie."""
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
    """The best hypotheses for these lines: how good each is, and the camera from the target; the best first, up to
    those that have less than `least` of its score.
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
    order = np.lexsort(cells.T[::-1])  # as by np.unique, which compares rows one by one
    return every[order[np.any(np.diff(cells[order], axis=0, prepend=np.nan), axis=1)]]


def _pairs(peaks: Array, lines: Array) -> tuple[Array, Array]:
    """Camera height and place for every two lines seen taken for two of the grid, in the same order."""
    i, j = np.triu_indices(len(peaks), 1)
    a, b = np.triu_indices(len(lines), 1)
    height = (lines[b] - lines[a])[None] / (peaks[j] - peaks[i])[:, None]
    place = lines[a][None] - height * peaks[i][:, None]
    return _telling(height.ravel(), place.ravel(), peaks, lines)


def _telling(height: Array, place: Array, peaks: Array, lines: Array) -> tuple[Array, Array]:
    """Those that put most of the lines seen on lines of the grid; where many are as good, all of them."""
    if len(height) <= _PAIRS:
        return height, place
    where = (lines - place[:, None]) / height[:, None]
    near = np.min(np.abs(where[:, None] - peaks[:, None]), axis=2) < 2.0 * _PEAK
    count = np.count_nonzero(near, axis=1)
    kept = count >= np.sort(count)[-_PAIRS]
    return height[kept], place[kept]


def _crossed(height: Array, place: Array, peaks: Array, lines: Array) -> Array:
    """(K, 3) each height and place with, third, the place across for each line seen taken for each of the grid."""
    other = lines[None, None] - height[:, None, None] * peaks[None, :, None]
    count = len(peaks) * len(lines)
    return np.column_stack([np.repeat(height, count), np.repeat(place, count), other.ravel()])


def _peaks(values: Array, weights: Array, total: float) -> Array:
    """Where most strokes lie, in increasing order."""
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
    """(K,) of each hypothesis, from 0 to 1."""
    there, first = places
    optics = upright.bend, upright.phi, stroke_map.unit_px, *stroke_map.centre, *stroke_map.image_size
    # In metres: a ray from the camera may have any length.
    along, feet = upright.rotation[:, :2] @ there.T, hypotheses[:, [1, 2, 0]] @ upright.rotation.T
    sums = np.empty((len(hypotheses), 3))
    near = stroke_map.near
    lines_near(near.plane, REDUCED, optics, along.astype(np.float32), ~first, feet.astype(np.float32), sums)
    covered, shown, inside = sums.T
    return np.where(inside >= _LEAST_IN_VIEW, stroke_map.likelihood(covered, shown), 0.0)
