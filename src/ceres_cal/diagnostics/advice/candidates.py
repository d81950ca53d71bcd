"""Possible next measurements, with a search for the best of each kind: heights, poles, boards, lines, frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from ceres_cal.base import Array, Frozen, InputError, Pose, SolutionError, field, replace
from ceres_cal.diagnostics.advice.outlook import Outlook
from ceres_cal.observations import NO_CURVES, NO_POINTS, Observations, Prior, gather_sights
from ceres_cal.problem import Estimate, Information, Key, Problem, Weighting, layout_of, stated_prior, tolerances
from ceres_cal.problem.reduced import information
from ceres_cal.problem.residuals import equations_of, residuals
from ceres_cal.problem.structure import Tolerance, make_structure
from ceres_cal.scene import Arc, Camera, Target, checkerboard, curve_points, custom, still
from ceres_cal.simulate import Scene, ViewPlan, board_pose, simulate, well_inside

POLE_M, POLE_SIGMA_M = 1.0, 0.005
"""Height of a pole, and standard deviation of its top's position along x and along y, m."""
BOARD = checkerboard(9, 6, 0.1)
_FRAMES = 10
_LINE_SPACING_M, _FRAME_SPACING_M = 0.05, 0.1
# Ratio of the remaining errors up to which a marked place is preferred for a pole: nobody measures a place to save a
# tenth. Nothing changes from half to double.
_MARKED = 1.1
_NEARER = ("upper", "right", "lower", "left")  # the edge that leans towards the camera, by quarter turns


class Measurement(Frozen):
    """A measurement in addition to what was observed.

    Attributes:
        kind: "tape", "pole", "board", "line" or "frames".
        words: one line that says what to do. steps: one line for each part of it, where it has parts.
        priors: what would be known of a station. Their values are the estimate's: only the sigmas matter.
        targets, tolerances: targets that are added, and how exactly they stand in place.
        placements: world_from_target. views: what the additional frames would show.
    """

    kind: str
    words: str
    steps: tuple[str, ...] = ()
    priors: tuple[Prior, ...] = ()
    targets: Mapping[str, Target] = field(default_factory=dict)
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)
    placements: Mapping[str, Pose] = field(default_factory=dict)
    views: tuple[ViewPlan, ...] = ()

    @property
    def is_seen_again(self) -> bool:
        """Whether it only repeats observations of the calibration, from the same place."""
        return bool(self.views) and not self.targets

    def before(self, cam_from_world: Pose, other: Pose) -> Measurement:
        """Return a copy whose placements are before a camera at another pose as these are before one at this pose."""
        moved = other.inverse @ cam_from_world
        return replace(self, placements={name: moved @ pose for name, pose in self.placements.items()})


def together(parts: Sequence[Measurement], words: str) -> Measurement:
    """Combine several measurements of one kind; their names must differ."""
    return Measurement(
        parts[0].kind,
        words,
        tuple(part.words for part in parts),
        tuple(prior for part in parts for prior in part.priors),
        {name: target for part in parts for name, target in part.targets.items()},
        {name: tolerance for part in parts for name, tolerance in part.tolerances.items()},
        {name: pose for part in parts for name, pose in part.placements.items()},
        tuple(plan for part in parts for plan in part.views),
    )


class Ground(Frozen):
    """The present knowledge, to which a measurement is added.

    Attributes:
        estimate: of everything. keys: (P) its free numbers. targets: as drawn.
        tolerances: those of the calibration. weighting: noise, px, of points and of curves, and the loss.
    """

    estimate: Estimate
    keys: tuple[Key, ...]
    targets: Mapping[str, Target]
    tolerances: Mapping[str, Tolerance]
    weighting: Weighting

    def information_of(self, measurement: Measurement) -> Information:
        """Return the information of a measurement about the free numbers, with its own unknowns integrated out.

        Its unknowns include placements and the offset of a pole. The information is zero where the camera sees nothing,
        or cannot project what it sees. Tolerances that the calibration had already add nothing.
        """
        try:
            return self._told_by(measurement)
        except (InputError, SolutionError):  # quiet: a measurement without information ranks last
            return Information.nothing(self.keys)

    def _told_by(self, measurement: Measurement) -> Information:
        """Like `information_of`, but raises where there is no information."""
        targets = {**self.targets, **measurement.targets}
        estimate = self._with(measurement, targets)
        observations = replace(_observed(estimate, targets, measurement.views), targets=targets)
        sights = gather_sights(observations, predicted=True)
        layout = layout_of(self.keys, estimate, measurement.placements)
        if len(sights):  # a measurement sees few of the hundreds of nodes of a surface
            seen = np.any(equations_of(sights, estimate, residuals(sights, estimate)).intrinsics != 0.0, axis=0)
            layout = replace(layout, free={name: own[seen[own]] for name, own in layout.free.items()})
        lenses = {name: camera.lens for name, camera in estimate.cameras.items()}
        stated = (stated_prior(prior, lenses[estimate.stations[prior.name].camera]) for prior in measurement.priors)
        priors = (*stated, *tolerances(estimate.structure, self.keys))
        told = information(Problem(sights, layout, priors, self.weighting), estimate)
        whole = told.points.beside_all([told.curves, told.stated, told.built])  # a lens's smoothness is known already
        return whole.marginal(whole.among(self.keys)).over(self.keys)

    def _with(self, measurement: Measurement, targets: Mapping[str, Target]) -> Estimate:
        """Return the estimate with what the measurement adds; of the placements only those that are still free."""
        solved = tuple(self.estimate.structure.dimensions)
        structure = make_structure(targets, {**self.tolerances, **measurement.tolerances}, solved)
        shared = dict.fromkeys(key.owner for key in self.keys if key.kind == "placement")
        return replace(
            self.estimate,
            placements={**{name: self.estimate.placements[name] for name in shared}, **measurement.placements},
            structure=structure.carrying(self.estimate.structure),
        )


def added_information(measurement: Measurement, ground: Ground, outlook: Outlook) -> Information:
    """Return the information that a measurement adds to the posterior; repeated observations only average out noise."""
    told = ground.information_of(measurement)
    return outlook.posterior.repeated(told) if measurement.is_seen_again else told


def _observed(estimate: Estimate, targets: Mapping[str, Target], views: tuple[ViewPlan, ...]) -> Observations:
    """Return what the views would show with everything as estimated, without noise, in units of sigma 1."""
    if not views:
        return Observations(targets, {}, (), NO_POINTS, NO_CURVES)
    stations = {plan.station: estimate.stations[plan.station] for plan in views}
    cameras = {station.camera: estimate.cameras[station.camera] for station in stations.values()}
    return simulate(Scene(targets, cameras, stations, estimate.placements, views)).observations


# ---- the best of each kind ------------------------------------------------------------------------------------------


class CandidateSearch(Frozen):
    """The search for the best measurement of each kind.

    Attributes:
        board: the board that would be shown, with its name.
    """

    ground: Ground
    outlook: Outlook
    board: tuple[str, Target]
    curves_observed: bool

    @property
    def station(self) -> str:
        return self.outlook.today.station

    @property
    def camera(self) -> Camera:
        return self.ground.estimate.camera_at(self.station)

    def candidates(self) -> Iterator[Measurement]:
        """Yield the candidates, those with the least work first."""
        pole_counts, board_counts, line_counts = (1, 3), (3, 6), (1, 3)
        yield from heights(self.station, self.camera)
        yield from self._best(poles(self), pole_counts, _poles_words, _marked_first)
        yield from self._best(lines(self), line_counts, _lines_words)
        yield from frames(self)
        yield from self._best(boards(self), board_counts, self._boards_words)

    def _best(
        self,
        pool: Iterator[Measurement],
        counts: Sequence[int],
        words: Callable[[Sequence[Measurement]], str],
        choose: Callable[[Sequence[Measurement], Array], int] = lambda pool, worst: int(np.argmin(worst)),
    ) -> Iterator[Measurement]:
        """Yield the best ones of a pool, in these counts; each adds most beside those before it."""
        left = list(pool)
        informations = [added_information(measurement, self.ground, self.outlook) for measurement in left]
        taken: list[Measurement] = []
        total = Information.nothing(self.ground.keys)
        while left and len(taken) < max(counts):
            errors = self.outlook.after_each(total, informations)
            number = choose(left, np.array([e.worst_mm for e in errors]))
            total = total + informations.pop(number)
            taken.append(left.pop(number))
            if len(taken) in counts:
                yield together(taken, words(taken))

    def _boards_words(self, taken: Sequence[Measurement]) -> str:
        grid = self.board[1].grid
        assert grid is not None  # `advise` takes no other board
        size = f"{grid.columns} x {grid.rows} corners, {1e3 * grid.spacing_m:.0f} mm apart"
        return f"show a board of {size}, in {len(taken)} frames"


# ---- the tape -------------------------------------------------------------------------------------------------------


def heights(station: str, camera: Camera) -> Iterator[Measurement]:
    """Yield measurements of the height, or of the whole position, by tape."""
    position_sigma_m = 0.01
    height_sigmas_m = (0.02, 0.01, 0.005)
    x, y, height = camera.position.tolist()
    for sigma in height_sigmas_m:
        prior = Prior("station", station, "height_m", (height,), (sigma,))
        yield Measurement("tape", f"measure the camera's height to {1e3 * sigma:.0f} mm", priors=(prior,))
    position = Prior("station", station, "position_m", (x, y, height), (position_sigma_m,) * 3)
    words = f"measure the camera's x, y and height to {1e3 * position_sigma_m:.0f} mm each"
    yield Measurement("tape", words, priors=(position,))


# ---- poles ----------------------------------------------------------------------------------------------------------


def poles(search: CandidateSearch) -> Iterator[Measurement]:
    """Yield a pole at each place of a grid over the field, and on each of its marked points, where its top is visible.

    Where phi is followed along its profile, it must be visible from each pose that the camera may have, except for
    those that are hardly above the pole.
    """
    most, step_m = 12, 0.5  # places along the longer side, on full steps
    camera, grid = search.camera, search.outlook.today
    grid_m = step_m * np.ceil(max(np.ptp(grid.x_m), np.ptp(grid.y_m)) / (most * step_m))
    top = min(POLE_M, float(np.floor(4.0 * camera.position[2]) / 10.0))  # shorter under a low camera
    elsewhere = [estimate.camera_at(search.station) for _, estimate in search.outlook.possible]
    cameras = [camera, *(other for other in elsewhere if other.position[2] > 2.0 * top)]
    x, y = (np.arange(np.ceil(a[0] / grid_m), a[-1] / grid_m + 1e-9) * grid_m for a in (grid.x_m, grid.y_m))
    places = [("", float(a), float(b)) for a in x for b in y]
    for target in still(search.ground.targets).values():
        places += [(name, a, b) for name, (a, b, z) in target.points.items() if z == 0.0]
    tops = np.array([(a, b, top) for _, a, b in places])
    for number in np.flatnonzero(np.all([well_inside(one, tops) for one in cameras], axis=0)).tolist():
        yield _pole(search.station, *places[number], top)


def _pole(station: str, mark: str, x: float, y: float, top: float) -> Measurement:
    name = f"pole_{mark}" if mark else f"pole_{x:.2f}_{y:.2f}"
    where = f"on {mark} ({x:.2f}, {y:.2f} m)" if mark else f"at ({x:.2f}, {y:.2f} m)"
    frames = tuple(f"{name}_{number:02d}" for number in range(1, _FRAMES + 1))
    return Measurement(
        "pole",
        f"{where}, its top {top:.2f} m above the field",
        targets={name: custom({"top": (x, y, top)})},
        tolerances={name: Tolerance(points_m=POLE_SIGMA_M)},
        views=(ViewPlan(frames, station, name),),
    )


def _marked_first(pool: Sequence[Measurement], worst_mm: Array) -> int:
    """Return the best place, or a marked one that is nearly as good: nobody has to measure its position."""
    marked = np.array([measurement.words.startswith("on ") for measurement in pool])
    near = marked & (worst_mm <= _MARKED * np.min(worst_mm))
    return int(np.argmin(np.where(near, worst_mm, np.inf))) if near.any() else int(np.argmin(worst_mm))


def _poles_words(taken: Sequence[Measurement]) -> str:
    what = "a pole" if len(taken) == 1 else f"{len(taken)} poles"
    return f"stand {what} upright, to {1e3 * POLE_SIGMA_M:.0f} mm, and observe the top in {_FRAMES} frames"


# ---- boards ---------------------------------------------------------------------------------------------------------


def boards(search: CandidateSearch) -> Iterator[Measurement]:
    """Yield the board at several places of the image, distances and tilts, where it is visible and above the floor."""
    least_height_m = 0.05  # of any corner of a board over the floor
    board_tilts_deg = (20.0, 40.0)
    board_places = (0.2, 0.5, 0.8)  # of the image's width and height
    board_sizes = (0.5, 0.3)  # shares of the image's shorter side that a board's diagonal takes
    name, board = search.board
    camera, size = search.camera, np.array(search.camera.image_size, dtype=float)
    diagonal = float(np.linalg.norm(np.ptp(board.point_array, axis=0)))
    pixels = [np.round(size * place) for place in product(board_places, repeat=2)]
    middles = [(pixel, camera.rays(pixel[None])[0]) for pixel in pixels]
    every = product(board_sizes, middles, board_tilts_deg, enumerate(_NEARER))
    for share, (pixel, line_of_sight), tilt, (quarter, edge) in every:
        distance = camera.phi * diagonal / (share * float(size.min()))
        turn = (np.deg2rad(tilt), 0.5 * np.pi * quarter, 0.0)
        held = camera.cam_from_world.inverse @ board_pose(board, line_of_sight, distance, turn)
        corners = held.transform(board.point_array)
        if np.min(corners[:, 2]) < least_height_m or not np.all(well_inside(camera, corners)):
            continue
        label = f"advised_{share:.1f}_{pixel[0]:.0f}_{pixel[1]:.0f}_{tilt:.0f}_{edge}"
        words = (
            f"middle at pixel ({pixel[0]:.0f}, {pixel[1]:.0f}), {distance:.2f} m from the camera, tilted by "
            f"{tilt:.0f} deg with its {edge} edge nearer"
        )
        view = ViewPlan((label,), search.station, name, label)
        yield Measurement("board", words, targets={name: board}, placements={label: held}, views=(view,))


# ---- the field's own curves -----------------------------------------------------------------------------------------


def lines(search: CandidateSearch) -> Iterator[Measurement]:
    """Yield each curve of the field that the image shows, observed densely in one more frame."""
    for name, target in still(search.ground.targets).items():
        for curve in target.curves:
            stretch = _seen_stretch(search, target, curve)
            if stretch is not None:
                plan = ViewPlan((f"advised_{curve}",), search.station, name, None, (), (curve,), _LINE_SPACING_M)
                yield Measurement("line", f"{curve}, {stretch}", views=(plan,))


def _seen_stretch(search: CandidateSearch, target: Target, name: str) -> str | None:
    """Return in words which stretch of a curve the image shows; None where it shows none."""
    fine = 199  # pieces of a curve, to tell which stretch is seen
    curve = target.curves[name]
    places = curve_points(curve, 0, fine)
    seen = well_inside(search.camera, places)
    if not seen.any():
        return None
    (x1, y1, _), (x2, y2, _) = places[seen][[0, -1]]
    if isinstance(curve, Arc):
        x, y, _ = curve.centre
        return f"around ({x:.2f}, {y:.2f} m), {100 * np.mean(seen):.0f} % of it in view"
    return f"from ({x1:.2f}, {y1:.2f}) to ({x2:.2f}, {y2:.2f} m)"


def _lines_words(taken: Sequence[Measurement]) -> str:
    what = "a line" if len(taken) == 1 else f"{len(taken)} lines"
    return f"observe {what} every {1e3 * _LINE_SPACING_M:.0f} mm in one more frame"


def frames(search: CandidateSearch) -> Iterator[Measurement]:
    """Yield more frames of the field, as it was observed: its curves, or its points where no curves were."""
    names = tuple(f"advised_{number:02d}" for number in range(1, _FRAMES + 1))
    for name, target in still(search.ground.targets).items():
        if search.curves_observed and target.curves:
            plan = ViewPlan(names, search.station, name, None, (), None, _FRAME_SPACING_M)
            what = f"every line, one point every {1e3 * _FRAME_SPACING_M:.0f} mm"
        elif target.points:
            plan, what = ViewPlan(names, search.station, name, None, None, ()), "every point"
        else:
            continue
        yield Measurement("frames", f"take {_FRAMES} more frames of {name!r}, {what}", views=(plan,))
