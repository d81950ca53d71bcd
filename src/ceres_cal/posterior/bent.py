"""Deviations of the cost from a quadratic form: along phi, and at the ends of weak directions.

Views of a flat field from nearly above determine phi by small differences of large numbers, so the least cost is a
long, bent valley that no ellipse describes (the profile likelihood). The valley is followed step by step; at each node
the other numbers have a covariance of their own. Together the nodes bound any number or mapped point that depends on
both: exactly along the valley, by the quadratic model across it.

A direction that is known to a few hundredths of its natural size reaches so far that the least cost along it is a
curve: one board in front of a lens with tangential terms fits nearly as well with the principal point a quarter of the
image aside and all coefficients changed accordingly. At both ends of each such direction the other numbers are solved
for again; the results make the posterior a mixture of components along curves through these ends. Nothing is solved
where all directions are well known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ceres_cal.base import NORMAL_95, Array, Frozen, SolutionError, eigh, or_none, replace
from ceres_cal.kernels import normal_cdf
from ceres_cal.posterior.mixture import Mixture
from ceres_cal.problem import Estimate, GaussianPrior, Information, Key, Problem, Solution, over, solve, unit_px
from ceres_cal.problem.quantities import PHI_RANGE, difference, moved, natural_sizes
from ceres_cal.problem.reduced import information
from ceres_cal.robust.other_minima import FEW, solved_soon

# Rise of twice the cost beyond which the valley is not followed: three sigma, or well beyond the 95 % bound where few
# degrees of freedom put that farther out. Nothing changes from half to double.
_FAR = 9.0
_STEPS = (0.02, 0.35)  # smallest and largest step of log phi


class Node(Frozen):
    """One point of the valley: the minimum with phi held.

    Attributes:
        cost: twice the least cost there: that of the observations divided by the factor on their variance, plus that of
            the priors, including those on phi.
        information: about all shared numbers, including phi, although it was held.
    """

    estimate: Estimate
    cost: float
    information: Information


def valley(
    camera: str, problem: Problem, estimate: Estimate, inflation: float = 1.0, half_width: float = NORMAL_95
) -> tuple[Node, ...]:
    """Follow the valley from the estimate in both directions, until the cost has risen far or phi leaves the range of
    lenses.

    Args:
        half_width: standard deviations from the middle to the end of a 95 % interval.
        inflation: factor on the variance of the observations along it: their cost is divided by it.

    Raises:
        SolutionError: the solve does not converge at the estimate, or does not lead from there to a lens that fits.
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
            f"camera {camera!r}: the lowest cost is at phi {estimate.cameras[camera].phi:.1f} px, which is impossible: "
            "check labels and dimensions, add a prior on height_m or phi, or boards tilted by 20 degrees"
        )
    far = max(_FAR, 2.0 * half_width**2)
    down, up = (list(_walk(camera, problem, first, direction, inflation, far)) for direction in (-1, +1))
    if not (down or up):
        raise SolutionError(
            f"camera {camera!r}: the solve fails at every phi other than {phi:.1f} px, so its uncertainty is "
            "unknown: check labels and dimensions, add observations, or a prior on height_m or phi"
        )
    return (*down[::-1], first, *up)


def profile(
    camera: str, nodes: Sequence[Node], estimate: Estimate, half_width: float, stated_sd: Mapping[Key, float]
) -> Mixture:
    """Return the valley relative to the estimate.

    Args:
        half_width: standard deviations from the middle to the end of a 95 % interval.
        stated_sd: of stated numbers: the distance of a node in standard deviations is at least that of each of them.
    """
    costs = np.array([node.cost for node in nodes])
    phi = estimate.cameras[camera].phi
    here = float(np.interp(phi, [node.estimate.cameras[camera].phi for node in nodes], costs))
    # Where the valley has a second, lower minimum within the bound, both count: rises are relative to the lower one.
    base = costs.min() if here - costs.min() <= half_width**2 else here
    keys = _keys_of(camera, estimate, nodes[0].information.keys)
    steps = np.array([difference(node.estimate, estimate, keys) for node in nodes])
    stated = (steps / [stated_sd.get(key, np.inf) for key in keys]) ** 2
    rises = np.maximum(costs - base, np.max(stated, axis=1))
    across = [_across(node.information, keys) for node in nodes]
    is_open = bool(rises[0] < half_width**2), bool(rises[-1] < half_width**2)
    return Mixture.along_phi(keys, phi, steps, rises, across, is_open)


@or_none  # quiet: a smaller step is tried; a valley without an end stays open
def _node(camera: str, problem: Problem, start: Estimate, inflation: float) -> Node | None:
    """Return the minimum with phi held at its value in the start; None where the solver does not converge."""
    held = problem.holding(camera, 0)
    solution = solve(held, start)
    if solution.failed:
        return None
    there = solution.estimate
    known = information(problem, there).shared
    # A solve that holds phi omits the priors on phi.
    of_held, stated = (sum(prior.cost(there) for prior in one.stated_at(there)) for one in (held, problem))
    return Node(there, (2.0 * solution.cost - of_held) / inflation + stated, known)


def _walk(camera: str, problem: Problem, first: Node, direction: int, inflation: float, far: float) -> Iterator[Node]:
    """Yield nodes on one side up to a rise; each is found from the one before by a step along the valley's slope."""
    most_nodes = 60
    most_rise = 1.5  # of the cost, from one node to the next
    unit = unit_px(first.estimate.cameras[camera])
    low, high = (unit * limit for limit in PHI_RANGE)
    node, step = first, _first_step(camera, first)
    lowest = first.cost
    for _ in range(most_nodes):
        phi = node.estimate.cameras[camera].phi
        wanted = float(np.clip(phi * np.exp(direction * step), low, high))
        if node.cost - lowest > far or direction * (wanted - phi) <= 0.0:
            return
        following = _node(camera, problem, _ahead(camera, node, wanted), inflation)
        change = np.inf if following is None else abs(following.cost - node.cost)
        if following is None or (change > most_rise and node.cost - lowest < far / 2.0 and step > _STEPS[0]):
            step *= 0.5  # too far to converge, or to interpolate the bounds
            if step < 0.5 * _STEPS[0]:
                return
            continue
        step = float(np.clip(step * (1.5 if change < 0.5 * most_rise else 1.0), *_STEPS))
        node, lowest = following, min(lowest, following.cost)
        yield node


def _first_step(camera: str, node: Node) -> float:
    """Return half a standard deviation of log phi by the quadratic model, within the limits of a step."""
    column = _phi_column(camera, node.information.keys)
    sd = float(np.sqrt(max(node.information.inverse[column, column], 0.0))) or np.inf
    return float(np.clip(0.5 * sd / node.estimate.cameras[camera].phi, *_STEPS))


def _ahead(camera: str, node: Node, phi: float) -> Estimate:
    """Return the estimate with another phi, and all shared numbers moved along as the normal equations predict."""
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
    """Return the keys of phi, of the camera's other numbers, and of its stations."""
    mine = {name for name, station in estimate.stations.items() if station.camera == camera}
    own = [key for key in keys if key.kind == "camera" and key.owner == camera]
    return (*own, *(key for key in keys if key.kind == "station" and key.owner in mine))


def _across(information: Information, keys: tuple[Key, ...]) -> Information:
    """Return information about all keys but the first, which is held; numbers that are not keys are integrated out."""
    held = information.given([key for key in information.keys if key != keys[0]])
    return held.marginal(keys[1:])


# Standard deviation in natural sizes above which a direction is examined.
BENDING = 0.01
_HELD = 0.005  # of a step: standard deviation with which its end is held
_FARTHEST = 4.0  # factor on the distance by normal equations: what is flatter than that is unknown


class Ends(Frozen):
    """The numbers at the ends of weak directions.

    Attributes:
        keys: (K). steps: (2 B, K) to the ends of the 95 % interval along each of B directions by the quadratic model,
            upper ends first. ends: (2 B, K) to where the least cost has risen as much.
        half_width: length of a step in standard deviations. information: of the quadratic model.
        others: minima that were found from starts far out, with their cost above the least.
    """

    keys: tuple[Key, ...]
    steps: Array
    ends: Array
    half_width: float
    information: Information
    others: tuple[Solution, ...] = ()

    @property
    def excesses(self) -> Array:
        """(2 B, K) ends minus steps, per standard deviation; each end counts half of its direction's variance."""
        return np.asarray((self.ends - self.steps) / (self.half_width * np.sqrt(2.0)))

    def beside(self, stated: Information) -> Ends:
        """Return a copy whose ends are no farther out than the statements allow."""
        if not np.any(stated.matrix):
            return self
        excesses = self.information.beside(stated, self.excesses)
        return replace(self, ends=self.steps + self.half_width * np.sqrt(2.0) * excesses)

    def mixture(self, information: Information) -> Mixture:
        """Return components along the curves through the ends, along all directions at once. Half of them mirror the
        others; together they are as wide as the directions, minus the width of each component itself.

        Args:
            information: about all shared numbers.
        """
        within = 0.25  # share of a weak direction's variance that each component along its curve has by itself
        up, down = np.split(self.ends / self.half_width, 2)
        linear, square = 0.5 * (up - down), 0.5 * (up + down) / self.half_width
        along = np.sqrt(1.0 - within) * _drawn(len(up))
        along = along[np.argsort(np.linalg.norm(along, axis=1), kind="stable")]
        keys, steps = information.keys, over(along @ linear + along**2 @ square, self.keys, information.keys)
        rows = np.split(self.steps / self.half_width, 2)[0] @ self.information.matrix
        rows = over(rows, self.keys, keys)
        known = Information(keys, information.matrix + (1.0 / within - 1.0) * rows.T @ rows)
        every = np.zeros(len(steps), dtype=np.int64)
        return Mixture(keys, np.full(len(steps), 1.0 / len(steps)), steps, (known,), every)


def _drawn(count: int) -> Array:
    """(2 H, count) normal variables, uncorrelated and of unit variance: H draws and their mirror images."""
    least_pairs = 12  # of components
    half = max(least_pairs, 2 * count)
    grid = np.linspace(0.0, 4.0, 401)
    each = np.interp((np.arange(half) + 0.5) / half, 2.0 * normal_cdf(grid) - 1.0, grid)
    rng = np.random.default_rng(0)
    drawn = np.column_stack([rng.permutation(each) * rng.choice((-1.0, 1.0), half) for _ in range(count)])
    values, vectors = eigh(drawn.T @ drawn / half)
    drawn = drawn @ (vectors / np.sqrt(values)) @ vectors.T
    return np.asarray(np.concatenate([drawn, -drawn]))


def weak_axes(information: Information, estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(K, A) directions of some of the keys whose standard deviation in natural sizes is above BENDING; each is one
    standard deviation long, in the units of the keys.

    Not included are structure and placements, which follow the others, numbers that are unknown, and a lens without a
    formula, which is a sum of the effects of its numbers.
    """
    sizes, at = natural_sizes(estimate, keys), information.columns(keys)
    sums = {(name, q) for name, one in estimate.cameras.items() for form in one.lens.roughness for q in form.names}
    plain = np.array([key.kind in ("camera", "station") and key[1:3] not in sums for key in keys], dtype=bool)
    scaled = information.spread.covariance[np.ix_(at, at)] / sizes[:, None] / sizes
    values, vectors = eigh(np.where(plain[:, None] & plain, scaled, 0.0))
    weak = values > BENDING**2
    return np.asarray(vectors[:, weak] * np.sqrt(values[weak]) * sizes[:, None])


def ends_of(
    problem: Problem, estimate: Estimate, information: Information, by_model: Information, half_width: float
) -> Ends | None:
    """Return where the numbers are at the ends of the weak directions of their information and, for few observations,
    other minima that fit as well; None where there is no weak direction.

    Args:
        problem: its cost is least at the estimate. information: with the scatter of the data. by_model: by that cost.
    """
    far_out = 3.0  # times the end of the 95 % interval: start of a search for another minimum
    keys, sizes = information.keys, natural_sizes(estimate, information.keys)
    axes = weak_axes(information, estimate, keys)
    if not axes.shape[1]:
        return None
    few, others = problem.sights.equations < FEW, list[Solution]()
    parts = [_part_along(problem, estimate, keys, axis / sizes) for axis in axes.T]
    costs = {id(part): 2.0 * solve(part, estimate).cost for part in parts}
    steps, excesses = [], []
    for sign in (half_width, -half_width):
        for part, axis in zip(parts, axes.T, strict=True):
            least = costs[id(part)]
            slopes = axis / sizes**2 / float(np.sum((axis / sizes) ** 2))
            # The cost rises by the model's information, which is larger than that with the scatter of the data.
            rise = half_width**2 / float(slopes @ by_model.spread.covariance @ slopes)
            along, step = sign * axis, sign * (information.spread.covariance @ slopes) / sizes
            end = _end(part, estimate, keys, along)
            found = [_excess(end, step, least, rise)]
            far = _end(part, estimate, keys, far_out * along) if few else None
            if far is not None:
                if (other := solved_soon(part, far.estimate)) is not None:
                    others.append(replace(other, cost=other.cost - 0.5 * least))
                # Where the cost rises ever more slowly, the interval ends between; a far end alone decides nothing.
                nearer = far_out * _reach(far, least, rise)
                if nearer > 1.0:
                    found.append(_excess(_end(part, estimate, keys, nearer * along), step, least, rise, nearer))
            steps.append(step)
            excesses.append(max(found, key=lambda one: float(np.linalg.norm(np.clip(one, -1.0, 1.0)))))
    reached = np.array(steps)
    return Ends(keys, reached * sizes, (reached + excesses) * sizes, half_width, information, tuple(others))


def _part_along(problem: Problem, estimate: Estimate, keys: Sequence[Key], axis: Array) -> Problem:
    """Return the part of a problem that moves along an axis (K,), in natural sizes; all of it where cameras move that
    depend on one another.
    """
    alone = 0.01  # share of other cameras in an axis: they have some scatter in common, but no curvature
    most = keys[int(np.argmax(np.abs(axis)))]
    camera = most.owner if most.kind == "camera" else estimate.stations[most.owner].camera
    part = problem.about(camera, estimate)
    free = {("camera", name) for name, numbers in part.layout.free.items() if len(numbers)}
    free |= {("station", name) for name in part.layout.stations}
    others = axis[[key[:2] not in free for key in keys]]
    return part if float(others @ others) < alone * float(axis @ axis) else problem


class _End(Frozen):
    """The end of a direction: the numbers (K,) relative to the estimate, in natural sizes, and twice the cost."""

    estimate: Estimate
    off: Array
    cost: float


@or_none  # quiet: no camera there; the end counts as far away as any
def _end(problem: Problem, estimate: Estimate, keys: tuple[Key, ...], step: Array) -> _End | None:
    """Return the minimum where the numbers' part along a step is as long as the step; None where it is not found."""
    sizes = natural_sizes(estimate, keys)
    row = step / sizes**2 / float(np.sum((step / sizes) ** 2)) / _HELD
    along = np.flatnonzero(row)
    own = tuple(keys[column] for column in along)
    held = GaussianPrior.about(Information(own, np.outer(row[along], row[along])), moved(estimate, keys, step))
    solution = solved_soon(replace(problem, priors=(*problem.priors, held)), estimate)
    if solution is None:
        return None
    pulled = float(np.sum(held.residuals(solution.estimate) ** 2))
    off = difference(solution.estimate, estimate, keys) / sizes
    return _End(solution.estimate, off, 2.0 * solution.cost - pulled)


def _reach(end: _End, least: float, rise: float) -> float:
    """Return the factor on the distance of an end at which the cost has the required rise, if it is a parabola."""
    return float(np.clip(np.sqrt(rise / max(end.cost - least, 1e-12)), 1.0 / _FARTHEST, _FARTHEST))


def _excess(end: _End | None, step: Array, least: float, rise: float, factor: float = 1.0) -> Array:
    """(K,) in natural sizes: where the cost has risen as required along one step, by an end that is `factor` steps
    away, minus the step.
    """
    if end is None:
        return (_FARTHEST - 1.0) * step if factor == 1.0 else np.zeros(len(step))
    excess = end.off * _reach(end, least, rise) - step
    along = step / np.linalg.norm(step)
    return np.asarray(excess - min(float(along @ excess), 0.0) * along)  # an end that is nearer narrows nothing
