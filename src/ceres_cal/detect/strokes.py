"""Short straight strokes of paint in a photograph, found without a prediction: thin, and brighter than both sides.

Ridges are found as by Steger (An Unbiased Detector of Curvilinear Structures, 1998): where the second derivative across
is most negative, at the sub-pixel maximum. Ridge points that are connected and straight over a few dozen pixels form a
stroke.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base import Array, Array32, Indices, Mask, Rows, median, medians

_SCALES = (1, 2)  # a photograph is searched at full size for narrow paint, and at half size for wide paint
_SIGMA_PX = 1.6
_TILE_PX = 24  # largest length of a stroke
# Least length of a stroke: shorter ones have no clear direction. Nothing changes from half to double.
_LEAST_PX = 9.0
# Largest rms distance of the points from their stroke: arcs, letters and noise bend more. Nothing changes from 0.43 to
# 0.75.
_STRAIGHT_PX = 0.6
# Least response, in units of the usual one. At half of it the carpet's texture becomes strokes, and two of nine fields
# are missed; at double nothing changes.
_NOISE = 5.0
# Width of the window in which noise is uniform, px; least response, in units of the noise in it.
_NEARBY_PX, _NOISE_NEARBY = 41, 3.0
# Largest response at twice the scale, as a share of the response: 0.125 for a thin line, more for stripes of sun and
# walls.
_WIDEST = 0.45
# Distance within which strokes found at two scales are the same, px; and how many times as bright the coarser one must
# be, because its place and direction are less precise. In a picture with blur and wear a third fewer strokes are kept
# at 1.0; nothing changes from 1.25 to 2.
_BESIDE_PX, _COARSER = 11, 1.4
# For strokes that run beside each other: least cosine of the angle between them, and least distance, px.
_SAME_WAY, _APART_PX = 0.97, 4.0
# Least value of `alone` where stripes hide the other strokes: at most two strokes run beside it.
_OWN = 0.15
# Width of the picture's border, px, where a ridge's other side is not seen.
_BORDER_PX = 3
# Width of the dilation that joins pieces of one stroke, px; least share of a stroke's length that is paint: worn lines
# are dashed.
_GAP_PX, _DENSE = 3, 0.5


class Strokes(Rows):
    """N strokes: their ends (N, 2, 2) px, and the strength (N,) of each as a ridge, grey levels per px squared."""

    ends: Array
    strength: Array

    @property
    def length_px(self) -> Array:
        """(N,) length of each stroke."""
        return np.asarray(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1))


def alone(strokes: Strokes, reach_px: float) -> Array:
    """(N,) 1 for a stroke without others beside it, less where others run beside it, as on striped floors and in sun.

    Args:
        reach_px: how far to either side others count.
    """
    middle, along = strokes.ends.mean(axis=1), np.diff(strokes.ends, axis=1)[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    between = middle[None] - middle[:, None]
    parallel = np.abs(along @ along.T) > _SAME_WAY
    ahead = np.abs(np.einsum("ijk,ik->ij", between, along)) < 0.5 * _TILE_PX
    aside = np.abs(between[..., 0] * along[:, None, 1] - between[..., 1] * along[:, None, 0])
    others = np.count_nonzero(parallel & ahead & (aside > _APART_PX) & (aside < reach_px), axis=1)
    return np.asarray(1.0 / (1.0 + others**2))


def drawn(strokes: Strokes, image_size: tuple[int, int]) -> Mask:
    """Return a mask (height, width) of the pixels on strokes."""
    mask = np.zeros(image_size[::-1], np.uint8)
    cv2.polylines(mask, list(np.round(strokes.ends).astype(np.int32)), isClosed=False, color=1)
    return mask > 0


def find_strokes(grey: Array32) -> Strokes:
    """Return every stroke of a photograph, of paint up to about 12 px wide, each at the scale where it is brightest."""
    return _of_scales(_reliefs(grey))


def _reliefs(grey: Array32) -> list[tuple[Array32, ...]]:
    """Return the relief of a photograph at each scale."""
    shares = (1.0 / scale for scale in _SCALES)
    planes = (cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) for share in shares)
    return [_relief(np.asarray(plane, np.float32)) for plane in planes]


def _of_scales(reliefs: list[tuple[Array32, ...]], *, dark: bool = False) -> Strokes:
    """Return the strokes at their brightest scale (see `find_strokes`), or with `dark` those darker than the floor."""
    by_scale, (height, width) = [], reliefs[0][0].shape
    size = (width, height)
    for scale, relief in zip(_SCALES, reliefs, strict=True):
        strokes = _strokes(*_ridge_points(relief, dark=dark))
        by_scale.append(Strokes((strokes.ends + 0.5) * scale - 0.5, strokes.strength))
    fine, coarse = by_scale
    fine = fine.take(_COARSER * fine.strength >= _strength_beside(fine, coarse, size))
    coarse = coarse.take(coarse.strength > _COARSER * _strength_beside(coarse, fine, size))
    return Strokes(*(np.concatenate([getattr(one, name) for one in (fine, coarse)]) for name in ("ends", "strength")))


def strokes_of_signs(grey: Array32) -> tuple[Strokes, Strokes]:
    """Return the strokes of a photograph that are brighter than the floor, and those that are darker.

    On fields with light lines, the length of the dark strokes was at most 0.92 of that of the light ones, mostly 0.2,
    and more on one field with dark seams; on two fields with dark lines it was 6 and 14 times.
    """
    reliefs = _reliefs(grey)
    return _of_scales(reliefs), _of_scales(reliefs, dark=True)


def find_narrow_strokes(grey: Array32, reach_px: float) -> Strokes:
    """Return strokes of the narrowest paint that have few others beside them: stripes of sun are wide, or run in
    parallel.
    """
    strokes = _strokes(*_ridge_points(_relief(grey)))
    return strokes.take(alone(strokes, reach_px) > _OWN)


def _strength_beside(strokes: Strokes, other: Strokes, image_size: tuple[int, int]) -> Array:
    """(N,) strength of the other scale's ridge along each stroke, 0 where there is none."""
    plane = np.zeros(image_size[::-1], np.float32)
    for row in np.argsort(other.strength):
        a, b = np.round(other.ends[row]).astype(int).tolist()
        cv2.line(plane, a, b, float(other.strength[row]), _BESIDE_PX)
    share = np.linspace(0.0, 1.0, 5)[:, None, None]
    places = np.round((1.0 - share) * strokes.ends[:, 0] + share * strokes.ends[:, 1]).astype(int)
    x, y = (np.clip(places[..., axis], 0, image_size[axis] - 1) for axis in (0, 1))
    return medians(plane[y, x].T).astype(float)


def _relief(grey: Array32) -> tuple[Array32, ...]:
    """Return a slightly smoothed plane, its `_second` derivatives, `_bends` of those, and the second derivatives of a
    more strongly smoothed plane.
    """
    soft = _smoothed(grey, _SIGMA_PX)
    second = _second(soft)
    return soft, *second, *_bends(*second), *_second(_smoothed(grey, 2.0 * _SIGMA_PX))


def _ridge_points(relief: tuple[Array32, ...], *, dark: bool = False) -> tuple[Array, Array, Indices]:
    """Return points on ridges, or on valleys: pixels (N, 2), strength (N,), and number of the connected piece of each
    (N,).
    """
    soft, xx, yy, xy, middle, apart, *wide = relief
    sign = np.float32(-1.0 if dark else 1.0)
    strength = np.maximum(apart - sign * middle, 0.0)
    usual = median(strength[::3, ::3].ravel())
    # Noise differs between sun and shadow; lines are not part of the noise around them.
    size = (_NEARBY_PX, _NEARBY_PX)
    nearby = cv2.boxFilter(np.minimum(strength, _NOISE * max(usual, 1e-3)), cv2.CV_32F, size, normalize=True)
    nearby = cv2.boxFilter(np.minimum(strength, 2.0 * _NOISE * nearby), cv2.CV_32F, size, normalize=True)
    ridge = strength > np.maximum(_NOISE_NEARBY * nearby, max(_NOISE * usual, 1e-3))
    ridge[:_BORDER_PX] = ridge[-_BORDER_PX:] = ridge[:, :_BORDER_PX] = ridge[:, -_BORDER_PX:] = False
    at, width = np.flatnonzero(ridge), ridge.shape[1]
    level, off = _bends(*(plane.ravel()[at] for plane in wide))
    at = at[off - sign * level < _WIDEST * strength.ravel()[at]]
    a, b, d = (sign * plane.ravel()[at] for plane in (xx, xy, yy))
    angle = 0.5 * np.arctan2(2.0 * b, a - d) + 0.5 * np.pi  # of the direction with the largest curvature
    nx, ny = np.cos(angle), np.sin(angle)
    gx, gy = (0.5 * sign * (soft.ravel()[at + later] - soft.ravel()[at - later]) for later in (1, width))
    high = strength.ravel()[at]
    step = (gx * nx + gy * ny) / high
    top = np.maximum(np.abs(step * nx), np.abs(step * ny)) <= 0.6
    mask = np.zeros(soft.shape, np.uint8)
    mask.ravel()[at[top]] = 1
    joined = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_RECT, (_GAP_PX, _GAP_PX)))
    _, labels = cv2.connectedComponents(joined, connectivity=8)
    pixels = np.column_stack([at % width + step * nx, at // width + step * ny])[top]
    return pixels, high[top], labels.ravel()[at[top]].astype(np.int64)


def _second(soft: Array32) -> tuple[Array32, ...]:
    """Second derivatives: by x twice, by y twice, and by x and y."""
    orders = ((2, 0), (0, 2), (1, 1))
    return tuple(np.asarray(cv2.Sobel(soft, cv2.CV_32F, *order, scale=0.25), np.float32) for order in orders)


def _bends(xx: Array32, yy: Array32, xy: Array32) -> tuple[Array32, Array32]:
    """Mean of both eigenvalues of second derivatives, and how far each is from the mean."""
    return 0.5 * (xx + yy), np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)


def _smoothed(grey: Array32, sigma_px: float) -> Array32:
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma_px), np.float32)


def _strokes(pixels: Array, strength: Array, piece: Indices) -> Strokes:
    """Fit a straight line to the points of each piece in each tile of the image."""
    if not len(pixels):
        return Strokes(np.empty((0, 2, 2)), np.empty(0))
    tile = np.floor(np.maximum(pixels, 0.0) / _TILE_PX).astype(np.int64)
    key = (piece * 4096 + tile[:, 0]) * 4096 + tile[:, 1]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)

    weight = strength**2  # at the ends of dashes ridges fan out and get fainter
    total = np.bincount(group, weight)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(group, weight * values) / total)

    x, y = pixels.T
    cx, cy = mean(x), mean(y)
    dx, dy = x - cx[group], y - cy[group]
    xx, xy, yy = mean(dx * dx), mean(dx * dy), mean(dy * dy)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    along_x, along_y = np.cos(angle), np.sin(angle)
    root = np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    # Half length of a uniform line with that second moment.
    half = np.sqrt(3.0 * np.maximum(0.5 * (xx + yy) + root, 0.0))
    across = np.sqrt(np.maximum(0.5 * (xx + yy) - root, 0.0))
    good = (2.0 * half >= _LEAST_PX) & (across < _STRAIGHT_PX) & (count > 2.0 * _DENSE * half)
    centre, reach = np.column_stack([cx, cy]), np.column_stack([half * along_x, half * along_y])
    return Strokes(np.stack([centre - reach, centre + reach], axis=1)[good], mean(strength)[good])
