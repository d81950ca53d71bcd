"""The last step of a calibration: compute the posterior, and replace the estimate where phi diverged.

The posterior includes the alternatives: statements in conflict, groups that may be outliers, other minima and other
lenses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import Array, numerical, replace
from ceres_cal.effects import Explanation, Scatter, ShiftsAt
from ceres_cal.posterior.bent import Node, ends_of, profile, valley
from ceres_cal.posterior.mixture import Mixture
from ceres_cal.posterior.posterior import Posterior, make_posterior, widths_over
from ceres_cal.problem import Estimate, Information, Problem, Solution, difference, is_lens, moved, over, unit_px
from ceres_cal.problem.reduced import ReducedInformation, information
from ceres_cal.robust import Conflicts, RobustSolution, minima_of
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR

if TYPE_CHECKING:
    from ceres_cal.posterior.other_lenses import OtherLenses


# Relative sigma of phi above which its valley is followed instead of the quadratic model. Nothing changes from half to
# double.
_BENT = 0.05
_MOST_DOUBT = 0.8  # upper limit of the summed probabilities of doubtful explanations


@numerical("the uncertainty")
def assess(
    problem: Problem,
    estimate: Estimate,
    reduced: ReducedInformation,
    degrees_of_freedom: float,
    scatter_at: Callable[[Estimate, ReducedInformation], Scatter | None],
    shifts_at: ShiftsAt | None = None,
    *,
    bends: bool = True,
) -> tuple[Estimate, Posterior]:
    """Return the estimate and what is known there; the estimate is another one where phi diverged.

    Nearly frontal views can be fitted slightly better by a camera a hand's breadth above the floor, or in the clouds,
    than by the true one. Where the least cost is at a phi that no lens has, or where the observations leave phi open on
    one side as far as lenses go, the node of the valley is taken that fits best with a usual lens; the posterior says
    that phi is unknown.

    Args:
        reduced: the problem's information at the estimate.
        degrees_of_freedom: spare equations behind the estimated noise, infinite where the sigmas were taken as stated.
        scatter_at: returns how the data scatter at an estimate, given the problem's information there.
        shifts_at: returns numbers, and shifts by which they scatter additionally, at an estimate. They widen the
            profile along a valley, and with phi held the components across it.
        bends: whether curvature along weak directions is evaluated, too; it does not change the estimate.

    Raises:
        SolutionError: no possible lens fits.
    """

    def known(there: Estimate, says: ReducedInformation) -> Posterior:
        by_scatter = make_posterior(says, degrees_of_freedom, scatter_at(there, says))
        by_model = by_scatter.by_model or by_scatter.information
        keys, shifts = ((), ()) if shifts_at is None else shifts_at(there, None)
        known = by_scatter.widened(keys, shifts)
        if there is found and by_scatter.by_model is not None:  # the minimum by the model with independent errors
            known = known.widened(known.keys, [to_best(by_scatter.information, says)])
        return known if known is by_scatter else replace(known, by_model=by_model)

    found = estimate
    posterior = known(estimate, reduced)
    width = posterior.half_width
    valleys: dict[str, tuple[Node, ...]] = {}
    astray = problem  # phi is held for cameras where it diverged, while others are examined
    for name in [name for name, numbers in problem.layout.free.items() if 0 in numbers]:
        camera = estimate.cameras[name]
        if is_lens(camera) and posterior.sd_of("camera", name, "phi") <= _BENT * camera.phi:
            continue
        alone = astray.about(name, estimate)
        nodes = valleys[name] = valley(name, alone, estimate, _inflation(posterior, name), width)
        rise = min(nodes[0].cost, nodes[-1].cost) - min(node.cost for node in nodes)
        if not is_lens(camera) or rise < width**2:
            estimate = _usual(name, nodes)
            astray = astray.holding(name, 0)
    if astray is not problem:
        reduced = information(problem, estimate)
        posterior = known(estimate, reduced)
    mixtures = {name: _profile(name, nodes, estimate, posterior) for name, nodes in valleys.items()}
    posterior = replace(posterior, mixtures=mixtures)
    return estimate, _with_bends(posterior, problem, estimate) if bends else posterior


def to_best(known: Information, says: ReducedInformation) -> Array:
    """(K,) from the estimate to the best one, where observations scatter more than the model says.

    The estimate weighs observations against priors as if errors were independent. Let A be the observations'
    information by the model, P the priors' information and g their pull. The observations alone have their minimum at
    A^-1 g from the estimate. With their final information A' the minimum of everything is at
    (A' + P)^-1 (A' A^-1 - 1) g.
    """
    priors = says.priors.less(says.built)
    alone, wider = says.shared.less(priors), known.less(priors)
    return np.asarray(known.inverse @ (wider.matrix @ (alone.inverse @ says.pull) - says.pull))


def _with_bends(posterior: Posterior, problem: Problem, estimate: Estimate) -> Posterior:
    """Return the posterior with curvature along weak directions; it also widens valleys across, where phi is held.

    Deviations of targets from their drawings cause no curvature, and a board may have a thousand of them: they are
    held.
    """
    followed = posterior.followed_phi
    if not estimate.structure.dimensions:
        followed |= {key for key in posterior.keys if key.kind == "structure"}
        problem, estimate = problem.built_as(estimate)
    held = [key for key in posterior.keys if key not in followed]
    by_model = posterior.by_model or posterior.information
    for name in posterior.followed:
        problem = problem.holding(name, 0)
    known = posterior.information.given(held)
    ends = ends_of(problem, estimate, known, by_model.given(held), posterior.half_width)
    if ends is None:
        return posterior
    mixtures = {
        name: _scattered(mixture, name, estimate, posterior, over(ends.excesses, ends.keys, mixture.keys[1:]))
        for name, mixture in posterior.mixtures.items()
    }
    own = ends.beside(posterior.stated.over(posterior.keys).marginal(held)).mixture(posterior.information)
    bent = replace(posterior, mixtures={**mixtures, "": own})
    return bent.with_alternatives(held, *minima_of(ends.others, estimate, by_model.given(held), posterior.half_width))


def _inflation(posterior: Posterior, camera: str) -> float:
    """Return the factor on the variance of the observations along a camera's valley: that of phi by them alone."""
    if posterior.by_model is None:
        return 1.0
    spreads = (one.less(posterior.stated).spread for one in (posterior.information, posterior.by_model))
    return float(widths_over(*spreads)[posterior.column("camera", camera, "phi")] ** 2)


def _profile(camera: str, nodes: Sequence[Node], estimate: Estimate, posterior: Posterior) -> Mixture:
    """Return the valley relative to the estimate, across it as wide as the data scatter with phi held: by the factor
    that all directions have in common at the estimate, and beyond that such that the same places scatter.
    """
    stated_sd = dict(zip(posterior.keys, posterior.stated_sd.tolist(), strict=True))
    along = profile(camera, nodes, estimate, posterior.half_width, stated_sd)
    if posterior.by_model is None:
        return along
    others, keys = [key for key in posterior.keys if key != along.keys[0]], along.keys[1:]
    held = (i.less(posterior.stated).given(others) for i in (posterior.information, posterior.by_model))
    known, by_model = (one.marginal(keys) for one in held)
    factor, excess = by_model.beyond(known.spread.covariance)
    return _scattered(along, camera, estimate, posterior, excess, factor)


def _scattered(
    along: Mixture, camera: str, estimate: Estimate, posterior: Posterior, shifts: Array, factor: float = 1.0
) -> Mixture:
    """Return a valley whose variances across are multiplied by a factor, and whose places also scatter as shifts (S, K)
    of all numbers but phi let them scatter at the estimate.

    Single numbers do not determine places: the higher a node, the more position and tilt are correlated, and the less a
    coefficient may vary.
    """
    from ceres_cal.posterior.other_lenses import shifts_along

    keys, others = along.keys[1:], [key for key in posterior.keys if key != along.keys[0]]
    known = posterior.information.given(others).marginal(keys)
    there = [moved(estimate, along.keys, step) for step in along.steps]
    every = shifts_along(camera, estimate, known, shifts, list(zip(there, along.information, strict=True)))

    def wider(across: Information, own: Array) -> Information:
        return posterior.wider(across, lambda seen: Information(keys, seen.matrix / factor).widened(own))

    return replace(along, information=tuple(map(wider, along.information, every)))


def _usual(name: str, nodes: Sequence[Node]) -> Estimate:
    """Return the node that fits best with a usual lens: one standard deviation is a factor of USUAL_PHI_FACTOR."""

    def cost(node: Node) -> float:
        camera = node.estimate.cameras[name]
        return float(node.cost + (np.log(camera.phi / (USUAL_PHI * unit_px(camera))) / np.log(USUAL_PHI_FACTOR)) ** 2)

    return min(nodes, key=cost).estimate


def with_doubts(
    posterior: Posterior,
    end: RobustSolution,
    conflicts: Conflicts,
    explanations: Sequence[Explanation],
    others: Sequence[Solution],
) -> Posterior:
    """Return the posterior with these alternatives as components, by how far the numbers move with each.

    Args:
        explanations: the less probable one counts by its probability. others: further minima.
    """
    estimate = end.estimate
    disputed = 1.0 / (len(conflicts.shifts) + 1.0)  # as likely to be right as each statement that contradicts it
    posterior = posterior.with_alternatives(conflicts.keys, conflicts.shifts, [disputed] * len(conflicts.shifts))
    for doubt in conflicts.doubts:  # their numbers no longer count as stated
        posterior = replace(posterior, stated=posterior.stated.without(doubt.keys))
        posterior = posterior.with_alternatives(conflicts.keys, [doubt.shift], [doubt.probability])
    doubtful = [one for one in explanations if one.is_doubtful]
    shifts = [difference(one.other, estimate, posterior.keys) for one in doubtful]
    likely = np.array([one.doubt for one in doubtful])
    likely /= max(1.0, likely.sum() / _MOST_DOUBT)
    posterior = posterior.with_alternatives(posterior.keys, shifts, likely.tolist())
    if posterior.followed:  # a followed valley contains its other minima
        return posterior
    known = posterior.by_model or posterior.information
    return posterior.with_alternatives(posterior.keys, *minima_of(others, estimate, known, posterior.half_width))


def with_other_lenses(posterior: Posterior, estimate: Estimate, lenses: OtherLenses) -> Posterior:
    """Return the posterior with other lenses as components by probability; in a valley along phi at each node."""
    if not lenses.others:
        return posterior
    from ceres_cal.posterior.other_lenses import counted, shifts_to_lenses

    followed = posterior.followed_phi
    # A lens was compared with some observations, targets as built: it says nothing about how they are built or placed,
    # except about dimensions, which were free.
    of_lens = ("camera", "station", "dimension")
    keys = [key for key in posterior.keys if key.kind in of_lens and key not in followed]
    weights = counted(lenses.weights)
    every = (lenses.near, *lenses.others)
    shifts = shifts_to_lenses(lenses, keys, every[:1])[0]
    wider = posterior.with_alternatives(keys, shifts, weights.tolist(), every)
    mixtures = dict(wider.mixtures)
    for name in posterior.followed:
        mine = posterior.mixtures[name]
        nodes = [moved(estimate, mine.keys, step) for step in mine.steps]
        along = shifts_to_lenses(lenses, mine.keys[1:], nodes)
        shifts = over(np.swapaxes(along, 0, 1), mine.keys[1:], mine.keys)
        mixtures[name] = mine.shifted_also(weights, shifts, range(1, len(every)))
    known = tuple(_as_open(own, posterior) for own in lenses.known)
    return replace(wider, mixtures=mixtures, lens_information=known)


def _as_open(known: Information, posterior: Posterior) -> Information:
    """Return what is known with another lens, at least as wide along phi as with the chosen lens where that follows a
    valley, in which normal equations hold only near the estimate.
    """
    for phi in posterior.followed_phi & {*known.keys}:
        of_it = posterior.normal_of_lens.spread.sd[posterior.information.columns([phi])[0]]
        along = known.spread.covariance[known.columns([phi])[0]]
        own = np.sqrt(along[known.columns([phi])[0]])
        if own < of_it:
            known = known.widened((np.sqrt(of_it**2 - own**2) / own**2 * along)[None])
    return known
