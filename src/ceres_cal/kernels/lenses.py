"""The lens models with their derivatives, a chunk of rays at a time: the formulas of `lens`, for the solve.

Names of the working arrays, each with one column per observation of the chunk:
    rays (3): the point in the camera frame.
    image (7): the offset (ox, oy) from the principal point on square pixels, its derivatives xx, xy = yx, yy with
        respect to the ray's x and y, and xz, yz with respect to its z.
    work (5): what the lens keeps for the derivatives with respect to its own numbers.
    jacobian (intrinsics + 6 + 1, 2): rows phi, aspect, cx, cy, coefficients, pose, residual; x and y components.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.jit import jit

LENS_CODES = {"radial": 0, "brown": 1, "kannala-brandt": 2}
INTRINSICS = 4
"""phi, aspect, cx, cy come first in an intrinsics vector; the lens's coefficients, scaled, follow."""

_RADIAL, _BROWN = 0, 1
_FAR = 6.0  # half image diagonals (radial), or ideal radii (brown): nothing is observed farther out
_FAR_STEPS = 96
_TINY = 1e-150  # its square is still a number


@jit
def one_dimensional(lens: int, intrinsics: Any, powers: Any) -> Any:
    """The lens's map along a radius as a dense polynomial x (d_0 + d_1 x + d_2 x^2 ...), d_0 = 1."""
    dense = np.zeros(max(powers))
    dense[0] = 1.0
    for k in range(len(powers)):
        at = 8 if lens == _BROWN and k == 2 else INTRINSICS + k  # brown: k1 k2 p1 p2 k3
        dense[powers[k] - 1] += intrinsics[at]
    return dense


@jit
def _slope(dense: Any, x: float) -> float:
    slope = 0.0
    for k in range(len(dense) - 1, -1, -1):
        slope = slope * x + (k + 1) * dense[k]
    return slope


@jit
def answer_limit(lens: int, dense: Any) -> float:
    """Where that map first stops growing, or the end of what can be observed: past it the lens has no answer."""
    far = np.pi if lens > _BROWN else _FAR
    step = far / _FAR_STEPS
    low, high = 0.0, far
    for i in range(1, _FAR_STEPS + 1):
        if _slope(dense, i * step) <= 0.0:
            low, high = (i - 1) * step, i * step
            break
        low = i * step
    if high < far or _slope(dense, far) <= 0.0:
        for _ in range(50):
            middle = 0.5 * (low + high)
            if _slope(dense, middle) > 0.0:
                low = middle
            else:
                high = middle
    return low


@jit
def _measured_radius(n: int, dense: Any, limit: float, ideal: Any, s: Any, value: Any, slope: Any) -> float:
    """One Newton step from s towards s (d_0 + d_1 s + ...) = ideal for a chunk; how far the farthest one went."""
    top = len(dense) - 1
    for i in range(n):
        value[i], slope[i] = dense[top], (top + 1) * dense[top]
    for k in range(top - 1, -1, -1):
        for i in range(n):
            value[i] = value[i] * s[i] + dense[k]
            slope[i] = slope[i] * s[i] + (k + 1) * dense[k]
    worst = 0.0
    for i in range(n):
        moved = max(0.0, min(s[i] - (value[i] * s[i] - ideal[i]) / slope[i], limit))
        worst = max(worst, abs(moved - s[i]))
        s[i] = moved
    return worst


@jit
def _radial(n: int, intrinsics: Any, dense: Any, unit: float, limit: float, rays: Any, image: Any, work: Any) -> bool:
    """The paper's lens: s (1 + c_2 s + ...) = phi |u| / unit solved for the radius s, in half image diagonals."""
    phi = intrinsics[0]
    ideal, value, slope = image[0], image[1], image[2]
    for i in range(n):
        u, v = rays[0, i] / rays[2, i], rays[1, i] / rays[2, i]
        m = np.sqrt(u * u + v * v) + _TINY
        work[0, i], work[1, i], work[2, i] = u, v, m
        ideal[i] = phi * m / unit
        work[3, i] = min(ideal[i], limit)
    worst = 1.0
    for _ in range(25):
        worst = _measured_radius(n, dense, limit, ideal, work[3], value, slope)
        if worst < 1e-8:  # the step just taken has squared this
            break
    good = worst < 1e-8
    for i in range(n):
        work[4, i] = 1.0 / slope[i]
        good &= (rays[2, i] > 0.0) & (slope[i] > 0.0) & (work[3, i] < limit)
    for i in range(n):
        u, v, m, iz = work[0, i], work[1, i], work[2, i], 1.0 / rays[2, i]
        stretch = unit * work[3, i] / m  # px per unit of the ideal point
        bend = (phi * work[4, i] - stretch) / (m * m)
        xx, xy, yy = (stretch + bend * u * u) * iz, bend * u * v * iz, (stretch + bend * v * v) * iz
        image[0, i], image[1, i] = stretch * u, stretch * v
        image[2, i], image[3, i], image[4, i] = xx, xy, yy
        image[5, i], image[6, i] = -(xx * u + xy * v), -(xy * u + yy * v)
    return good


@jit
def _brown(n: int, intrinsics: Any, limit: float, rays: Any, image: Any, work: Any) -> bool:
    """Brown's lens, coefficients in the order k1 k2 p1 p2 k3."""
    phi = intrinsics[0]
    k1, k2, p1, p2, k3 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7], intrinsics[8]
    good = True
    for i in range(n):
        iz = 1.0 / rays[2, i]
        u, v = rays[0, i] * iz, rays[1, i] * iz
        r2 = u * u + v * v
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        xx = phi * (radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u) * iz
        xy = phi * (u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v) * iz
        yy = phi * (radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u) * iz
        image[0, i] = phi * (u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u))
        image[1, i] = phi * (v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v)
        image[2, i], image[3, i], image[4, i] = xx, xy, yy
        image[5, i], image[6, i] = -(xx * u + xy * v), -(xy * u + yy * v)
        work[0, i], work[1, i], work[2, i] = u, v, r2
        good &= (rays[2, i] > 0.0) & (r2 < limit * limit)
    return good


@jit
def _kannala_brandt(n: int, intrinsics: Any, limit: float, rays: Any, image: Any, work: Any) -> bool:
    """Kannala and Brandt's lens: the measured radius is a polynomial of the angle from the axis."""
    phi = intrinsics[0]
    k1, k2, k3, k4 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7]
    good = True
    for i in range(n):
        x, y, z = rays[0, i], rays[1, i], rays[2, i]
        across2 = x * x + y * y
        across = np.sqrt(across2) + _TINY
        range2 = across2 + z * z
        angle = np.arctan2(across, z)
        a2 = angle * angle
        measured = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
        # On the axis measured / across is 1 / z, and the bend's factor x^2 takes it to 0.
        stretch = measured / across if across > 1e-12 * z else 1.0 / z
        bend = (slope * z / range2 - stretch) / (across2 + _TINY) if across > 1e-12 * z else 0.0
        image[0, i], image[1, i] = phi * stretch * x, phi * stretch * y
        image[2, i] = phi * (stretch + bend * x * x)
        image[3, i] = phi * bend * x * y
        image[4, i] = phi * (stretch + bend * y * y)
        image[5, i], image[6, i] = -phi * x * slope / range2, -phi * y * slope / range2
        work[0, i], work[1, i], work[2, i] = x / across, y / across, angle
        good &= (angle < limit) & (range2 > 0.0)
    return good


@jit
def distort(
    lens: int, n: int, intrinsics: Any, dense: Any, unit: float, limit: float, rays: Any, image: Any, work: Any
) -> bool:
    """Fill `image` and `work`; False where any ray has no answer."""
    if lens == _RADIAL:
        return _radial(n, intrinsics, dense, unit, limit, rays, image, work)
    if lens == _BROWN:
        return _brown(n, intrinsics, limit, rays, image, work)
    return _kannala_brandt(n, intrinsics, limit, rays, image, work)


@jit
def intrinsics_rows(
    lens: int, n: int, intrinsics: Any, powers: Any, unit: float, image: Any, work: Any, jacobian: Any
) -> None:
    """Derivatives of the distorted chunk's pixels with respect to phi, aspect, principal point and coefficients."""
    phi, aspect = intrinsics[0], intrinsics[1]
    for i in range(n):
        jacobian[0, 0, i], jacobian[0, 1, i] = image[0, i] / phi, aspect * image[1, i] / phi
        jacobian[1, 0, i], jacobian[1, 1, i] = 0.0, image[1, i]
        jacobian[2, 0, i], jacobian[2, 1, i] = 1.0, 0.0
        jacobian[3, 0, i], jacobian[3, 1, i] = 0.0, 1.0
    if lens == _RADIAL:
        for i in range(n):
            jacobian[0, 0, i], jacobian[0, 1, i] = work[0, i] * work[4, i], aspect * work[1, i] * work[4, i]
        for k in range(len(powers)):
            row = INTRINSICS + k
            for i in range(n):
                jacobian[row, 0, i] = -unit * work[4, i] / work[2, i]
            for _ in range(powers[k]):
                for i in range(n):
                    jacobian[row, 0, i] *= work[3, i]
            for i in range(n):
                d = jacobian[row, 0, i]
                jacobian[row, 0, i], jacobian[row, 1, i] = d * work[0, i], aspect * d * work[1, i]
    elif lens == _BROWN:
        for i in range(n):
            u, v, r2 = work[0, i], work[1, i], work[2, i]
            x, y, r4 = phi * u, aspect * phi * v, r2 * r2
            jacobian[4, 0, i], jacobian[4, 1, i] = x * r2, y * r2
            jacobian[5, 0, i], jacobian[5, 1, i] = x * r4, y * r4
            jacobian[6, 0, i], jacobian[6, 1, i] = 2.0 * x * v, aspect * phi * (r2 + 2.0 * v * v)
            jacobian[7, 0, i], jacobian[7, 1, i] = phi * (r2 + 2.0 * u * u), 2.0 * u * y
            jacobian[8, 0, i], jacobian[8, 1, i] = x * r2 * r4, y * r2 * r4
    else:
        for k in range(4):
            for i in range(n):
                d = phi * work[2, i] ** (2 * k + 3)
                jacobian[4 + k, 0, i], jacobian[4 + k, 1, i] = d * work[0, i], aspect * d * work[1, i]
