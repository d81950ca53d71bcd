"""How well a target's own lines are seen where a camera puts them, and which of those it may lack are not there."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from ceres_cal.base.arrays import Array, Array32, Mask, median, quantile
from ceres_cal.detect.courses import Course, predict
from ceres_cal.detect.lines import search
from ceres_cal.detect.photographs.matching import divergence
from ceres_cal.scene import Camera, Target

# Where lines are sought: px apart, and to either side as a share of half the image's diagonal.
_SPACING_PX, _REACH, _FEWEST = 8.0, 0.035, 12
BY_CHANCE = 0.3  # of the places on any lines, those that look like paint: what is brighter than the others does
_R3 = 1.2207440846057596 ** -np.arange(1.0, 4.0)
_NEAR = 0.012  # the same where they are known to lie
# Of the floor beside the curves that are seen, the darkest and the lightest share, times which it is another floor.
_DARKEST, _ANOTHER = 0.25, 1.4
# Log-likelihood ratio from which on paint along a curve is none by chance.
_SURELY = 3.0
# Of the places on lines, at most, where lines that are not painted look like paint: 0.3 by chance, 0.8 of worn ones.
_LACKS = 0.5


def _seen(
    grey: Array32,
    target: Target,
    course: Course,
    share_of_image: float = _REACH,
    known: dict[float, float] | None = None,
) -> tuple[Array, Array, Array]:
    """Of each of the target's C curves: places in view, and those of them that have paint nearby; and how bright what
    is brightest near each place (N,) of the course is.

    Args:
        known: how bright lines laid anywhere are by chance, by their width.
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
    """Curves of the optional parts that are in view, and of which hardly more is seen than by chance."""
    names: set[str] = set()
    for part in target.optional:
        rows = [target.curve_index[name] for name in part]
        if np.sum(bright[rows]) < _LACKS * np.sum(places[rows]):
            names |= set(part)
    return names


def _laid_anywhere(image_size: tuple[int, int], width_px: float) -> Course:
    """Places of lines all over an image, in all directions: a low-discrepancy sequence (Roberts 2018, R3)."""
    anywhere = 400  # places of lines laid anywhere, by which that brightness is known
    x, y, turn = np.mod(np.outer(_R3, np.arange(1.0, anywhere + 1.0)), 1.0)
    pixels = np.column_stack([x, y]) * (np.array(image_size) - 1.0)
    normals = np.column_stack([np.cos(np.pi * turn), np.sin(np.pi * turn)])
    none = np.zeros(anywhere)
    return Course(none.astype(np.int32), none, pixels, normals, none, np.full(anywhere, width_px))


def painted_curves(grey: Array32, target: Target, camera: Camera, curves: Collection[str]) -> tuple[str, ...]:
    """These curves without the optional parts of the target that are not in the picture, where the camera sees them."""
    lacking = _lacking(target, *_seen(grey, target, _course(target, camera, curves))[:2])
    return tuple(name for name in curves if name not in lacking)


def _covered(grey: Array32, course: Course, bright: Array, seen: Mask) -> Array:
    """(C,) of each of the target's curves the places beside which lies no floor that those have which are seen (C,), by
    how bright what is near each place (N,) is.
    """
    beside_widths = 4.0  # from a line's middle, of its width: past its edges' blur, before its neighbour
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
    """Those of the curves along which there is more paint than by chance, though it may be in dashes, or too near to
    other paint, to be measured; and those that something covers, by what is beside them: no floor that the others have.
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
    """How much likelier the target is in each of some places than elsewhere, by where its own lines are seen in the
    picture itself.

    The log-likelihood ratio of so many places with paint, less what tells that the curves do not share one share: of a
    target that is elsewhere some lie on paint and others do not, while wear and robots are everywhere. Optional parts
    that are not seen say nothing.
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
