"""Visibility of a target's own lines where a camera predicts them, and which of its optional parts are absent."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from ceres_cal.base.arrays import Array, Array32, Mask, median, quantile
from ceres_cal.detect.courses import Course, predict
from ceres_cal.detect.lines import search
from ceres_cal.detect.photographs.matching import divergence
from ceres_cal.scene import Camera, Target

# Spacing of the places where lines are searched, px; search distance to either side, as a share of half the image's
# diagonal; least number of places.
_SPACING_PX, _REACH, _FEWEST = 8.0, 0.035, 12
BY_CHANCE = 0.3  # share of the places on any lines that look like paint: those brighter than the others
_R3 = 1.2207440846057596 ** -np.arange(1.0, 4.0)
_NEAR = 0.012  # search distance where the lines' positions are known, as a share of half the image's diagonal
# Quantile for the darkest and lightest floor beside visible curves, and the factor beyond these that makes another
# floor.
_DARKEST, _ANOTHER = 0.25, 1.4
# Log-likelihood ratio beyond which paint along a curve is not by chance.
_SURELY = 3.0
# Largest share of the places that look like paint on an unpainted part: 0.3 are so by chance, 0.8 on worn lines.
_LACKS = 0.5


def _seen(
    grey: Array32,
    target: Target,
    course: Course,
    share_of_image: float = _REACH,
    known: dict[float, float] | None = None,
) -> tuple[Array, Array, Array]:
    """For each of the target's C curves, count the places in view and those with paint nearby; also return the largest
    brightness near each place (N,) of the course.

    Args:
        known: cache of the brightness that lines laid anywhere have by chance, by their width.
    """
    count, size = len(target.curves), (grey.shape[1], grey.shape[0])
    if len(course) < _FEWEST:
        return np.zeros(count), np.zeros(count), np.zeros(len(course))
    reach_px = 0.5 * share_of_image * float(np.hypot(*size))
    width_px, known = float(np.round(median(course.width_px))), {} if known is None else known
    if width_px not in known:
        anywhere = search(grey, _laid_anywhere(size, width_px), reach_px)[1]
        known[width_px] = quantile(anywhere, 1.0 - BY_CHANCE)
    bright = search(grey, course, reach_px)[1]
    every = np.ones(len(course)), bright > known[width_px]
    places, painted = (np.bincount(course.curve, one, count) for one in every)
    return places.astype(float), painted.astype(float), bright


def _course(target: Target, camera: Camera, curves: Collection[str]) -> Course:
    return predict(target, camera, curves, _SPACING_PX, _SPACING_PX)


def _lacking(target: Target, places: Array, bright: Array) -> set[str]:
    """Return the curves of optional parts that are in view, and of which hardly more is seen than by chance."""
    names: set[str] = set()
    for part in target.optional:
        rows = [target.curve_index[name] for name in part]
        if np.sum(bright[rows]) < _LACKS * np.sum(places[rows]):
            names |= set(part)
    return names


def _laid_anywhere(image_size: tuple[int, int], width_px: float) -> Course:
    """Return places of lines all over an image, in all directions: a low-discrepancy sequence (Roberts 2018, R3)."""
    anywhere = 400  # number of places from which that brightness is estimated
    x, y, turn = np.mod(np.outer(_R3, np.arange(1.0, anywhere + 1.0)), 1.0)
    pixels = np.column_stack([x, y]) * (np.array(image_size) - 1.0)
    normals = np.column_stack([np.cos(np.pi * turn), np.sin(np.pi * turn)])
    none = np.zeros(anywhere)
    return Course(none.astype(np.int32), none, pixels, normals, none, np.full(anywhere, width_px))


def painted_curves(grey: Array32, target: Target, camera: Camera, curves: Collection[str]) -> tuple[str, ...]:
    """Return these curves without those optional parts that the camera should see and that are not in the picture."""
    lacking = _lacking(target, *_seen(grey, target, _course(target, camera, curves))[:2])
    return tuple(name for name in curves if name not in lacking)


def _covered(grey: Array32, course: Course, bright: Array, seen: Mask) -> Array:
    """(C,) number of places on each curve beside which the floor differs from that of the curves that are seen (C,),
    given the brightness near each place (N,).
    """
    beside_widths = 4.0  # distance from a line's middle, in line widths: past its edges' blur, before its neighbour
    paint = bright * seen[course.curve]
    if not np.any(paint > 0.0):
        return np.zeros(len(seen))
    x, y = np.round(course.pixels + beside_widths * course.width_px[:, None] * course.normals).astype(int).T
    beside = grey[np.clip(y, 0, grey.shape[0] - 1), np.clip(x, 0, grey.shape[1] - 1)]
    usual = beside[paint >= median(paint[paint > 0.0])]
    low, high = quantile(usual, _DARKEST), quantile(usual, 1.0 - _DARKEST)
    other = (beside < low / _ANOTHER) | (beside > high * _ANOTHER)
    return np.asarray(np.bincount(course.curve, other, len(seen)), dtype=float)


def visible_curves(grey: Array32, target: Target, camera: Camera, curves: Collection[str]) -> tuple[str, ...]:
    """Return the curves along which there is more paint than by chance, even if it cannot be measured (dashes, or other
    paint too near), and those that something covers, as the floor beside them differs from that beside the others.
    """
    course = _course(target, camera, curves)
    places, painted, bright = _seen(grey, target, course, _NEAR)
    share = np.maximum(painted / np.maximum(places, 1.0), BY_CHANCE)
    sure = places * divergence(share, BY_CHANCE) > _SURELY
    sure |= _covered(grey, course, bright, sure) > 0.5 * np.maximum(places, 1.0)
    return tuple(name for name in curves if sure[target.curve_index[name]])


def likelihoods_of_places(
    grey: Array32, places: Iterable[tuple[Target, Camera]], curves: Collection[str]
) -> list[float]:
    """Return how much likelier the target is at each of some places than elsewhere, given where its own lines are seen.

    This is the log-likelihood ratio of so many places with paint, less that of different shares on different curves: if
    the target is elsewhere, some of its lines are on paint and others are not, while wear and robots are everywhere.
    Optional parts that are not seen are ignored.
    """
    known: dict[float, float] = {}
    seen = ((target, _seen(grey, target, _course(target, camera, curves), known=known)) for target, camera in places)
    return [_likelihood(target, own, painted) for target, (own, painted, _) in seen]


def _likelihood(target: Target, places: Array, bright: Array) -> float:
    lacking = _lacking(target, places, bright)
    painted = np.array([name not in lacking for name in target.curves], dtype=bool)
    places, bright = places[painted], bright[painted]
    if not np.sum(places):
        return -np.inf
    own, share = bright / np.maximum(places, 1.0), max(float(np.sum(bright) / np.sum(places)), BY_CHANCE)
    return float(np.sum(places) * divergence(share, BY_CHANCE) - np.sum(places * divergence(own, share)))
