"""What the kernels are handed, by name: optics, observations, loss, unknowns, blocks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array


class Optics(NamedTuple):
    """A camera's optics.

    Attributes:
        lens: a `scene.lens.Lens` of the camera's kind; only one that is not compiled is asked for anything.
        kind: its name, by which the compiled one is known. form: (F,) what that one is chosen by, see `Lens.form`.
        intrinsics: phi, aspect, cx, cy, scaled coefficients, skew. unit: half the image diagonal, px.
    """

    lens: Any
    kind: str
    form: Array
    intrinsics: Array
    unit: float


BUILT = 8
"""Numbers at most that move an observation on its target: of a point x, y and what a board's warp is made of."""


class PointColumns(NamedTuple):
    """The point observations of some sights, one sight after the other.

    Attributes:
        bounds: (S + 1,) where each sight's rows begin. places: (N, 3) m, as built. pixels: (N, 2).
        weights: (N,) 1 / (noise scale * sigma).
        slots: (N, BUILT) with bends (N, BUILT - 2): the structure numbers that move each point, -1 for none; empty
            without structure (see `structure.Structure`).
    """

    bounds: Any
    places: Array
    pixels: Array
    weights: Array
    slots: Any
    bends: Array


class CurveColumns(NamedTuple):
    """The curve observations of some sights, one sight after the other.

    Attributes:
        bounds: (S + 1,) where each sight's rows begin. tracks: (T, 3, 3) as built, is_arc: (T,).
        track: (M,) index into tracks. pixels: (M, 2). weights: (M,) 1 / (noise scale * sigma).
        feet: (M,) place on the track, read as a start and left at the foot.
        slots: (T, 3) the structure numbers that move each track, -1 for none; empty without structure.
    """

    bounds: Any
    tracks: Array
    is_arc: Any
    track: Any
    pixels: Array
    weights: Array
    feet: Array
    slots: Any


class Loss(NamedTuple):
    """A robust loss: a LOSS_CODES value and its scale in standard deviations."""

    code: int
    scale: float


class Unknowns(NamedTuple):
    """What is solved for besides poses: places in the intrinsics vector, and how many structure numbers."""

    free: Any
    structure: int


class Blocks(NamedTuple):
    """One array for each of Ceres's parameter blocks of a sight, empty where the block is held."""

    camera: Array
    station: Array
    placement: Array
    structure: Array


class Sweep(NamedTuple):
    """Placements at their best for given shared numbers.

    Attributes:
        poses: (S, 3, 4) [R t] of cam_from_target. gains: (S, 6, shared) how they follow the shared numbers.
        costs: (S,) sum of rho of each sight; infinite where an observation cannot be projected.
        reduced: (shared + 1,) squared, lower triangle: the normal equations that are left, the residual's row last.
    """

    poses: Array
    gains: Array
    costs: Array
    reduced: Array


NOTHING = np.empty(0)
"""A block that is held."""

LOSS_CODES = {"trivial": 0, "huber": 1, "soft_l1": 2, "cauchy": 3, "tukey": 4}

ROUNDING = 1e-9  # of a cost
