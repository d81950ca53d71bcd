"""The spline lens for the solve: plain numbers and loops, which the kernels compile.

The state is the limit, how many monomials and how many powers there are, and a spare; the table of the B-splines'
pieces (see `b_splines`); the profile's polynomial on each interval; of each monomial the place of its coefficient among
the intrinsics, whether that is conjugated, m, n and weight.
"""

from __future__ import annotations

from typing import Any

import numpy as np

INTERVALS, DEGREE = 8, 5
MOST = 9  # powers across the radius
END = 2.0  # rims: nothing is observed farther out
TINY = 1e-150
HEAD = 4  # of the state
TABLE = INTERVALS * (DEGREE + 1) ** 2
WORK_ROWS = 3 + 2 * (MOST + 1) + 2


def prepare(intrinsics: Any, unit: float, state: Any) -> None:
    """See `Lens.prepare`."""
    for j in range(INTERVALS):
        for d in range(DEGREE + 1):
            total = 0.0
            for a in range(DEGREE + 1):
                if j + a >= 2:
                    total += intrinsics[5 + j + a - 2] * state[HEAD + ((j * (DEGREE + 1)) + a) * (DEGREE + 1) + d]
            state[HEAD + TABLE + j * (DEGREE + 1) + d] = total
    rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
    state[0] = END
    for k in range(1, 8 * INTERVALS + 1):
        u = k / (8.0 * INTERVALS)
        if rim + _piecewise(state, u)[1] <= 0.0:
            state[0] = u
            break


def distort(n: int, intrinsics: Any, unit: float, state: Any, rays: Any, image: Any, work: Any) -> bool:
    """See `Lens.distort_chunk`."""
    limit = state[0]
    phi = intrinsics[0]
    rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
    most = int(state[2])
    scale = 2.0 * phi / (unit * rim)
    for i in range(n):
        x, y, z = rays[0, i], rays[1, i], rays[2, i]
        s = scale / (np.sqrt(x * x + y * y + z * z) + z)
        work[0, i], work[1, i] = s * x, s * y
        work[2, i] = np.sqrt(work[0, i] * work[0, i] + work[1, i] * work[1, i])
        work[3, i], work[4, i] = 1.0, 0.0
    for k in range(1, most + 1):
        for i in range(n):
            a, b = work[1 + 2 * k, i], work[2 + 2 * k, i]
            work[3 + 2 * k, i] = a * work[0, i] - b * work[1, i]
            work[4 + 2 * k, i] = a * work[1, i] + b * work[0, i]
    for k in range(6):
        for i in range(n):
            image[k, i] = 0.0
    for k in range(int(state[1])):
        row = HEAD + TABLE + INTERVALS * (DEGREE + 1) + 5 * k
        _add_monomial(n, intrinsics, state[row : row + 5], work, image)
    good = True
    for i in range(n):
        x, y, z = rays[0, i], rays[1, i], rays[2, i]
        u, v, radius = work[0, i], work[1, i], work[2, i]
        value, slope = _piecewise(state, radius)
        stretch = value / (radius + TINY)
        bend = (slope - stretch) / (radius * radius + TINY)
        # Derivatives by q (rows 2, 3) and by its conjugate (rows 4, 5) become those by x and y.
        first_x, first_y = image[2, i] + image[4, i], image[3, i] + image[5, i]
        second_x, second_y = image[2, i] - image[4, i], image[3, i] - image[5, i]
        jxx, jyy = rim + stretch + bend * u * u + first_x, rim + stretch + bend * v * v + second_x
        jxy, jyx = bend * u * v - second_y, bend * u * v + first_y
        length = np.sqrt(x * x + y * y + z * z)
        s = scale / (length + z)
        f = s / (length * (length + z))
        ax, ab, by = s - f * x * x, -f * x * y, s - f * y * y
        image[0, i] = unit * ((rim + stretch) * u + image[0, i])
        image[1, i] = unit * ((rim + stretch) * v + image[1, i])
        xy = unit * (jxx * ab + jxy * by)
        image[2, i], image[3, i], image[4, i] = unit * (jxx * ax + jxy * ab), xy, unit * (jyx * ab + jyy * by)
        image[7, i] = unit * (jyx * ax + jyy * ab) - xy
        along_x, along_y = unit * (jxx * u + jxy * v), unit * (jyx * u + jyy * v)
        image[5, i], image[6, i] = -along_x / length, -along_y / length
        work[2 * MOST + 5, i], work[2 * MOST + 6, i] = along_x / phi, along_y / phi
        good &= (length + z > 1e-9 * length) & (radius < limit) & (jxx * jyy > jxy * jyx) & (jxx + jyy > 0.0)
    return good


def differentiate(n: int, intrinsics: Any, unit: float, state: Any, image: Any, work: Any, jacobian: Any) -> None:
    """See `Lens.differentiate_chunk`."""
    phi, aspect, last = intrinsics[0], intrinsics[1], len(intrinsics)
    rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
    for i in range(n):
        jacobian[0, 0, i], jacobian[0, 1, i] = work[2 * MOST + 5, i], aspect * work[2 * MOST + 6, i]
        jacobian[4, 0, i] = unit * work[0, i] - phi * work[2 * MOST + 5, i] / rim
        jacobian[4, 1, i] = aspect * (unit * work[1, i] - phi * work[2 * MOST + 6, i] / rim)
    for k in range(5, last):
        for i in range(n):
            jacobian[k, 0, i], jacobian[k, 1, i] = 0.0, 0.0
    for i in range(n):
        radius = work[2, i]
        inside = min(radius, 1.0)
        j = min(int(inside * INTERVALS), INTERVALS - 1)
        t = inside * INTERVALS - j
        x, y = unit * work[0, i] / (radius + TINY), aspect * unit * work[1, i] / (radius + TINY)
        for a in range(DEGREE + 1):
            if j + a >= 2:
                row = HEAD + (j * (DEGREE + 1) + a) * (DEGREE + 1)
                value = state[row + DEGREE]
                for d in range(DEGREE - 1, -1, -1):
                    value = value * t + state[row + d]
                if radius > 1.0:
                    value += INTERVALS * (radius - 1.0) * _polynomial(state, row, t)[1]
                jacobian[3 + j + a, 0, i], jacobian[3 + j + a, 1, i] = value * x, value * y
    for k in range(int(state[1])):
        row = HEAD + TABLE + INTERVALS * (DEGREE + 1) + 5 * k
        at, m, p, weight = int(state[row]), int(state[row + 2]), int(state[row + 3]), unit * state[row + 4]
        sign = -1.0 if state[row + 1] > 0.0 else 1.0
        for i in range(n):
            a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
            x, y = weight * (a * c + b * d), weight * (b * c - a * d)
            jacobian[at, 0, i] += x
            jacobian[at, 1, i] += aspect * y
            jacobian[at + 1, 0, i] -= sign * y
            jacobian[at + 1, 1, i] += sign * aspect * x


def _polynomial(state: Any, row: int, t: float) -> tuple[float, float]:
    """Value and slope at t of a polynomial of the state."""
    value, slope = state[row + DEGREE], 0.0
    for d in range(DEGREE - 1, -1, -1):
        slope = slope * t + value
        value = value * t + state[row + d]
    return value, slope


def _piecewise(state: Any, u: float) -> tuple[float, float]:
    """G and its slope, straight on beyond the last knot."""
    inside = min(u, 1.0)
    j = min(int(inside * INTERVALS), INTERVALS - 1)
    value, slope = _polynomial(state, HEAD + TABLE + j * (DEGREE + 1), inside * INTERVALS - j)
    return value + INTERVALS * slope * max(u - 1.0, 0.0), INTERVALS * slope


def _add_monomial(n: int, intrinsics: Any, one: Any, work: Any, image: Any) -> None:
    """c q^m conj(q)^n added to the image's rows 0 and 1, its derivatives by q and its conjugate to 2, 3 and 4, 5."""
    at, m, p = int(one[0]), int(one[2]), int(one[3])
    real = one[4] * intrinsics[at]
    imaginary = one[4] * (-intrinsics[at + 1] if one[1] > 0.0 else intrinsics[at + 1])
    for i in range(n):
        a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
        x, y = a * c + b * d, b * c - a * d
        image[0, i] += real * x - imaginary * y
        image[1, i] += real * y + imaginary * x
    if m > 0:
        for i in range(n):
            a, b, c, d = work[1 + 2 * m, i], work[2 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
            x, y = m * (a * c + b * d), m * (b * c - a * d)
            image[2, i] += real * x - imaginary * y
            image[3, i] += real * y + imaginary * x
    if p > 0:
        for i in range(n):
            a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[1 + 2 * p, i], work[2 + 2 * p, i]
            x, y = p * (a * c + b * d), p * (b * c - a * d)
            image[4, i] += real * x - imaginary * y
            image[5, i] += real * y + imaginary * x
