"""What a lens does not say of itself: other lenses that predict as well as it, and by how much it is too smooth.

Where other lenses agree, the data tell them apart; at the rim and between lines they do not, and what the chosen one
says there is its own. So they are components of the posterior, and maps show what they show, also where nothing was
observed. The numbers of the chosen one follow each as closely as they can, by least squares over places on the floor
and above it, or over rays of a camera that sees no floor.

What a lens that is too smooth leaves displaces an image in the same way in all views: no number of views makes that
less. What goes together within a sight alone, as a bent board or a blurred frame has it, is no lens, and does not
count: whether sums of residuals over cells of the image agree between sights is asked first, by products of different
sights. Bumps along the radius and over the image are columns X beside the free numbers; their coefficients scatter by
tau (px). With P what all free numbers leave, the residuals r say u = X^T P r of them, and

    Cov u = kappa V + tau^2 V V,    V = X^T P X,

kappa for what goes together within a view. The restricted likelihood of tau, of each kind of bumps, says how rough the
lens is. By what the free numbers take up of them they are off.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ceres_cal.base import HEIGHTS_M, Array, Frozen, Indices, Mask, Pose, cached_property, grid_places
from ceres_cal.effects import Linearised, equation_weights, likeliest_sizes, linearise_within, shifts_by
from ceres_cal.effects.evidence import agreement as agreement_of
from ceres_cal.observations.sights import Sights
from ceres_cal.posterior.maps import Functional, Picture, located_by, shown_by
from ceres_cal.problem import Estimate, Information, Key, ReducedInformation, natural_sizes
from ceres_cal.problem.residuals import Equations, Residuals, equations_of
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.scene.camera import Camera

_PLACES = 12  # along each side of the picture
# How closely the heights of HEIGHTS_M are followed. Above the floor phi tells, and the quadratic picture bends:
# followed as closely, what lenses with another phi show there ruins the floor; not at all, one map in ten was 2.5
# standard deviations off there.
_PARTS = (1.0, 0.1)


class OtherLenses(Frozen):
    """Other lenses than the chosen one, solved for from the same observations.

    Attributes:
        near: with the chosen lens. others: with others. weights: of each, its probability or less.
        reach_px: camera -> how far from its principal point it was observed: farther out nothing is compared.
        failed: why nothing could be compared; "" where it could.
    """

    near: Estimate
    others: tuple[Estimate, ...]
    weights: tuple[float, ...]
    reach_px: Mapping[str, float]
    failed: str = ""

    @cached_property
    def pixels(self) -> dict[str, Array]:
        """Camera -> (N, 2) of a grid over its image, as far as it was observed."""
        return {name: _places_of(self.near.cameras[name], reach_px) for name, reach_px in self.reach_px.items()}


class OpenDirection(NamedTuple):
    """How numbers (K) vary with one of a camera's, by a standard deviation of that."""

    along: Key
    keys: tuple[Key, ...]
    step: Array


class LensSpread(Frozen):
    """How numbers vary with a lens.

    Attributes:
        there: with it. keys: (K) the numbers. root: (K, R) a root of their covariance. slopes: see `shown_slopes`.
    """

    there: Estimate
    keys: tuple[Key, ...]
    root: Array
    slopes: Sequence[Array]

    def beyond(self, chosen: LensSpread, probability: float) -> Sequence[OpenDirection]:
        """What this lens leaves open and the chosen one does not, along one number of a camera after the other, as far
        as it makes a difference to what pixels show at a height, where they were observed or farther out.

        Straight from above the form of a lens alone tells phi. Of a floor one coefficient knew it to 0.4 %, 16 standard
        deviations off at robot height; three, which predicted as well, knew it to 10 %. In a cropped picture's corner
        two knew a place to 10 mm, 60 off, and four, which predicted better, to 36.

        Args:
            probability: of this lens.
        """
        least = 0.25  # of all variance by the chosen lens, for a direction to be worth two more components
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
        """(N, R), (N, Q) how what pixels show varies with the chosen lens and with this one, each height and part of
        the picture over all that it varies with the chosen one.
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
        """(N, R) of each of the slopes, how what pixels show varies."""
        return [slopes @ self.root for slopes in self.slopes]

    def _along(self, along: Key, step: Array) -> OpenDirection:
        """The direction, no farther than to half of phi and half as much again."""
        most = 0.5
        phi = [(i, self.there.cameras[key.owner].phi) for i, key in enumerate(self.keys) if key.quantity == "phi"]
        far = max((abs(float(step[i])) / size for i, size in phi), default=0.0)
        moving = [i for i, value in enumerate(step) if value]
        return OpenDirection(along, tuple(self.keys[i] for i in moving), step[moving] * min(1.0, most / max(far, most)))


def shown_slopes(there: Estimate, keys: Sequence[Key], lenses: OtherLenses) -> Sequence[Array]:
    """(N, K) how what pixels show moves with numbers of an estimate, at each height where they were observed, and
    farther out: the same for all lenses of a kind.

    Args:
        lenses: with the pixels that are asked, and none besides yet.
    """
    near, found = lenses.near, list[Array]()
    for name, reach_px in lenses.reach_px.items():
        places = _places_of(near.cameras[name])
        is_within = np.repeat(_distance_px(near.cameras[name], places) <= reach_px, 2)
        for _, one in _shown(keys, near, {name: places}):
            slopes = one.slopes(there, keys).reshape(-1, len(keys))
            found += [slopes[is_within], slopes[~is_within]]
    return found


def together(each: Sequence[OtherLenses], floors: Container[str], end: Estimate) -> OtherLenses:
    """Those of several cameras, each with its own probabilities, in as many combinations as there are lenses: for each
    camera its others and then the chosen one have their probabilities beside each other from 0 to 1, and what has one
    place there is a combination.

    Args:
        floors: stations that see the floor. end: where the others stand, which a camera by itself does not know.
    """
    if len(each) == 1:
        return each[0]
    bounds = [np.cumsum(counted(one.weights)) for one in each]
    cuts = np.unique(np.concatenate([np.zeros(1), *bounds]))

    def combined(parts: Sequence[Estimate]) -> Estimate:
        cameras = {name: camera for one in parts for name, camera in one.cameras.items()}
        seen = {name: station for one in parts for name, station in one.stations.items() if name in floors}
        return Estimate(cameras, {**end.stations, **seen}, {}, parts[0].structure)

    which = np.array([np.searchsorted(own, cuts[:-1], side="right") for own in bounds])
    return OtherLenses(
        combined([one.near for one in each]),
        tuple(combined([[*one.others, one.near][i] for one, i in zip(each, at, strict=True)]) for at in which.T),
        tuple(np.diff(cuts).tolist()),
        {name: reach_px for one in each for name, reach_px in one.reach_px.items()},
        "; ".join(filter(None, (one.failed for one in each))),
    )


def _places_of(camera: Camera, reach_px: float = np.inf) -> Array:
    """(N, 2) px of a grid over a camera's image, so far from its principal point."""
    x, y = (np.linspace(0.0, side - 1.0, _PLACES) for side in camera.image_size)
    places = grid_places(x, y)
    return np.asarray(places[_distance_px(camera, places) <= reach_px])


def _distance_px(camera: Camera, places: Array) -> Array:
    return np.asarray(np.linalg.norm(places - camera.principal_point, axis=1))


def counted(weights: Sequence[float]) -> Array:
    """(L,) probabilities of other lenses as far as they count, together less than all."""
    most = 0.8  # of all of them together
    each = np.asarray(weights, dtype=float)
    return np.asarray(each / max(1.0, float(each.sum()) / most))


def shifts_to_lenses(lenses: OtherLenses, keys: Sequence[Key], nodes: Sequence[Estimate]) -> Array:
    """(M, L, K) of numbers of M estimates, which follow each of the others by least squares.

    Args:
        nodes: with the chosen lens, at its best or elsewhere in a valley along phi.
    """
    followed = 1e-4  # of the largest singular value: directions that show less are not moved along
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
    return found


def shifts_along(
    camera: str, here: Estimate, known: Information, shifts: Array, nodes: Sequence[tuple[Estimate, Information]]
) -> Array:
    """(M, S, K) of numbers of M estimates, each with what is known of them there, which show on the floor what shifts
    (S, K) of one estimate's show, each place as far as it is known; what no place shows stays where it is.
    """
    loosely = 0.1  # as in units of what is known at a node: shifts of ten sigmas that no place shows cost as one sigma
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
    """(2 N, K) px of all that is shown, by each of the keys."""
    return np.concatenate([weight * one.slopes(there, keys).reshape(-1, len(keys)) for weight, one in shown])


def _shown(keys: Sequence[Key], near: Estimate, pixels: Mapping[str, Array]) -> Iterator[tuple[float, Functional]]:
    """What pixels of cameras show that the keys say anything of, each with its weight, px per unit: places on the
    floor, where phi is free also above it, and rays of a camera that sees no floor.
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
                yield part * px_per_m, located_by(station, places, height_m)
        if not stations:
            yield 1.0, shown_by(name, Picture(near.cameras[name].at(Pose.identity()), places))


AGREES = 2.5
"""From how many standard deviations on a lens leaves something: of one that leaves nothing one in 160 does."""
# Observations on average; cells along the image: some show what is long, many what a surface's nodes do not follow.
_IN_A_CELL, _MOST_CELLS, _FINE_CELLS = 8, 8, 24


class LensResiduals(Frozen):
    """What a lens leaves of some sights.

    Attributes:
        points, curves: (N, 2), (M,) residuals, in standard deviations. cameras: by name.
    """

    sights: Sights
    points: Array
    curves: Array
    cameras: Mapping[str, Camera]

    @classmethod
    def of(cls, sights: Sights, there: Residuals, scales: tuple[float, float], estimate: Estimate) -> LensResiduals:
        """At an estimate; of very many equations those of some sights.

        Args:
            sights: of what took part. scales: of the noise of points and curves, over what is stated.
        """
        most_compared = 50_000
        every = -(-sights.equations // most_compared)
        some = sights if every <= 1 else sights[::every]
        points = there.points[some.point_rows] / (scales[0] * some.sigma_px[:, None])
        curves = there.curves[some.curve_rows] / (scales[1] * some.curve_sigma_px)
        return cls(some, points, curves, {name: estimate.cameras[name] for name in some.cameras})

    @classmethod
    def of_end(cls, end: RobustSolution, sights: Sights | None = None) -> LensResiduals:
        """At the end of all rounds, of some sights or of all that took part."""
        sights = end.problem.sights if sights is None else sights
        return cls.of(sights, end.residuals, end.problem.weighting.scales, end.estimate)

    @property
    def in_cells(self) -> float:
        """By how many standard deviations sums of residuals over a cell have one sign in all sights; 0 of one sight."""
        sizes = {name: camera.image_size for name, camera in self.cameras.items()}
        of_points, of_curves = _sight_of(self.sights.point_bounds), _sight_of(self.sights.curve_bounds)
        sight = np.concatenate([of_points, of_points, of_curves])
        left = np.concatenate([self.points[:, 0], self.points[:, 1], self.curves])
        return max(_agreement(cells_of(self.sights, sizes, most), sight, left) for most in (_MOST_CELLS, _FINE_CELLS))

    @property
    def in_rings(self) -> float:
        """The same of sums over rings about the principal point, of how far out points lie; of cameras the most."""
        rings = 24  # from the middle to the farthest observation
        agree = 0.0
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
        """Whether another lens would leave less in the same places of all sights."""
        return max(self.in_cells, self.in_rings) > AGREES


def of_placements(sights: Sights) -> Sights:
    """Those of what lies elsewhere in each view. Lines of a floor that are painted aside leave the same in all views of
    a camera that stands still, whatever its lens.
    """
    return sights.take(np.flatnonzero([key.placement is not None for key in sights.keys]))


def _sight_of(bounds: Indices) -> Indices:
    """Of each observation its sight's number; of very many sights, that of some beside each other."""
    most_groups = 200  # of sights: products within one do not count, a half of a percent
    sights = len(bounds) - 1
    return np.repeat(np.arange(sights) * min(sights, most_groups) // max(sights, 1), np.diff(bounds))


def _agreement(place: Indices, sight: Indices, left: Array) -> float:
    """By how many standard deviations the sums of residuals (N,) by place (N,) agree between sights (N,)."""
    count = int(np.max(sight, initial=0)) + 1
    size = count * (int(np.max(place, initial=0)) + 1)
    sums = np.bincount(place * count + sight, left, size).reshape(-1, count)
    return agreement_of(np.asarray(sums.T, dtype=float))


def cells_of(sights: Sights, sizes: Mapping[str, tuple[int, int]], most: int = _MOST_CELLS) -> Indices:
    """(2 N + M,) numbers of the cells of all points' x, of their y and of all curve observations, each curve apart;
    no more than so many along the image.
    """
    names = sorted(sizes)
    count = (len(sights.point_rows) + len(sights.curve_rows)) / (_IN_A_CELL * len(names))
    side = min(most, max(2, int(np.sqrt(count))))
    owners = np.array([names.index(key.camera) for key in sights.keys])
    per_px = side / np.array([sizes[name] for name in names], dtype=float)

    def cells(bounds: Indices, pixels: Array) -> Indices:
        owner = np.repeat(owners, np.diff(bounds))
        x, y = (np.clip((pixels[:, k] * per_px[owner, k]).astype(int), 0, side - 1) for k in (0, 1))
        return np.asarray((owner * side + y) * side + x)

    points, curves = cells(sights.point_bounds, sights.pixels), cells(sights.curve_bounds, sights.curve_pixels)
    first = 2 * side * side * len(names)
    return np.concatenate([points * 2, points * 2 + 1, first + curves * len(sights.tracks) + sights.track_index])


# Bumps from the middle to the farthest observation, and along the longer side of the image: with one size more between
# them rays are as far off over what is stated, and it takes four times as long.
_ALONG, _OVER = 36, (7, 21)


def shifts_by_roughness(end: RobustSolution, cameras: Iterable[str]) -> tuple[Sequence[Key], Sequence[Array]]:
    """Numbers (K), and shifts (K,) of them whose products with themselves, added up, are the covariance of what rough
    lenses of some cameras do to them.
    """
    reduced = end.information
    model = _linearised(end, reduced)
    shifts = [_shifts_of(model, name, end.estimate.cameras[name]) for name in cameras]
    return reduced.shared.keys, [shift for own in shifts for shift in own]


def _linearised(end: RobustSolution, reduced: ReducedInformation) -> Linearised:
    """Some sights' equations, beside their share of what was known before."""
    most_equations = 12_000  # that tell how rough a lens is: of more, those of some views
    problem, estimate = end.problem, end.estimate
    every = max(1, -(-problem.sights.equations // most_equations))
    sights = problem.sights[::every]
    equations = equations_of(sights, estimate, end.residuals)
    weights = equation_weights(problem.weighting, equations, end.residuals).within_sigma
    model = linearise_within(problem, estimate, equations, weights, reduced.shared)
    share = sights.equations / problem.sights.equations
    return model.beside_prior(share * model.root.T @ reduced.priors.over(reduced.shared.keys).matrix @ model.root)


def _shifts_of(model: Linearised, name: str, camera: Camera) -> Array:
    """(R, K) by the bumps of a camera's image."""
    at_rest = 0.02  # relative change of a size
    loose_px, least_px = 3.0, 1e-3  # of bumps, before the data have spoken, and what they cannot talk below
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
    none so small that most of them have fewer than eight.
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
    """(E, count + 1) straight up to 1 at each whole number from 0 to the count, and down."""
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(count + 1))))
