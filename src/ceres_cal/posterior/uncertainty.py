"""The uncertainty of a calibration, for people: numbers with verdicts, weak directions in words, maps, rigs.

A number is known, weak or unknown by its standard deviation in natural sizes; a direction, by how large a change along
it goes unnoticed.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import (
    Array,
    Frozen,
    InputError,
    Shown,
    are_known,
    cached_property,
    eigh,
    html_of,
    median,
    numbers_in,
    rows,
    text_of,
)
from ceres_cal.base.words import two_digits, with_sd
from ceres_cal.posterior.maps import FieldGrid, FieldMap, ImageMap, PointSpread, field_map, image_map, spread_of_points
from ceres_cal.posterior.mixture import FARTHER
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import PLACEMENT_QUANTITIES, Estimate, Key, natural_sizes, sigma_limits, values_of
from ceres_cal.robust.stated import Conflict
from ceres_cal.scene.targets import Target, still

if TYPE_CHECKING:
    from ceres_cal.posterior.seam import RigPair

T = TypeVar("T")
KNOWN, WEAK = 0.01, 0.3
"""Relative standard deviations: up to the first a number is known (phi of 868 px to 9 px, a height of 4 m to 40 mm, a
turn to 0.6 degrees), up to the second it is weak; beyond it, or with an open bound, it is unknown."""
CONFLICT = "in conflict"
_GIVES_WAY = ("usual", "tolerance")  # kinds of conflicts in which the statement is not kept
_LEARNT = 0.5  # of a tolerance's sigma: the offset of a line is known if the data determine it to this
# Share of the largest component below which others are not named. Nothing changes from half to double.
_IN_WORDS = 0.3
# A ratio is mentioned if it is known better than its parts by this factor. Nothing changes from half to double.
_TOGETHER = 0.1


class Verdict(Frozen, eq=True):
    """The uncertainty of one number, with a verdict.

    key: the number. value: in the key's unit; 0 for a turn, which is relative to the pose.
    sd: root mean square deviation, infinite where unknown; where phi is followed along its profile, half the distance
        of the bounds over the half width of an interval in sigmas. low, high: 95 % bounds, infinite where open.
        relative: sd over the natural size, infinite also for phi and height where the valley is open.
    verdict: "known", "weak" or "unknown" (see KNOWN and WEAK), or "in conflict": everything else contradicts a
        statement about it, and both are within its bounds. by_profile: whether the bounds are the profile's.
    factor: standard deviation with the scatter of the data, over that by the model alone.
    """

    key: Key
    value: float
    sd: float
    low: float
    high: float
    relative: float
    verdict: str
    by_profile: bool
    factor: float = 1.0


class WeakDirection(Frozen, eq=True):
    """A combination of numbers that the observations hardly determine.

    Attributes:
        words: one line. relative: sigma along it in natural sizes, infinite where unknown.
        shares: key -> share relative to the largest, which is 1; small ones are omitted.
    """

    words: str
    relative: float
    shares: tuple[tuple[Key, float], ...]


def _word(key: Key, relative: float, is_disputed: bool) -> str:
    known, weak = (_LEARNT, 0.95) if key.kind == "structure" else (KNOWN, WEAK)
    return "unknown" if relative > weak else CONFLICT if is_disputed else "known" if relative <= known else "weak"


def _is_set_aside(one: Conflict, value: float) -> bool:
    return abs(value - one.seen) < abs(value - one.stated)


class Uncertainty(Frozen):
    """The uncertainty of a calibration. It is valid as far as the model is: see `Posterior`.

    Attributes:
        conflicts: statements that everything else contradicts.
    """

    estimate: Estimate
    posterior: Posterior
    targets: Mapping[str, Target]
    conflicts: tuple[Conflict, ...] = ()

    @property
    def _shown(self) -> Shown:
        numbers = []
        for one in self.verdicts:
            unit = "" if one.key.unit == "1" else f" {one.key.unit}"
            value = f"{with_sd(one.value, one.sd)}{unit}"
            numbers.append((f"{one.key.quantity} of {one.key.owner}", value, one.verdict))
        return f"Uncertainty of {len(numbers)} numbers (value ± standard deviation)", numbers

    def __repr__(self) -> str:
        return text_of(self._shown)

    def _repr_html_(self) -> str:
        return html_of(self._shown)

    @cached_property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Known, weak, unknown or in conflict: one for each shared number, in the order of the posterior's keys."""
        posterior = self.posterior
        disputed = {one.number for one in self.conflicts if one.kind not in _GIVES_WAY}
        bounds, values = posterior.bounds, values_of(self.estimate, posterior.keys)
        half = (bounds[:, 1] - bounds[:, 0]) / (2.0 * posterior.half_width)
        if posterior.followed:  # a valley that widens farther out is no better known than there
            half = np.maximum(half, np.ptp(posterior.bounds_at(FARTHER), axis=1) / (2.0 * FARTHER))
        sizes, open_half = natural_sizes(self.estimate, posterior.keys), half.copy()
        low, high = values + bounds[:, 0], values + bounds[:, 1]
        followed = np.zeros(len(values), dtype=bool)
        for name in posterior.followed:
            mixture = posterior.mixtures[name]
            at = posterior.information.columns(mixture.keys)
            followed[at] = True
            if mixture.open_below or mixture.open_above:  # an open valley has no width, whatever it is compared with
                along = [column for column in at if posterior.keys[column].quantity in ("phi", "height")]
                open_half[along], low[along] = np.inf, np.maximum(low[along], 0.0)
        sd = np.where(followed, half, posterior.sd)
        relative = np.where(followed, open_half, posterior.sd) / sizes
        columns = (c.tolist() for c in (values, sd, low, high, relative, followed, posterior.factors))
        return tuple(
            Verdict(key, value, sigma, bottom, top, share, _word(key, share, key[1:] in disputed), by_profile, factor)
            for key, value, sigma, bottom, top, share, by_profile, factor in zip(posterior.keys, *columns, strict=True)
        )

    @cached_property
    def undisputed(self) -> Uncertainty:
        """The uncertainty without components that are nearer to a rejected statement than to the estimate."""
        every = self.posterior.mixture()
        columns, values = {key[1:]: i for i, key in enumerate(every.keys)}, values_of(self.estimate, every.keys)
        named = [
            (columns.get((one.owner, one.quantity, one.unit)), one) for one in self.conflicts if one.kind == "prior"
        ]
        stated = {i: one.stated for i, one in named if i is not None and _is_set_aside(one, float(values[i]))}
        if not stated or self.posterior.followed:  # a whole valley is one answer
            return self
        off = every.steps[:, [*stated]]
        nearer = np.abs(off) < np.abs(off + values[[*stated]] - [*stated.values()])
        return Uncertainty(self.estimate, self.posterior.of(np.all(nearer, axis=1)), self.targets)

    def table(self) -> list[dict[str, Any]]:
        """Return each shared number as a row of a table: `pandas.DataFrame(known.table())`."""
        return [
            {**one.key._asdict(), **{name: getattr(one, name) for name in ("value", "sd", "low", "high", "verdict")}}
            for one in self.verdicts
        ]

    def verdict(self, kind: str, owner: str, quantity: str) -> Verdict:
        """Return the verdict on one number.

        Raises:
            InputError: it is not a free number.
        """
        return self.verdicts[self.posterior.column(kind, owner, quantity)]

    @cached_property
    def weak_directions(self) -> tuple[WeakDirection, ...]:
        """Directions along which sigma exceeds KNOWN in natural sizes, in words, weakest first. Directions with the
        same words appear once; structure and the nodes of a lens's surface are not included.

        Natural sizes make units irrelevant: a direction is weak if an unnoticed change along it changes some number by
        more than a hundredth of itself.
        """
        posterior = self.posterior
        nodes = {(name, quantity) for name, camera in self.estimate.cameras.items() for quantity in camera.lens.nodes}
        keys = [key for key in posterior.keys if key.kind != "structure" and key[1:3] not in nodes]
        at = posterior.information.columns(keys)
        sizes = natural_sizes(self.estimate, keys)
        lost = posterior.spread.unknown[at] / sizes[:, None]
        finite = posterior.spread.covariance[np.ix_(at, at)] / sizes[:, None] / sizes
        values, vectors = eigh(finite)
        weak = [(np.inf, column / np.linalg.norm(column)) for column in lost.T if np.any(column)]
        weak += [(float(np.sqrt(v)), vectors[:, i]) for i, v in enumerate(values) if v > KNOWN**2][::-1]
        every = [self._direction(keys, relative, vector) for relative, vector in weak]
        words = [one.words for one in every]
        return tuple(one for number, one in enumerate(every) if one.words not in words[:number])

    def _direction(self, keys: Sequence[Key], relative: float, vector: Array) -> WeakDirection:
        scaled = vector / vector[np.argmax(np.abs(vector))]
        named = [int(i) for i in np.argsort(-np.abs(scaled)) if abs(scaled[i]) >= _IN_WORDS]
        shares = tuple((keys[i], float(scaled[i])) for i in named)
        return WeakDirection(self._words([keys[i] for i in named], relative), relative, shares)

    def _words(self, keys: Sequence[Key], relative: float) -> str:
        phi, stations = next((key for key in keys if key.quantity == "phi"), None), self.estimate.stations
        heights = [key for key in keys if key.quantity == "height" and phi and stations[key.owner].camera == phi.owner]
        if phi is not None and heights:
            ratio = max(self.ratio_sd(key.owner) for key in heights)
            if ratio < _TOGETHER * relative:
                named = ", ".join(repr(key.owner) for key in heights)
                whose = "its height" if named == repr(phi.owner) else f"the height of {named}"
                known = f"only their ratio is known, to {two_digits(100.0 * ratio)} %"
                return f"phi of {phi.owner!r} and {whose} trade off: {known}; places on the floor depend only on that"
        owners = dict.fromkeys(key.owner for key in keys)
        parts = [f"{' and '.join(key.quantity for key in keys if key.owner == o)} of {o!r}" for o in owners]
        many, names = len(keys) > 1, " and ".join(parts)
        if relative >= 1.0:  # known to its own size or worse: a percentage would say nothing
            how = "do not" if np.isinf(relative) else "hardly"
            return f"the observations {how} {'separate' if many else 'determine'} {names}"
        return f"{names}{' trade off: each' if many else ':'} known to {two_digits(100.0 * relative)} % only"

    @cached_property
    def unknown_placements(self) -> dict[str, tuple[str, ...]]:
        """Placements with unknown numbers, and which these are, such as the roll of a ring sheet about its axis."""
        posterior = self.posterior
        unknown: dict[str, tuple[str, ...]] = {}
        every = list(posterior.placements.values())
        if every and are_known(np.array([one.matrix for one in every]), sigma_limits(every[0].keys)):
            return unknown
        for name in posterior.placements:
            lost = np.isinf(posterior.placement(name).sd)
            if lost.any():
                unknown[name] = tuple(q for q, is_lost in zip(PLACEMENT_QUANTITIES, lost, strict=True) if is_lost)
        return unknown

    @cached_property
    def rig(self) -> tuple[RigPair, ...]:
        """Baseline and angle between the first station and those of other cameras."""
        if len({station.camera for station in self.estimate.stations.values()}) < 2:
            return ()
        from ceres_cal.posterior.seam import rig_pairs

        return rig_pairs(self.estimate, self.posterior)

    @property
    def widening(self) -> str:
        """One line on why standard deviations are larger than by the model alone; "" where they are not."""
        widened = 1.1  # factor on standard deviations from which on it is mentioned
        dependence, factor = self.posterior.dependence, median(self.posterior.factors)
        if dependence is None or not dependence.causes or factor < widened:
            return ""
        return f"{' and '.join(dependence.causes)}: this makes standard deviations {two_digits(factor)} times as large"

    def ratio_sd(self, station: str) -> float:
        """Relative standard deviation of phi over the station's height: a view from straight above determines this
        ratio.

        Raises:
            InputError: one of them was held.
        """
        posterior, placed = self.posterior, self.estimate.stations[station]
        slopes = np.zeros(len(posterior.keys))
        slopes[posterior.column("camera", placed.camera, "phi")] = 1.0 / self.estimate.cameras[placed.camera].phi
        slopes[posterior.column("station", station, "height")] = -1.0 / float(placed.cam_from_world.position[2])
        return float(np.sqrt(posterior.spread.through(slopes[None])[0, 0]))

    def located(self, pixels: ArrayLike, height_m: float = 0.0, station: str | None = None) -> PointSpread:
        """Locate pixels (N, 2), or one (2,), at a height, with 95 % bounds.

        Raises:
            InputError: see `map_sd_mm`.
        """
        name = self.estimate.station_name(station)
        given = rows(np.atleast_2d(numbers_in(pixels, "pixels")), 2, "pixels")
        return spread_of_points(self.estimate, self.posterior, name, given, height_m)

    def map_sd_mm(
        self,
        station: str | None = None,
        height_m: float = 0.0,
        x_m: ArrayLike | None = None,
        y_m: ArrayLike | None = None,
    ) -> FieldMap:
        """Return how well a station locates points at a height, over a grid; by default one over the field.

        Raises:
            InputError: no such station, none named where there are several, or it was held as the world.
        """
        name = self.estimate.station_name(station)
        make = partial(field_map, self.estimate, self.posterior, name, self._grid(height_m, x_m, y_m))
        return self._kept(make, (name, height_m)) if x_m is None and y_m is None else make()

    def map_px(self, camera: str | None = None) -> ImageMap:
        """Return how well a camera knows its image, px, independently of its pose.

        Raises:
            InputError: no such camera, or none named where there are several.
        """
        if camera is None:
            (camera, *others) = self.estimate.cameras
            if others:
                raise InputError(f"which camera? One of {', '.join(self.estimate.cameras)}")
        return self._kept(partial(image_map, self.estimate, self.posterior, camera), camera)

    def _kept(self, make: Callable[[], T], of: Hashable) -> T:
        """Return a map, computed once: along a valley it takes a second, and three chapters of a report use it."""
        if of not in self._maps:
            self._maps[of] = make()
        kept: T = self._maps[of]
        return kept

    @cached_property
    def _maps(self) -> dict[Hashable, Any]:
        return {}

    def seam_sd_mm(
        self, first: str, second: str, height_m: float = 0.0, x_m: ArrayLike | None = None, y_m: ArrayLike | None = None
    ) -> FieldMap:
        """Return how much two stations may disagree about places that both see.

        Raises:
            InputError: see `map_sd_mm`.
        """
        from ceres_cal.posterior.seam import seam_map

        map_of = partial(self.map_sd_mm, height_m=height_m, x_m=x_m, y_m=y_m)
        return seam_map(self.estimate, self.posterior, (first, second), self._grid(height_m, x_m, y_m), map_of)

    def _grid(self, height_m: float, x_m: ArrayLike | None, y_m: ArrayLike | None) -> FieldGrid:
        """Return a grid; where x and y are not given, over the box around the targets that do not move.

        Raises:
            InputError: there is no such target.
        """
        field = field_grid(self.targets) if x_m is None or y_m is None else ()
        x, y = (field[axis] if given is None else given for axis, given in enumerate((x_m, y_m)))
        return FieldGrid(height_m, np.asarray(x, dtype=float), np.asarray(y, dtype=float))


def field_grid(targets: Mapping[str, Target]) -> tuple[Array, Array]:
    """Return x and y of a grid over the box around the targets that do not move.

    Raises:
        InputError: there is no such target.
    """
    grid = 36  # steps along the longer side
    box = [target.box for target in still(targets).values()]
    if not box:
        raise InputError("no field to draw a map of: give x_m and y_m")
    low, high = np.min([b[0] for b in box], axis=0), np.max([b[1] for b in box], axis=0)
    spacing = float(np.max(high - low)) / grid
    counts = np.maximum(np.round((high - low) / spacing).astype(int) + 1, 2)
    x, y = (np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True))
    return x, y
