"""Other lenses that predict as well as the chosen one, and by how much the chosen one is too smooth.

Where lenses agree, the data determine the result; at the rim and between lines they do not, and what the chosen lens
shows there is its own. So the other lenses are components of the posterior, and maps include what they show, also where
nothing was observed. The chosen lens's numbers follow each of them as closely as they can, by least squares over places
on the floor and above it, or over rays of a camera that sees no floor.

What a too smooth lens leaves displaces an image in the same way in all views: no number of views reduces it. Errors
that are correlated within a sight only, as from a bent board or a blurred frame, are not the lens's. So it is tested
first whether sums of residuals over cells of the image agree between sights, by products of different sights. Bumps
along the radius and over the image are columns X beside the free numbers; their coefficients have the standard
deviation tau (px). With P the projection onto what the free numbers leave, the residuals r give u = X^T P r, and

    Cov u = kappa V + tau^2 V V,    V = X^T P X,

with kappa for errors correlated within a view. The restricted likelihood of tau, for each kind of bumps, estimates how
rough the lens is. The free numbers are off by what they absorb of the bumps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from ceres_cal.base import HEIGHTS_M, Array, Frozen, Indices, Mask, Pose, cached_property, grid_places
from ceres_cal.effects import Linearised, equation_weights, likeliest_sizes, linearise_within, shifts_by
from ceres_cal.effects.evidence import agreement as agreement_of
from ceres_cal.observations.sights import Sights
from ceres_cal.posterior.maps import Functional, Picture, located_by, shown_by
from ceres_cal.problem import Estimate, Information, Key, difference, natural_sizes
from ceres_cal.problem.residuals import Equations, Residuals, equations_of
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.scene.camera import Camera

_PLACES = 12  # grid points along each side of the picture
# Weights at HEIGHTS_M. Above the floor phi matters, and the quadratic model is inaccurate: full weight there spoils the
# floor; with none, one map in ten was 2.5 standard deviations off.
_PARTS = (1.0, 0.1)


class OtherLenses(Frozen):
    """Other lenses than the chosen one, solved for from the same observations.

    Attributes:
        near: estimate with the chosen lens. others: with other lenses. weights: of the others, probabilities or less.
        reach_px: camera -> distance from its principal point that observations reach: nothing is compared farther out.
        failed: why nothing could be compared, else "". known: information about the numbers of each of the others.
    """

    near: Estimate
    others: tuple[Estimate, ...]
    weights: tuple[float, ...]
    reach_px: Mapping[str, float]
    failed: str = ""
    known: tuple[Information, ...] = ()

    @cached_property
    def pixels(self) -> dict[str, Array]:
        """Camera -> (N, 2) pixels of a grid over its image, as far as it was observed."""
        return {name: _places_of(self.near.cameras[name], reach) for name, reach in self.reach_px.items()}


class OpenDirection(NamedTuple):
    """The variation of numbers (K) with one number of a camera, by one standard deviation of that number."""

    along: Key
    keys: tuple[Key, ...]
    step: Array


class LensSpread(Frozen):
    """The covariance of numbers with one lens.

    Attributes:
        there: with the lens. keys: (K) the numbers. root: (K, R) a root of their covariance. slopes: see
            `shown_slopes`.
    """

    there: Estimate
    keys: tuple[Key, ...]
    root: Array
    slopes: Sequence[Array]

    def beyond(self, chosen: LensSpread, probability: float) -> Sequence[OpenDirection]:
        """Return the directions that this lens leaves open and the chosen one does not, along one number of a camera
        after the other, as far as they change what pixels show at a height, where they were observed or farther out.

        From straight above only the form of the lens determines phi. Over a floor one coefficient gave it to 0.4 %, 16
        standard deviations off at robot height; three, which predicted as well, to 10 %. In a cropped picture's corner
        two gave a place to 10 mm, 60 mm off; four, which predicted better, to 36 mm.

        Args:
            probability: of this lens.
        """
        least = 0.25  # of all variance with the chosen lens: a direction with more is worth two more components
        columns = [i for i, key in enumerate(self.keys) if key.kind == "camera" and np.any(self.root[i])]
        found, root, tiny = list[OpenDirection](), self.root, np.finfo(float).tiny
        of_chosen, own = self._shown_beside(chosen)
        while columns and len(found) < len(columns):
            axes = root[columns].T / np.maximum(np.linalg.norm(root[columns], axis=1), tiny)
            seen = own @ axes
            squares = np.maximum(np.sum(seen**2, axis=0), tiny)
            excess = squares - np.sum((of_chosen.T @ seen) ** 2, axis=0) / squares
            best = int(np.argmax(excess))
            if not probability * excess[best] > least:
                break
            share, axis = excess[best] / squares[best], axes[:, best]
            found.append(self._along(self.keys[columns[best]], share**0.5 * root @ axis))
            left = np.eye(len(axis)) - (1.0 - (1.0 - share) ** 0.5) * np.outer(axis, axis)
            root, own = root @ left, own @ left
        return found

    def _shown_beside(self, chosen: LensSpread) -> tuple[Array, Array]:
        """(N, R), (N, Q) how what pixels show varies with the chosen lens and with this one, at each height and part of
        the picture relative to all its variation with the chosen one.
        """
        each = [(np.empty((0, chosen.root.shape[1])), np.empty((0, self.root.shape[1])))]
        for of_chosen, own in zip(chosen.shown, self.shown, strict=True):
            known = np.isfinite(of_chosen).all(axis=1) & np.isfinite(own).all(axis=1)
            size = np.linalg.norm(of_chosen[known])
            if size > 0.0:
                each.append((of_chosen[known] / size, own[known] / size))
        of_chosen, own = (np.concatenate(part) for part in zip(*each, strict=True))
        return of_chosen, own

    @property
    def shown(self) -> Sequence[Array]:
        """(N, R) for each of the slopes: how what pixels show varies."""
        return [slopes @ self.root for slopes in self.slopes]

    def _along(self, along: Key, step: Array) -> OpenDirection:
        """Return the direction, shortened such that phi changes by at most half of itself."""
        most, moving = 0.5, [i for i, value in enumerate(step) if value]
        phi = [(i, self.there.cameras[key.owner].phi) for i, key in enumerate(self.keys) if key.quantity == "phi"]
        far = max((abs(float(step[i])) / size for i, size in phi), default=0.0)
        return OpenDirection(along, tuple(self.keys[i] for i in moving), step[moving] * min(1.0, most / max(far, most)))


def shown_slopes(there: Estimate, keys: Sequence[Key], lenses: OtherLenses) -> Sequence[Array]:
    """Return (N, K) derivatives of what pixels show by numbers of an estimate, for each height, where they were
    observed and farther out; they are the same for all lenses of a kind.

    Args:
        lenses: with the pixels in question; it needs no other lenses yet.
    """
    near, found = lenses.near, list[Array]()
    for name, reach_px in lenses.reach_px.items():
        places = _places_of(near.cameras[name])
        is_within = np.repeat(_distance_px(near.cameras[name], places) <= reach_px, 2)
        for _, one in _shown(keys, near, {name: places}):
            slopes = one.slopes(there, keys).reshape(-1, len(keys))
            found += [slopes[is_within], slopes[~is_within]]
    return found


def together(each: Sequence[OtherLenses], floors: Set[str], end: Estimate) -> OtherLenses:
    """Combine other lenses of several cameras, each with its probabilities, into about as many combinations as there
    are lenses: for each camera the others and then the chosen one divide the interval from 0 to 1 by their
    probabilities, and lenses that share a part of the interval are a combination.

    Args:
        floors: stations that see the floor. end: poses of the others, which one camera does not determine.
    """
    if len(each) == 1:
        return each[0]
    bounds = [np.cumsum(counted(one.weights)) for one in each]
    cuts = np.unique(np.concatenate([np.zeros(1), *bounds]))

    def combined(parts: Sequence[Estimate]) -> Estimate:
        cameras = {name: camera for one in parts for name, camera in one.cameras.items()}
        seen = {name: station for one in parts for name, station in one.stations.items() if name in floors}
        own = [one.structure for one in parts if floors & {*one.stations}] or [parts[0].structure]
        built = own[0].with_values(np.mean([one.values for one in own], axis=0))
        return Estimate(cameras, {**end.stations, **seen}, {}, built)

    which = np.array([np.searchsorted(own, cuts[:-1], side="right") for own in bounds])
    nothing = Information.nothing()
    return OtherLenses(
        combined([one.near for one in each]),
        tuple(combined([[*one.others, one.near][i] for one, i in zip(each, at, strict=True)]) for at in which.T),
        tuple(np.diff(cuts).tolist()),
        {name: reach_px for one in each for name, reach_px in one.reach_px.items()},
        "; ".join(filter(None, (one.failed for one in each))),
        tuple(nothing.beside_all([*one.known, nothing][i] for one, i in zip(each, at, strict=True)) for at in which.T),
    )


def _places_of(camera: Camera, reach_px: float = np.inf) -> Array:
    """(N, 2) px of a grid over a camera's image, up to this distance from its principal point."""
    x, y = (np.linspace(0.0, side - 1.0, _PLACES) for side in camera.image_size)
    places = grid_places(x, y)
    return np.asarray(places[_distance_px(camera, places) <= reach_px])


def _distance_px(camera: Camera, places: Array) -> Array:
    return np.asarray(np.linalg.norm(places - camera.principal_point, axis=1))


def counted(weights: Sequence[float]) -> Array:
    """(L,) probabilities of other lenses, reduced such that some is left for the chosen one."""
    most, each = 0.8, np.asarray(weights, dtype=float)  # upper limit of their sum
    return np.asarray(each / max(1.0, float(each.sum()) / most))


def shifts_to_lenses(lenses: OtherLenses, keys: Sequence[Key], nodes: Sequence[Estimate]) -> Array:
    """(M, L, K) shifts of the numbers of M estimates that follow each of the other lenses; each has its own dimensions.

    Args:
        nodes: with the chosen lens, at its minimum or elsewhere in a valley along phi.
    """
    followed = 1e-4  # of the largest singular value: numbers do not move along weaker directions
    shown, found = list(_shown(keys, lenses.near, lenses.pixels)), np.zeros((len(nodes), len(lenses.others), len(keys)))
    if not shown:
        return found
    near, *others = (
        np.concatenate([weight * one.values(lens).ravel() for weight, one in shown])
        for lens in (lenses.near, *lenses.others)
    )
    for number, there in enumerate(nodes):
        slopes, sizes = _slopes_of(shown, keys, there), natural_sizes(there, keys)
        for column, other in enumerate(others):
            off = other - near
            known = np.isfinite(slopes).all(axis=1) & np.isfinite(off)
            found[number, column] = np.linalg.lstsq(slopes[known] * sizes, off[known], rcond=followed)[0] * sizes
    if own := [number for number, key in enumerate(keys) if key.kind == "dimension"]:
        found[:, :, own] = [difference(other, lenses.near, [keys[i] for i in own]) for other in lenses.others]
    return found


def shifts_along(
    camera: str, here: Estimate, known: Information, shifts: Array, nodes: Sequence[tuple[Estimate, Information]]
) -> Array:
    """(M, S, K) shifts of the numbers of M estimates, each with its information, that show on the floor what shifts (S,
    K) of one estimate show, with places weighted by their accuracy; numbers that no place shows are not shifted.
    """
    loosely = 0.1  # weight of a node's information: shifts of ten sigmas that no place shows cost as one sigma
    shown = list(_shown(known.keys, here, {camera: _places_of(here.cameras[camera])}))
    slopes, found = _slopes_of(shown, known.keys, here), np.zeros((len(nodes), *shifts.shape))
    squares = np.sum((slopes @ known.spread.covariance) * slopes, axis=1).reshape(-1, 2).sum(axis=1)
    sigma = np.sqrt(np.repeat(squares, 2))[:, None]
    for number, (there, own) in enumerate(nodes):
        rows = np.hstack([_slopes_of(shown, known.keys, there), slopes @ shifts.T]) / sigma
        rows = rows[np.isfinite(rows).all(axis=1)]
        sides = np.vstack([rows, np.hstack([loosely * own.root, np.zeros((len(own.root), len(shifts)))])])
        sizes = natural_sizes(there, known.keys)
        step = np.linalg.lstsq(sides[:, : len(sizes)] * sizes, sides[:, len(sizes) :], rcond=None)[0]
        found[number] = (step * sizes[:, None]).T
    return found


def _slopes_of(shown: Sequence[tuple[float, Functional]], keys: Sequence[Key], there: Estimate) -> Array:
    """(2 N, K) px derivatives of all that is shown, by each of the keys."""
    return np.concatenate([weight * one.slopes(there, keys).reshape(-1, len(keys)) for weight, one in shown])


def _shown(keys: Sequence[Key], near: Estimate, pixels: Mapping[str, Array]) -> Iterator[tuple[float, Functional]]:
    """Yield what pixels of cameras show that depends on the keys, each with its weight, px per unit: places on the
    floor, and above it where phi is free, or rays of a camera that sees no floor.
    """
    known = dict.fromkeys(key.owner for key in keys if key.kind == "station")
    spoken_of = {key.owner for key in keys if key.kind == "camera"} | {near.stations[name].camera for name in known}
    for name, places in pixels.items():
        if name not in spoken_of:
            continue
        stations = [station for station in known if near.has_floor and near.stations[station].camera == name]
        tells_phi = any(key[:3] == ("camera", name, "phi") for key in keys)
        for station in stations:
            px_per_m = near.cameras[name].phi / max(abs(float(near.camera_at(station).position[2])), 1e-3)
            for height_m, part in zip(HEIGHTS_M[: 2 if tells_phi else 1], _PARTS, strict=False):
                yield part * px_per_m, located_by(near, station, places, height_m)
        if not stations:
            yield 1.0, shown_by(name, Picture(near.cameras[name].at(Pose.identity()), places))


AGREES = 2.5
"""Standard deviations above which a lens leaves systematic residuals: a perfect one exceeds them once in 160 times."""
# Mean observations in a cell; cells along the image: few show long waves, many what a surface's nodes do not follow.
_IN_A_CELL, _MOST_CELLS, _FINE_CELLS = 8, 8, 24


class LensResiduals(Frozen):
    """The residuals of a lens in some sights.

    Attributes:
        points, curves: (N, 2), (M,) residuals, in standard deviations. cameras: by name.
    """

    sights: Sights
    points: Array
    curves: Array
    cameras: Mapping[str, Camera]

    @classmethod
    def of(cls, sights: Sights, there: Residuals, scales: tuple[float, float], estimate: Estimate) -> LensResiduals:
        """Return the residuals at an estimate; of very many equations only those of some sights.

        Args:
            sights: of the inliers. scales: noise scales of points and curves, on the stated sigmas.
        """
        most_compared = 50_000
        every = -(-sights.equations // most_compared)
        some = sights if every <= 1 else sights[::every]
        points = there.points[some.point_rows] / (scales[0] * some.sigma_px[:, None])
        curves = there.curves[some.curve_rows] / (scales[1] * some.curve_sigma_px)
        return cls(some, points, curves, {name: estimate.cameras[name] for name in some.cameras})

    @classmethod
    def of_end(cls, end: RobustSolution, sights: Sights | None = None) -> LensResiduals:
        """Return the residuals at the end of all rounds, of some sights or of all that took part."""
        sights = end.problem.sights if sights is None else sights
        return cls.of(sights, end.residuals, end.problem.weighting.scales, end.estimate)

    @property
    def in_cells(self) -> float:
        """Standard deviations by which sums of residuals over a cell agree in sign in all sights; 0 of one sight."""
        sizes = {name: camera.image_size for name, camera in self.cameras.items()}
        of_points, of_curves = _sight_of(self.sights.point_bounds), _sight_of(self.sights.curve_bounds)
        sight = np.concatenate([of_points, of_points, of_curves])
        left = np.concatenate([self.points[:, 0], self.points[:, 1], self.curves])
        return max(_agreement(cells_of(self.sights, sizes, most), sight, left) for most in (_MOST_CELLS, _FINE_CELLS))

    @property
    def in_rings(self) -> float:
        """Like `in_cells`, over rings about the principal point and for radial residuals; the largest of cameras."""
        rings, agree = 24, 0.0  # from the middle to the farthest observation
        for name, camera in self.cameras.items():
            own = np.repeat([key.camera == name for key in self.sights.keys], np.diff(self.sights.point_bounds))
            offsets = camera.offsets(self.sights.pixels[own])
            radius = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-12)
            ring = (rings / np.max(radius, initial=1e-12) * radius).astype(int)
            outward = np.einsum("ij,ij->i", offsets, self.points[own]) / radius
            agree = max(agree, _agreement(ring, _sight_of(self.sights.point_bounds)[own], outward))
        return agree

    @property
    def asks_for_more(self) -> bool:
        """Whether another lens would leave smaller residuals in the same places of all sights."""
        return max(self.in_cells, self.in_rings) > AGREES


def of_placements(sights: Sights) -> Sights:
    """Return the sights of targets that move from view to view. Floor lines that are painted off their nominal position
    leave the same residuals in all views of a fixed camera, whatever its lens.
    """
    return sights.take(np.flatnonzero([key.placement is not None for key in sights.keys]))


def _sight_of(bounds: Indices) -> Indices:
    """(N,) number of each observation's sight; where there are very many, neighbouring sights share a number."""
    most_groups = 200  # of sights: products within a group do not count, half a percent of all
    sights = len(bounds) - 1
    return np.repeat(np.arange(sights) * min(sights, most_groups) // max(sights, 1), np.diff(bounds))


def _agreement(place: Indices, sight: Indices, left: Array) -> float:
    """Return by how many standard deviations sums of residuals (N,) by place (N,) agree between sights (N,)."""
    count = int(np.max(sight, initial=0)) + 1
    size = count * (int(np.max(place, initial=0)) + 1)
    sums = np.bincount(place * count + sight, left, size).reshape(-1, count)
    return agreement_of(np.asarray(sums.T, dtype=float))


def cells_of(sights: Sights, sizes: Mapping[str, tuple[int, int]], most: int = _MOST_CELLS) -> Indices:
    """(2 N + M,) numbers of the cells of all points' x, of their y and of all curve observations, with cells of its own
    for each curve; at most so many along the image.
    """
    names, places = sorted(sizes), len(sights.point_rows) + len(sights.curve_rows)
    side = min(most, max(2, int((places / (_IN_A_CELL * len(names))) ** 0.5)))
    owners = np.array([names.index(key.camera) for key in sights.keys])
    per_px = side / np.array([sizes[name] for name in names], dtype=float)

    def cells(bounds: Indices, pixels: Array) -> Indices:
        owner = np.repeat(owners, np.diff(bounds))
        x, y = (np.clip((pixels[:, k] * per_px[owner, k]).astype(int), 0, side - 1) for k in (0, 1))
        return np.asarray((owner * side + y) * side + x)

    points, curves = cells(sights.point_bounds, sights.pixels), cells(sights.curve_bounds, sights.curve_pixels)
    first = 2 * side * side * len(names)
    return np.concatenate([points * 2, points * 2 + 1, first + curves * len(sights.tracks) + sights.track_index])


# Bumps from the middle to the farthest observation, and along the longer side of the image, in two sizes: with another
# size between them, errors of rays over what is stated are the same, and it takes four times as long.
_ALONG, _OVER = 36, (7, 21)


def shifts_by_roughness(end: RobustSolution, cameras: Iterable[str]) -> tuple[Sequence[Key], Sequence[Array]]:
    """Return numbers (K), and shifts (K,) of them; the sum of the shifts' outer products is the covariance that the
    roughness of some cameras' lenses adds.
    """
    model = _linearised(end)
    shifts = [_shifts_of(model, name, end.estimate.cameras[name]) for name in cameras]
    return end.information.shared.keys, [shift for own in shifts for shift in own]


def _linearised(end: RobustSolution) -> Linearised:
    """Return the linearised equations of some sights, beside their share of the prior information."""
    most_equations = 12_000  # to estimate how rough a lens is; of more, those of some views
    problem, estimate, reduced = end.problem, end.estimate, end.information
    sights = problem.sights[:: max(1, -(-problem.sights.equations // most_equations))]
    equations = equations_of(sights, estimate, end.residuals)
    weights = equation_weights(problem.weighting, equations, end.residuals).within_sigma
    model = linearise_within(problem, estimate, equations, weights, reduced.shared)
    share = sights.equations / problem.sights.equations
    return model.beside_prior(share * model.root.T @ reduced.priors.over(reduced.shared.keys).matrix @ model.root)


def _shifts_of(model: Linearised, name: str, camera: Camera) -> Array:
    """(R, K) shifts of the numbers by the bumps of a camera's image."""
    at_rest = 0.02  # relative change of a size at convergence
    loose_px, least_px = 3.0, 1e-3  # sizes of bumps: before the data are used, and the smallest
    equations, rows = model.equations, model.equations.bounds[:-1]
    own = equations.of_sights(np.array([key.camera == name for key in equations.sights.keys]))
    every = list(_bumps(equations, camera, own))
    kind = np.repeat(np.arange(len(every)), [columns.shape[1] for columns in every])
    inside = model.beyond_private(np.hstack(every) * (own * model.weight)[:, None])
    taken = model.shared.T @ inside
    normal, slope = inside.T @ inside - taken.T @ taken, inside.T @ model.left_over
    best = np.linalg.solve(normal + np.eye(len(kind)) / loose_px**2, slope)
    rest = model.left_over - inside @ best + model.shared @ (taken @ best)
    scatter = np.add.reduceat(inside * rest[:, None], rows), np.add.reduceat(inside**2, rows)
    within = max(1.0, float(np.sum(scatter[0] ** 2) / np.sum(scatter[1])))
    forms = [np.diag((kind == number).astype(float)) for number in range(len(every))]
    loose, least = np.full((2, len(every)), [[loose_px], [least_px]])
    _, amount, precision = likeliest_sizes(normal / within, slope / within, forms, loose, least, at_rest)
    return shifts_by(model.root @ taken, np.linalg.inv(precision) + np.outer(amount, amount))


def _bumps(equations: Equations, camera: Camera, own: Mask) -> Iterator[Array]:
    """(E, Q) px per px of bumps along the radius and over the image, as far as a camera's own equations (E,) reach;
    none so small that most of them have fewer than eight equations.
    """
    offsets = camera.offsets(equations.pixel)
    radius = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    outward = np.sum(equations.direction * offsets * (1.0, camera.aspect), axis=1) / radius
    yield _hats(radius / np.max(radius[own], initial=1e-12) * _ALONG, _ALONG) * outward[:, None]
    for count in _OVER:
        step_px = max(camera.image_size) / count
        if 2 * _IN_A_CELL * np.prod([side / step_px for side in camera.image_size]) > np.count_nonzero(own):
            break
        x, y = (_hats(equations.pixel[:, k] / step_px, -int(-camera.image_size[k] // step_px)) for k in (0, 1))
        over = (x[:, :, None] * y[:, None, :]).reshape(len(x), -1)
        yield np.hstack([over * equations.direction[:, axis, None] for axis in (0, 1)])


def _hats(place: Array, count: int) -> Array:
    """(E, count + 1) hat functions: 1 at a whole number from 0 to the count, and linear to 0 at its neighbours."""
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(count + 1))))
