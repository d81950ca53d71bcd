"""Tail probabilities as logarithms, far below the smallest float: what tests compare (scipy is for the tests only).

Continued fractions of the incomplete beta and gamma functions by Lentz's method (NIST DLMF 8.17.22 and 8.9.2).
"""

from __future__ import annotations

from collections.abc import Callable
from math import lgamma

import numpy as np

from ceres_cal.transforms import Array

_TINY = 1e-300
_MOST_TERMS = 20_000
_lgamma = np.vectorize(lgamma, otypes=[float])


def log_f_tail(value: Array, d1: Array, d2: Array) -> Array:
    """log P(F > value) of Fisher's F with d1 and d2 degrees of freedom, (N,) each."""
    value, d1, d2 = (np.asarray(v, dtype=float) for v in (value, d1, d2))
    return _log_incomplete_beta(0.5 * d2, 0.5 * d1, d2 / (d2 + d1 * np.maximum(value, 0.0)))


def log_binomial_tail(count: Array, trials: Array, probability: Array) -> Array:
    """log P(at least `count` of `trials` succeed), (N,), count from 1 to trials."""
    count, trials, probability = (np.asarray(v, dtype=float) for v in (count, trials, probability))
    return _log_incomplete_beta(count, trials - count + 1.0, np.clip(probability, 0.0, 1.0))


def log_chi2_tail(value: float, freedom: float) -> float:
    """log P(chi-square with `freedom` degrees of freedom > value)."""
    a, x = 0.5 * freedom, 0.5 * value
    if x <= 0.0:
        return 0.0
    front = a * np.log(x) - x - lgamma(a)
    if x < a + 1.0:  # the series of the lower tail, DLMF 8.7.1
        total = one = 1.0 / a
        for n in range(1, _MOST_TERMS):
            one *= x / (a + n)
            total += one
            if one < 1e-16 * total:
                break
        return float(np.log1p(-min(np.exp(front + np.log(total)), 1.0 - 1e-16)))

    def term(n: int) -> tuple[Array, Array]:
        return np.array([-n * (n - a)]), np.array([x + 2.0 * n + 1.0 - a])

    return float(front - np.log(_lentz(term, np.array([x + 1.0 - a]))[0]))


def _log_incomplete_beta(a: Array, b: Array, x: Array) -> Array:
    """log I_x(a, b)."""
    a, b, x = (v.ravel() for v in np.broadcast_arrays(a, b, x))
    answer = np.where(x > 0.0, 0.0, -np.inf)
    inner = (x > 0.0) & (x < 1.0)
    below = inner & (x <= (a + 1.0) / (a + b + 2.0))
    above = inner & ~below
    answer[below] = _log_beta_fraction(a[below], b[below], x[below])
    other = _log_beta_fraction(b[above], a[above], 1.0 - x[above])
    answer[above] = np.log1p(-np.minimum(np.exp(other), 1.0 - 1e-16))
    return answer


def _log_beta_fraction(a: Array, b: Array, x: Array) -> Array:
    """log I_x(a, b) where the continued fraction converges fast: x up to about the mean a / (a + b)."""
    if not len(x):
        return x

    def term(n: int) -> tuple[Array, Array]:
        m = n // 2
        if n % 2:
            return -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)), np.ones_like(x)
        return m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)), np.ones_like(x)

    front = a * np.log(x) + b * np.log1p(-x) - np.log(a) + _lgamma(a + b) - _lgamma(a) - _lgamma(b)
    return np.asarray(front - np.log(_lentz(term, np.ones_like(x))))


def _lentz(term: Callable[[int], tuple[Array, Array]], first: Array) -> Array:
    """first + a_1 / (b_1 + a_2 / (b_2 + ...)) with term(n) = (a_n, b_n)."""
    value = np.where(np.abs(first) > _TINY, first, _TINY)
    c, d = value, np.zeros_like(value)
    for n in range(1, _MOST_TERMS):
        upper, lower = term(n)
        d = lower + upper * d
        d = 1.0 / np.where(np.abs(d) > _TINY, d, _TINY)
        c = lower + upper / c
        c = np.where(np.abs(c) > _TINY, c, _TINY)
        value = value * c * d
        if np.all(np.abs(c * d - 1.0) < 1e-15):
            break
    return np.asarray(value)
