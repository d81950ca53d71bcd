"""The lenses that are compared, and the rule that chooses the simplest of those that are as good as the best."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np

from ceres_cal.base import Array, DegenerateError, Frozen, replace
from ceres_cal.problem.parameters import AUTO, OF_PIXELS, PAPERS_POWERS, Options
from ceres_cal.scene.lens import LENSES, Lens, make_lens

TANGENTIAL = "tangential"  # name of the decentring terms
PAPER = "radial 2,3"
"""Label of the lens that wins ties."""


def papers(options: Options) -> Options:
    """Return the options with the paper's lens."""
    return replace(options, lens="radial", powers=PAPERS_POWERS, coefficients=None, terms=(), lens_by_camera={})


def any_lens(options: Options) -> Options:
    """Return the options with the lens left to the data; held coefficients are dropped, as they belong to one lens."""
    fixed = {name: value for name, value in options.fixed.items() if name in (*OF_PIXELS, "skew")}
    return replace(options, lens=AUTO, powers=(), coefficients=None, terms=(), fixed=fixed, lens_by_camera={})


def candidates(options: Options) -> list[Options]:
    """Return options with each sensible lens of the same kind, fewest coefficients first, including the given one."""
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
    """Return a lens's label: "radial 2,3", decentred or not, or "brown k1 k2 p1 p2"."""
    if powers := options.blank_lens.powers:
        terms = (term for term in options.terms if term != TANGENTIAL)
        return " ".join([options.lens, ",".join(map(str, powers)), *terms])
    return " ".join([options.lens, *(name for name in options.blank_lens.names if name not in options.held)])


def coefficients_of(options: Options) -> int:
    """Return the number of free coefficients of the lens, without those of decentring, whose usual size is known."""
    return len(set(options.blank_lens.names) - set(options.held) - set(options.blank_lens.tangential))


def size_of(options: Options) -> int:
    """Return the effective number of coefficients: the free ones, and two more where the lens without coefficients is
    no pinhole, because its projection determines the first two coefficients of its series in the tangent.
    """
    projection = 2  # number of coefficients that another projection counts as
    any_phi = 100.0
    blank = make_lens(options.lens, options.blank_lens.powers)
    is_pinhole = np.isclose(blank.distort([[1.0, 0.0, 1.0]], any_phi)[0, 0], any_phi)
    return coefficients_of(options) + (0 if is_pinhole else projection)


def is_usual(label: str) -> bool:
    """Return whether a lens is widely known: all but radial ones with powers other than the paper's or ssl-vision's."""
    return not label.startswith("radial ") or label in (PAPER, "radial 3")


class Form(Frozen, eq=True):
    """A lens to be compared, see `Options`.

    Attributes:
        names: of the free coefficients. label: see `label_of`. size: see `size_of`.
        blank: the lens with every coefficient 0.
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
        """Return the lens of some options."""
        names = tuple(name for name in options.blank_lens.names if name not in options.held)
        chosen = options.lens, options.powers, options.coefficients, options.terms
        return cls(*chosen, names, label_of(options), size_of(options), options.blank_lens)

    def of(self, options: Options, **more: Any) -> Options:
        """Return the options with this lens and the changes `more`."""
        more |= {"lens": self.lens, "powers": self.powers, "coefficients": self.coefficients, "terms": self.terms}
        return replace(options, **more)


@cache
def forms_of(kind: str) -> tuple[Form, ...]:
    """Return every sensible lens of a kind, with its decentring, the longest first; all others are the longest with
    coefficients at 0.
    """
    lens = LENSES[kind]
    powers = tuple(sorted({power for trial in lens.trial_powers for power in trial}))
    longest = Options(lens=kind, powers=powers, terms=tuple({TANGENTIAL} & {*lens.more_terms}))
    every = {(form := Form.among(one)).label: form for one in candidates(longest)}
    return tuple(sorted(every.values(), key=lambda one: -len(one.names)))


def kinds() -> Iterator[tuple[Form, ...]]:
    """Yield the lenses of each kind that has a formula; a kind without a formula has no shorter lenses."""
    return (forms_of(kind) for kind, lens in LENSES.items() if not lens.set_at_start)


def undecentred() -> list[Form]:
    """Return the paper's lens, and one of each other kind with as many coefficients and no decentring."""
    of_paper = Options(lens="radial", powers=PAPERS_POWERS)
    others = [Options(lens=forms[0].lens) for forms in kinds() if forms[0].lens != of_paper.lens]
    count = len(PAPERS_POWERS)
    short = [
        replace(one, coefficients=tuple(n for n in one.blank_lens.names if n not in one.blank_lens.tangential)[:count])
        for one in others
    ]
    return [Form.among(one) for one in (of_paper, *short)]


def without_formula(*, of_one_view: bool) -> Iterator[tuple[Form, ...]]:
    """Yield the lenses of all kinds without a formula.

    Args:
        of_one_view: whether they only get a profile along the radius and a decentring. In one view of a floor, further
            terms look like other dimensions of the field or a tilt of the sensor: places at a height were 76 mm off.
    """
    for kind, lens in LENSES.items():
        if lens.set_at_start and of_one_view:
            blank = make_lens(kind, (2,))
            own = {*blank.set_at_start, *blank.roughness[0].names, "p1", "p2"}
            told = tuple(name for name in blank.names if name in own)
            yield (Form.among(Options(lens=kind, powers=(2,), coefficients=told)),)
        elif lens.set_at_start:
            yield (Form.among(Options(lens=kind)),)


# Standard errors of the difference by which a lens may predict worse than the best and still be as good. At 1 the
# paper's lens is missed more often (at 1.5 in 4 of 100 fields), beyond 2 the decentring of real sets is missed.
AS_GOOD = 1.75
# Factor on the least squared error of lenses of one size up to which a lens that other programs know is preferred:
# OpenCV's right camera has 1.005; photographs of fields have 1.1 or more, and there the map would be off by 3 instead
# of 1 standard deviations.
ALIKE = 1.02
# Standard errors by which a lens without a formula, which few programs know, must predict better: five of eight real
# sets have 3.1 to 4.7, the others at most 2.2; lenses that no formula describes have 4.5 to 19 (146 full-frame views).
CLEARLY = 2.5
AS_GOOD_BESIDE_LENGTHS = 0.5
"""`AS_GOOD` where dimensions of targets are solved for: these absorb what a too simple lens cannot follow."""


def decide(
    labels: Sequence[str],
    sizes: Sequence[int],
    squares: Sequence[Array | None],
    as_good: float = AS_GOOD,
    is_refuted: Callable[[int], bool] = lambda _: False,
) -> tuple[int, int]:
    """Return the indices of the best lens and of the simplest that is as good; the paper's comes before all others.

    A lens is as good if its error exceeds the least by no more than 1.75 standard errors of their difference by group
    (the one-standard-error rule of Breiman et al. 1984, paired, and wider because the best of many is the luckiest).

    Args:
        labels: of the lenses. sizes: see `size_of`. squares: (G,) squared errors by group of each lens; None where it
            cannot be used.
        as_good: number of standard errors in place of 1.75.
        is_refuted: whether a longer lens refutes the lens of this index, which then is not as good, whatever few groups
            say.

    Raises:
        DegenerateError: no lens can be used.
    """
    known = {i: one for i, one in enumerate(squares) if one is not None}
    if not known:
        raise DegenerateError("every lens folds inside the image or cannot be solved for: check labels and dimensions")
    totals = {i: float(one.sum()) for i, one in known.items()}
    best = min(totals, key=totals.__getitem__)
    least = {sizes[i]: min(totals[j] for j in totals if sizes[j] == sizes[i]) for i in totals}
    familiar = {i: is_usual(labels[i]) and totals[i] <= ALIKE * least[sizes[i]] for i in totals}
    order = sorted(totals, key=lambda i: (labels[i] != PAPER, sizes[i], not familiar[i], totals[i]))
    near = (i for i in order if standard_errors(known[i], known[best]) <= as_good)
    return best, next((i for i in near if not is_refuted(i)), best)


def pseudo_bma(densities: Sequence[Array]) -> Array:
    """Return the (L,) probability of each lens that it predicts best: likelihoods, averaged over draws of groups.

    This is Pseudo-BMA+ of Yao, Vehtari, Simpson and Gelman (Bayesian Analysis 13, 2018, section 3.4), except that the
    draws are balanced half samples, counted twice (McCarthy, Review of the International Statistical Institute 37,
    1969), so that nothing in them is random.

    Args:
        densities: (G,) minus twice the logarithm of the density that each lens predicts for each group.
    """
    each = np.array(densities)
    more = _half_samples(each.shape[1]) @ each.T
    likelihoods = np.exp(more.min(axis=1, keepdims=True) - more)
    return np.asarray(np.mean(likelihoods / likelihoods.sum(axis=1, keepdims=True), axis=0))


@cache
def _half_samples(groups: int) -> Array:
    """(D, G) 1 for groups that are in a draw, else 0: each group is in half of the draws, each pair in a quarter."""
    signs = np.ones((1, 1))
    while len(signs) <= groups:
        signs = np.block([[signs, signs], [signs, -signs]])  # Sylvester's Hadamard matrix
    return np.asarray(0.5 * (1.0 + signs[:, 1 : groups + 1]))


def surprise(squares: Array, counts: Array) -> Array:
    """Return (G,) squares that grow logarithmically where a group is off by more than the noise, so that a line off its
    nominal position or a feature with a wrong label does not decide.

    Args:
        squares: (G,) sum of squares of each group's residuals, in standard deviations. counts: (G,) of residuals.
    """
    return np.asarray(counts * np.log1p(squares / counts))


def standard_errors(squares: Array, others: Array) -> float:
    """Return by how many standard errors of the difference squared errors by group exceed others; 0 if equal."""
    more, count = squares - others, len(squares)
    total = float(more.sum())
    apart = more - total / count
    error = (float(apart @ apart) * count / (count - 1)) ** 0.5 if count > 1 else np.inf
    return total / error if error > 0.0 else 0.0
