"""The spline lens for the solve: plain numbers and loops, which the kernels compile.

The state is the limit, how many monomials there are and the highest power of the place in them, and where among the
intrinsics Conrady's decentring and the surface are (0: nowhere); the table of the B-splines' pieces (see `b_splines`),
coefficients by power, those of all pieces of an interval side by side; the profile's polynomial on each interval; of
each monomial the place of its coefficient among the intrinsics, m and n.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.scene.lens.surface_kernel import add_surface, differentiate_surface

INTERVALS, DEGREE = 8, 5
CONRADY = 3  # terms of the decentring
COUNT = INTERVALS + DEGREE - 2  # of the B-splines: value and slope at the axis are 0
MOST = 9  # powers across the radius
END = 2.0  # rims: nothing is observed farther out
TINY = 1e-150
HEAD = 5  # of the state
TABLE = INTERVALS * (DEGREE + 1) ** 2
MONOMIALS = HEAD + TABLE + INTERVALS * (DEGREE + 1)
WORK_ROWS = 3 + 2 * (MOST + 1) + 2


def prepare(intrinsics: Any, unit: float, state: Any) -> None:
    """See `Lens.prepare`."""
    for j in range(INTERVALS):
        for d in range(DEGREE + 1):
            total = 0.0
            for a in range(DEGREE + 1):
                if j + a >= 2:
                    total += intrinsics[5 + j + a - 2] * state[HEAD + (j * (DEGREE + 1) + d) * (DEGREE + 1) + a]
            state[HEAD + TABLE + j * (DEGREE + 1) + d] = total
    rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
    state[0] = END
    for k in range(1, 8 * INTERVALS + 1):
        u = k / (8.0 * INTERVALS)
        if rim + _profile(state, u)[1] <= 0.0:
            state[0] = u
            break


def distort(n: int, intrinsics: Any, unit: float, state: Any, rays: Any, image: Any, work: Any) -> bool:
    """See `Lens.distort_chunk`."""
    limit = state[0]
    phi = intrinsics[0]
    rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
    scale = 2.0 * phi / (unit * rim)
    per_scale, per_phi = 1.0 / scale, 1.0 / phi
    for i in range(n):
        x, y, z = rays[0, i], rays[1, i], rays[2, i]
        length = np.sqrt(x * x + y * y + z * z)
        s = scale / (length + z)
        work[2 * MOST + 5, i], work[2 * MOST + 6, i] = length, s
        work[0, i], work[1, i] = s * x, s * y
        work[2, i] = np.sqrt(work[0, i] * work[0, i] + work[1, i] * work[1, i])
    _add_conrady(n, intrinsics, int(state[3]), work, image)
    if state[1] > 0.0:
        _raise_powers(n, int(state[2]), work)
    for k in range(int(state[1])):
        row = MONOMIALS + 3 * k
        _add_monomial(n, intrinsics, int(state[row]), int(state[row + 1]), int(state[row + 2]), work, image)
    if state[4] > 0.0:
        add_surface(n, intrinsics, int(state[4]), work, image)
    for i in range(n):  # by itself: its look-up keeps the rest from SIMD registers
        image[5, i], image[6, i] = _profile(state, work[2, i])
    good = True
    for i in range(n):
        x, y, z = rays[0, i], rays[1, i], rays[2, i]
        u, v, radius, slope = work[0, i], work[1, i], work[2, i], image[6, i]
        length, s = work[2 * MOST + 5, i], work[2 * MOST + 6, i]
        per_radius, per_length = 1.0 / (radius + TINY), 1.0 / length
        stretch = image[5, i] * per_radius
        bend = (slope - stretch) * per_radius * per_radius
        # Derivatives by q (rows 2, 3) and by its conjugate (rows 4, 5) become those by x and y.
        first_x, first_y = image[2, i] + image[4, i], image[3, i] + image[7, i]
        second_x, second_y = image[2, i] - image[4, i], image[3, i] - image[7, i]
        jxx, jyy = rim + stretch + bend * u * u + first_x, rim + stretch + bend * v * v + second_x
        jxy, jyx = bend * u * v - second_y, bend * u * v + first_y
        f = s * s * per_scale * per_length
        ax, ab, by = s - f * x * x, -f * x * y, s - f * y * y
        image[0, i] = unit * ((rim + stretch) * u + image[0, i])
        image[1, i] = unit * ((rim + stretch) * v + image[1, i])
        xy = unit * (jxx * ab + jxy * by)
        image[2, i], image[3, i], image[4, i] = unit * (jxx * ax + jxy * ab), xy, unit * (jyx * ab + jyy * by)
        image[7, i] = unit * (jyx * ax + jyy * ab) - xy
        along_x, along_y = unit * (jxx * u + jxy * v), unit * (jyx * u + jyy * v)
        image[5, i], image[6, i] = -along_x * per_length, -along_y * per_length
        work[2 * MOST + 5, i], work[2 * MOST + 6, i] = along_x * per_phi, along_y * per_phi
        good &= (length + z > 1e-9 * length) & (radius < limit) & (jxx * jyy > jxy * jyx) & (jxx + jyy > 0.0)
    return good


def differentiate(n: int, intrinsics: Any, unit: float, state: Any, image: Any, work: Any, jacobian: Any) -> None:
    """See `Lens.differentiate_chunk`."""
    phi, aspect = intrinsics[0], intrinsics[1]
    rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
    for i in range(n):
        jacobian[0, 0, i], jacobian[0, 1, i] = work[2 * MOST + 5, i], aspect * work[2 * MOST + 6, i]
        jacobian[4, 0, i] = unit * work[0, i] - phi * work[2 * MOST + 5, i] / rim
        jacobian[4, 1, i] = aspect * (unit * work[1, i] - phi * work[2 * MOST + 6, i] / rim)
        outward = unit / (work[2, i] + TINY)
        work[2 * MOST + 5, i], work[2 * MOST + 6, i] = outward * work[0, i], aspect * outward * work[1, i]
    _weigh_pieces(n, state, work, jacobian)
    for k in range(5, 5 + COUNT):
        own, x, y = jacobian[k], work[2 * MOST + 5], work[2 * MOST + 6]
        for i in range(n):
            value = own[0, i]
            own[0, i], own[1, i] = value * x[i], value * y[i]
    at = int(state[3])
    for k in range(CONRADY if at > 0 else 0):
        p, q = jacobian[at + 2 * k], jacobian[at + 2 * k + 1]
        for i in range(n):
            u, v = work[0, i], work[1, i]
            x, y, s = u * u - v * v, 2.0 * u * v, u * u + v * v
            size = unit / 3.0
            for _ in range(k):
                size *= s
            p[0, i], p[1, i] = size * (2.0 * s + x), aspect * size * y
            q[0, i], q[1, i] = size * y, aspect * size * (2.0 * s - x)
    for k in range(int(state[1])):
        row = MONOMIALS + 3 * k
        at, m, p = int(state[row]), int(state[row + 1]), int(state[row + 2])
        for i in range(n):
            a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
            x, y = unit * (a * c + b * d), unit * (b * c - a * d)
            jacobian[at, 0, i], jacobian[at, 1, i] = x, aspect * y
            jacobian[at + 1, 0, i], jacobian[at + 1, 1, i] = -y, aspect * x
    if state[4] > 0.0:
        differentiate_surface(n, intrinsics, unit, int(state[4]), work, jacobian)


def _weigh_pieces(n: int, state: Any, work: Any, jacobian: Any) -> None:
    """The B-splines at each radius, straight on beyond the last knot, to the first of their rows' two components."""
    for k in range(5, 5 + COUNT):
        for i in range(n):
            jacobian[k, 0, i] = 0.0
    for i in range(n):
        j, t = _place(work[2, i])
        row = HEAD + j * (DEGREE + 1) ** 2
        for a in range(DEGREE + 1):
            if j + a >= 2:
                value = state[row + DEGREE * (DEGREE + 1) + a]
                for d in range(DEGREE - 1, -1, -1):
                    value = value * t + state[row + d * (DEGREE + 1) + a]
                jacobian[3 + j + a, 0, i] = value
    for i in range(n):
        beyond = work[2, i] - 1.0
        if beyond > 0.0:
            for a in range(DEGREE + 1):
                row = HEAD + (INTERVALS - 1) * (DEGREE + 1) ** 2 + a
                jacobian[2 + INTERVALS + a, 0, i] += INTERVALS * beyond * _polynomial(state, row, DEGREE + 1, 1.0)[1]


def _place(u: float) -> tuple[int, float]:
    """The interval of a radius, and how far into it that lies."""
    inside = min(u, 1.0) * INTERVALS
    j = min(int(inside), INTERVALS - 1)
    return j, inside - j


def _polynomial(state: Any, row: int, step: int, t: float) -> tuple[float, float]:
    """Value and slope at t of a polynomial of the state, whose coefficients are so far apart."""
    value, slope = state[row + DEGREE * step], 0.0
    for d in range(DEGREE - 1, -1, -1):
        slope = slope * t + value
        value = value * t + state[row + d * step]
    return value, slope


def _profile(state: Any, u: float) -> tuple[float, float]:
    """G and its slope, straight on beyond the last knot."""
    j, t = _place(u)
    value, slope = _polynomial(state, HEAD + TABLE + j * (DEGREE + 1), 1, t)
    return value + INTERVALS * slope * max(u - 1.0, 0.0), INTERVALS * slope


def _add_conrady(n: int, intrinsics: Any, at: int, work: Any, image: Any) -> None:
    """(2 s C(s) + q^2 conj(C(s))) / 3 with s = |q|^2 and C its three terms, to the image's rows 0 and 1; its
    derivatives by q and its conjugate to rows 2, 3 and 4, 7.
    """
    a0, b0, a1, b1, a2, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if at > 0:
        a0, b0 = intrinsics[at] / 3.0, intrinsics[at + 1] / 3.0
        a1, b1 = intrinsics[at + 2] / 3.0, intrinsics[at + 3] / 3.0
        a2, b2 = intrinsics[at + 4] / 3.0, intrinsics[at + 5] / 3.0
    for i in range(n):
        u, v = work[0, i], work[1, i]
        s, x, y = u * u + v * v, u * u - v * v, 2.0 * u * v
        a, b = a0 + s * (a1 + s * a2), b0 + s * (b1 + s * b2)
        da, db = a1 + 2.0 * s * a2, b1 + 2.0 * s * b2
        image[0, i], image[1, i] = 2.0 * s * a + a * x + b * y, 2.0 * s * b + a * y - b * x
        c, d = 2.0 * (a + s * da), 2.0 * (b + s * db)
        image[2, i] = c * u + d * v + s * (da * u + db * v) + 2.0 * (a * u + b * v)
        image[3, i] = d * u - c * v + s * (da * v - db * u) + 2.0 * (a * v - b * u)
        c, d = c + da * x + db * y, d + da * y - db * x
        image[4, i], image[7, i] = c * u - d * v, c * v + d * u


def _raise_powers(n: int, most: int, work: Any) -> None:
    """Powers of the place from 0 to `most`, from the work's row 3 on."""
    for i in range(n):
        work[3, i], work[4, i] = 1.0, 0.0
    for k in range(1, most + 1):
        for i in range(n):
            a, b = work[1 + 2 * k, i], work[2 + 2 * k, i]
            work[3 + 2 * k, i] = a * work[0, i] - b * work[1, i]
            work[4 + 2 * k, i] = a * work[1, i] + b * work[0, i]


def _add_monomial(n: int, intrinsics: Any, at: int, m: int, p: int, work: Any, image: Any) -> None:
    """c q^m conj(q)^p in the same way."""
    real, imaginary = intrinsics[at], intrinsics[at + 1]
    _add_product(n, real, imaginary, m, p, work, image[0], image[1])
    if m > 0:
        _add_product(n, m * real, m * imaginary, m - 1, p, work, image[2], image[3])
    if p > 0:
        _add_product(n, p * real, p * imaginary, m, p - 1, work, image[4], image[7])


def _add_product(n: int, real: float, imaginary: float, m: int, p: int, work: Any, along: Any, across: Any) -> None:
    """The same of one pair of rows: of fewer rows the compiler sees that they are not each other's."""
    for i in range(n):
        a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
        x, y = a * c + b * d, b * c - a * d
        along[i] += real * x - imaginary * y
        across[i] += real * y + imaginary * x
