"""Pixels outside their camera's image: a few are strays, many mean that the image size is another one. And sigmas."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ceres_cal.base.arrays import Array, Mask, median
from ceres_cal.base.errors import InputError
from ceres_cal.observations.columns import Alone, Columns, Curves, each_block, view_label
from ceres_cal.observations.files import Content

# The image ends half a pixel beyond the centres of its outermost ones; a detector that interpolates may go one further.
_MARGIN_PX = 1.5
# Of a camera's observations: more of them outside, and its image has another size.
_FEW = 0.01
_FAR = 10.0  # image diagonals: a pixel farther off was not measured, and its square swamps what was
# The largest playing fields end at 60 m; the smallest board in millimetres reaches as far.
_LARGE_M = 100.0
# Of the largest sigma over the smallest: from ten pixels by a click to a thousandth of a pixel by a large target in the
# image. Beyond it one observation decides alone, and nothing contradicts it.
_SIGMA_RATIO = 1e4


def require_alike(content: Content) -> None:
    """Raise InputError where a sigma is so far from the others that its observation, or they, decide nothing."""
    columns = {"point": content.points, "curve": content.curves}
    ends = [end for column in columns.values() for end in each_block(_extremes, Alone(column.sigma_px))]
    if max(high for _, high in ends) <= _SIGMA_RATIO * min(low for low, _ in ends):
        return
    sigmas = np.concatenate([column.sigma_px for column in columns.values()])
    usual_px = median(sigmas)
    row = int(np.argmax(np.abs(np.log(sigmas / usual_px))))
    kind, number = ("point", row) if row < len(content.points) else ("curve", row - len(content.points))
    raise InputError(
        f"{view_label(columns[kind].view[number], content.views)}, {kind} {content.feature_name(kind, number)!r}: its "
        f"sigma_px is {sigmas[row]:g} where {usual_px:g} is usual: sigmas may differ by a factor of {_SIGMA_RATIO:.0f} "
        "at most: correct it, or leave the observation out"
    )


def _extremes(_: int, block: Alone) -> tuple[float, float]:
    """The smallest and the largest of a block."""
    return (float(block.values.min()), float(block.values.max())) if len(block.values) else (np.inf, 0.0)


def stray_pixels(content: Content) -> tuple[str, ...]:
    """A line for each camera of which a few observations lie outside its image.

    Raises:
        InputError: naming the first of them, where they are more than one in a hundred (and not a single one).
    """
    if _all_inside(content):
        return ()
    sizes = np.array([content.cameras[view.camera] for view in content.views])
    points, curves = (_outside(column, sizes) for column in (content.points, content.curves))
    owners = np.array([view.camera for view in content.views])
    lines = []
    for camera, size in content.cameras.items():
        own = owners == camera
        mine = own[content.points.view], own[content.curves.view]
        count = sum(np.count_nonzero(out & here) for out, here in zip((points, curves), mine, strict=True))
        total = sum(np.count_nonzero(here) for here in mine)
        if not count:
            continue
        first = _first(content, points & mine[0], curves & mine[1])
        pixels = np.concatenate([content.points.pixels[mine[0]], content.curves.pixels[mine[1]]])
        if not np.all(np.abs(pixels) <= _FAR * float(np.hypot(*size))):
            far = [
                np.any(np.abs(column.pixels) > _FAR * float(np.hypot(*size)), axis=1) & here
                for column, here in zip((content.points, content.curves), mine, strict=True)
            ]
            raise InputError(
                f"camera {camera!r}: its image is {size[0]} x {size[1]} px, but {_first(content, *far)} lies "
                f"{_FAR:.0f} images away: correct or remove it"
            )
        text = f"camera {camera!r}: {count} of {total} observations lie outside its image"
        if count > max(1.0, _FEW * total):
            raise InputError(f"{text}: {_cause(pixels, size)}; the first is {first}")
        lines.append(f"{text} of {size[0]} x {size[1]} px, the first is {first}: correct or remove what lies outside")
    return tuple(lines)


def _all_inside(content: Content) -> bool:
    """Whether no pixel lies outside the smallest image."""
    ends = _end(np.min(list(content.cameras.values()), axis=0))

    def inside(_: int, block: Alone) -> bool:
        each = zip(block.values.T, ends, strict=True)
        return not len(block.values) or all(own.min() >= -_MARGIN_PX and own.max() <= end for own, end in each)

    return all(all(each_block(inside, Alone(column.pixels))) for column in (content.points, content.curves))


def _end(size: Sequence[int] | Array) -> Array:
    return np.asarray(size) - 1.0 + _MARGIN_PX


def _outside(column: Columns, sizes: Array) -> Mask:
    """(N,) which observations lie outside; `sizes` (V, 2) is that of each view's image."""
    seen = column.pixels
    return np.asarray(np.any((seen < -_MARGIN_PX) | (seen > _end(sizes[column.view])), axis=1))


def _cause(pixels: Array, size: Sequence[int]) -> str:
    """What the pixels say is wrong with the image size, or with themselves."""
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    width, height = size
    if left < -_MARGIN_PX or top < -_MARGIN_PX:
        reach = f"pixels begin at ({left:.0f}, {top:.0f})"
        return f"{reach}, but (0, 0) is the centre of the top-left pixel, x to the right, y downwards: correct them"
    reach = f"pixels reach {right:.0f} x {bottom:.0f} but image_size is {width} x {height}"
    if width != height and np.all((right, bottom) <= _end((height, width))):
        return f"{reach}: width and height, or x and y, are swapped: correct that"
    return f"{reach}: another image size? Give that of the pictures the pixels were measured in"


def _first(content: Content, points: Mask, curves: Mask) -> str:
    long = 1e6  # px: printed with an exponent
    column: Columns = content.points if points.any() else content.curves
    row = int(np.argmax(points if points.any() else curves))
    kind = "curve" if isinstance(column, Curves) else "point"
    feature, (x, y) = content.feature_name(kind, row), column.pixels[row]
    at = ", ".join(f"{value:.1f}" if abs(value) < long else f"{value:g}" for value in (x, y))
    return f"{view_label(column.view[row], content.views)}, {kind} {feature!r}: pixel ({at})"


def unfilled(content: Content) -> Iterator[str]:
    """A line for each camera whose observations all lie in a small corner of its image."""
    corner = 0.25  # of either side: a board that is always held so far from the middle of the image is rare
    owners = np.array([view.camera for view in content.views])
    for camera, size in content.cameras.items():
        own = owners == camera
        pixels = np.concatenate([column.pixels[own[column.view]] for column in (content.points, content.curves)])
        if len(pixels) and np.all(pixels.max(axis=0) < corner * np.array(size)):
            reach = "{:.0f} x {:.0f}".format(*pixels.max(axis=0))
            yield (
                f"camera {camera!r}: observations reach {reach} px of an image of {size[0]} x {size[1]}: is image_size "
                "that of the pictures?"
            )


def odd_sizes(content: Content) -> Iterator[str]:
    """A line for each target so large that its numbers may be millimetres."""
    for name, target in content.targets.items():
        if (reach_m := target.reach_m) > _LARGE_M:
            yield f"target {name!r} reaches {reach_m:.0f} m from its origin: are its numbers metres, or millimetres?"
