"""Which of several lenses is the simplest that is as good as the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import DegenerateError
from ceres_cal.lens_choice.forms import PAPER, is_usual

# How much worse than the best, in standard errors of the difference, is as good: at 1 the paper's lens is missed more
# often (at 1.5 in 4 of 100 fields), beyond 2 the decentring of real sets.
AS_GOOD = 1.75
# Times the least squared error of lenses of one size, up to which what other programs know is preferred: OpenCV's right
# camera has 1.005; photographs of fields 1.1 and more, where the map was off by 3 instead of 1 standard deviations.
ALIKE = 1.02
# Share of the error of prediction that a lens without a formula leaves besides: few programs know it. Real sets have
# 0.98, 0.97, 0.95 and 0.79; of a lens that no formula has, 0.2 to 0.5, by 2.4 to eight standard errors.
CLEARLY = 0.9
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
        raise DegenerateError("no lens can be calibrated: check labels and target dimensions")
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
    signs = np.ones((1, 1))
    while len(signs) <= each.shape[1]:
        signs = np.block([[signs, signs], [signs, -signs]])  # Sylvester's Hadamard matrix
    more = 0.5 * (1.0 + signs[:, 1 : each.shape[1] + 1]) @ each.T
    likelihoods = np.exp(more.min(axis=1, keepdims=True) - more)
    return np.asarray(np.mean(likelihoods / likelihoods.sum(axis=1, keepdims=True), axis=0))


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
