"""What phi could be: the cost along it, everything else at its best (the profile likelihood).

The views of a flat field from nearly above tell phi by the small differences of large numbers, so the least cost has a
long, bent valley that no ellipse describes. The valley is followed step by step; at each of its places the other
numbers have a covariance of their own. Together they bound any number or mapped point that depends on both: along the
valley exactly, across it by the quadratic picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, SolutionError
from ceres_cal.base.spread import known_inverses, without
from ceres_cal.model.parameters import Estimate, Layout, Options, unit_px
from ceres_cal.model.quantities import Key, difference, moved, sigma_limits
from ceres_cal.observations.sights import Sights
from ceres_cal.solve import Information, Weighting, information, solve
from ceres_cal.start.initialise import PHI_RANGE

_FAR = 9.0  # rise of twice the cost at which the valley is followed no further: three sigma
_STEPS = (0.02, 0.35)  # of log phi
_MOST_RISE = 1.5  # from one place to the next
_MOST_NODES = 60
_FINE = 16  # places interpolated between two
_TWICE = (np.log(2.0), np.log(4.0))
_SETTLED = 1.0  # standard deviation across: what changes by less over the last factor two of phi is bounded by the data
_SHRINKING = 0.75  # ratio of two changes over a factor two each: 1/2 of what goes with phi towards 0


@dataclass(frozen=True, eq=False)
class Setting:
    """The last solve of a calibration, to be taken up again; `places` are the feet of the curve observations."""

    sights: Sights
    layout: Layout
    weighting: Weighting
    options: Options
    places: Array | None = None

    def holding_phi(self, camera: str) -> Setting:
        """The same with phi of a camera held."""
        free = {**self.layout.free, camera: self.layout.free[camera][self.layout.free[camera] != 0]}
        return replace(self, layout=replace(self.layout, free=free))

    def solved(self, estimate: Estimate) -> tuple[Estimate, float] | None:
        """The least cost from there, doubled, and where it is; None where the solver does not get there."""
        try:
            solution = solve(self.sights, estimate, self.layout, self.weighting, self.options, places=self.places)
        except CalibrationError:
            return None
        return None if solution.failed else (solution.estimate, 2.0 * solution.cost)

    def told(self, estimate: Estimate) -> Information:
        """What the observations say there."""
        return information(self.sights, estimate, self.layout, self.weighting, self.places)


@dataclass(frozen=True, eq=False)
class Node:
    """One place of the valley: phi held, everything else at its best."""

    estimate: Estimate
    cost: float
    told: Information
    """With phi among its keys, though it was held."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The valley of least cost along phi of one camera.

    Attributes:
        camera: whose phi. keys: (K) phi first, then the camera's other numbers and those of its stations.
        phi_px: where the estimate has it.
        steps: (N, K) from the estimate to each place, in the order of phi. rises: (N,) of twice the cost, from the
            lowest place.
        information: (N, K - 1, K - 1) about all but phi, there, every other number integrated out.
        open_below, open_above: the rise stays within the 95 % bound as far as PHI_RANGE goes.
    """

    camera: str
    keys: tuple[Key, ...]
    phi_px: float
    steps: Array
    rises: Array
    information: Array
    open_below: bool = False
    open_above: bool = False

    @property
    def phi(self) -> Array:
        """(N,) px."""
        return np.asarray(self.phi_px + self.steps[:, 0])

    def reaches(self, half_width: float) -> tuple[Array, Array]:
        """Fine steps along the valley within the 95 % bound: weights (M, N) that interpolate what is known at the N
        places, and how many standard deviations across the valley each leaves, (M,).
        """
        phi, root = self.steps[:, 0], np.sqrt(self.rises)
        fine = np.concatenate([np.linspace(a, b, _FINE, endpoint=False) for a, b in pairwise(phi)])
        fine = np.append(fine, phi[-1])
        weights = np.array([np.interp(fine, phi, row) for row in np.eye(len(phi))]).T
        left = half_width**2 - (weights @ root) ** 2
        inside = left >= 0.0
        return weights[inside], np.sqrt(left[inside])

    def bounds(self, values: Array, sds: Array, half_width: float) -> tuple[Array, Array]:
        """95 % bounds (m,) below and above of numbers that are `values` (N, m) along the valley, with standard
        deviations `sds` (N, m) across it; infinite on a side where the valley is open and they grow on.
        """
        weights, widths = self.reaches(half_width)
        known = np.isfinite(sds)
        spread = widths[:, None] * (weights @ np.where(known, sds, 0.0))
        spread[weights @ ~known > 0.0] = np.inf  # no 0 times infinity
        middle = weights @ values
        low, high = np.min(middle - spread, axis=0), np.max(middle + spread, axis=0)
        for is_open, end in ((self.open_below, 0), (self.open_above, -1)):
            if is_open:
                limit = self._limit(values, sds[end], end)
                low = np.minimum(low, limit - widths[end] * sds[end])
                high = np.maximum(high, limit + widths[end] * sds[end])
        return low, high

    def _limit(self, values: Array, sds: Array, end: int) -> Array:
        """(m,) where numbers go beyond an open end: on by a geometric series, each term for another factor two of phi,
        to infinity where the last two terms do not shrink.
        """
        away = np.abs(np.log(self.phi / self.phi[end]))
        order = np.argsort(away)
        halves = [np.array([np.interp(d, away[order], column[order]) for column in values.T]) for d in _TWICE]
        last, before = values[end] - halves[0], halves[0] - halves[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(last / before)
            limit = values[end] + last * ratio / (1.0 - ratio)
        going = np.where(np.abs(last) > _SETTLED * sds, np.copysign(np.inf, last), values[end] + last)
        return np.asarray(np.where(ratio < _SHRINKING, limit, going))


def valley(camera: str, setting: Setting, estimate: Estimate) -> tuple[Node, ...]:
    """Follow the valley from the estimate both ways, until it is three sigma up or phi is no lens any more.

    Raises:
        SolutionError: the solve does not find back to where it ended.
    """
    held = setting.holding_phi(camera)
    unit, phi = unit_px(estimate.cameras[camera]), estimate.cameras[camera].phi
    first = _node(camera, held, setting, estimate)
    within = float(np.clip(phi, unit * PHI_RANGE[0], unit * PHI_RANGE[1]))
    while first is not None and phi != within:
        factor = within / phi
        phi = within if 0.5 <= factor <= 2.0 else phi * float(np.clip(factor, 0.5, 2.0))
        first = _node(camera, held, setting, _ahead(camera, first, phi))
    if first is None:
        raise SolutionError(
            f"camera {camera!r}: the least cost lies at phi {estimate.cameras[camera].phi:.1f} px, which is no lens: "
            "check labels and dimensions, add a prior on height_m or phi, or boards tilted by 20 degrees"
        )
    down = list(_walk(camera, held, setting, first, -1))
    up = list(_walk(camera, held, setting, first, +1))
    return (*down[::-1], first, *up)


def profile(camera: str, nodes: Sequence[Node], estimate: Estimate, half_width: float) -> Profile:
    """The valley as seen from the estimate.

    Args:
        half_width: standard deviations from the middle to the end of a 95 % interval.
    """
    costs = np.array([node.cost for node in nodes])
    rises = costs - costs.min()
    keys = _keys_of(camera, estimate, nodes[0].told.keys)
    return Profile(
        camera,
        keys,
        estimate.cameras[camera].phi,
        np.array([difference(node.estimate, estimate, keys) for node in nodes]),
        rises,
        np.array([_others(node.told, keys) for node in nodes]),
        bool(rises[0] < half_width**2),
        bool(rises[-1] < half_width**2),
    )


def _node(camera: str, held: Setting, setting: Setting, start: Estimate) -> Node | None:
    found = held.solved(start)
    if found is None:
        return None
    estimate, cost = found
    return Node(estimate, cost + _of_prior(camera, setting, estimate), setting.told(estimate))


def _of_prior(camera: str, setting: Setting, estimate: Estimate) -> float:
    """What priors on phi itself add to twice the cost: a solve that holds phi leaves them out."""
    priors = [p for p in setting.layout.priors if (p.owner, p.name, p.quantity) == ("camera", camera, "phi")]
    return float(sum(((estimate.cameras[camera].phi - p.value[0]) / p.sigma[0]) ** 2 for p in priors))


def _walk(camera: str, held: Setting, setting: Setting, first: Node, direction: int) -> Iterator[Node]:
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
        found = _node(camera, held, setting, _ahead(camera, node, wanted))
        change = np.inf if found is None else abs(found.cost - node.cost)
        if found is None or (change > _MOST_RISE and node.cost - lowest < _FAR / 2.0 and step > _STEPS[0]):
            step *= 0.5  # too far to find, or to interpolate where the bounds will lie
            if step < 0.5 * _STEPS[0]:
                return
            continue
        step = float(np.clip(step * (1.5 if change < 0.5 * _MOST_RISE else 1.0), *_STEPS))
        node, lowest = found, min(lowest, found.cost)
        yield node


def _first_step(camera: str, node: Node) -> float:
    """Half a standard deviation of log phi by the quadratic picture, within reason."""
    place = _phi_place(camera, node.told.keys)
    inverse = known_inverses(node.told.matrix, sigma_limits(node.told.keys))
    sd = float(np.sqrt(inverse[place, place])) or np.inf
    return float(np.clip(0.5 * sd / node.estimate.cameras[camera].phi, *_STEPS))


def _ahead(camera: str, node: Node, phi: float) -> Estimate:
    """The estimate with another phi, and everything shared moved along with it as the normal equations say."""
    keys, matrix = node.told.keys, node.told.matrix
    place = _phi_place(camera, keys)
    others = np.delete(np.arange(len(keys)), place)
    step = np.zeros(len(keys))
    step[place] = phi - node.estimate.cameras[camera].phi
    inverse = known_inverses(matrix[np.ix_(others, others)], sigma_limits([keys[i] for i in others]))
    step[others] = -inverse @ matrix[others, place] * step[place]
    return moved(node.estimate, keys, step)


def _phi_place(camera: str, keys: tuple[Key, ...]) -> int:
    return next(i for i, key in enumerate(keys) if key[:3] == ("camera", camera, "phi"))


def _keys_of(camera: str, estimate: Estimate, keys: tuple[Key, ...]) -> tuple[Key, ...]:
    """phi, the camera's other numbers, those of its stations."""
    mine = {name for name, station in estimate.stations.items() if station.camera == camera}
    own = [key for key in keys if key.kind == "camera" and key.owner == camera]
    return (*own, *(key for key in keys if key.kind == "station" and key.owner in mine))


def _others(told: Information, keys: tuple[Key, ...]) -> Array:
    """Information about all of the keys but the first, which is held; what is not among them integrated out."""
    at = np.array([told.keys.index(key) for key in keys])
    rest = np.setdiff1d(np.arange(len(told.keys)), at)
    here = told.matrix[np.ix_(at[1:], at[1:])]
    if not len(rest):
        return np.asarray(here)
    limits = sigma_limits([told.keys[i] for i in rest])
    return without(here, told.matrix[np.ix_(rest, at[1:])], told.matrix[np.ix_(rest, rest)], limits)
