"""What phi could be: the cost along it, everything else at its best (the profile likelihood).

The views of a flat field from nearly above tell phi by the small differences of large numbers, so the least cost has a
long, bent valley that no ellipse describes. The valley is followed step by step; at each of its nodes the other
numbers have a covariance of their own. Together they bound any number or mapped point that depends on both: along the
valley exactly, across it by the quadratic picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.errors import CalibrationError, SolutionError
from ceres_cal.posterior.mixture import Mixture
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Estimate, unit_px
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import difference, moved
from ceres_cal.problem.ranges import PHI_RANGE
from ceres_cal.problem.reduced import information

# Rise of twice the cost at which the valley is followed no further: three sigma, well beyond any 95 % bound. Nothing
# changes from half to double.
_FAR = 9.0
_STEPS = (0.02, 0.35)  # of log phi
_MOST_RISE = 1.5  # from one node to the next
_MOST_NODES = 60


@dataclass(frozen=True, eq=False)
class Node:
    """One point of the valley: phi held, everything else at its best.

    Attributes:
        cost: twice the least cost there, that of the observations over the factor on their variance; with that of the
            priors, also of those on phi.
        information: about everything shared, phi too, though it was held.
    """

    estimate: Estimate
    cost: float
    information: Information


def valley(camera: str, problem: Problem, estimate: Estimate, inflation: float = 1.0) -> tuple[Node, ...]:
    """Follow the valley from the estimate both ways, until it is three sigma up or phi is no lens any more.

    Args:
        inflation: factor on the variance of the observations along it: what they cost is divided by it.

    Raises:
        SolutionError: the solve does not find back to where it ended, or from there to a lens that fits.
    """
    unit, phi = unit_px(estimate.cameras[camera]), estimate.cameras[camera].phi
    first = least = _node(camera, problem, estimate, inflation)
    within = float(np.clip(phi, unit * PHI_RANGE[0], unit * PHI_RANGE[1]))
    while first is not None and phi != within:
        factor = within / phi
        phi = within if 0.5 <= factor <= 2.0 else phi * float(np.clip(factor, 0.5, 2.0))
        first = _node(camera, problem, _ahead(camera, first, phi), inflation)
    if first is None or least is None or first.cost - least.cost > _FAR:
        raise SolutionError(
            f"camera {camera!r}: the least cost lies at phi {estimate.cameras[camera].phi:.1f} px, which is no lens: "
            "check labels and dimensions, add a prior on height_m or phi, or boards tilted by 20 degrees"
        )
    down = list(_walk(camera, problem, first, -1, inflation))
    up = list(_walk(camera, problem, first, +1, inflation))
    if not (down or up):
        raise SolutionError(
            f"camera {camera!r}: no other phi beside {phi:.1f} px can be solved for, so nothing says how far it is "
            "known: check labels and dimensions, add observations, or a prior on height_m or phi"
        )
    return (*down[::-1], first, *up)


def profile(
    camera: str, nodes: Sequence[Node], estimate: Estimate, half_width: float, stated_sd: Mapping[Key, float]
) -> Mixture:
    """The valley as seen from the estimate.

    Args:
        half_width: standard deviations from the middle to the end of a 95 % interval.
        stated_sd: of numbers that were stated: a node is no nearer, in standard deviations, than any of them has it.
    """
    costs = np.array([node.cost for node in nodes])
    phi = estimate.cameras[camera].phi
    here = float(np.interp(phi, [node.estimate.cameras[camera].phi for node in nodes], costs))
    # Where the valley has a second, lower place, both count: the bound reaches as high over either.
    base = costs.min() if here - costs.min() <= half_width**2 else here
    keys = _keys_of(camera, estimate, nodes[0].information.keys)
    steps = np.array([difference(node.estimate, estimate, keys) for node in nodes])
    stated = (steps / [stated_sd.get(key, np.inf) for key in keys]) ** 2
    rises = np.maximum(costs - base, np.max(stated, axis=1))
    across = [_across(node.information, keys) for node in nodes]
    is_open = bool(rises[0] < half_width**2), bool(rises[-1] < half_width**2)
    return Mixture.along_phi(keys, phi, steps, rises, across, is_open)


def _node(camera: str, problem: Problem, start: Estimate, inflation: float) -> Node | None:
    """The least cost with phi held where the start has it; None where the solver does not get there."""
    try:
        held = problem.holding(camera, 0)
        solution = solve(held, start)
        known = None if solution.failed else information(problem, solution.estimate).shared
    except CalibrationError:  # quiet: a smaller step is tried; a valley without an end stays open
        return None
    if known is None:
        return None
    there = solution.estimate
    stated = sum(prior.cost(there) for prior in held.stated_at(there))
    cost = (2.0 * solution.cost - stated) / inflation + stated + _cost_of_phi(camera, problem, there)
    return Node(there, cost, known)


def _cost_of_phi(camera: str, problem: Problem, estimate: Estimate) -> float:
    """What priors on phi alone add to twice the cost: a solve that holds phi leaves them out."""
    own = [prior for prior in problem.priors if [key[:3] for key in prior.keys] == [("camera", camera, "phi")]]
    return sum(prior.cost(estimate) for prior in own)


def _walk(camera: str, problem: Problem, first: Node, direction: int, inflation: float) -> Iterator[Node]:
    """Nodes on one side, each found from the one before by a step along the valley's slope."""
    unit = unit_px(first.estimate.cameras[camera])
    low, high = (unit * limit for limit in PHI_RANGE)
    node, step = first, _first_step(camera, first)
    lowest = first.cost
    for _ in range(_MOST_NODES):
        phi = node.estimate.cameras[camera].phi
        wanted = float(np.clip(phi * np.exp(direction * step), low, high))
        if node.cost - lowest > _FAR or direction * (wanted - phi) <= 0.0:
            return
        following = _node(camera, problem, _ahead(camera, node, wanted), inflation)
        change = np.inf if following is None else abs(following.cost - node.cost)
        if following is None or (change > _MOST_RISE and node.cost - lowest < _FAR / 2.0 and step > _STEPS[0]):
            step *= 0.5  # too far to find, or to interpolate where the bounds will lie
            if step < 0.5 * _STEPS[0]:
                return
            continue
        step = float(np.clip(step * (1.5 if change < 0.5 * _MOST_RISE else 1.0), *_STEPS))
        node, lowest = following, min(lowest, following.cost)
        yield node


def _first_step(camera: str, node: Node) -> float:
    """Half a standard deviation of log phi by the quadratic picture, within reason."""
    column = _phi_column(camera, node.information.keys)
    sd = float(np.sqrt(max(node.information.inverse[column, column], 0.0))) or np.inf
    return float(np.clip(0.5 * sd / node.estimate.cameras[camera].phi, *_STEPS))


def _ahead(camera: str, node: Node, phi: float) -> Estimate:
    """The estimate with another phi, and everything shared moved along with it as the normal equations say."""
    keys = node.information.keys
    column = _phi_column(camera, keys)
    others = np.delete(np.arange(len(keys)), column)
    step = np.zeros(len(keys))
    step[column] = phi - node.estimate.cameras[camera].phi
    held = node.information.given([keys[i] for i in others])
    step[others] = -held.inverse @ node.information.matrix[others, column] * step[column]
    return moved(node.estimate, keys, step)


def _phi_column(camera: str, keys: tuple[Key, ...]) -> int:
    return next(i for i, key in enumerate(keys) if key[:3] == ("camera", camera, "phi"))


def _keys_of(camera: str, estimate: Estimate, keys: tuple[Key, ...]) -> tuple[Key, ...]:
    """phi, the camera's other numbers, those of its stations."""
    mine = {name for name, station in estimate.stations.items() if station.camera == camera}
    own = [key for key in keys if key.kind == "camera" and key.owner == camera]
    return (*own, *(key for key in keys if key.kind == "station" and key.owner in mine))


def _across(information: Information, keys: tuple[Key, ...]) -> Information:
    """About all of the keys but the first, which is held; what is not among them integrated out."""
    held = information.given([key for key in information.keys if key != keys[0]])
    return held.marginal(keys[1:])
