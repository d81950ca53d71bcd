"""One picture of what stands still, from several pictures of a fixed camera in which robots and people move.

A picture that is blurred, or that was taken after the camera was moved, is left out. Its displacement from a reference
is estimated from image gradients (Lucas and Kanade, IJCAI 1981), in one robust linear fit with an affine motion, a gain
and an offset. A camera that shakes displaces each picture a little: these are moved back, since the median of displaced
lines is displaced differently for each direction of line.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from ceres_cal.base import Array, Array32, Frozen, Image, InputError, most_bytes, rms
from ceres_cal.detect.images import light

MOST_PICTURES = 25
"""Number of pictures that one is made from, taken evenly from video frames and photographs."""
# Largest displacement, px, of a picture that is used, of a camera that stands still, and of one that shakes.
_MOVED_PX = 0.2, 1.0
# Share of the usual sharpness below which a picture is blurred. Noise is smoothed away before.
_BLURRED = 0.5
_BLOCKS, _OF_BLOCK, _FEWEST = 8, 120, 30  # blocks to a side; pixels used of each; fewest pixels of a block that counts
_CLEAR = 4.0  # limit of a clear gradient, in units of the median gradient, which is noise and texture
# Iterations of the fit, and of the choice of pictures; deviation, in standard deviations, beyond which a level is
# down-weighted.
_ROUNDS, _BEND = 8, 2.0
_BAND, _EVERY = 64, 31  # rows processed at once; step between the pixels from which noise is estimated
_NEAR = 3.0  # largest deviation from the median, in standard deviations of the noise


class MedianPicture(Frozen):
    """One picture made from several.

    Attributes:
        picture: (height, width) grey levels, 0 to `white`.
        used: names of the pictures that took part.
        left_out: name and reason of the others.
        shaken_px: root mean square displacement of those that took part, which were moved back.
    """

    picture: Array32
    white: int
    used: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    shaken_px: float


def merged(pictures: Iterable[tuple[str, Image]]) -> MedianPicture:
    """Combine pictures into one of what stands still: each pixel's median, refined by the mean of the levels near it.

    Pictures are read one by one and kept in grey. If the camera was moved in between, the largest group that agrees is
    used.

    Args:
        pictures: at most MOST_PICTURES, with their names, as (height, width) or (height, width, 3).

    Raises:
        InputError: there is none, no two show the same, they differ in size or depth, or are too many to be held at
            once.
    """
    names, greys = _read(pictures)
    sharpness = [float(np.mean(np.asarray(cv2.Laplacian(_smooth(one), cv2.CV_32F)) ** 2)) for one in greys]
    left_out = {n: "blurred" for n, one in enumerate(sharpness) if one < _BLURRED * np.median(sharpness)}
    sharp = [n for n in range(len(names)) if n not in left_out]
    half = (len(sharp) + 1) // 2  # the camera may have been moved half-way
    chosen = _agreeing(greys, sharp, sharp)
    if len(chosen) < half:
        chosen = max((chosen, *(_agreeing(greys, sharp, some) for some in (sharp[:half], sharp[half:]))), key=len)
    if len(chosen) < min(len(sharp), 2):
        raise InputError(
            f"no two of {len(names)} pictures agree, and a median needs a camera that does not move: give the pictures "
            "one by one"
        )
    left_out |= {n: "the camera had moved" for n in sharp if n not in chosen}
    return MedianPicture(
        _middle([picture for picture, _ in chosen.values()]),
        int(np.iinfo(greys[0].dtype).max),
        tuple(names[n] for n in chosen),
        tuple((names[n], left_out[n]) for n in sorted(left_out)),
        rms(np.array([px for _, px in chosen.values()])),
    )


def _agreeing(greys: Sequence[Image], every: Sequence[int], some: Sequence[int]) -> dict[int, tuple[Image, float]]:
    """Return by number the pictures that are not displaced from the median of those of `some` that agree with each
    other by more than a shaking camera displaces them: moved back to where it was on average, and by how many px.
    """
    at_rest_px, usually = 0.02, 4.0  # largest displacement by shaking, in units of the median one
    kept, back, moves = list(some), dict(enumerate(greys)), dict[int, Array]()
    for _ in range(_ROUNDS):
        reference = _Reference.of(_middle([back[n] for n in kept]))
        further = {n: reference.motion(back[n]) for n in every}
        moves = {n: moves.get(n, 0.0) + further[n] for n in every}
        away = {n: _size_px(moves[n]) for n in every}
        most_px = np.clip(usually * np.median(list(away.values())), *_MOVED_PX)
        same = [n for n in every if away[n] < most_px]
        if not same or (same == kept and max(_size_px(further[n]) for n in same) < at_rest_px):
            break
        kept, middle = same, np.mean([moves[n] for n in same], axis=0)
        moves = {n: moves[n] - middle for n in same}
        back = dict(enumerate(greys)) | {n: _moved_back(greys[n], moves[n]) for n in same}
    return {n: (back[n], away[n]) for n in same}


def _size_px(motion: Array) -> float:
    """Root mean square displacement by a motion (6,)."""
    return float(np.sqrt(motion[:2] @ motion[:2] + motion[2:] @ motion[2:] / 3.0))


def _moved_back(grey: Image, motion: Array) -> Image:
    """Return a picture without its motion (6,)."""
    size, turn = grey.shape[::-1], motion[2:].reshape(2, 2)
    back = np.column_stack([np.eye(2) - 2.0 * turn / size, turn.sum(axis=1) - motion[:2]])
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(grey, back, size, flags=how, borderMode=cv2.BORDER_REPLICATE))


def _read(pictures: Iterable[tuple[str, Image]]) -> tuple[list[str], list[Image]]:
    names: list[str] = []
    greys: list[Image] = []
    for name, picture in pictures:
        grey = picture if picture.ndim == 2 else np.round(light(picture)).astype(picture.dtype)
        if greys and (grey.shape != greys[0].shape or grey.dtype != greys[0].dtype):
            size, first = (f"{one.shape[1]} x {one.shape[0]} px of {one.dtype}" for one in (grey, greys[0]))
            raise InputError(f"{name}: {size}, but {names[0]} has {first}: give pictures of one camera")
        if (len(greys) + 1) * grey.nbytes > most_bytes():
            raise InputError(
                f"{name}: more than {len(greys)} pictures of {grey.shape[1]} x {grey.shape[0]} px are too many to be "
                "held at once: give fewer"
            )
        names.append(name)
        greys.append(grey)
    if not greys:
        raise InputError("no pictures are given: give at least one")
    return names, greys


def _smooth(grey: Image | Array32) -> Array32:
    smooth_px = 1.5
    return np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), smooth_px))


class _Reference(Frozen):
    """A picture at its clearest pixels.

    Attributes:
        pixels: (N,) flat indices of the pixels.
        block: (N,) number of the picture's block that each pixel is in.
        grey: (N,) smoothed grey level.
        columns: (N, 8) derivatives of a level by a motion (x, y, and both by x and y, in half the picture's size), a
            gain and an offset.
    """

    pixels: Array
    block: Array
    grey: Array
    columns: Array

    @classmethod
    def of(cls, grey: Array32) -> _Reference:
        soft = _smooth(grey)
        dx, dy = (np.asarray(cv2.Sobel(soft, cv2.CV_32F, *order, scale=0.125)) for order in ((1, 0), (0, 1)))
        steep = np.hypot(dx, dy)
        height, width = soft.shape
        row, column = np.divmod(np.arange(soft.size), width)
        block = (row * _BLOCKS // height) * _BLOCKS + column * _BLOCKS // width
        clear = np.flatnonzero(steep.ravel() > _CLEAR * float(np.median(steep)))
        order = clear[np.lexsort((-steep.ravel()[clear], block[clear]))]
        place = np.arange(len(order)) - np.searchsorted(block[order], block[order])
        chosen = order[place < _OF_BLOCK]
        x, y = 2.0 * column[chosen] / width - 1.0, 2.0 * row[chosen] / height - 1.0
        gx, gy, level = (one.ravel()[chosen].astype(float) for one in (dx, dy, soft))
        columns = np.column_stack([gx, gy, gx * x, gx * y, gy * x, gy * y, level, np.ones(len(chosen))])
        return cls(chosen, block[chosen], level, columns)

    def motion(self, grey: Image) -> Array:
        """(6,) px by which another picture is displaced, as in `columns`; infinity where it shows something else."""
        seen = _smooth(grey).ravel()[self.pixels].astype(float)
        alike = self._alike(seen)
        if 2 * sum(alike.values()) <= len(alike):
            return np.full(6, np.inf)
        rows = np.isin(self.block, [block for block, same in alike.items() if same])
        columns, seen, weight = self.columns[rows], seen[rows], np.ones(np.count_nonzero(rows))
        for _ in range(_ROUNDS):
            wide = columns * weight[:, None]
            fit = np.linalg.lstsq(wide.T @ wide, wide.T @ (seen * weight), rcond=None)[0]
            left = np.abs(seen - columns @ fit)
            weight = np.minimum(1.0, _BEND * 1.4826 * max(float(np.median(left)), 1e-3) / np.maximum(left, 1e-12))
        return np.asarray(fit[:6] / max(abs(float(fit[6])), 1e-3))

    def _alike(self, seen: Array) -> dict[int, bool]:
        """Whether each block of the picture that shows anything shows the same as the reference."""
        alike = 0.6  # least correlation of a block that shows the same; most blocks must, as people hide some
        shift = self.columns[:, (0, 1, -2, -1)]  # the picture may be displaced
        blocks = {int(number): self.block == number for number in np.unique(self.block)}
        return {
            number: bool(np.corrcoef(_fitted(shift[own], seen[own]), seen[own])[0, 1] > alike)
            for number, own in blocks.items()
            if np.count_nonzero(own) >= _FEWEST and np.ptp(seen[own]) > 0.0
        }


def _fitted(columns: Array, values: Array) -> Array:
    """(N,) values as columns (N, K) explain them."""
    return np.asarray(columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def _middle(greys: Sequence[Image]) -> Array32:
    """(height, width) median of each pixel, refined: the mean of those levels that are near the median."""
    some = np.stack([grey.ravel()[::_EVERY] for grey in greys]).astype(np.float32)
    noise = 1.4826 * float(np.median(np.abs(some - np.median(some, axis=0))))
    picture = np.empty(greys[0].shape, dtype=np.float32)
    for row in range(0, len(picture), _BAND):
        band = np.stack([grey[row : row + _BAND] for grey in greys]).astype(np.float32)
        median = np.median(band, axis=0)
        near = np.abs(band - median) <= max(_NEAR * noise, 1.0)
        count = np.count_nonzero(near, axis=0)
        mean = np.sum(band, axis=0, where=near) / np.maximum(count, 1)
        # Two pictures whose levels differ have no level near the median.
        picture[row : row + _BAND] = np.where(count > 0, mean, median)
    return picture
