"""What a printed target looks like: its sheet of paper, and how much of a small square on it is dark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from ceres_cal.base.arrays import Array


@dataclass(frozen=True, eq=False)
class Footprints:
    """Small squares of a picture on the target's plane z = const.

    Attributes:
        plane: (M, 2) their middles, m. along_x, along_y: (M, 2) what a step of one square to the right and down is on
            the plane, m.
    """

    plane: Array
    along_x: Array
    along_y: Array

    def step_m(self, direction: Array) -> Array:
        """(M,) how far the place moves along a direction (M, 2) over one square, m."""
        across = np.sum(self.along_x * direction, axis=1), np.sum(self.along_y * direction, axis=1)
        return np.asarray(np.maximum(np.hypot(*across), 1e-12))


def share_inside(distance: Array, step: Array) -> Array:
    """The share of a square that lies on the positive side of a straight border, from the middle's distance to it."""
    return np.clip(distance / step + 0.5, 0.0, 1.0)


class Square(Struct, frozen=True):
    """A dark square by its corner of the least x and y, and its side, m."""

    corner_m: tuple[float, float]
    side_m: float
    is_dark: bool = True


class Disc(Struct, frozen=True):
    """A disc by its centre and radius, m; a light one lies on a dark one."""

    centre_m: tuple[float, float]
    radius_m: float
    is_dark: bool = True


class Paper(Struct, frozen=True, eq=False):
    """The rectangular sheet that a target is printed on.

    Attributes:
        low_m, high_m: (x, y) of two opposite corners of the sheet.
        dark: the share (M,) of each small square that is dark, as a camera sees it.
        shapes: what is printed, in this order, on white.
    """

    low_m: tuple[float, float]
    high_m: tuple[float, float]
    dark: Callable[[Footprints], Array]
    shapes: Callable[[], Iterator[Square | Disc]]
