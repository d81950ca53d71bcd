"""Information with named keys: joint knowledge of some numbers, the inverse of a covariance if there is one.

Information is added. Numbers that are held are struck out, numbers of no interest are integrated out. Nothing is
inverted where nothing is known.

Also the keys: names of the numbers of a calibration, each with an owner and a unit.

Intrinsics are in the units of the files. A pose has a position in the world (m) and three turns (rad): those of a
station are about the camera's own axes (x right, y down, z forward), those of a placement about the target's own axes.
Turns are small angles from the present pose, so that no pose is special, not even one turned by half a turn.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Spread, cached_property, eigh, known_inverses, root_of, without
from ceres_cal.observations.sights import STRUCTURE, Owner

_TURNS = ("turn_x", "turn_y", "turn_z")
STATION_QUANTITIES = ("x", "y", "height", *_TURNS)
PLACEMENT_QUANTITIES = ("x", "y", "z", *_TURNS)
POSE_QUANTITIES = {"station": STATION_QUANTITIES, "placement": PLACEMENT_QUANTITIES}
_POSE_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_LIMITS = {"rad": 1e2, "m": 1e6, "px": 1e7}


class Key(NamedTuple):
    """The name of one number: the kind ("camera", "station", "placement", "structure" or "dimension") and name of its
    owner, its quantity and its unit.

    A camera, a station and a placement may have the same name. The owner of a structure number is the target, and its
    quantity is the feature ("HalfwayLine", "CenterCircle.radius", "0,0.x", "bow.x") or a dimension of the target.
    """

    kind: str
    owner: str
    quantity: str
    unit: str

    @classmethod
    def of_structure(cls, name: str, kind: str = "structure") -> Key:
        """The key of a structure number by its full name, "target/feature"."""
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
    """(P,) sigmas above which a number counts as unknown: angles of many turns, a camera in orbit."""
    return np.array([_LIMITS.get(key.unit, 1e12) for key in keys])


def pose_keys(kind: str, name: str) -> list[Key]:
    """The six keys of a station or a placement."""
    return [Key(kind, name, q, unit) for q, unit in zip(POSE_QUANTITIES[kind], _POSE_UNITS, strict=True)]


def over(values: Array, keys: Sequence[Key], wanted: Sequence[Key]) -> Array:
    """(..., W) values (..., K) of the keys (K), rearranged for the wanted keys (W), with 0 for keys that have no value.

    What is known of one camera says nothing of another, so all parts of a set of keys are selected by this function.
    """
    column = {key: number for number, key in enumerate(keys)}
    whole = np.zeros((*np.shape(values)[:-1], len(wanted)))
    at = [number for number, key in enumerate(wanted) if key in column]
    whole[..., at] = np.asarray(values)[..., [column[wanted[number]] for number in at]]
    return whole


def columns_by_owner(keys: Sequence[Key]) -> dict[Owner, list[int]]:
    """The columns of the keys of each owner."""
    columns: dict[Owner, list[int]] = {}
    for column, key in enumerate(keys):
        columns.setdefault(STRUCTURE if key.is_structure else (key.kind, key.owner), []).append(column)
    return columns


class Information(Frozen):
    """An information matrix, symmetric, not necessarily of full rank.

    Attributes:
        keys: (K) the numbers. matrix: (K, K), in inverse units of the keys.
    """

    keys: tuple[Key, ...]
    matrix: Array

    @classmethod
    def nothing(cls, keys: Sequence[Key] = ()) -> Information:
        """No information on these numbers."""
        return cls(tuple(keys), np.zeros((len(keys), len(keys))))

    @classmethod
    def of_sigmas(cls, sigmas: Mapping[Key, float]) -> Information:
        """Information on independent numbers, each with a standard deviation."""
        return cls(tuple(sigmas), np.diag(np.array(list(sigmas.values()), dtype=float) ** -2.0))

    @cached_property
    def _column(self) -> dict[Key, int]:
        return {key: column for column, key in enumerate(self.keys)}

    def columns(self, keys: Sequence[Key]) -> Indices:
        """The columns of some of its keys."""
        return np.array([self._column[key] for key in keys], dtype=np.int64)

    def among(self, keys: Collection[Key]) -> tuple[Key, ...]:
        """Those of its keys that are among the given ones, in its order."""
        wanted = set(keys)
        return tuple([key for key in self.keys if key in wanted])

    def given(self, keys: Sequence[Key]) -> Information:
        """The information on some of the numbers, with all others held."""
        if tuple(keys) == self.keys:
            return self
        at = self.columns(keys)
        return Information(tuple(keys), self.matrix[at[:, None], at])

    def marginal(self, keys: Sequence[Key]) -> Information:
        """The information on some of the numbers, with all others integrated out: the Schur complement."""
        wanted = set(keys)
        rest = [key for key in self.keys if key not in wanted]
        if not rest:
            return self.given(keys)
        at, others = self.columns(keys), self.columns(rest)
        here, coupling = self.matrix[at[:, None], at], self.matrix[others[:, None], at]
        return Information(
            tuple(keys), without(here, coupling, self.matrix[others[:, None], others], sigma_limits(rest))
        )

    @property
    def of_cameras(self) -> Information:
        """The information on cameras and stations, with all else integrated out."""
        return self.marginal([key for key in self.keys if key.kind in ("camera", "station")])

    def without(self, keys: Collection[Key]) -> Information:
        """The information without some numbers, which are integrated out."""
        gone = set(keys)
        return self.marginal([key for key in self.keys if key not in gone])

    def over(self, keys: Sequence[Key]) -> Information:
        """The same information over other keys, which must include all of its own."""
        whole = Information.nothing(keys)
        at = whole.columns(self.keys)
        whole.matrix[at[:, None], at] = self.matrix
        return whole

    def widened(self, shifts: Array) -> Information:
        """The information if the covariance is larger by d d^T for each of the shifts d (S, K) (Woodbury).

        It is computed by a root A of the matrix, so that rounding makes no variance negative: A^T (1 + A D D^T A^T)^-1
        A.
        """
        if not len(shifts):
            return self
        unit = np.sqrt(np.maximum(np.diagonal(self.matrix), np.finfo(float).tiny))
        root = root_of(self.matrix / unit[:, None] / unit) * unit
        along, sizes, _ = np.linalg.svd(root @ shifts.T, full_matrices=False)
        left = root - (along * (1.0 - 1.0 / np.hypot(1.0, sizes))) @ (along.T @ root)
        return Information(self.keys, left.T @ left)

    def beyond(self, covariance: Array, least: float | None = None) -> tuple[float, Array]:
        """The least ratio of a covariance (K, K) to the one of this information, or `least` if given; and shifts (S, K)
        whose outer products sum to what it is beyond that ratio. Unknown directions count as wide enough.
        """
        ratios, turned = eigh(self.root @ covariance @ self.root.T)
        factor = least if least is not None else float(max(np.min(ratios, initial=1.0), np.finfo(float).eps))
        more = turned * np.sqrt(np.maximum(ratios - factor, 0.0))
        return factor, (self.spread.covariance @ self.root.T @ more).T

    def beside(self, stated: Information, shifts: Array) -> Array:
        """(S, K) shifts that widen all of this as the given shifts (S, K) widen the part beyond what was stated.

        With L the information beyond P, what was stated, C = (L + P)^-1 and E the given shifts, the covariance of L + P
        with L widened by E is C + G^T N^-1 G, where G = E L C and N = 1 + E L C P E^T: N^-1/2 G replaces E.
        """
        moved = shifts @ self.less(stated).matrix @ self.inverse
        left = moved @ stated.matrix @ shifts.T
        values, vectors = eigh(np.eye(len(left)) + 0.5 * (left + left.T))
        return np.asarray((vectors / np.sqrt(np.maximum(values, 1.0))) @ vectors.T @ moved)

    def less(self, other: Information) -> Information:
        """The information without a part of it; none on numbers of which only rounding would remain."""
        told_from_rounding = 1e-12  # share of the information on a number
        left = self.matrix - other.over(self.keys).matrix
        visible = np.diagonal(left) > told_from_rounding * np.diagonal(self.matrix)
        return Information(self.keys, np.where(visible[:, None] & visible, left, 0.0))

    def __add__(self, other: Information) -> Information:
        """The sum of both, over the keys of either."""
        return self.beside_all([other])

    def beside_all(self, others: Iterable[Information]) -> Information:
        """The sum of all, over the keys of any of them."""
        every = [self, *others]
        whole = Information.nothing(tuple(dict.fromkeys(chain(*(other.keys for other in every)))))
        for other in every:
            at = whole.columns(other.keys)
            whole.matrix[(at[:, None], at) if other.keys != whole.keys else ...] += other.matrix
        return whole

    @cached_property
    def spread(self) -> Spread:
        """Covariance and unknown directions."""
        return Spread.of(self.matrix, sigma_limits(self.keys))

    @cached_property
    def inverse(self) -> Array:
        """(K, K) inverse over known directions; unknown directions are left out."""
        return known_inverses(self.matrix, sigma_limits(self.keys))

    @property
    def known_rank(self) -> int:
        """Number of directions that are known."""
        return len(self.keys) - int(self.spread.unknown.shape[1])

    @cached_property
    def root(self) -> Array:
        """(R, K) with root^T root = matrix: a row for each determined direction, in standard deviations."""
        determined = 1e-11  # eigenvalue at unit diagonal above which a direction counts as determined
        diagonal = np.diagonal(self.matrix)
        if np.count_nonzero(self.matrix) == np.count_nonzero(diagonal):
            return np.asarray(np.diag(np.sqrt(diagonal))[diagonal > 0.0])
        scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
        values, vectors = eigh(self.matrix * scale[:, None] * scale)
        kept = values > determined
        return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T / scale)
