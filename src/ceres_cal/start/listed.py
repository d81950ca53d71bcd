"""Detect points of flat targets that are listed in another order than the target's (column by column, from the last to
the first, there and back), and targets that move although they are said not to.

The picture of a plane is nearly a homography, for any lens. Points under each other's names do not fit a homography,
but do again if they are read in the order in which they were listed. Orders that look like the target turned or
mirrored fit as well as its own order, so they are not reported here: half a turn matters only to a rig (`same_labels`),
and a target that is seen from its other side is reported after the solve (`calibration.outcome`).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np

from ceres_cal.base import Array, Indices, Indices32, InputError, Mask, evenly, first_of, log_binomial_tail, median
from ceres_cal.observations import Columns, Observations, bounds_of, ranges
from ceres_cal.start.closed_forms import PlaneData, RadialProfile, homographies_of_sights

_FEW = 16  # points of a view used to decide whether its order is examined
_FEWEST = 6  # points of a view: four make a homography in any order, and a fifth hardly contradicts it
# Factor by which the right order must leave less: before fisheyes it is 5 and more, for a grid's mirrored order it is
# 1.
_CLEARLY = 2.0
# Probability that some order fits a view as well by chance: a thousand views are misjudged once in a thousand times.
_BY_CHANCE = 1e-6


def require_as_listed(observations: Observations) -> None:
    """Raise InputError if views list a target's points in another order than the target's; it names the views."""
    for name, target in observations.targets.items():
        numbers = np.flatnonzero([view.target == name for view in observations.views])
        places = target.point_array
        if len(places) < _FEWEST or np.ptp(places[:, 2]) > 0.0 or not len(numbers):
            continue
        found = dict[str, list[str]]()
        for number, order in _in_another_order(observations, numbers, places[:, :2]):
            found.setdefault(order, []).append(repr(observations.views[number].frame))
        if found:
            orders = [f"{order} in {len(of)} of {len(numbers)} views ({first_of(of)})" for order, of in found.items()]
            raise InputError(
                f"target {name!r}: its points are listed {', '.join(orders)}: list them in the target's own order, or "
                "correct its numbers of columns and rows"
            )


def require_at_rest(observations: Observations, most: float) -> None:
    """Raise InputError if a fixed target moves from frame to frame in the picture of a camera that does not move, too.

    Args:
        most: share of the image's diagonal by which half of its features may be elsewhere in the next frame.
    """
    shown, enough = dict[tuple[str, str], list[int]](), 100  # views of a target that are compared with the next
    for number, view in enumerate(observations.views):
        if view.placement is None:
            shown.setdefault((view.target, view.station), []).append(number)
    for (target, station), numbers in shown.items():
        some = [numbers[at] for at in evenly(len(numbers), enough)]
        pairs = {pair: np.array([*_apart(observations, *pair)]) for pair in pairwise(some)}
        apart = np.concatenate([np.empty(0), *pairs.values()])
        limit_px = most * float(np.hypot(*observations.cameras[observations.views[some[0]].camera]))
        if len(apart) and median(apart) > limit_px:
            farthest_px, now, then = max((median(own), *pair) for pair, own in pairs.items() if len(own))
            frame, before = observations.views[then].frame, observations.views[now].frame
            raise InputError(
                f"station {station!r}, frame {frame!r}: half of what it shows of {target!r} is {farthest_px:.0f} px or "
                f"more from its place in frame {before!r}, but neither may move: if the target was moved, give "
                'moves=True (in a file "movable": true); if the camera was, give each frame a station of its own; or '
                "correct the names"
            )


def _apart(observations: Observations, first: int, second: int) -> Iterator[float]:
    """Distances between the places of one feature in two views, px; of a curve, of which each may show another part,
    between the nearest observations.
    """
    least, most = 10, 50  # observations of a curve: fewer are clicks in places of their own; more change nothing
    for columns, is_point in ((observations.points, True), (observations.curves, False)):
        features, pixels = zip(*(_of_view(columns, number) for number in (first, second)), strict=True)
        for feature in sorted(set(features[0].tolist()) & set(features[1].tolist())):
            one, other = (seen[own == feature] for own, seen in zip(features, pixels, strict=True))
            if is_point or min(len(one), len(other)) >= least:
                one, other = (seen[evenly(len(seen), most)] for seen in (one, other))
                yield float(np.linalg.norm(one[:, None] - other, axis=2).min())


def _of_view(columns: Columns, number: int) -> tuple[Indices32, Array]:
    rows = slice(*np.searchsorted(columns.view, (number, number + 1)))
    return columns.feature[rows], columns.pixels[rows]


def _in_another_order(observations: Observations, numbers: Indices, places: Array) -> Iterator[tuple[int, str]]:
    """Numbers of views of a target with points at places (P, 2), and the order in which they list the points."""
    points, most = observations.points, 100  # points of a view that is examined: more do not change the result
    by_view = np.argsort(points.view, kind="stable")
    counts = np.bincount(points.view, minlength=len(observations.views))
    asked, all_bounds = numbers[counts[numbers] >= _FEWEST], bounds_of(counts)
    if len(asked):
        evenly_drawn = np.arange(1, _FEW + 1) * 0.6180339887 % 1.0  # not in the period of a target's own pattern
        few = by_view[all_bounds[asked, None] + (evenly_drawn * counts[asked, None]).astype(np.int64)]
        asked = asked[_is_bent(places[points.feature[few]], points.pixels[few], _between_neighbours(places))]
    if not len(asked):
        return
    rows, bounds = by_view[ranges(all_bounds, asked)], bounds_of(counts[asked])
    words, orders = zip(("", np.arange(len(places))), *_orders(places), strict=True)
    listed = places[np.array(orders)]
    of_all = [_mean_misfits(one[points.feature[rows]], points.pixels[rows], bounds) for one in listed]
    may_be = np.min(of_all, axis=0) < 0.9 * of_all[0]  # a quick test: outliers affect these means
    for number in asked[may_be].tolist():
        own = by_view[all_bounds[number] + evenly(int(counts[number]), most)]
        left_px, by_chance = _left(listed[:, points.feature[own]], points.pixels[own])
        first = int(np.argmax(left_px <= 1.01 * np.min(left_px)))  # the first of those that are equal by symmetry
        if left_px[first] * _CLEARLY < left_px[0] and by_chance[first] < _BY_CHANCE:
            yield number, words[first]


def _is_bent(plane: Array, pixels: Array, between_m: float) -> Mask:
    """(S,) whether the points of views, at places (S, K, 2), are so far from a homography that their order is examined.
    Most lenses leave less, and most calibrations need no more than this test.

    Args:
        between_m: distance between neighbours of the target.
    """
    least = 0.5  # share of the distance between neighbours: a fisheye leaves 0.2 to 0.4, another order 1.4 and more
    size_m, size_px = (
        np.linalg.norm(one - one.mean(axis=1, keepdims=True), axis=2).mean(axis=1) for one in (plane, pixels)
    )
    bounds = np.arange(0, plane.shape[0] * plane.shape[1] + 1, plane.shape[1])
    left_px = _mean_misfits(plane.reshape(-1, 2), pixels.reshape(-1, 2), bounds)
    return np.asarray(left_px * size_m > least * between_m * size_px)


def _between_neighbours(places: Array) -> float:
    """Median distance (m) between neighbours among the places (P, 2) of a target."""
    some = places[evenly(len(places), _FEW)]
    apart_m = np.linalg.norm(some[:, None] - places, axis=2)
    return median(np.min(np.where(apart_m > 0.0, apart_m, np.inf), axis=1))


def _mean_misfits(plane: Array, pixels: Array, bounds: Indices) -> Array:
    """(S,) px, mean distances of the points of views from a homography."""
    middle = np.add.reduceat(pixels, bounds[:-1]) / np.diff(bounds)[:, None]
    offsets = pixels - np.repeat(middle, np.diff(bounds), axis=0)
    off_px = homographies_of_sights(PlaneData(bounds, plane, offsets), _straight(offsets))[1]
    return np.asarray(np.add.reduceat(off_px, bounds[:-1]) / np.diff(bounds))


def _left(plane: Array, pixels: Array) -> tuple[Array, Array]:
    """For O orders that put a view's points at places (O, K, 2): (O,) px within which three quarters lie from a
    homography through four of them, and the probability that so many do by chance. All orders use the same sets of
    four, so that orders which look alike leave the same.
    """
    tries = 50  # sets of four: with a tenth outliers, 33 sets have none
    offsets, (orders, count) = pixels - pixels.mean(axis=0), plane.shape[:2]
    fours = np.random.default_rng(0).permuted(np.tile(np.arange(count), (tries, 1)), axis=1)[:, :4]
    seen = np.tile(offsets[fours].reshape(-1, 2), (orders, 1))
    data = PlaneData(4 * np.arange(orders * tries + 1), plane[:, fours].reshape(-1, 2), seen)
    matrices = homographies_of_sights(data, _straight(offsets))[0].reshape(orders, tries, 3, 3)
    shown = np.einsum("otij,okj->otki", matrices, np.dstack([plane, np.ones((orders, count))]))
    with np.errstate(all="ignore"):
        off_px = np.linalg.norm(np.nan_to_num(shown[..., :2] / shown[..., 2:] - offsets, nan=np.inf), axis=3)
    within = 3 * count // 4
    left_px = np.sort(off_px, axis=2)[:, :, within].min(axis=1)
    area = 12.0 * np.sqrt(np.linalg.det(np.cov(offsets.T)))  # px^2, of an evenly filled rectangle
    near = np.minimum(np.pi * left_px**2 / max(area, 1e-9), 1.0)
    by_chance = np.exp(log_binomial_tail(within - 3, count - 4, near))
    return left_px, orders * tries * by_chance


def _straight(offsets: Array) -> RadialProfile:
    """The profile of a lens without distortion."""
    return RadialProfile((), float(np.max(np.abs(offsets))))


def _orders(places: Array) -> Iterator[tuple[str, Indices]]:
    """Orders in which points at places (P, 2) may be listed: in words, and the number of the point at each position of
    the list.
    """
    yield "in reverse order", np.arange(len(places))[::-1]
    x, y = places.round(9).T
    for across, along in product((1.0, -1.0), repeat=2):
        yield "row by row", np.lexsort([across * x, along * y])
        yield "column by column", np.lexsort([along * y, across * x])
    for words, on, over in (("row by row, there and back", x, y), ("column by column, there and back", y, x)):
        turn = np.unique(over, return_inverse=True)[1] % 2
        yield words, np.lexsort([np.where(turn, -on, on), over])
