"""The last step of a calibration: what is known of its numbers, and what to do where phi ran away."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ceres_cal.base.numerical import numerical
from ceres_cal.model.information import Information
from ceres_cal.model.parameters import Estimate, unit_px
from ceres_cal.model.ranges import PHI_RANGE
from ceres_cal.scene.camera import Camera
from ceres_cal.solve import Problem, ReducedInformation, information
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR
from ceres_cal.uncertainty.bent import bends
from ceres_cal.uncertainty.dependence import Scatter
from ceres_cal.uncertainty.posterior import Posterior, make_posterior, widths_over
from ceres_cal.uncertainty.profile import Node, PhiProfile, profile, valley

# Relative sigma of phi above which the quadratic picture is left. Nothing changes from half to double.
_BENT = 0.05


@numerical("the uncertainty")
def assess(
    problem: Problem,
    estimate: Estimate,
    reduced: ReducedInformation,
    degrees_of_freedom: float,
    scatter_at: Callable[[Estimate, ReducedInformation], Scatter | None],
) -> tuple[Estimate, Posterior]:
    """What is known at the estimate, and the estimate: another one where phi went astray.

    Nearly frontal views can be fitted a little better by a camera a hand's breadth over the floor, or in the clouds,
    than by the true one. Where the least cost lies at a phi that no lens has, or the observations leave phi open on
    a side as far as lenses go, the node of the valley is taken that fits best with what is usual of lenses; the
    posterior says that phi is unknown.

    Args:
        reduced: what the problem says at the estimate.
        degrees_of_freedom: spare equations behind the estimated noise, infinite where the sigmas were taken as stated.
        scatter_at: how the data scatter at an estimate, of which the problem says so much.

    Raises:
        SolutionError: no possible lens fits.
    """
    posterior = make_posterior(reduced, degrees_of_freedom, scatter_at(estimate, reduced))
    width = posterior.half_width
    valleys: dict[str, tuple[Node, ...]] = {}
    astray = problem  # with phi held of the cameras that went astray, while others are looked at
    for name in [name for name, numbers in problem.layout.free.items() if 0 in numbers]:
        camera = estimate.cameras[name]
        if _is_lens(camera) and posterior.sd_of("camera", name, "phi") <= _BENT * camera.phi:
            continue
        nodes = valleys[name] = valley(name, astray, estimate, _inflation(posterior, name))
        rise = min(nodes[0].cost, nodes[-1].cost) - min(node.cost for node in nodes)
        if not _is_lens(camera) or rise < width**2:
            estimate = _usual(name, nodes)
            astray = astray.holding(name, 0)
    if astray is not problem:
        reduced = information(problem, estimate)
        posterior = make_posterior(reduced, degrees_of_freedom, scatter_at(estimate, reduced))
    profiles = {name: _profile(name, nodes, estimate, posterior) for name, nodes in valleys.items()}
    return estimate, _with_bends(replace(posterior, profiles=profiles), problem, estimate)


def _with_bends(posterior: Posterior, problem: Problem, estimate: Estimate) -> Posterior:
    """The posterior with what bends in it; across its valleys, where phi is held, that is put into what they say."""
    followed = {profile.keys[0] for profile in posterior.profiles.values()}
    held = [key for key in posterior.keys if key not in followed]
    by_model = posterior.by_model or posterior.information
    for name in posterior.profiles:
        problem = problem.holding(name, 0)
    known = posterior.information.given(held)
    bent = bends(problem, estimate, known, by_model.given(held), posterior.half_width)
    if bent is None:
        return posterior
    profiles = {
        name: replace(profile, across=tuple(posterior.wider(one, bent.widened) for one in profile.across))
        for name, profile in posterior.profiles.items()
    }
    bent = bent.beside(known, posterior.stated.over(posterior.keys).marginal(held))
    return replace(posterior, profiles=profiles, bends=bent)


def _inflation(posterior: Posterior, camera: str) -> float:
    """Factor on the variance of the observations along a camera's valley: that of phi by them alone."""
    if posterior.by_model is None:
        return 1.0
    spreads = (one.less(posterior.stated).spread for one in (posterior.information, posterior.by_model))
    return float(widths_over(*spreads)[posterior.column("camera", camera, "phi")] ** 2)


def _profile(camera: str, nodes: Sequence[Node], estimate: Estimate, posterior: Posterior) -> PhiProfile:
    """The valley as seen from the estimate, across it as wide as the data scatter with phi held."""
    stated_sd = dict(zip(posterior.keys, posterior.stated_sd.tolist(), strict=True))
    along = profile(camera, nodes, estimate, posterior.half_width, stated_sd)
    if posterior.by_model is None:
        return along
    others = [key for key in posterior.keys if key != along.keys[0]]
    held = (i.less(posterior.stated).given(others) for i in (posterior.information, posterior.by_model))
    factors = widths_over(*(one.marginal(along.keys[1:]).spread for one in held))

    def scattered(seen: Information) -> Information:
        return Information(seen.keys, seen.matrix / factors[:, None] / factors)

    return replace(along, across=tuple(posterior.wider(one, scattered) for one in along.across))


def _is_lens(camera: Camera) -> bool:
    unit = unit_px(camera)
    return PHI_RANGE[0] * unit <= camera.phi <= PHI_RANGE[1] * unit


def _usual(name: str, nodes: Sequence[Node]) -> Estimate:
    """The node that fits best with what is usual of lenses: a standard deviation is a factor of USUAL_PHI_FACTOR."""

    def cost(node: Node) -> float:
        camera = node.estimate.cameras[name]
        return float(node.cost + (np.log(camera.phi / (USUAL_PHI * unit_px(camera))) / np.log(USUAL_PHI_FACTOR)) ** 2)

    return min(nodes, key=cost).estimate
