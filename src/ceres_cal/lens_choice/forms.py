"""The lenses that are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from ceres_cal.model.parameters import AUTO, OF_PIXELS, PAPERS_POWERS, Options
from ceres_cal.scene.lens import LENSES, Lens, make_lens

PAPER = "radial 2,3"
"""The lens that wins ties."""
_ANY_PHI = 100.0
_BEFORE = 2  # coefficients along the radius come before decentring, which is smaller: as OpenCV has them
_PROJECTION = 2  # coefficients that a projection of its own is worth


def papers(options: Options) -> Options:
    """The options with the paper's lens."""
    return replace(options, lens="radial", powers=PAPERS_POWERS, coefficients=None, terms=())


def any_lens(options: Options) -> Options:
    """The options with the lens that the data ask for; coefficients that they hold belong to a lens of its own."""
    fixed = {name: value for name, value in options.fixed.items() if name in (*OF_PIXELS, "skew")}
    return replace(options, lens=AUTO, powers=(), coefficients=None, terms=(), fixed=fixed)


def candidates(options: Options) -> list[Options]:
    """Options with every sensible lens of the same kind, fewest coefficients first; the given one is among them."""
    lens = options.blank_lens
    if lens.powers:
        powers = sorted({*lens.trial_powers, lens.powers}, key=lambda p: (len(p), p))
        if set(lens.names) & set(options.fixed):  # a held coefficient belongs to its own powers alone
            powers = [lens.powers]
        return [replace(options, powers=one) for one in powers]
    by_order = [name for _, name in sorted(zip(lens.orders, lens.names, strict=True)) if name not in options.fixed]
    names = [name for name in by_order if name not in _tangential(lens)]
    also = tuple(name for name in by_order if name in _tangential(lens) and name not in options.held)
    counts = range(1, len(names) + 1)
    shorter = [replace(options, coefficients=(*names[:n], *(also if n >= _BEFORE else ()))) for n in counts]
    if all(label_of(one) != label_of(options) for one in shorter):
        shorter.append(options)
    return shorter


def _tangential(lens: Lens | type[Lens]) -> tuple[str, ...]:
    """Names of its coefficients that displace tangentially, which it has or may have."""
    return lens.decentring or lens.more_terms.get("tangential", ())


def label_of(options: Options) -> str:
    """How a lens is called: "radial 2,3" or "brown k1 k2 p1 p2"."""
    if powers := options.blank_lens.powers:
        return " ".join([options.lens, ",".join(map(str, powers)), *options.terms])
    return " ".join([options.lens, *(name for name in options.blank_lens.names if name not in options.held)])


def coefficients_of(options: Options) -> int:
    """How many coefficients of the lens are free."""
    return len(set(options.blank_lens.names) - set(options.held))


def size_of(options: Options) -> int:
    """How much a lens may follow: its free coefficients, and two more where it is no pinhole without any: its series in
    the tangent has its first two coefficients chosen.
    """
    blank = make_lens(options.lens, options.blank_lens.powers)
    is_pinhole = np.isclose(blank.distort([[1.0, 0.0, 1.0]], _ANY_PHI)[0, 0], _ANY_PHI)
    return coefficients_of(options) + (0 if is_pinhole else _PROJECTION)


def is_usual(label: str) -> bool:
    """Whether a lens of that label is one that people know: all but the paper's with other powers, or ssl-vision's."""
    return not label.startswith("radial ") or label in (PAPER, "radial 3")


@dataclass(frozen=True)
class Form:
    """A lens to be tried: see `Options`.

    Attributes:
        names: of the coefficients that are free. label: how it is called. size: see `size_of`.
        blank: with every coefficient 0.
    """

    lens: str
    powers: tuple[int, ...]
    coefficients: tuple[str, ...] | None
    terms: tuple[str, ...]
    names: tuple[str, ...]
    label: str
    size: int
    blank: Lens

    @classmethod
    def among(cls, options: Options) -> Form:
        """The lens of some options."""
        names = tuple(name for name in options.blank_lens.names if name not in options.held)
        chosen = options.lens, options.powers, options.coefficients, options.terms
        return cls(*chosen, names, label_of(options), size_of(options), options.blank_lens)

    def of(self, options: Options, **more: Any) -> Options:
        """The options with this lens, and others of them changed."""
        more |= {"lens": self.lens, "powers": self.powers, "coefficients": self.coefficients, "terms": self.terms}
        return replace(options, **more)


@cache
def forms_of(kind: str) -> tuple[Form, ...]:
    """Every sensible lens of a kind, with decentring terms and without, the longest first: all others are this one with
    coefficients at 0.
    """
    lens = LENSES[kind]
    powers = tuple(sorted({power for trial in lens.trial_powers for power in trial}))
    terms = tuple(term for term, names in lens.more_terms.items() if names == _tangential(lens))
    longest, plain = Options(lens=kind, powers=powers, terms=terms), Options(lens=kind, powers=powers)
    bare = tuple(name for name in plain.blank_lens.names if name not in _tangential(lens))
    starts = [longest, *([replace(plain, coefficients=bare)] if _tangential(lens) else [])]
    every = {(form := Form.among(one)).label: form for start in starts for one in candidates(start)}
    return tuple(sorted(every.values(), key=lambda one: -len(one.names)))


def kinds() -> Iterator[tuple[Form, ...]]:
    """The lenses of each kind that has a formula: one without has no shorter ones."""
    return (forms_of(kind) for kind, lens in LENSES.items() if not lens.set_at_start)


def without_formula() -> Iterator[tuple[Form, ...]]:
    """The lenses of all other kinds."""
    return ((Form.among(Options(lens=kind)),) for kind, lens in LENSES.items() if lens.set_at_start)
