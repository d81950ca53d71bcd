"""Tails of chi-squared, F and binomial variables, as logarithms, even far below the smallest float.

They need no statistics library (scipy is for the tests only): the continued fractions of the incomplete beta and gamma
functions are evaluated by Lentz's method (NIST DLMF 8.17.22 and 8.9.2). Arguments broadcast; the result has their
common shape.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, Indices

NORMAL_95 = 1.959963984540054
"""Half width, in standard deviations, of the interval that contains 95 % of a normal variable."""
NORMAL_95_ONE_SIDED = 1.645
"""Upper limit of 95 % of a normal variable, in standard deviations."""
_FEW, _FAR = 12, 1e3  # largest degrees of freedom, and limit of the value, for the short sum
_MOST_TERMS = 20_000
_lgamma = np.vectorize(math.lgamma, otypes=[float])


def upper_tail(value: float, degrees: int, freedom: float = math.inf) -> float:
    """Probability that a chi-squared variable is larger than the value.

    Args:
        freedom: degrees of freedom of the noise by which the value was divided. The result is then for `degrees` times
            an F variable, as a mean over the possible noise: accurate to 2 % down to 1e-3 for 30 or more.
    """
    if degrees < 1 or value <= 0.0:
        return 1.0
    values, weights = _over_noise(value, freedom)
    few = degrees <= _FEW and values[-1] < _FAR
    tails = _few(0.5 * values, degrees) if few else np.exp(log_chi2_tail(values, degrees))
    return float(weights @ tails / weights.sum())


def _few(x: Array, degrees: int) -> Array:
    """(N,) upper tail for few degrees of freedom by a short sum, a hundred times as fast (DLMF 8.4.8 and 8.4.14)."""
    total, term, power = np.zeros_like(x), np.exp(-x), 0.0
    if degrees % 2:
        root = np.sqrt(x)
        total, term, power = np.array([*map(math.erfc, root.tolist())]), 2.0 / math.sqrt(math.pi) * root * term, 0.5
    for _ in range(degrees // 2):
        total, power = total + term, power + 1.0
        term = term * (x / power)
    return total


def quadratic_tail(value: float, variances: Array, squares: Array, freedom: float = math.inf) -> float:
    """Probability that the sum of squares of D independent normal variables is larger than the value.

    Approximated by a chi-squared variable with the same mean, variance and skewness (Pearson, Biometrika 46, 1959):
    accurate to 10 % down to 1e-3.

    Args:
        variances: (D,) of the variables. squares: (D,) squares of their means. freedom: see `upper_tail`.
    """
    if not len(variances):
        return 1.0
    variances = np.maximum(variances, 1e-9)
    mean = float(np.sum(variances + squares))
    second = float(np.sum(2.0 * variances**2 + 4.0 * variances * squares))
    third = float(np.sum(8.0 * variances**3 + 24.0 * variances**2 * squares))
    degrees = 8.0 * second**3 / third**2
    values, weights = _over_noise(value, freedom)
    values = degrees + (values - mean) * math.sqrt(2.0 * degrees / second)
    return float(np.average(np.exp(log_chi2_tail(values, degrees)), weights=weights))


def _over_noise(value: float, freedom: float) -> tuple[Array, Array]:
    """Return the value for each possible size of the noise behind it, and their weights, after Wilson and Hilferty."""
    parts, reach = 40, 6.0  # number of steps to either side, and range in sigmas, of a mean over a normal variable
    if math.isinf(freedom):
        return np.array([value]), np.ones(1)
    spread = 2.0 / (9.0 * max(freedom, 3.0))
    z = np.linspace(-reach, reach, 2 * parts + 1)
    return value * np.maximum(1.0 - spread + z * math.sqrt(spread), 0.0) ** 3, np.exp(-0.5 * z * z)


def student_95(degrees_of_freedom: float) -> float:
    """Half width of the 95 % interval of Student's t, by the series of Cornish and Fisher: 0.1 % from 5 degrees on."""
    z, n = NORMAL_95, max(degrees_of_freedom, 1.0)
    terms = (
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
    )
    return z + sum(term / n**power for power, term in enumerate(terms, start=1))


def mixture_95(weights: Array, variances: Array) -> float:
    """Half width of the 95 % interval of a mixture of normal variables about 0."""

    def beyond(width: float) -> float:
        inside = [math.erf(width * math.sqrt(0.5 / variance)) for variance in variances.tolist()]
        return float(weights @ inside) - 0.95

    most = NORMAL_95 * math.sqrt(float(np.max(variances)))
    return bisected(beyond, 0.0, most)


def bisected(rising: Callable[[float], float], low: float, high: float) -> float:
    """The place where a rising function changes its sign, by bisection; an end of the range where it does not."""
    bisections = 50
    for _ in range(bisections):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rising(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)


def log_chi2_tail(value: ArrayLike, freedom: ArrayLike) -> Array:
    """log P(chi-squared with `freedom` degrees of freedom > value)."""
    x, a = np.broadcast_arrays(0.5 * np.asarray(value, dtype=float), 0.5 * np.asarray(freedom, dtype=float))
    answer = np.where(x < np.inf, 0.0, -x)  # NaN stays NaN
    below = (x > 0.0) & (x < a + 1.0)
    above = (x >= a + 1.0) & (x < np.inf)
    lower = np.exp(_log_gamma_front(a[below], x[below]) + np.log(_lower_series(a[below], x[below])))
    answer[below] = np.log1p(-np.minimum(lower, 1.0 - 1e-16))
    answer[above] = _log_gamma_front(a[above], x[above]) - np.log(_upper_fraction(a[above], x[above]))
    return answer


def log_f_tail(value: ArrayLike, d1: ArrayLike, d2: ArrayLike) -> Array:
    """log P(F > value) of Fisher's F with d1 and d2 degrees of freedom."""
    value, d1, d2 = (np.asarray(v, dtype=float) for v in (value, d1, d2))
    return _log_incomplete_beta(0.5 * d2, 0.5 * d1, d2 / (d2 + d1 * np.maximum(value, 0.0)))


def log_binomial_tail(count: ArrayLike, trials: ArrayLike, probability: ArrayLike) -> Array:
    """log P(at least `count` of `trials` succeed), count from 1 to trials."""
    count, trials, probability = (np.asarray(v, dtype=float) for v in (count, trials, probability))
    return _log_incomplete_beta(count, trials - count + 1.0, np.clip(probability, 0.0, 1.0))


def _log_gamma_front(a: Array, x: Array) -> Array:
    """log(x^a exp(-x) / Gamma(a)), the common factor of both tails of the incomplete gamma function."""
    return np.asarray(a * np.log(x) - x - _lgamma(a))


def _lower_series(a: Array, x: Array) -> Array:
    """1 / a + x / (a (a + 1)) + ... for the lower tail, DLMF 8.7.1; it converges fast for x up to about a."""
    least_term = 1e-16  # relative to the sum so far: later terms are lost in rounding
    one = 1.0 / a
    total = one.copy()
    for n in range(1, _MOST_TERMS):
        one = one * x / (a + n)
        total += one
        if np.all(one < least_term * total):
            break
    return total


def _upper_fraction(a: Array, x: Array) -> Array:
    """x + 1 - a - 1 (1 - a) / (x + 3 - a - ...) for the upper tail, DLMF 8.9.2, for x from about a on."""

    def term(n: int) -> tuple[Array, Array]:
        return -n * (n - a), x + 2.0 * n + 1.0 - a

    return _lentz(term, x + 1.0 - a)


def _log_incomplete_beta(a: Array, b: Array, x: Array) -> Array:
    """log I_x(a, b)."""
    a, b, x = np.broadcast_arrays(a, b, x)
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

    def term(n: int) -> tuple[Array, Array]:
        m = n // 2
        if n % 2:
            return -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)), np.ones_like(x)
        return m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)), np.ones_like(x)

    front = a * np.log(x) + b * np.log1p(-x) - np.log(a) + _lgamma(a + b) - _lgamma(a) - _lgamma(b)
    return np.asarray(front - np.log(_lentz(term, np.ones_like(x))))


def _lentz(term: Callable[[int], tuple[Array, Array]], first: Array) -> Array:
    """first + a_1 / (b_1 + a_2 / (b_2 + ...)) with term(n) = (a_n, b_n)."""
    tiny = 1e-300
    value = np.where(np.abs(first) > tiny, first, tiny)
    c, d = value, np.zeros_like(value)
    for n in range(1, _MOST_TERMS):
        upper, lower = term(n)
        d = lower + upper * d
        d = 1.0 / np.where(np.abs(d) > tiny, d, tiny)
        c = lower + upper / c
        c = np.where(np.abs(c) > tiny, c, tiny)
        value = value * c * d
        if np.all(np.abs(c * d - 1.0) < 1e-15):
            break
    return np.asarray(value)


def tail_root(above: Callable[[Array, Indices], Array], low: Array, high: Array, tail: float) -> Array:
    """(N,) roots at which decreasing functions equal `tail`, each bracketed by `low` and `high`; `above` evaluates some
    of the functions at one place each.

    By Chandrupatla's method (Advances in Engineering Software 28, 1997) on their logarithms: inverse quadratic
    interpolation through three places where that is reliable, else bisection.
    """
    # Least value of the function; tolerance of its logarithm and of the interval, as accurate as its values; steps.
    least, exact, most_steps = 1e-12, 1e-7, 40
    roots, rows = np.full(len(low), np.nan), np.flatnonzero(np.ones(len(low)))
    x, y, width, share = low, high, exact * (high - low), 0.5 * np.ones_like(low)
    a, b = -np.log(tail) * np.ones_like(low), np.log(least / tail) * np.ones_like(low)
    for _ in range(most_steps):
        roots[rows] = place = x + share * (y - x)
        value = np.log(np.maximum(above(place, rows), least) / tail)
        left = (np.abs(value) > exact) & (np.abs(y - x) > width)
        if not left.any():
            break
        rows, (width, place, value, x, y, a, b) = rows[left], (v[left] for v in (width, place, value, x, y, a, b))
        alike = (value > 0.0) == (a > 0.0)
        z, c = np.where(alike, x, y), np.where(alike, a, b)  # the remaining place
        y, b, x, a = np.where(alike, y, x), np.where(alike, b, a), place, value
        with np.errstate(divide="ignore", invalid="ignore"):
            off, at = (x - y) / (z - y), (a - b) / (c - b)
            through = a / (b - a) * c / (b - c) + (z - x) / (y - x) * a / (c - a) * b / (c - b)
            nearest = np.minimum(0.5 * width / np.abs(y - x), 0.5)
        share = np.where((at**2 < off) & ((1.0 - at) ** 2 < 1.0 - off), through, 0.5)
        share = np.clip(share, nearest, 1.0 - nearest)
    return roots
