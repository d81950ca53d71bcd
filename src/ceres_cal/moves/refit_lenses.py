"""What new observations say of the lenses by which the old calibration predicted about as well.

The old posterior is a mixture: one picture determines a lens's numbers, but hardly which lens it is, and in other
places of the picture the lenses differ. So each of them is solved for from the new observations, with what was known of
its numbers as a prior, and is as likely as it was, times how well it explains them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import Array, Frozen, attempt, replace
from ceres_cal.calibration import Calibration
from ceres_cal.moves.refit_plan import RefitPlan, of_other_lens, refit_problem
from ceres_cal.posterior import OtherLenses
from ceres_cal.problem import Estimate, Information, Problem, Solution, Weighting
from ceres_cal.problem.reduced import information
from ceres_cal.robust.other_minima import solved_soon
from ceres_cal.scene import Camera, Lens


def with_lenses(plan: RefitPlan, start_of: Callable[[RefitPlan], Estimate], number: int | None = None) -> RefitPlan:
    """Return the plan with the lens that the new observations make likeliest, and with the others as they see them.

    After another zoom each distorts rays at the same angle as before; after another iris the others are unknown.

    Args:
        start_of: returns where a plan's solve starts, or raises where nothing fits. number: the lens to take in any
            case, in place of the likeliest; where intrinsics are held, it is the chosen one.
    """
    # Nats by which another lens must be likelier than the chosen one, as among lenses of few observations; and by which
    # one without a formula, which few programs know, must be likelier than one with a formula.
    strong = 3.0
    known = plan.calibration.uncertainty.posterior
    if len(known.lenses) < 2:
        return plan
    if plan.what in ("iris", "everything"):
        return plan.of_lens(number) if number else plan
    if plan.is_repeated:  # its lenses have seen these observations
        near, *rest = known.lenses
        parts = tuple(rest), known.lens_weights(), _reach_px(plan, near), "", known.lens_information
        return replace(plan, others=OtherLenses(near, *parts))
    every = _seen_by_each(plan, start_of)
    weights = np.array([one.weight for one in every])
    if not every or not np.isfinite(weights.max()):
        return plan
    number = 0 if plan.what == "pose-only" else number
    if number is None:
        without_formula = np.array([any(c.lens.roughness for c in one.cameras.values()) for one in known.lenses])
        ahead = weights - strong * without_formula
        ahead[0] += strong
        number = int(np.argmax(ahead)) if known.lens_information else 0
    likely = np.exp(weights - weights.max())
    return _among(plan, every, number, likely / likely.sum())


def with_lens_of(before: Calibration, camera: Camera, name: str) -> Calibration:
    """Return an earlier calibration with the lens of its posterior that is most like that of a camera."""

    def off(lens: Lens) -> bool:
        return (lens.kind, lens.names) != (camera.lens.kind, camera.lens.names)

    lenses = before.uncertainty.posterior.lenses
    if not lenses or name not in before.cameras or not off(before.cameras[name].lens):
        return before
    every = [one.cameras[name] for one in lenses]
    number = min(range(len(every)), key=lambda n: (off(every[n].lens), abs(every[n].phi - camera.phi)))
    return of_other_lens(before, number, {name})


class _SeenLens(Frozen):
    """A lens of the old posterior, with what the new observations say of it.

    Attributes:
        plan: with the lens. problem: of the refit with it. end: its solution, None where there is none. shown: with phi
            free, as the lens appears beside the others. weight: the logarithm of its probability, plus a constant.
    """

    plan: RefitPlan
    problem: Problem
    end: Solution | None
    shown: Estimate
    weight: float

    def information(self, cameras: Collection[str]) -> Information:
        """Return what is known with it of some cameras and their stations, by old and new observations."""
        estimate = self.shown if self.end is None else self.end.estimate
        stations = estimate.stations
        owners = {("camera", name) for name in cameras}
        owners |= {("station", name) for name, one in stations.items() if one.camera in cameras}
        every = information(self.problem, estimate).shared
        return every.marginal([key for key in every.keys if key[:2] in owners])


def _seen_by_each(plan: RefitPlan, start_of: Callable[[RefitPlan], Estimate]) -> list[_SeenLens]:
    """Return the lenses, the chosen one first; none where nothing fits with any of them."""
    known = plan.calibration.uncertainty.posterior
    weights = known.lens_weights(*plan.moved_cameras) if len(plan.moved_cameras) == 1 else known.lens_weights()
    probabilities = [1.0 - sum(weights), *weights]
    plans = [plan, *(plan.of_lens(number) for number in range(1, len(known.lenses)))]
    ordered = sorted(range(len(plans)), key=lambda number: (number > 0, -probabilities[number]))
    # quiet: a lens with which nothing fits; where none does, the chosen one's refusal follows
    starts = ((plans[n], attempt(partial(start_of, plans[n]))) for n in ordered)
    of, start = next(((of, one) for of, one in starts if isinstance(one, Estimate)), (plan, None))
    if start is None:
        return []
    ratios = {name: start.cameras[name].phi / of.known.cameras[name].phi for name in plan.moved_cameras}
    return [_seen(own, start, ratios, one) for own, one in zip(plans, probabilities, strict=True)]


def _seen(plan: RefitPlan, start: Estimate, ratios: Mapping[str, float], probability: float) -> _SeenLens:
    """Return a lens of this probability as the new observations see it.

    Args:
        start: with another lens. ratios: of phi to the one before.
    """
    known, weighting = plan.known, Weighting(*plan.scales)
    zoomed = {name: known.cameras[name].zoomed(ratio * known.cameras[name].phi)[0] for name, ratio in ratios.items()}
    stays = {name: known.stations[name] for name in plan.stays}
    start = replace(start, cameras={**known.cameras, **zoomed}, stations={**start.stations, **stays})
    what = "pose" if plan.what == "pose-only" else plan.what  # held numbers are no better known than others
    problem = replace(refit_problem(plan, what, start)[0], weighting=weighting)
    # First the poses alone: from a wrong pose, the first step may lead to an impossible lens.
    posing, layout = refit_problem(plan, "pose-only", start)
    posing = replace(posing, priors=(), weighting=weighting)
    held = replace(layout, stations=plan.moved, free={name: free[:0] for name, free in layout.free.items()})
    posed = solved_soon(replace(posing, layout=held), start)
    end = None if posed is None else solved_soon(problem, posed.estimate) or posed
    weight = np.log(max(probability, np.finfo(float).tiny)) - (np.inf if end is None else end.cost)
    # Beside the others it is shown with its own phi by these observations: where a zoom that nobody stated cannot be
    # seen, phi was otherwise known and wrong twice as often. A valley along phi contains all of that.
    here = start if end is None else end.estimate
    followed = plan.earlier.uncertainty.posterior.followed
    own = {name: free[:0] if name in followed else free[free == 0] for name, free in layout.free.items()}
    alone = None if end is None else solved_soon(replace(posing, layout=replace(held, free=own)), here)
    return _SeenLens(plan, problem, end, here if alone is None else alone.estimate, float(weight))


def _among(plan: RefitPlan, every: Sequence[_SeenLens], number: int, likely: Array) -> RefitPlan:
    """Return the plan with one of the lenses, and with the others by their probabilities (L,)."""
    least = 1e-3  # probability below which another lens makes no difference
    earlier, moved = plan.calibration.uncertainty.posterior.lenses, plan.moved_cameras
    still = plan.known.cameras.keys() - moved
    # Cameras that were not observed refer to the lenses by their numbers: those stay, and the two change places.
    places = [(n, n if n != number else 0) for n in range(1, len(every))]
    places = [(at, n) for at, n in places if still or likely[n] >= least]

    def there(one: _SeenLens, before: Estimate) -> Estimate:
        cameras = {name: before.cameras[name] for name in still}
        stations = {name: own for name, own in before.stations.items() if own.camera in still}
        here = one.shown
        return replace(here, cameras={**here.cameras, **cameras}, stations={**here.stations, **stations})

    near = there(every[number], earlier[0])
    lenses = OtherLenses(
        near,
        tuple(there(every[n], earlier[at]) for at, n in places),
        tuple(likely[n] for _, n in places),
        _reach_px(plan, near),
        known=tuple(every[n].information(moved) for _, n in places),
    )
    own = every[number]
    if own.end is None or plan.what == "pose-only":
        return replace(own.plan, others=lenses)
    return replace(own.plan, near=own.end.estimate, others=lenses)


def _reach_px(plan: RefitPlan, near: Estimate) -> dict[str, float]:
    return {name: plan.sights.of_camera(name).about(near.cameras[name]).reach_px for name in plan.sights.cameras}
