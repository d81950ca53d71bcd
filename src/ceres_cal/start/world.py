"""Find where a camera stands from one sight of the world: by the homography's proposal if it holds, else by a search.

Also chain the poses of sights into stations and placements.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping

import numpy as np

from ceres_cal.base import DegenerateError, Frozen, InputError, Pose, Poses, SolutionError, chained, inverted, replace
from ceres_cal.base.arrays import Array, Indices, distinct, eigh, evenly
from ceres_cal.base.words import first_of, plural
from ceres_cal.observations import Prior, Sights
from ceres_cal.problem.parameters import Station, anchored_stations
from ceres_cal.start.closed_forms import RadialProfile
from ceres_cal.start.search import BestCameras, apart, best_of, information, searched
from ceres_cal.start.sightlines import CameraPrior, Candidates, Sightlines

_MOST = (20, 12)  # points of a sight, and places of each curve, that a search for a camera uses
_HOLDS = 0.7  # share of rows that must be near for a place to hold: a fifth and more, of any features, may be wrong
_SCALES = 8.0  # scales of the residuals within which a row is near: no clean row is farther
_ROUGH = 0.01  # share of the half diagonal beyond which no row is near: at a wrong place the scale is large
_LEFT_OVER = 8  # degrees of freedom for a place to hold: with fewer, another place may explain the rows as well
_TOLD = 0.05  # standard deviation of log phi up to which a sight determines phi: above, the start is called a guess
_OPEN = 1e-10  # least eigenvalue of the normalised information: rounding is less, the weakest scenes have 1e-7
_ALIKE = 30.0  # variances by which the cost of another place may be higher: the solve, which is exact, decides
_APART = 0.05  # rad, and share of the height: places that are nearer than this are one minimum
_NAMES = ("direction", "direction", "direction", "x", "y", "height", "phi", "lens")


class CameraPlace(Frozen):
    """The place of a camera, from one sight.

    Attributes:
        pose: cam_from_world (3, 4). phi: px. profile: of the lens under which the sight is seen from there.
    """

    pose: Array
    phi: float
    profile: RadialProfile


class CameraPlaces(Frozen):
    """The possible places of a camera, from one sight, the likeliest first.

    Attributes:
        open: names of the numbers that the sight leaves undetermined. tells_phi: whether it determines phi.
    """

    places: tuple[CameraPlace, ...]
    open: tuple[str, ...]
    tells_phi: bool


def beforehand(priors: Iterable[Prior], station: str, log_phi: tuple[float, float]) -> CameraPrior:
    """The prior of a search: what is stated of a station's place, and mean and sd of log phi."""
    least_sd = 1e-3  # relative, of a stated number: an initial estimate is no more accurate
    position, sd = np.zeros(3), np.full(3, np.inf)
    for prior in priors:
        if prior.owner == "station" and prior.name == station and prior.quantity in ("height_m", "position_m"):
            numbers = slice(3 - len(prior.value), 3)
            position[numbers] = prior.value
            sd[numbers] = np.maximum(prior.sigma, least_sd * max(abs(prior.value[-1]), least_sd))
    return CameraPrior(position, sd, log_phi, 0.0)


def placed(
    sight: Sights,
    profile: RadialProfile,
    known: CameraPrior,
    proposed: Array | None,
    log_phi: float,
    *,
    may_bend: bool,
    may_search: bool = True,
) -> CameraPlaces:
    """The possible places of a camera by one sight about its principal point.

    Args:
        proposed: cam_from_world (3, 4) of a homography at this log phi, if there is one.
        may_bend: whether the profile may be changed: where nothing holds, wrong labels may have determined it.
        may_search: whether a camera is searched for where the proposal does not hold.

    Raises:
        InputError: only a mirrored picture of the floor holds.
        SolutionError: nothing holds, and no search is made.
    """
    bend_sd = 0.15  # sd of the bend at the image's corner for an unknown lens; more is a fisheye, which lines show
    lines = _lines_of(sight, profile, known, _rows_of(sight))
    given = Candidates.none()
    if proposed is not None and np.all(np.isfinite(proposed)):
        given = _candidate(proposed, log_phi)
        found = best_of(lines, given)
        if holds(lines, found):
            if known.held[6]:  # other sights determine phi and lens: their homography is as accurate as this sight
                return _answered(lines, profile, replace(found, poses=given, costs=found.costs[:1]))
            return _answered(*_at_rest(sight, lines, profile, found))
    if not may_search:
        raise SolutionError(f"station {sight.keys[0].station!r}: {_what_poses(sight)}")
    known = replace(known, bend_sd=bend_sd if may_bend else 0.0)
    none = RadialProfile((0.0, 0.0), profile.unit_px)
    profiles = (profile, none) if may_bend else (profile,)

    def best(axes: tuple[float, float]) -> tuple[Sightlines, RadialProfile, BestCameras]:
        every = [_searched(sight, one, known, given, axes) for one in profiles]
        return min(every, key=lambda one: float(one[-1].costs[0]))

    lines, chosen, found = best((1.0, 1.0))
    if not holds(lines, found):
        mirrored, _, other = best((-1.0, 1.0))
        if holds(mirrored, other) and other.costs[0] + _ALIKE < found.costs[0]:
            raise InputError(
                f"station {sight.keys[0].station!r}: its picture of the floor is mirrored: x and y are "
                "swapped, or y points upwards, or left and right, or top and bottom, are exchanged in the labels: "
                "correct the observations"
            )
    return _answered(*_at_rest(sight, lines, chosen, found))


def _at_rest(
    sight: Sights, lines: Sightlines, profile: RadialProfile, found: BestCameras
) -> tuple[Sightlines, RadialProfile, BestCameras]:
    """The best places and those that fit as well, refined by nearly all rows of a sight instead of some."""
    most_places = 5  # places returned: a valley has as many as were tried, and the solve follows it from any
    alike = [n for n in apart(found.poses, found.costs, _APART) if found.costs[n] <= found.costs[0] + _ALIKE]
    # Depending on which twelve places of a curve were used, a wide lens' field was found or lost, and phi was
    # determined or a guess.
    times = 16  # ratio of the rows used here to those used in the search
    every = _lines_of(sight, profile, lines.known, _rows_of(sight, (times * _MOST[0], times * _MOST[1])))
    return every, profile, best_of(every, found.poses.take(np.array(alike[:most_places])))


def _searched(
    sight: Sights, profile: RadialProfile, known: CameraPrior, given: Candidates, axes: tuple[float, float]
) -> tuple[Sightlines, RadialProfile, BestCameras]:
    """Search for a camera. `axes`: signs of the picture's x and y, -1 for a mirrored picture."""
    few = 8, 4  # points, and places of each curve, for the first rounds of a search
    every = (_lines_of(sight, profile, known, _rows_of(sight, most)) for most in (_MOST, few))
    lines, some = (replace(one, pixels=one.pixels * axes) for one in every)
    return lines, profile, searched(lines, some, given)


def _answered(lines: Sightlines, profile: RadialProfile, found: BestCameras) -> CameraPlaces:
    """The answer: the places found, and what the best of them leaves undetermined."""
    finest_px = 1e-2  # least scale: exact data determine numbers no better
    best, scale = found.poses.take(np.array([0])), max(found.scale_px, finest_px)
    matrix = information(lines, best, scale)
    places = tuple(_place(found.poses, number, profile) for number in apart(found.poses, found.costs, _APART))
    return CameraPlaces(places, open_numbers(matrix), _sd_of(matrix, 6) < _TOLD)


def holds(lines: Sightlines, found: BestCameras) -> bool:
    """Whether nearly all rows agree with the best place, and they are more than any place could fit."""
    best = found.poses.take(np.array([0]))
    distance = np.abs(lines.distances(best)[0])
    limit = min(_SCALES * found.scale_px, _ROUGH * lines.unit_px) + 1e-3
    near = (distance < limit) & lines.seen(best)[0]
    return bool(np.mean(near) > _HOLDS and lines.independent >= np.count_nonzero(~lines.known.held) + _LEFT_OVER)


def open_numbers(matrix: Array) -> tuple[str, ...]:
    """Names of the numbers that an information matrix (8, 8) leaves undetermined; held numbers have zero rows."""
    free, sizes, values, vectors = _decomposed(matrix)
    missing = [_NAMES[n] for n in range(6) if n not in free]
    lost = vectors[:, values < _OPEN * max(values[-1], 1e-300)] / sizes[:, None] if len(free) else np.empty((0, 0))
    moved = np.max(np.abs(lost), axis=1, initial=0.0)
    names = [_NAMES[n] for n, m in zip(free, moved, strict=True) if m > 0.1 * np.max(moved, initial=0.0) > 0.0]
    return tuple(dict.fromkeys([*missing, *names]))


def _decomposed(matrix: Array) -> tuple[Indices, Array, Array, Array]:
    """The free numbers of an information matrix, their sizes, and eigenvalues and eigenvectors in units of these."""
    free = np.flatnonzero(np.diag(matrix) > 0.0)
    sizes = np.sqrt(np.diag(matrix)[free])
    return free, sizes, *eigh(matrix[np.ix_(free, free)] / sizes[:, None] / sizes)


def _sd_of(matrix: Array, number: int) -> float:
    """Standard deviation of one number; infinite where it is undetermined, 0 where it is held."""
    free, sizes, values, vectors = _decomposed(matrix)
    if number not in free:
        return 0.0
    row = int(np.searchsorted(free, number))
    share = vectors[row] / sizes[row]
    return float(np.sqrt(np.sum(share**2 / np.maximum(values, 1e-300))))


def left_of(sight: Sights, place: CameraPlace) -> Array:
    """(2 N + M,) distances, in stated sigmas, of all rows of a sight from where they should be seen; infinite where
    they cannot be seen. The profile is the one found, whatever lenses the options allow.
    """
    points, some = chosen = _rows_of(sight, (len(sight.points), len(sight.on_arc)))
    log_phi = float(np.log(place.phi))
    held = CameraPrior(np.zeros(3), np.full(3, np.inf), (log_phi, 0.0), 0.0)
    lines, there = _lines_of(sight, place.profile, held, chosen), _candidate(place.pose, log_phi)
    sigma_px = np.concatenate([sight.sigma_px[points], sight.sigma_px[points], sight.curve_sigma_px[some]])
    return np.asarray(np.where(lines.seen(there), np.abs(lines.distances(there)), np.inf)[0] / sigma_px)


def _candidate(pose: Array, log_phi: float) -> Candidates:
    """The candidate with one camera at cam_from_world (3, 4)."""
    rotation = pose[:, :3].T
    return Candidates(rotation[None], (-rotation @ pose[:, 3])[None], np.array([log_phi]), np.zeros(1))


def _place(poses: Candidates, number: int, profile: RadialProfile) -> CameraPlace:
    rotation = poses.rotations[number].T
    pose = np.column_stack([rotation, -rotation @ poses.positions[number]])
    return CameraPlace(pose, float(np.exp(poses.log_phi[number])), profile.bent(float(poses.bend[number])))


def _rows_of(sight: Sights, most: tuple[int, int] = _MOST) -> tuple[Indices, Indices]:
    """Numbers of some points of a sight and of some places of each of its curves, evenly, with those of arcs last."""
    points = evenly(len(sight.points), most[0])
    every = (np.flatnonzero(sight.track_index == track) for track in distinct(sight.track_index))
    some = np.concatenate([np.empty(0, np.int64), *(own[evenly(len(own), most[1])] for own in every)])
    return points, some[np.argsort(sight.on_arc[some], kind="stable")]


def _lines_of(sight: Sights, profile: RadialProfile, known: CameraPrior, chosen: tuple[Indices, Indices]) -> Sightlines:
    """The sight lines of the chosen rows, see `_rows_of`."""
    (points, some), tracks = chosen, sight.track_index
    arcs = int(np.count_nonzero(sight.on_arc[some]))
    starts, along = sight.tracks[tracks[some], 0], sight.tracks[tracks[some], 1].copy()
    if arcs:
        along[-arcs:] = np.column_stack([np.linalg.norm(along[-arcs:], axis=1), np.zeros((arcs, 2))])
    pixels = np.vstack([sight.pixels[points], sight.pixels[points], sight.curve_pixels[some]])
    places = np.vstack([sight.points[points], sight.points[points], starts])
    radius = np.linalg.norm(pixels, axis=1)
    return Sightlines(
        known,
        pixels,
        profile.lift(pixels)[:, 2],
        profile.slope(radius),
        profile.unit_px,
        places,
        np.vstack([np.zeros((2 * len(points), 3)), along]),
        (len(points), len(some) - arcs, arcs),
        np.concatenate([np.full(2 * len(points), -1), tracks[some]]),
    )


_STATED = {"x": "position_m", "y": "position_m", "height": "height_m", "phi": "phi"}
"""Names of the priors by which an undetermined number may be stated."""


def chained_poses(
    sights: Sights,
    numbers: Indices,
    poses: Array,
    standing: Mapping[str, Station] | None = None,
    open_numbers: Mapping[int, tuple[str, ...]] | None = None,
) -> tuple[dict[str, Station], Poses]:
    """Chain the poses (K, 3, 4) of sights into stations and placements: the best-seen first, each extending the known
    ones.

    Args:
        numbers: (K,) of these sights. standing: stations whose pose is known. open_numbers: what other sights leave
            undetermined, by their numbers.

    Raises:
        DegenerateError: it names a sight that is connected with nothing.
    """
    sizes = np.diff(sights.point_bounds) + np.diff(sights.curve_bounds)
    order = np.argsort(-sizes[numbers], kind="stable")
    keys, seen = [sights.keys[i] for i in numbers[order]], poses[order]
    stations = {name: station.cam_from_world.matrix for name, station in (standing or {}).items()}
    stations = stations or {name: np.eye(3, 4) for name in anchored_stations(sights.observations)}
    placements: dict[str | None, Array] = {None: np.eye(3, 4)}
    stacks, known, left = [np.empty((0, 3, 4))], -1, list(enumerate(keys))
    while len(stations) + len(placements) > known:
        known = len(stations) + len(placements)
        for row, key in left:
            if key.station not in stations and key.placement in placements:
                stations[key.station] = chained(seen[row], inverted(placements[key.placement]))
        fresh: dict[str | None, int] = {}
        for row, key in left:
            if key.placement not in placements and key.station in stations:
                fresh.setdefault(key.placement, row)
        if fresh:
            rows, number = list(fresh.values()), {name: number for number, name in enumerate(stations)}
            world_from_cam = inverted(np.array(list(stations.values())))[[number[keys[row].station] for row in rows]]
            stacks.append(chained(world_from_cam, seen[rows]))
            placements |= dict(zip(fresh, stacks[-1], strict=True))
        left = [(row, key) for row, key in left if not (key.station in stations and key.placement in placements)]
    _require_all(sights, stations, placements, open_numbers or {})
    cameras, placed = (
        sights.observations.stations,
        Poses.stacked([name for name in placements if name is not None], np.concatenate(stacks)),
    )
    own = list(dict.fromkeys(key.placement for key in sights.keys if key.placement is not None))
    return (
        {n: Station(cameras[n], Pose(stations[n][:, :3], stations[n][:, 3])) for n in cameras if n in stations},
        Poses.stacked(own, placed.of_names(own)),
    )


def _what_poses(sight: Sights) -> str:
    """The advice where no pose of a sight is found."""
    if len(sight.points) > 3 and np.linalg.matrix_rank(sight.points - sight.points[0]) > 1:
        return "no pose explains its points with this lens: check its labels, or try another lens"
    return "give at least four points, not on one line, or straight lines in two directions, two of each"


def _require_all(
    sights: Sights,
    stations: Container[str],
    placements: Container[str | None],
    open_numbers: Mapping[int, tuple[str, ...]],
) -> None:
    for number, key in enumerate(sights.keys):
        if key.station in stations and key.placement in placements:
            continue
        sight = sights[number]
        frames = first_of(list(dict.fromkeys(repr(sights.observations.views[i].frame) for i in sight.views[0])))
        said = f"{plural(len(sight.point_rows), 'point')} and {plural(len(sight.curve_rows), 'curve observation')} (on "
        said += f"{plural(len(distinct(sight.track_index)), 'curve')}) cannot fix its pose"
        if names := open_numbers.get(number, ()):
            stated = [_STATED[name] for name in names if name in _STATED]
            state = f", state {' or '.join(dict.fromkeys(stated))} as a prior" if stated else ""
            what = f"{', '.join(names)} of the camera cannot be determined: add another point or line{state}"
        else:
            what = _what_poses(sight)
        text = f"frame {frames} ({key}): {said}: {what}, or remove the view"
        raise DegenerateError(text, sights.observations.stations[key.station])
