"""Rigid transforms between named frames.

A pose named `cam_from_world` maps world coordinates to camera coordinates, so frames chain in names:
`cam_from_board = cam_from_world @ world_from_board`. Rotations are 3 x 3 matrices, lengths metres, angles radians.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from math import atan2, hypot
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.frozen import Frozen, cached_property
from ceres_cal.base.typed import numbers_in

_SMALL_ANGLE = 1e-4  # below this angle (rad) the series below are exact to rounding


def skew(v: ArrayLike) -> Array:
    """The matrix [v]x with [v]x w = v x w, shape (3, 3)."""
    x, y, z = np.asarray(v, dtype=float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def skews(v: Array) -> Array:
    """(K, 3, 3) matrices [v]x of many vectors (K, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.asarray(np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3))


def _with_powers(vector: Array, first: float, second: float) -> Array:
    """I + first [w]x + second [w]x^2, written out by elements: arrays of three numbers take several times as long."""
    x, y, z = vector.tolist()
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    u, v, w = first * x, first * y, first * z
    return np.array(
        [
            [1.0 - second * (y * y + z * z), xy - w, xz + v],
            [xy + w, 1.0 - second * (x * x + z * z), yz - u],
            [xz - v, yz + u, 1.0 - second * (x * x + y * y)],
        ]
    )


def rotation_exp(rotation_vector: ArrayLike) -> Array:
    """Rotation matrix of a rotation vector (axis times angle, rad): Rodrigues' formula."""
    w = np.asarray(rotation_vector, dtype=float)
    angle = hypot(*w.tolist())
    if angle < _SMALL_ANGLE:
        sine, versine = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    else:
        sine, versine = float(np.sin(angle)) / angle, 2.0 * (float(np.sin(0.5 * angle)) / angle) ** 2
    return _with_powers(w, sine, versine)


def rotation_log(rotation: ArrayLike) -> Array:
    """Rotation vector (rad, length at most pi) of a rotation matrix, by its quaternion: exact up to the angle pi."""
    *axis, cosine = quaternion(rotation).tolist()
    sine = hypot(*axis)
    return np.array(axis) * (2.0 if sine < 1e-12 else 2.0 * atan2(sine, cosine) / sine)


def quaternion(rotation: ArrayLike) -> Array:
    """(x, y, z, w) of a rotation matrix, of unit length, with w >= 0."""
    r = np.asarray(rotation, dtype=float).tolist()
    trace = r[0][0] + r[1][1] + r[2][2]
    # Four times the squared components, w last; dividing by the largest one avoids a loss of digits.
    squares = [*(1.0 - trace + 2.0 * r[i][i] for i in range(3)), 1.0 + trace]
    largest = squares.index(max(squares))
    turns = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1], 0.0]  # four times x w, y w and z w
    q = turns if largest == 3 else [*(r[largest][k] + r[k][largest] for k in range(3)), turns[largest]]
    q[largest] = squares[largest]
    return np.array(q) / (-hypot(*q) if q[3] < 0.0 else hypot(*q))


def rotation_of(quaternion: ArrayLike) -> Array:
    """Rotation matrix of a quaternion (x, y, z, w) of any length but 0."""
    x, y, z, w = np.asarray(quaternion, dtype=float)
    sine = float(np.sqrt(x * x + y * y + z * z))
    return rotation_exp(np.array([x, y, z]) * (2.0 * np.arctan2(sine, w) / sine if sine > 0.0 else 0.0))


def left_jacobian(rotation_vector: ArrayLike) -> Array:
    """J with exp(w + dw) = exp(J dw) exp(w) to first order, shape (3, 3)."""
    w = np.asarray(rotation_vector, dtype=float)
    angle = hypot(*w.tolist())
    if angle < _SMALL_ANGLE:
        versine, rest = 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    else:
        versine = 2.0 * (float(np.sin(0.5 * angle)) / angle) ** 2
        rest = (angle - float(np.sin(angle))) / angle**3
    return _with_powers(w, versine, rest)


def require_rotation(matrix: ArrayLike, name: str) -> Array:
    """Return a 3 x 3 matrix if it is a rotation matrix to six digits; InputError otherwise."""
    rounding = 1e-6  # copied numbers have six digits or more
    m = np.asarray(matrix, dtype=float)
    with np.errstate(over="ignore", invalid="ignore"):  # such large numbers are no rotation matrix either
        off = float(np.max([*np.abs(m @ m.T - np.eye(3)).flat, abs(np.linalg.det(m) - 1.0)]))
    if not off < rounding:
        raise InputError(
            f"{name} is not a rotation matrix: R R^T and its determinant are {off:.2g} from the identity and 1"
        )
    return m


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotation matrix nearest to a 3 x 3 matrix in the Frobenius norm (polar factor, determinant +1)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def rotation_from_euler(alpha: float, beta: float, gamma: float) -> Array:
    """The paper's rotation matrix R(alpha, beta, gamma) (section 3.6), angles in radians."""
    ca, cb, cg = np.cos([alpha, beta, gamma])
    sa, sb, sg = np.sin([alpha, beta, gamma])
    return np.array(
        [
            [cb * cg, cb * sg, -sb],
            [sa * sb * cg - sg * ca, sa * sb * sg + ca * cg, sa * cb],
            [ca * sb * cg + sa * sg, ca * sb * sg - sa * cg, ca * cb],
        ]
    )


def euler_from_rotation(rotation: ArrayLike) -> tuple[float, float, float]:
    """The paper's angles (alpha, beta, gamma), rad; beta within +-pi/2.

    At beta = +-pi/2 alpha and gamma are not separable; gamma is then 0.
    """
    r = np.asarray(rotation, dtype=float)
    cos_beta = np.hypot(r[0, 0], r[0, 1])
    gamma = np.arctan2(r[0, 1], r[0, 0]) if cos_beta > 1e-15 else 0.0
    # With gamma taken out of the rotation, alpha compensates for gamma's error near beta = +-pi/2.
    s, c = np.sin(gamma), np.cos(gamma)
    alpha = np.arctan2(s * r[2, 0] - c * r[2, 1], c * r[1, 1] - s * r[1, 0])
    return float(alpha), float(np.arctan2(-r[0, 2], cos_beta)), float(gamma)


class Pose(Frozen):
    """A rigid transform b_from_a: x_b = rotation @ x_a + translation.

    Attributes:
        rotation: (3, 3) rotation matrix.
        translation: (3,) metres, in frame b.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            value = np.array(numbers_in(getattr(self, name), name), order="C")  # otherwise products round differently
            if value.shape != shape:
                raise InputError(f"{name} must have shape {shape}, not {value.shape}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        turn, shift = (", ".join(f"{v:.3f}" for v in part) for part in np.split(self.log(), 2))
        return f"Pose(rotation vector ({turn}) rad, translation ({shift}) m)"

    @classmethod
    @cache
    def identity(cls) -> Pose:
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def exp(cls, vector: ArrayLike) -> Pose:
        """Make the pose of a 6-vector (rotation vector in rad, translation in metres), which is the solver's block of a
        pose.
        """
        v = np.asarray(vector, dtype=float)
        return cls(rotation_exp(v[:3]), v[3:])

    @property
    def matrix(self) -> Array:
        """(3, 4), [R t]."""
        matrix = np.empty((3, 4))
        matrix[:, :3], matrix[:, 3] = self.rotation, self.translation
        return matrix

    def log(self) -> Array:
        """The 6-vector (rotation vector, translation) of this pose: the inverse of `exp`."""
        return np.concatenate([rotation_log(self.rotation), self.translation])

    @classmethod
    def looking(cls, position: ArrayLike, rotation: ArrayLike) -> Pose:
        """Make cam_from_world of a camera at `position` (the paper's t): x_cam = R (x_world - t)."""
        r, place = numbers_in(rotation, "rotation"), numbers_in(position, "position")
        if r.shape != (3, 3) or place.shape != (3,):
            raise InputError(f"position and rotation must have shapes (3,) and (3, 3), not {place.shape} and {r.shape}")
        return cls(r, -r @ place)

    def turned(self, turn: ArrayLike) -> Pose:
        """Return cam_from_world of the camera rotated by a rotation vector about its own axes, at the same position."""
        return Pose.looking(self.position, rotation_exp(turn) @ self.rotation)

    @cached_property
    def position(self) -> Array:
        """(3,) origin of frame b in frame a, metres; for cam_from_world the camera's position (the paper's t)."""
        position = np.asarray(-self.rotation.T @ self.translation)
        position.setflags(write=False)
        return position

    @cached_property
    def inverse(self) -> Pose:
        return Pose(self.rotation.T, self.position)

    def __matmul__(self, other: Pose) -> Pose:
        """c_from_b @ b_from_a = c_from_a."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def transform(self, points: ArrayLike) -> Array:
        """Transform points (..., 3) from frame a to frame b."""
        return np.asarray(np.asarray(points, dtype=float) @ self.rotation.T + self.translation)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Pose)
            and np.array_equal(self.rotation, other.rotation)
            and np.array_equal(self.translation, other.translation)
        )

    __hash__: ClassVar[None] = None  # type: ignore[assignment]


# ---- very many poses ------------------------------------------------------------------------------------------------


def chained(first: Array, second: Array) -> Array:
    """(S, 3, 4) [R t] of c_from_b @ b_from_a, pose by pose; an argument (3, 4) is the same for all."""
    turned = first[..., :3] @ second
    turned[..., 3] += first[..., 3]
    return np.asarray(turned)


def inverted(poses: Array) -> Array:
    """(S, 3, 4) [R t] of the inverses of poses."""
    rotations = np.swapaxes(poses[..., :3], -1, -2)
    return np.concatenate([rotations, -rotations @ poses[..., 3:]], axis=-1)


_IDENTITY = np.eye(3, 4)[None]


class Poses(Frozen, Mapping[str, Pose]):
    """Poses by name, held as one stack.

    Attributes:
        numbers: name -> index in the stack. stack: (K, 3, 4) as [R t].
    """

    numbers: Mapping[str, int]
    stack: Array

    @classmethod
    def of(cls, poses: Mapping[str, Pose]) -> Poses:
        if isinstance(poses, cls):
            return poses
        return cls.stacked(list(poses), np.array([pose.matrix for pose in poses.values()]).reshape(-1, 3, 4))

    @classmethod
    def stacked(cls, names: Sequence[str], stack: Array) -> Poses:
        """Make poses from their names and a stack in the same order."""
        return cls({name: number for number, name in enumerate(names)}, stack)

    def __getitem__(self, name: str) -> Pose:
        matrix = self.stack[self.numbers[name]]
        return Pose(matrix[:, :3], matrix[:, 3])

    def __contains__(self, name: object) -> bool:
        return name in self.numbers

    def __iter__(self) -> Iterator[str]:
        return iter(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def of_names(self, names: Sequence[str | None]) -> Array:
        """(N, 3, 4) poses of these names; None is the identity."""
        if self._are_all(names):
            return self.stack
        every = np.concatenate([self.stack, _IDENTITY])
        return np.asarray(every[[len(self.stack) if name is None else self.numbers[name] for name in names]])

    def _are_all(self, names: Sequence[str | None]) -> bool:
        """Whether these are the names of all poses in order, so that no look-up is needed."""
        return len(names) == len(self.numbers) and list(self.numbers) == names

    def updated(self, names: Sequence[str], stack: Array) -> Poses:
        """Return the poses with those of these names replaced."""
        if self._are_all(names):
            return Poses(self.numbers, stack)
        changed = self.stack.copy()
        changed[[self.numbers[name] for name in names]] = stack
        return Poses(self.numbers, changed)
