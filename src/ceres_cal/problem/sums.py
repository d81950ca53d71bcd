"""What shares of very many observations answer: sums, that do not grow with their rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Indices32
from ceres_cal.observations.sights import SightKey
from ceres_cal.problem.noise import LengthSums

# Bins of a histogram of lengths in stated sigmas, to 2e7: from which on one is, and how much wider than the last.
_LEAST, _WIDTH, _BINS = 1e-6, 0.00375, 8192


@dataclass(frozen=True, eq=False)
class Histogram:
    """Lengths by their size: (B,) how many, and (B,) the sum of their squares."""

    counts: Indices
    squares: Array

    @classmethod
    def of(cls, lengths: Array) -> Histogram:
        """Of those that are finite."""
        seen = lengths[np.isfinite(lengths)]
        bins = _bin_of(seen)
        squares = np.asarray(np.bincount(bins, seen**2, minlength=_BINS), dtype=float)
        return cls(np.bincount(bins, minlength=_BINS), squares)

    def __add__(self, other: Histogram) -> Histogram:
        return Histogram(self.counts + other.counts, self.squares + other.squares)

    @property
    def count(self) -> int:
        """How many there are."""
        return int(self.counts.sum())

    def middle(self) -> float:
        """Their median; 0 of none."""
        total = np.cumsum(self.counts)
        middle = np.searchsorted(total, total[-1] // 2 + 1)
        return float(_LEAST * np.exp((middle + 0.5) * _WIDTH)) if total[-1] else 0.0

    def within(self, bound: float) -> LengthSums:
        """Of those that are no longer, to the width of a bin."""
        last = int(_bin_of(np.array([bound]))[0])
        return LengthSums(int(self.counts[:last].sum()), float(self.squares[:last].sum()))


def _bin_of(lengths: Array) -> Indices32:
    """Number of the bin of each."""
    with np.errstate(divide="ignore"):
        place = (np.log(lengths) - np.log(_LEAST)) / _WIDTH
    return np.asarray(np.clip(place, 0.0, _BINS - 1.0), dtype=np.int32)


@dataclass(frozen=True, eq=False)
class Looked:
    """What residuals are like.

    Attributes:
        points, curves: their lengths in stated sigmas.
        view: (n,) numbers of the views. equations, squares: (n,) of what lies within the bounds in each, how many and
            their squared lengths. beyond: (n,) how many do not.
    """

    points: Histogram
    curves: Histogram
    view: Indices
    equations: Indices
    squares: Array
    beyond: Indices

    def __add__(self, other: Looked) -> Looked:
        each = zip(list(vars(self).values())[2:], list(vars(other).values())[2:], strict=True)
        return Looked(self.points + other.points, self.curves + other.curves, *map(np.concatenate, each))


@dataclass(frozen=True, eq=False)
class CompressedBlocks:
    """Compressed blocks (K + 1, K + 1) by sight, the residual last; None where an observation cannot be projected."""

    of: Mapping[SightKey, Array] | None

    def __add__(self, other: CompressedBlocks) -> CompressedBlocks:
        if self.of is None or other.of is None:
            return CompressedBlocks(None)
        both = {**self.of, **other.of}
        for key in self.of.keys() & other.of.keys():
            both[key] = compressed(np.vstack([self.of[key], other.of[key]]))
        return CompressedBlocks(both)


@dataclass(frozen=True, eq=False)
class SightNormals:
    """Normal equations by sight and by kind, see `problem.reduced`."""

    of: Mapping[SightKey, Mapping[int, Array]]

    def __add__(self, other: SightNormals) -> SightNormals:
        both = {key: dict(kinds) for key, kinds in self.of.items()}
        for key, kinds in other.of.items():
            own = both.setdefault(key, {})
            for kind, matrix in kinds.items():
                own[kind] = own[kind] + matrix if kind in own else matrix
        return SightNormals(both)


@dataclass(frozen=True, eq=False)
class Used:
    """The rows that take part, and those that do not.

    Attributes:
        sums: (2, 3) of points and of curve observations that take part: how many, squared lengths and sigmas, px.
        rows, sigmas: of those that do not, points and curve observations: numbers, and lengths in stated sigmas.
    """

    sums: Array
    rows: tuple[Indices, Indices]
    sigmas: tuple[Array, Array]

    def __add__(self, other: Used) -> Used:
        rows, sigmas = (
            tuple(np.concatenate(pair) for pair in zip(mine, theirs, strict=True))
            for mine, theirs in ((self.rows, other.rows), (self.sigmas, other.sigmas))
        )
        return Used(self.sums + other.sums, (rows[0], rows[1]), (sigmas[0], sigmas[1]))


def compressed(rows: Array) -> Array:
    """(K + 1, K + 1) upper triangle with the same products as rows (N, K + 1)."""
    size = rows.shape[1]
    triangle = np.linalg.qr(np.vstack([rows, np.zeros((max(size - len(rows), 0), size))]), mode="r")
    return np.asarray(triangle)
