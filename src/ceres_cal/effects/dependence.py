"""Estimate the dependence of errors from the residuals, as one covariance of all shared numbers (a sandwich).

First what is correlated within a view, and what displaces its rows as they are read out one after the other (a rolling
shutter); then whether views scatter as that predicts (`effects/groups.py`). In directions in which the model's
information on everything shared is the unit matrix (root root^T its covariance), the observations, of information A,
have a score of covariance C = M - P, with P that of the priors: with S = root^T A and B = S root they say A + S^T (C^-1
- B^-1) S instead of A. Priors stay as certain as they were, and what nothing determines stays unknown.

Errors may be correlated along a curve, or over a board, within one view or over all views of a sight. Their covariance
falls with the distance d on the target like exp(-d / l), and over boards, which bend smoothly, also like exp(-(d / l)^2
/ 2). The likelihood on a grid of lengths l and shares (`effects/likelihood.py`) weighs them against independent errors.
The covariance of the scores is averaged over all of these, since the best alone would be too certain. Score tests first
show whether there is any correlation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, eigh, evenly, numbers_of, replace, two_digits
from ceres_cal.base.tails import bisected, mixture_95, student_95
from ceres_cal.effects.columns import SparseColumns, places_in_view, smooth_image, smooth_view
from ceres_cal.effects.evidence import DEPENDENCE, LENS_LEAVES, LIKELY, READ_OUT, SMOOTH_ERRORS, RepeatedAmounts
from ceres_cal.effects.groups import FEWEST_GROUPS, GroupNormals, GroupScatter, compare_groups
from ceres_cal.effects.linearised import Linearised
from ceres_cal.effects.strands import (
    LOUD,
    Strand,
    StrandFamily,
    decays,
    distances_of,
    families_of,
    go_over_groups,
    is_loud,
    sampled,
    views_or_placements,
)
from ceres_cal.problem import Estimate, Information, Problem, ReducedInformation, Residuals

if TYPE_CHECKING:
    from ceres_cal.effects.likelihood import Likelihoods

_INDEFINITE = 1e6  # degrees of freedom that count as infinite


class Correlation(Frozen, eq=True):
    """The correlation of errors of one kind of observation.

    Attributes:
        kind: "points" or "curves". probability: that errors are correlated. length_m: the likeliest correlation length;
            None where whole curves are displaced. share: of the variance that is correlated. lasting: whether errors
            are the same in all views of a sight, not different in each. camera: the camera's name; None if there is
            only one.
    """

    kind: str
    probability: float
    length_m: float | None
    share: float
    lasting: bool
    camera: str | None = None


def correlated(model: Linearised, group: Indices, informations: Array) -> tuple[Array, Dependence]:
    """(G, P, P) covariance of each group's score, including correlations of a camera's errors, and the dependence
    found.

    Args:
        model: of some views, in directions in which the information of everything is the unit matrix. group: (E,) the G
            views or placements that are compared. informations: (G, P, P) of each group if errors were independent.
    """
    fewest_rows = 12
    scores, private, kinds, equations = informations.copy(), [1.0], [], model.equations
    owners = [key.camera for key in equations.sights.keys]
    names = list(dict.fromkeys(owners))
    owner, inverse = numbers_of(owners, names)[equations.sight], [0.0] * len(names)
    for number, (is_curve, kind) in product(range(len(names)), ((False, "points"), (True, "curves"))):
        rows = (owner == number) & (equations.is_curve == is_curve)
        if np.count_nonzero(rows) < fewest_rows:
            continue
        families = families_of(model, group, rows)
        if not any(map(is_loud, families)):
            continue
        average = _Average.of(model.shared, families, rows, may_be_smooth=not is_curve)
        change, factor = average.change(model.columns, group)
        scores += change
        private.append(factor)
        inverse[number] += average.inverse_freedom
        kinds.append(average.correlation(kind, names[number] if len(names) > 1 else None))
    return scores, Dependence(tuple(kinds), None, max(private), max(inverse))


class _Average(Frozen):
    """The mean over the grid of correlations.

    Attributes:
        families: of strands. at: places on the grid; the first is independence. variance: (N,) relative to that of
            independence. weight: (N,) posterior probabilities. inverse_freedom: 1 / degrees of freedom of the average.
    """

    families: Sequence[StrandFamily]
    at: Likelihoods
    variance: Array
    weight: Array
    inverse_freedom: float

    @classmethod
    def of(cls, shared: Array, families: Sequence[StrandFamily], rows: Mask, may_be_smooth: bool) -> _Average:
        """The average, weighted by likelihood and prior. Bent boards and lenses err smoothly; edges along a line do
        not.
        """
        negligible = 1e-3  # weight below which a place on the grid is left out
        from ceres_cal.effects.likelihood import likelihoods

        own = np.sum(shared[rows] ** 2)
        at = likelihoods(families, may_be_smooth, float(own))
        variance = at.variance / at.variance[0]  # the noise scale is that of independent errors
        weight = DEPENDENCE.over(len(at.share) - 1) * np.exp(at.log - at.log.max())
        weight /= weight.sum()
        weight[weight < negligible] = 0.0
        weight /= weight.sum()
        used, rest = weight > 0.0, shared.shape[1] - own  # the information of all other rows
        mixed = 1.0 / _freedom_of_mixture(weight[used], (rest + variance * at.trace)[used])
        return cls(families, at, variance, weight, mixed + float(weight @ at.inverse_freedom))

    def correlation(self, kind: str, camera: str | None) -> Correlation:
        """The likeliest correlation."""
        best = 1 + int(np.argmax(self.weight[1:])) if len(self.weight) > 1 else 0
        length, longest = float(self.at.length_m[best]), max(family.longest for family in self.families)
        aside, probability = length > 2.0 * longest, float(1.0 - self.weight[0])
        share, lasting = float(self.at.share[best]), self.families[int(self.at.family[best])].lasting
        return Correlation(kind, probability, None if aside else length, share, lasting, camera)

    def change(self, columns: Array, group: Indices) -> tuple[Array, float]:
        """(G, P, P) the amount added to the covariance of each group's score, and the factor on private placements.

        Args:
            columns: (E, 6 + P + 1) those of the linear model.
        """
        size = columns.shape[1] - 7
        scores, private = np.zeros((int(group.max()) + 1, size, size)), np.zeros(2)
        for number, family in enumerate(self.families):
            here = self.at.family == number
            each, share = (self.weight * self.variance)[here], self.at.share[here]
            alone = float(np.sum(each * (1.0 - share))) - (1.0 if number == 0 else 0.0)
            for strands in map(family.strands.__getitem__, family.of_shape):
                kernel = self._kernel(strands[0], here, each * share)
                x = columns[np.array([strand.rows for strand in strands])][..., :-1]
                product = np.swapaxes(x, 1, 2) @ (alone * x + kernel @ x)
                np.add.at(scores, group[[strand.rows[0] for strand in strands]], product[:, 6:, 6:])
                if number == 0:
                    private[1] += float(np.sum(x[..., :6] ** 2))
                # An error common to all rows of a view is not its scatter.
                common = float(kernel.min()) * float(np.sum(x[..., :6].sum(axis=1) ** 2))
                private[0] += float(np.trace(product[:, :6, :6], axis1=1, axis2=2).sum()) - common
        return scores, float(1.0 + max(private[0], 0.0) / private[1]) if private[1] > 0.0 else 1.0

    def _kernel(self, strand: Strand, here: Mask, weights: Array) -> Array:
        """(N, N) sum of weights times correlations at some places of the grid."""
        rows = 64  # rows at a time, so that distances stay in the cache
        places, used, together = strand.places, weights > 0.0, dict[tuple[float, bool], float]()
        for *place, weight in zip(self.at.length_m[here][used], self.at.smooth[here][used], weights[used], strict=True):
            together[*place] = together.get((*place,), 0.0) + weight
        along = sorted(together, reverse=True)
        each = [together[place] for place in along]
        kernel = np.zeros((len(places), len(places)))
        for first in range(0, len(places) if together else 0, rows):
            distance = distances_of(places[first : first + rows], places[first:])
            part = kernel[first : first + rows, first:]
            for weight, correlation in zip(each, decays(distance, along), strict=True):
                part += weight * correlation
            kernel[first:, first : first + rows] = part.T  # the kernel is symmetric
        return kernel


# ---- degrees of freedom of a mixture --------------------------------------------------------------------------------


def _freedom_of_mixture(weights: Array, variances: Array) -> float:
    """Degrees of freedom for which Student's t has the 95 % interval of a mixture of normals of these variances, if
    both have the same mean variance.
    """
    width = mixture_95(weights, variances / float(weights @ variances))
    return math.exp(bisected(lambda log: width - student_95(math.exp(log)), 0.0, math.log(_INDEFINITE)))


# Share of the largest variance of a score below which it is rounding. For a direction that only priors know it was
# 3e-10, and its rounding made a standard deviation four times too large. Up to a thousandfold nothing changes.
_DETERMINED = 1e-9
_OVER = {"points": "errors are correlated between a target's points", "curves": "errors are correlated along lines"}


class Dependence(Frozen, eq=True):
    """The dependence of errors, as the residuals show it.

    Attributes:
        correlations: of points and of curves whose neighbours might agree. between: the scatter of views or placements;
            None where there are too few, or where an error that lasts over all of them would enter it.
        private: factor on the variance of placements due to their own observations.
        inverse_freedom: 1 / degrees of freedom of the dependence, without those of the noise scale; the largest of all
            cameras.
        read_out_px: standard deviation of the displacement of the uppermost observed row of a view, and of the lowest
            in the opposite direction, because rows are read out one after the other; 0 where that is not likely.
    """

    correlations: tuple[Correlation, ...] = ()
    between: GroupScatter | None = None
    private: float = 1.0
    inverse_freedom: float = 0.0
    read_out_px: float = 0.0

    @property
    def is_likely(self) -> bool:
        """Whether errors are likely correlated, or views scatter by another amount than errors within them predict."""
        return bool(self.causes) or (self.between is not None and self.between.probability > LIKELY)

    @property
    def causes(self) -> tuple[str, ...]:
        """The likely causes that widen, in words."""
        likely = [one for one in self.correlations if one.probability > LIKELY]
        causes = [_OVER[one.kind] + _reach(one) for one in likely]
        if self.read_out_px > 0.0:
            causes.append(f"views move by {two_digits(self.read_out_px)} px while rows are read out (rolling shutter)")
        if self.between is not None and self.between.probability > LIKELY and self.between.variance > 1.0:
            factor = two_digits(self.between.variance**0.5)
            causes.append(f"views scatter {factor} times as much as the errors within them predict")
        return tuple(causes)


def _reach(correlation: Correlation) -> str:
    length = correlation.length_m
    if length is None:
        over = " as a whole"
    else:  # an error that repeats at each place alone has no length: the likeliest one was 13 nm
        over = f" over {two_digits(length)} m" if length >= 1e-3 else " over less than 1 mm"
    over += "" if correlation.camera is None else f" in camera {correlation.camera!r}"
    return over + (", the same in all views" if correlation.lasting else "")


class Scatter(Frozen):
    """The scatter of the shared numbers, relative to what the model says.

    Attributes:
        root: (K, P) maps directions in which their information by the model is the unit matrix to the shared numbers.
            matrix: (P, P) their covariance by the scatter of the data. dependence: what that is based on.
    """

    root: Array
    matrix: Array
    dependence: Dependence

    def widened(self, seen: Information) -> Information:
        """The information of the observations without any prior, as they scatter.

        Args:
            seen: their information by the model.
        """
        along = self.root.T @ seen.matrix
        own = along @ self.root
        values, vectors = eigh(0.5 * (own + own.T))
        determined = values > _DETERMINED * values[-1]
        white = vectors[:, determined] / np.sqrt(values[determined])
        scores = np.eye(white.shape[1]) + white.T @ (self.matrix - np.eye(len(own))) @ white
        # Share of the model's variance that remains at least. Correlated errors cancel in some directions, but nothing
        # is known a hundred times better because of that. In a rig whose cameras contradicted one another it was 1e-8,
        # and its rounding hid everything else.
        least = 1e-4
        scatters, turned = eigh(0.5 * (scores + scores.T))
        inverse = (turned / np.maximum(scatters, least)) @ turned.T
        change = (along.T @ white) @ (inverse - np.eye(len(scores))) @ (white.T @ along)
        return Information(seen.keys, seen.matrix + 0.5 * (change + change.T))


def scattered(reduced: ReducedInformation, scatter: Scatter | None) -> Information:
    """The information of observations and priors on everything shared, as the observations scatter.

    The prior on targets as built describes a scatter of their own, so it is widened with the observations. Otherwise,
    where errors are correlated, halves of real boards differed by 1.7 times what was stated.
    """
    if scatter is None:
        return reduced.shared
    built = reduced.built.over(reduced.shared.keys)
    return scatter.widened(reduced.points + reduced.curves + built) + reduced.priors.less(built)


def measure_scatter(
    problem: Problem, there: Residuals, estimate: Estimate, reduced: ReducedInformation
) -> Scatter | None:
    """Estimate the scatter of the shared numbers from the residuals; None where there are none, or nothing is left
    over.

    Args:
        problem: as it was solved, at the estimated noise. there: residuals at the estimate. reduced: its information
            there.
    """
    # Views of a camera for the first test, and for the estimate where dependence is likely: with another 16 of 60 or
    # 120 views of a crooked lens, the 95 % intervals were up to a quarter shorter or longer, and held 65 to 100 %.
    few, many = 16, 64
    scatter = None
    for most_views in (few, many):
        model = sampled(problem, there, estimate, reduced, most_views)
        if model is None or not model.root.shape[1]:
            return None
        scatter = _measured(problem, model, reduced, estimate)
        if not scatter.dependence.is_likely or len(model.equations) == problem.sights.equations:
            break
    return scatter


def _measured(problem: Problem, model: Linearised, reduced: ReducedInformation, estimate: Estimate) -> Scatter:
    """The scatter from the equations of some views."""
    group = views_or_placements(model.equations)
    prior = model.root.T @ reduced.priors.over(reduced.shared.keys).matrix @ model.root
    groups = GroupNormals.of(model, group, prior)
    scores, dependence = correlated(model, group, groups.normal)
    read_out = _ReadOut.of(model, estimate)
    if read_out is not None:
        np.add.at(scores, group[model.equations.bounds[:-1]], read_out.scores)
        dependence = read_out.beside(dependence)
    if len(groups.counts) < FEWEST_GROUPS:
        scores += _stated_together(model, group, problem.weighting.scales)
    whole = _whole(groups, scores)
    lasting = any(kind.lasting for kind in dependence.correlations) and go_over_groups(model.equations, group)
    enough = len(groups.counts) >= FEWEST_GROUPS and not lasting
    if enough and (compared := compare_groups(groups, scores, whole)) is not None:
        between, whole = compared
        inverse = dependence.inverse_freedom + between.probability / between.degrees_of_freedom
        dependence = replace(dependence, between=between, inverse_freedom=inverse)
    return Scatter(model.root, whole, dependence)


class _ReadOut(Frozen):
    """Motion while the rows of a view are read out one after the other, as the displacement of its lowest row.

    A pose absorbs nearly all of a shear or stretch, so little of it is left to be seen; but the shared numbers, which
    absorb it as well, are displaced by all of it. What turns and zooms is among the smooth errors of a view.

    Attributes:
        sigma_px, probability: of either direction. scores: (S, P, P) what it adds to the covariance of each sight's
            score.
    """

    sigma_px: float
    probability: float
    scores: Array

    @classmethod
    def of(cls, model: Linearised, estimate: Estimate) -> _ReadOut | None:
        """Estimate it from views of boards that only one camera sees, since a contradiction may be due to another
        moment; None where there are few, or where they do not seem to be displaced.
        """
        fewest, enough = 5, 20  # views: the least that are tested, and those from which the size is estimated
        equations = model.equations
        boards = np.flatnonzero(np.maximum.reduceat(model.of_private, equations.bounds[:-1]))
        if len(boards) < fewest:
            return None
        place = places_in_view(equations)
        growing = equations.direction * place[:, 1:] * model.weight[:, None]
        rows = np.where(model.used[:, None], model.beyond_private(growing), 0.0)
        whole = np.column_stack([rows, model.shared, model.left_over])
        products = np.array(
            [rows[own].T @ whole[own] for own in map(slice, equations.bounds[:-1], equations.bounds[1:])]
        )
        told, common, score = products[:, :, :2], products[:, :, 2:-1], products[:, :, -1]
        z2 = np.einsum("si,sij,sj->s", score, np.linalg.pinv(told, hermitian=True), score)[boards]
        if np.sum(z2 - 2.0) <= LOUD * np.sqrt(4.0 * len(boards)):
            return None
        sigma, probability = _sizes_of_views(model, estimate, place, boards[evenly(len(boards), enough)])
        there = np.isin(np.arange(len(common)), boards)[:, None, None]
        return cls(sigma, probability, probability * sigma**2 * there * (np.swapaxes(common, 1, 2) @ common))

    def beside(self, dependence: Dependence) -> Dependence:
        """The dependence with the read-out added."""
        inverse = dependence.inverse_freedom + self.probability / (2.0 * len(self.scores))
        likely_px = self.sigma_px if self.probability > LIKELY else 0.0
        return replace(dependence, inverse_freedom=inverse, read_out_px=likely_px)


def _sizes_of_views(model: Linearised, estimate: Estimate, place: Array, views: Indices) -> tuple[float, float]:
    """Sigma and probability of the read-out in some sights, beside smooth displacements of each and of all alike.

    Args:
        place: see `places_in_view`.
    """
    tells = 1e-4  # share of the largest eigenvalue above which a direction counts beside the poses
    equations, count = model.equations, len(views)
    number = np.full(len(equations.bounds) - 1, -1)
    number[views] = np.arange(count)
    group, image = number[equations.sight], smooth_image(equations, estimate)
    polynomials = smooth_view(equations, place)
    each = (image, polynomials[:, :, 1], polynomials.reshape(len(image), -1))
    owners = ((np.zeros_like(group), 1), (group, count), (group, count))
    parts = [
        SparseColumns.of_groups(model, own * model.weight[:, None], *of) for own, of in zip(each, owners, strict=True)
    ]
    firsts = np.cumsum([0, *(part.size for part in parts)]).tolist()
    names = ("alike", "read-out", "smooth")
    repeated = RepeatedAmounts.of(model, SparseColumns.side_by_side(parts, len(equations)))
    numbers = {name: np.arange(*ends) for name, ends in zip(names, pairwise(firsts), strict=True)}
    priors = dict(zip(names, (LENS_LEAVES, READ_OUT, SMOOTH_ERRORS), strict=True))
    return repeated.scatters(numbers, priors, tells)["read-out"]


def _stated_together(model: Linearised, group: Indices, scales: tuple[float, float]) -> Array:
    """(G, P, P) the amount added to the covariance of each group's score where observations scatter clearly less than
    their stated sigmas: as likely as not, the rest is an error that neighbours share, which no residual shows.
    """
    likely, by_chance, alike = 0.5, 1.0, 1e-3  # probability; standard errors; spread of sigmas stated for all
    scores = np.zeros((int(group.max()) + 1, *2 * (model.columns.shape[1] - 7,)))
    for is_curve, scale in zip((False, True), scales, strict=True):
        rows = np.flatnonzero((model.equations.is_curve == is_curve) & model.used)
        scale *= 1.0 + by_chance / np.sqrt(2.0 * max(len(rows), 1))
        if scale < 1.0 and len(rows) and np.ptp(model.weight[rows]) > alike * np.max(model.weight[rows]):
            columns = model.columns[rows, 6:-1]
            np.add.at(scores, group[rows], likely * (scale**-2.0 - 1.0) * columns[:, :, None] * columns[:, None, :])
    return scores


def _whole(groups: GroupNormals, scores: Array) -> Array:
    """(P, P) covariance of the score of everything, if the views left out of the sample scatter like those in it."""
    seen, everything = groups.normal.sum(axis=0), np.eye(len(groups.known)) - groups.known
    values, vectors = eigh(seen)
    determined = values > 1e-6
    back = vectors[:, determined] / np.sqrt(values[determined])
    change = back.T @ scores.sum(axis=0) @ back - np.eye(int(determined.sum()))
    values, vectors_of = eigh(everything)
    root = (vectors_of * np.sqrt(np.maximum(values, 0.0))) @ vectors_of.T @ vectors[:, determined]
    whole = np.eye(len(seen)) + root @ change @ root.T
    return np.asarray(0.5 * (whole + whole.T))
