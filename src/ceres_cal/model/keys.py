"""Names of the numbers that a calibration is about, each with an owner and a unit.

Intrinsics are in the units of the files. A pose has a position in the world (m) and three turns (rad): of a station
about the camera's own axes (x right, y down, z forward), of a placement about the target's own. Turns are small angles
from where the pose is, so no pose is special, not even one turned by half a turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array

_TURNS = ("turn_x", "turn_y", "turn_z")
STATION_QUANTITIES = ("x", "y", "height", *_TURNS)
PLACEMENT_QUANTITIES = ("x", "y", "z", *_TURNS)
_POSE_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_LIMITS = {"rad": 1e2, "m": 1e6, "px": 1e7}


class Key(NamedTuple):
    """One number: whose it is (a "camera", "station", "placement", "structure" or "dimension" by name), what, and in
    which unit.

    A camera, a station and a placement may carry the same name. Of a structure number the owner is the target, the
    quantity the feature ("HalfwayLine", "CenterCircle.radius", "0,0.x", "bow.x"), or a dimension of the target.
    """

    kind: str
    owner: str
    quantity: str
    unit: str

    @classmethod
    def of_structure(cls, name: str, kind: str = "structure") -> Key:
        """Of a structure number by its full name, "target/feature"."""
        target, _, feature = name.partition("/")
        return cls(kind, target, feature, "m")

    @property
    def whose(self) -> str:
        """Its owner in words: station 'overhead', target 'field'."""
        return f"{'target' if self.is_structure else self.kind} {self.owner!r}"

    @property
    def is_structure(self) -> bool:
        """Whether it is one of the numbers of the targets as built."""
        return self.kind in ("structure", "dimension")

    @property
    def structure_name(self) -> str:
        """The full name of a structure number."""
        return f"{self.owner}/{self.quantity}"


def sigma_limits(keys: Sequence[Key]) -> Array:
    """(P,) sigmas beyond which a number means nothing: turns of many turns, a camera in orbit."""
    return np.array([_LIMITS.get(key.unit, 1e12) for key in keys])


def pose_keys(kind: str, name: str) -> list[Key]:
    """The six keys of a station or a placement."""
    quantities = STATION_QUANTITIES if kind == "station" else PLACEMENT_QUANTITIES
    return [Key(kind, name, q, unit) for q, unit in zip(quantities, _POSE_UNITS, strict=True)]


def over(values: Array, keys: Sequence[Key], wanted: Sequence[Key]) -> Array:
    """(..., W) values (..., K) of the keys (K), in the order of the wanted keys (W): 0 of what is not among the keys.

    What is known of one camera says nothing of another: whoever takes a part of the keys takes it by this.
    """
    column = {key: number for number, key in enumerate(keys)}
    whole = np.zeros((*np.shape(values)[:-1], len(wanted)))
    at = [number for number, key in enumerate(wanted) if key in column]
    whole[..., at] = np.asarray(values)[..., [column[wanted[number]] for number in at]]
    return whole


def columns_by_owner(keys: Sequence[Key]) -> dict[tuple[str, str], list[int]]:
    """(kind, owner) -> where its keys are."""
    columns: dict[tuple[str, str], list[int]] = {}
    for column, key in enumerate(keys):
        columns.setdefault((key.kind, key.owner), []).append(column)
    return columns
