"""Registration with a poor initial estimate: the shift, turn and scale by which predicted curves best match bright
lines.

A photograph is reduced to a map of how near each pixel is to something thin and bright; thousands of shifts are tried
on this map.
"""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np

from ceres_cal.base import Array, Array32, Frozen, Mask, median, quantile
from ceres_cal.detect.courses import Course

REDUCED = 4
_NEAR_PX = 8.0
_TURNS_DEG = np.arange(-7.5, 7.6, 1.25)


class Nearness(Frozen):
    """(H, W) nearness of a photograph's pixels to bright lines, from 1 on them to 0 far away, REDUCED times smaller."""

    plane: Array32

    @property
    def length_px(self) -> float:
        """Length of the lines, including what is near to their ends, px."""
        return float(np.sum(self.plane) * REDUCED**2 / (np.sqrt(2.0 * np.pi) * _NEAR_PX))

    def score(self, pixels: Array) -> float:
        """Mean nearness of places (N, 2) px; those outside the image count as far away."""
        return float(np.mean(self.at(pixels[:, 0], pixels[:, 1])))

    def at(self, x: Array, y: Array) -> Array:
        """Nearness of places x, y px of any shape; 0 outside the image."""
        column, row = (np.round((v + 0.5) / REDUCED - 0.5) for v in (x, y))
        height, width = self.plane.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)  # False for NaN
        rows, columns = (np.where(inside, one, 0.0).astype(np.int32) for one in (row, column))
        return np.where(inside, self.plane.ravel()[rows * width + columns], np.float32(0.0))


def nearness(grey: Array32, width_px: float) -> Nearness:
    """Return how near each pixel is to something at most about `width_px` wide and brighter than its surroundings."""
    speck_px = 25  # fewer connected pixels than this are no line
    soft = cv2.GaussianBlur(grey, (0, 0), 0.8)
    size = 2 * int(np.ceil(width_px) + 2) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    bright = cv2.morphologyEx(soft, cv2.MORPH_TOPHAT, kernel)
    limit = max(0.3 * quantile(bright.ravel(), 0.99), 4.0 * median(bright.ravel()))
    mask = (bright > limit).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    kept = stats[:, cv2.CC_STAT_AREA] >= speck_px
    kept[0] = False
    return nearness_to(kept[labels])


def nearness_to(mask: Mask) -> Nearness:
    """Return how near each pixel is to the pixels of a mask (height, width)."""
    size = mask.shape[1] // REDUCED, mask.shape[0] // REDUCED
    if not np.any(mask):
        return Nearness(np.zeros(size[::-1], np.float32))
    away = cv2.distanceTransform(1 - mask.astype(np.uint8), cv2.DIST_L2, 3)
    near = np.exp(-0.5 * (away / _NEAR_PX) ** 2).astype(np.float32)
    return Nearness(np.asarray(cv2.resize(near, size, interpolation=cv2.INTER_AREA), dtype=np.float32))


def shifted(course: Course, near: Nearness, image_size: tuple[int, int], reach_px: float, most: int) -> list[Array]:
    """Return the best positions (N, 2) px of a course that may be off by `reach_px` and some degrees. Each is a shift,
    turn and scale of its pixels about the image's middle; the best is first, and there are at most `most`.
    """
    apart_px = 25.0
    scales = (0.92, 1.0, 1.08)
    middle = 0.5 * np.array(image_size)
    steps = np.arange(-reach_px, reach_px + 1.0, 2.5 * REDUCED)
    away, scored = course.pixels - middle, []
    for turn, scale in product(np.deg2rad(_TURNS_DEG), scales):
        cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
        turned = middle + away @ np.array([[cosine, sine], [-sine, cosine]])
        score = np.empty((len(steps), len(steps)))
        for row, dy in enumerate(steps):
            score[row] = near.at(turned[:, 0] + steps[:, None], turned[:, 1] + dy).mean(axis=1)
        best = int(np.argmax(score))
        shift = np.array([steps[best % len(steps)], steps[best // len(steps)]])
        scored.append((float(score.flat[best]), turned + shift))
    scored.sort(key=lambda one: -one[0])
    chosen: list[Array] = []
    for _, places in scored:
        if all(np.mean(np.linalg.norm(places - other, axis=1)) > apart_px for other in chosen):
            chosen.append(places)
        if len(chosen) == most:
            break
    return chosen
