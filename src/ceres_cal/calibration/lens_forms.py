"""The lenses that are compared.

Which of several lenses is the simplest that is as good as the best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np

from ceres_cal.base import Array, DegenerateError, Frozen, replace
from ceres_cal.problem.parameters import AUTO, OF_PIXELS, PAPERS_POWERS, Options
from ceres_cal.scene.lens import LENSES, Lens, make_lens

TANGENTIAL = "tangential"  # the terms that displace so
PAPER = "radial 2,3"
"""The lens that wins ties."""


def papers(options: Options) -> Options:
    """The options with the paper's lens."""
    return replace(options, lens="radial", powers=PAPERS_POWERS, coefficients=None, terms=(), lens_by_camera={})


def any_lens(options: Options) -> Options:
    """The options with the lens that the data ask for; coefficients that they hold belong to a lens of its own."""
    fixed = {name: value for name, value in options.fixed.items() if name in (*OF_PIXELS, "skew")}
    return replace(options, lens=AUTO, powers=(), coefficients=None, terms=(), fixed=fixed, lens_by_camera={})


def candidates(options: Options) -> list[Options]:
    """Options with every sensible lens of the same kind, fewest coefficients first; the given one is among them."""
    lens = options.blank_lens
    if lens.powers:
        powers = sorted({*lens.trial_powers, lens.powers}, key=lambda p: (len(p), p))
        if set(lens.names) & set(options.fixed):  # a held coefficient belongs to its own powers alone
            powers = [lens.powers]
        return [replace(options, powers=one) for one in powers]
    by_order = [name for _, name in sorted(zip(lens.orders, lens.names, strict=True)) if name not in options.fixed]
    names = [name for name in by_order if name not in lens.tangential]
    also = tuple(name for name in lens.tangential if name not in options.held)
    shorter = [replace(options, coefficients=(*names[:n], *also)) for n in range(1, len(names) + 1)]
    if all(label_of(one) != label_of(options) for one in shorter):
        shorter.append(options)
    return shorter


def label_of(options: Options) -> str:
    """How a lens is called: "radial 2,3", decentred or not, or "brown k1 k2 p1 p2"."""
    if powers := options.blank_lens.powers:
        terms = (term for term in options.terms if term != TANGENTIAL)
        return " ".join([options.lens, ",".join(map(str, powers)), *terms])
    return " ".join([options.lens, *(name for name in options.blank_lens.names if name not in options.held)])


def coefficients_of(options: Options) -> int:
    """How many coefficients of the lens are free, but for decentring, of which the usual size is known."""
    return len(set(options.blank_lens.names) - set(options.held) - set(options.blank_lens.tangential))


def size_of(options: Options) -> int:
    """How much a lens may follow: its free coefficients, and two more where it is no pinhole without any: its series in
    the tangent has its first two coefficients chosen.
    """
    projection = 2  # coefficients that a projection of its own is worth
    any_phi = 100.0
    blank = make_lens(options.lens, options.blank_lens.powers)
    is_pinhole = np.isclose(blank.distort([[1.0, 0.0, 1.0]], any_phi)[0, 0], any_phi)
    return coefficients_of(options) + (0 if is_pinhole else projection)


def is_usual(label: str) -> bool:
    """Whether a lens of that label is one that people know: all but the paper's with other powers, or ssl-vision's."""
    return not label.startswith("radial ") or label in (PAPER, "radial 3")


class Form(Frozen, eq=True):
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
    """Every sensible lens of a kind, with its decentring, the longest first: all others are this one with coefficients
    at 0.
    """
    lens = LENSES[kind]
    powers = tuple(sorted({power for trial in lens.trial_powers for power in trial}))
    longest = Options(lens=kind, powers=powers, terms=tuple({TANGENTIAL} & {*lens.more_terms}))
    every = {(form := Form.among(one)).label: form for one in candidates(longest)}
    return tuple(sorted(every.values(), key=lambda one: -len(one.names)))


def kinds() -> Iterator[tuple[Form, ...]]:
    """The lenses of each kind that has a formula: one without has no shorter ones."""
    return (forms_of(kind) for kind, lens in LENSES.items() if not lens.set_at_start)


def undecentred() -> list[Form]:
    """The paper's lens, and one of each other kind with as many coefficients and no decentring."""
    of_paper = Options(lens="radial", powers=PAPERS_POWERS)
    others = [Options(lens=forms[0].lens) for forms in kinds() if forms[0].lens != of_paper.lens]
    count = len(PAPERS_POWERS)
    short = [
        replace(one, coefficients=tuple(n for n in one.blank_lens.names if n not in one.blank_lens.tangential)[:count])
        for one in others
    ]
    return [Form.among(one) for one in (of_paper, *short)]


def without_formula(*, of_one_view: bool) -> Iterator[tuple[Form, ...]]:
    """The lenses of all other kinds.

    Args:
        of_one_view: a profile along the radius and a decentring alone. One view of a floor tells nothing else from a
            field of other dimensions, or from a tilt of the sensor, by which places at a height were 76 mm off.
    """
    for kind, lens in LENSES.items():
        if lens.set_at_start and of_one_view:
            blank = make_lens(kind, (2,))
            own = {*blank.set_at_start, *blank.roughness[0].names, "p1", "p2"}
            told = tuple(name for name in blank.names if name in own)
            yield (Form.among(Options(lens=kind, powers=(2,), coefficients=told)),)
        elif lens.set_at_start:
            yield (Form.among(Options(lens=kind)),)


# How much worse than the best, in standard errors of the difference, is as good: at 1 the paper's lens is missed more
# often (at 1.5 in 4 of 100 fields), beyond 2 the decentring of real sets.
AS_GOOD = 1.75
# Times the least squared error of lenses of one size, up to which what other programs know is preferred: OpenCV's right
# camera has 1.005; photographs of fields 1.1 and more, where the map was off by 3 instead of 1 standard deviations.
ALIKE = 1.02
# Standard errors by which a lens without a formula, which few programs know, must predict better: five of eight real
# sets have 3.1 to 4.7, the others 2.2 and less; those that no formula has 4.5 to 19, of 146 views of a full frame.
CLEARLY = 2.5
AS_GOOD_BESIDE_LENGTHS = 0.5
"""The same where dimensions of targets are solved for: what a lens that is too simple cannot follow, they do."""


def decide(
    labels: Sequence[str],
    sizes: Sequence[int],
    squares: Sequence[Array | None],
    as_good: float = AS_GOOD,
    is_refuted: Callable[[int], bool] = lambda _: False,
) -> tuple[int, int]:
    """Indices of the best lens and of the simplest that is as good; the paper's comes before all others.

    As good is what exceeds the least error by no more than 1.75 standard errors of their difference, group by group
    (the one-standard-error rule of Breiman et al. 1984, paired, and wider because the best of many is the luckiest).

    Args:
        sizes: see `forms.size_of`. squares: (G,) squared errors by group of each lens; None where there is no answer.
        as_good: in place of those 1.75.
        is_refuted: whether a longer lens refutes one, which then is not as good whatever few groups say.

    Raises:
        DegenerateError: no lens has one.
    """
    known = {i: one for i, one in enumerate(squares) if one is not None}
    if not known:
        raise DegenerateError("each of them folds or cannot be solved for: check labels and dimensions")
    totals = {i: float(one.sum()) for i, one in known.items()}
    best = min(totals, key=totals.__getitem__)
    least = {sizes[i]: min(totals[j] for j in totals if sizes[j] == sizes[i]) for i in totals}
    familiar = {i: is_usual(labels[i]) and totals[i] <= ALIKE * least[sizes[i]] for i in totals}
    order = sorted(totals, key=lambda i: (labels[i] != PAPER, sizes[i], not familiar[i], totals[i]))
    near = (i for i in order if standard_errors(known[i], known[best]) <= as_good)
    return best, next((i for i in near if not is_refuted(i)), best)


def pseudo_bma(squares: Sequence[Array]) -> Array:
    """(L,) probability that each lens is the one that predicts best: likelihoods, averaged over draws of groups.

    Pseudo-BMA+ of Yao, Vehtari, Simpson and Gelman (Bayesian Analysis 13, 2018, section 3.4), but that the draws are
    balanced half samples, twice each (McCarthy, Review of the International Statistical Institute 37, 1969): nothing
    in them is left to chance.

    Args:
        squares: (G,) squared errors of each lens by group.
    """
    each = np.array(squares)
    more = _half_samples(each.shape[1]) @ each.T
    likelihoods = np.exp(more.min(axis=1, keepdims=True) - more)
    return np.asarray(np.mean(likelihoods / likelihoods.sum(axis=1, keepdims=True), axis=0))


@cache
def _half_samples(groups: int) -> Array:
    """(D, G) 1 of the groups that are in a draw, else 0: each in half of them, each two in a quarter."""
    signs = np.ones((1, 1))
    while len(signs) <= groups:
        signs = np.block([[signs, signs], [signs, -signs]])  # Sylvester's Hadamard matrix
    return np.asarray(0.5 * (1.0 + signs[:, 1 : groups + 1]))


def surprise(squares: Array, counts: Array) -> Array:
    """(G,) squares that grow by their logarithm where a group is off by more than the noise: a line that lies aside, or
    a feature whose label is wrong, must not decide.

    Args:
        squares: (G,) of each group's counts (G,) of residuals, in standard deviations.
    """
    return np.asarray(counts * np.log1p(squares / counts))


def standard_errors(squares: Array, others: Array) -> float:
    """By how many standard errors of the difference squared errors by group exceed others; 0 of the same."""
    more, count = squares - others, len(squares)
    total = float(more.sum())
    apart = more - total / count
    error = (float(apart @ apart) * count / (count - 1)) ** 0.5 if count > 1 else np.inf
    return total / error if error > 0.0 else 0.0
