"""Define which numbers are free, fixed, shared or under a prior: the only module that knows the solver's layout.

The solver has one block per camera with its free intrinsics (in the order of `intrinsic_names`, with coefficients
scaled to be of order one) and one 6-vector (rotation vector, translation) per free station and per placement.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter

import numpy as np

from ceres_cal.base import Array, Indices, InputError, Pose, Poses, chained, inverted, no_such, take_types
from ceres_cal.base.frozen import Frozen, cached_property, field, replace
from ceres_cal.observations import Observations, Owner, Prior, SightKey
from ceres_cal.problem.structure import Structure, Tolerance, make_structure
from ceres_cal.scene import Camera, Target
from ceres_cal.scene.lens import Lens, lens_class, make_lens

AUTO = "auto"
"""The lens is chosen from the data (`calibration.lens_choice`); the result is in the options of the calibration."""
PAPERS_POWERS = (2, 3)
_OF_POWERS = "radial"  # the lens that is meant if only powers are given
OF_PIXELS = ("phi", "aspect", "cx", "cy")
"""The intrinsics that every camera has, in the order of the solver's vector; skew follows after the coefficients."""
LOSSES = ("trivial", "huber", "soft_l1", "cauchy", "tukey")


class OneLens(Frozen, eq=True):
    """The lens of one camera, see `Options`."""

    lens: str
    powers: tuple[int, ...] = ()
    coefficients: tuple[str, ...] | None = None
    terms: tuple[str, ...] = ()
    free_skew: bool = False


class Options(Frozen, eq=True):
    """Options of a calibration: what to solve for, and how.

    Attributes:
        lens: one of `scene.lens.LENSES`, or "auto": chosen from the data.
        powers: powers of the radius, for a lens that leaves the choice; without a named lens they mean "radial". ()
            means (2, 3), or for "spline" as many as the residuals require (`calibration.solving`).
        coefficients: names of the lens coefficients that are solved for, the others are 0; None: all.
        free_principal_point: if False, it is held at the image centre, or where `fixed` says.
        free_aspect: whether fy / fx is free without a prior (True), or held (False) at 1 or what `fixed` says. None:
            free under what is usual of cameras, and held if that is not used.
        free_skew: whether the skew of the pixel axes is free; if not, it is 0 or what `fixed` says. For a "spline"
            without stated powers it is free from eight views on.
        usual_camera: whether numbers that are not stated have priors by what is usual of cameras: a principal point
            near the middle of its image, square pixels, little decentring, a phi that lenses have
            (`priors.usual_cameras`). They have heavy tails and give way to observations.
        terms: terms of the lens beyond those that it always has: names of its `more_terms`.
        fixed: numbers held, by name: phi, aspect, cx, cy (px), skew and the lens's coefficients in the units of the
            files. They hold for every camera.
        priors: prior knowledge, besides the observations' own.
        tolerances: target -> how far it may have been built from its drawing.
        dimensions: lengths of targets that are solved for, "target/dimension" such as "field/field_length_m": from a
            prior on them, or from the target as drawn. Those with a prior are included.
        as_built: for targets without a tolerance, "estimate" how far they were built from their drawings, where
            residuals repeat over the views (the result is in the calibration's tolerances), or take them "as drawn".
        loss: robust loss of each observation: one of LOSSES. loss_scale: where it starts to bend, in standard
            deviations; halving or doubling 2.5 changes the squared error by less than a tenth.
        reject_sigma: observations farther off than this many standard deviations are rejected and listed. At half of 5
            good ones are rejected, and the squared error of boards grows by a quarter; at twice 5, with 20 % outliers
            over a field, by three quarters.
        noise_scale: "estimate" the factor on the stated sigmas of points and curves from the residuals, or "stated".
        closed_form_only: stop at the paper's own method (radial fit, four points, max-norm lambda): a baseline for
            comparison, not a calibration.
        max_iterations: of each solve. threads: of the solver; 0 chooses.
        lens_by_camera: camera -> its lens, where that differs from `lens`, for example if chosen for each camera.
    """

    lens: str = AUTO
    powers: tuple[int, ...] = ()
    coefficients: tuple[str, ...] | None = None
    free_principal_point: bool = True
    free_aspect: bool | None = None
    free_skew: bool = False
    terms: tuple[str, ...] = ()
    usual_camera: bool = True
    fixed: Mapping[str, float] = field(default_factory=dict)
    priors: tuple[Prior, ...] = ()
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)
    dimensions: tuple[str, ...] = ()
    loss: str = "huber"
    loss_scale: float = 2.5
    reject_sigma: float = 5.0
    noise_scale: str = "estimate"
    as_built: str = "estimate"
    closed_form_only: bool = False
    max_iterations: int = 100
    threads: int = 0
    lens_by_camera: Mapping[str, OneLens] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Range of standard deviations that make sense: a bound below rejects everything, one above rejects nothing.
        sigmas = (1e-3, 1e9)
        largest = 2**31 - 1  # largest whole number of Ceres
        take_types(self)
        if self.lens == AUTO and self.powers:
            object.__setattr__(self, "lens", _OF_POWERS)
        if self.lens != AUTO:
            lens_class(self.lens, also=(AUTO,))
            left_open = () if lens_class(self.lens).set_at_start else PAPERS_POWERS
            object.__setattr__(self, "powers", tuple(self.powers) or left_open)
        elif self.terms:
            raise InputError("terms need a named lens: leave them out, or name the lens")
        if self.loss not in LOSSES:
            raise InputError(no_such("loss", self.loss, LOSSES))
        if self.noise_scale not in ("estimate", "stated"):
            raise InputError(f"noise_scale must be 'estimate' or 'stated', not {self.noise_scale!r}")
        if self.as_built not in ("estimate", "as drawn"):
            raise InputError(f"as_built must be 'estimate' or 'as drawn', not {self.as_built!r}")
        stated = (prior.dimension for prior in self.priors if prior.dimension)
        object.__setattr__(self, "dimensions", tuple(dict.fromkeys((*self.dimensions, *stated))))
        names = self.intrinsic_names  # this also refuses unknown terms
        if unknown := [name for name in self.coefficients or () if name not in names[len(OF_PIXELS) : -1]]:
            raise InputError(f"cannot solve for {unknown[0]!r}: {self._which} has {', '.join(names)}")
        for name, value in self.fixed.items():
            if name not in names:
                raise InputError(f"cannot fix {name!r}: {self._which} has {', '.join(names)}")
            if not np.isfinite(value):
                raise InputError(f"cannot fix {name} at {value}: give a finite number")
        if self.reject_sigma == np.inf:  # the largest value that counts, which files can store
            object.__setattr__(self, "reject_sigma", sigmas[1])
        for name in ("loss_scale", "reject_sigma"):
            if not sigmas[0] <= getattr(self, name) <= sigmas[1]:
                least, most = sigmas
                raise InputError(f"{name} must be {least:g} to {most:g} sigmas, not {getattr(self, name)}")
        if not self.max_iterations > 0:
            raise InputError(f"max_iterations must be above 0, not {self.max_iterations}")
        if self.threads < 0:
            raise InputError(f"threads must be 0 (to choose) or above, not {self.threads}")
        for name in ("max_iterations", "threads"):
            if getattr(self, name) > largest:
                raise InputError(f"{name} must be {largest} at most, not {getattr(self, name):.3g}")
        _ = self._own  # this refuses lenses that do not exist

    @property
    def _which(self) -> str:
        return "a lens that is still to be chosen (name it)" if self.lens == AUTO else f"the {self.lens} lens"

    def of_camera(self, name: str) -> Options:
        """These options with a camera's own lens."""
        return self._own.get(name, self)

    def with_lenses(self, each: Mapping[str, Options]) -> Options:
        """These options with the lens of each camera from the given options."""
        parts = ("lens", "powers", "coefficients", "terms", "free_skew")
        named = {name: OneLens(*(getattr(one, part) for part in parts)) for name, one in each.items()}
        first = next(iter(named.values()))
        return replace(self, **vars(first), lens_by_camera={name: one for name, one in named.items() if one != first})

    @property
    def is_rough(self) -> bool:
        """Whether the lens of a camera has no formula."""
        return any(one.blank_lens.roughness for one in (self, *self._own.values()))

    def structure_of(self, targets: Mapping[str, Target]) -> Structure:
        """The structure of the targets that may differ from the drawing, with values as drawn."""
        return make_structure(targets, self.tolerances, self.dimensions)

    @cached_property
    def held(self) -> Mapping[str, float]:
        """The numbers that `fixed` holds, and coefficients that are not solved for, which are 0."""
        if self.coefficients is None:
            return self.fixed
        names = self._unset.names
        return {**{name: 0.0 for name in names if name not in self.coefficients}, **self.fixed}

    @cached_property
    def intrinsic_names(self) -> tuple[str, ...]:
        """Names of a camera's numbers that may be stated; without coefficients if the lens is still to be chosen."""
        return (*OF_PIXELS, "skew") if self.lens == AUTO else intrinsic_names(self.blank_lens)

    @cached_property
    def blank_lens(self) -> Lens:
        """The chosen lens with its fixed coefficients; the others are 0."""
        lens = self._unset
        return lens.with_values([self.fixed.get(name, 0.0) for name in lens.names]) if self.fixed else lens

    def with_first_power(self, views: int) -> Options:
        """These options with a free skew, which displaces by the first power of the radius, if the lens's powers are
        left open and there are enough views.
        """
        enough_views = 8  # these determine a skew beside a lens without a formula: no test decides it
        if self.powers or views < enough_views or not self.usual_camera:
            return self
        return replace(self, free_skew="skew" not in self.fixed)

    @cached_property
    def _own(self) -> dict[str, Options]:
        """Camera -> these options with its own lens, where that differs."""
        return {name: replace(self, **vars(one), lens_by_camera={}) for name, one in self.lens_by_camera.items()}

    @property
    def _unset(self) -> Lens:
        """The chosen lens with all coefficients 0."""
        return make_lens(self.lens, self.powers or PAPERS_POWERS, terms=self.terms)


def intrinsic_names(lens: Lens) -> tuple[str, ...]:
    """Names of a camera's intrinsics in the order of the solver's vector."""
    return (*OF_PIXELS, *lens.names, "skew")


def unit_px(camera: Camera) -> float:
    """Half the image diagonal: the unit of radius in which the solver's coefficients are of order one."""
    return 0.5 * math.hypot(*camera.image_size)


def intrinsics_vector(camera: Camera) -> Array:
    """(4 + coefficients + 1,) the solver's numbers of a camera."""
    scaled = np.asarray(camera.lens.values) * camera.lens.scales(unit_px(camera))
    return np.array([camera.phi, camera.aspect, *camera.principal_point, *scaled, camera.skew])


def intrinsics_scales(camera: Camera) -> Array:
    """Factors from a camera's numbers in the files' units to the solver's."""
    return np.concatenate([np.ones(4), camera.lens.scales(unit_px(camera)), np.ones(1)])


def with_intrinsics(camera: Camera, vector: Array) -> Camera:
    """The camera with its intrinsics taken from the solver's vector."""
    phi, aspect, cx, cy = (float(v) for v in vector[:4])
    lens = camera.lens.with_values(vector[4:-1] / camera.lens.scales(unit_px(camera)))
    return replace(camera, phi=phi, aspect=aspect, principal_point=(cx, cy), lens=lens, skew=float(vector[-1]))


def as_held(estimate: Estimate, options: Options) -> Estimate:
    """The estimate with the camera numbers that the options hold at their held values."""
    return replace(estimate, cameras={name: _as_held(camera, options) for name, camera in estimate.cameras.items()})


def _as_held(camera: Camera, options: Options) -> Camera:
    """The camera with the numbers that the options hold at their held values."""
    middle = 0.5 * (np.array(camera.image_size) - 1.0)
    held = {} if options.free_principal_point else dict(zip(("cx", "cy"), middle.tolist(), strict=True))
    held |= options.fixed
    vector, scales, names = intrinsics_vector(camera), intrinsics_scales(camera), intrinsic_names(camera.lens)
    for name, value in held.items():
        vector[names.index(name)] = value * scales[names.index(name)]
    return with_intrinsics(camera, vector)


class Station(Frozen, eq=True):
    """One fixed pose of a camera over the field."""

    camera: str
    cam_from_world: Pose


class Estimate(Frozen, eq=True):
    """A value for everything that is solved for: cameras (without a pose), stations and placements, by name."""

    cameras: Mapping[str, Camera]
    stations: Mapping[str, Station]
    placements: Mapping[str, Pose]
    """world_from_target of each placement."""
    structure: Structure
    """The targets as built."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "placements", Poses.of(self.placements))  # costs nothing when repeated

    @property
    def has_floor(self) -> bool:
        """Whether the world is a field. With boards only, a camera is the world, and nothing lies in its plane
        z = 0.
        """
        return not any(np.array_equal(one.cam_from_world.matrix, np.eye(3, 4)) for one in self.stations.values())

    def station_name(self, name: str | None) -> str:
        """The name of a station; if `name` is None, that of the only station.

        Raises:
            InputError: there is no such station, or no name is given and there are several.
        """
        if name is None and len(self.stations) == 1:
            return next(iter(self.stations))
        if name is None:
            raise InputError(f"which station? Name one of {', '.join(self.stations)} (--station NAME)")
        if name not in self.stations:
            raise InputError(no_such("station", name, self.stations))
        return name

    def camera_at(self, station: str, placement: str | None = None) -> Camera:
        """The station's camera in the world, or in the frame of a placement (its cam_from_world is cam_from_target)."""
        pose = self.stations[station].cam_from_world
        if placement is not None:
            pose = pose @ self.placements[placement]
        return self.cameras[self.stations[station].camera].at(pose)

    def pose_stack(self, keys: Sequence[SightKey]) -> Array:
        """(S, 3, 4) cam_from_frame of each sight as [R t]."""
        stations = self._station_stack(keys)
        return chained(stations, Poses.of(self.placements).of_names(list(map(itemgetter(2), keys))))

    def with_placements(self, keys: Sequence[SightKey], cam_from_target: Array) -> Estimate:
        """The estimate with the placement of each key where its station sees it, at cam_from_target (S, 3, 4)."""
        names = [key.placement for key in keys if key.placement is not None]
        stations = self._station_stack(keys)
        moved = chained(inverted(stations), cam_from_target)
        return replace(self, placements=Poses.of(self.placements).updated(names, moved))

    def _station_stack(self, keys: Sequence[SightKey]) -> Array:
        """(S, 3, 4) cam_from_world of each sight; (3, 4) if all have the same station."""
        names = list(map(itemgetter(1), keys))
        poses = {name: self.stations[name].cam_from_world for name in dict.fromkeys(names)}
        if len(poses) == 1:
            return poses[names[0]].matrix
        return Poses.of(poses).of_names(names)


class Layout(Frozen, eq=True):
    """The numbers that the solver may move.

    Attributes:
        free: camera -> indices into its intrinsics vector.
        stations, placements: names of the free poses.
    """

    free: Mapping[str, Indices]
    stations: frozenset[str]
    placements: frozenset[str]

    @property
    def size(self) -> int:
        """Number of free numbers."""
        return sum(len(f) for f in self.free.values()) + 6 * (len(self.stations) + len(self.placements))

    def holding(self, camera: str, number: int) -> Layout:
        """The layout with one of a camera's intrinsics held."""
        return replace(self, free={**self.free, camera: self.free[camera][self.free[camera] != number]})

    def of(self, keys: Iterable[SightKey]) -> Layout:
        """The layout of a problem with only these sights. Placements that they do not show are not free."""
        return replace(self, placements=self.placements & {key.placement for key in keys})


def make_layout(observations: Observations, options: Options) -> Layout:
    """The layout of a calibration: everything is free except what the options fix and what nothing determines."""
    views = observations.shown_views
    return Layout(
        {name: _free_intrinsics(options.of_camera(name)) for name in observations.cameras},
        frozenset(view.station for view in views) - anchored_stations(observations),
        frozenset(view.placement for view in views if view.placement is not None),
    )


def _free_intrinsics(options: Options) -> Indices:
    """Indices of the free numbers in the vector of a camera with the lens of these options."""
    names = intrinsic_names(options.blank_lens)
    held = {*options.held, *options.blank_lens.set_at_start}
    if not options.free_principal_point:
        held |= {"cx", "cy"}
    if not (options.usual_camera if options.free_aspect is None else options.free_aspect):
        held |= {"aspect"}
    if not options.free_skew:
        held |= {"skew"}
    return np.array([i for i, name in enumerate(names) if name not in held], dtype=np.int64)


def anchored_stations(observations: Observations) -> frozenset[str]:
    """One station of each group that no view connects with the world: its camera frame is used as the world.

    Boards alone determine only relative poses; holding one station removes this freedom.
    """
    seen_by = dict[str | None, set[str]]()
    for view in observations.shown_views:
        seen_by.setdefault(view.placement, set()).add(view.station)
    known = seen_by.pop(None, set())
    together, anchors = [stations for stations in seen_by.values() if len(stations) > 1], list[str]()
    for name in dict.fromkeys(view.station for view in observations.shown_views):
        known = connected(known, together)
        if name not in known:
            anchors.append(name)
            known.add(name)
    return frozenset(anchors)


def connected(start: Iterable[str], groups: Iterable[set[str]]) -> set[str]:
    """The start, and everything that groups connect with it, each with what it overlaps."""
    linked, before = {*start}, set[str]()
    while linked != before:
        before, linked = linked, linked.union(*(group for group in groups if group & linked))
    return linked


# ---- charts: the numbers of a camera as Ceres moves them ------------------------------------------------------------

# A picture taken straight down determines only phi over height: with another phi everything looks the same from another
# height, through a lens whose coefficients of tan^n have grown with phi^(n - 1). Gauss-Newton converges slowly along
# this curve. With coefficients over phi^(n - 1), which act on pixels as the paper's do, it is a line (a chart).

_PHI = 0  # index of phi in the intrinsics


class Chart:
    """Coordinates in which Ceres moves a camera's free numbers. Ceres calls this a manifold, which pyceres does not let
    Python define.
    """

    def __init__(self, camera: Camera, free: Indices) -> None:
        powers = np.array([0.0] * 4 + [order - 1.0 for order in camera.lens.orders] + [0.0])
        self._powers, self._phi, self._unit = powers[free], free.tolist().index(_PHI), unit_px(camera)

    def moved(self, numbers: Array) -> Array:
        """(K,) the coordinates that Ceres moves, from the free numbers (K,)."""
        return np.asarray(numbers / self._scales(numbers))

    def numbers(self, moved: Array) -> Array:
        """(K,) the free numbers, from the coordinates that Ceres moves."""
        return np.asarray(moved * self._scales(moved))

    def chained(self, jacobian: Array, numbers: Array) -> Array:
        """(N, K) derivatives by the coordinates that Ceres moves, from those by the free numbers (K,)."""
        chained = jacobian * self._scales(numbers)
        chained[:, self._phi] += jacobian @ (self._powers * numbers) / numbers[self._phi]
        return np.asarray(chained)

    def _scales(self, numbers: Array) -> Array:
        nothing = 1e-30  # phi may be 0 during a solve: such a camera shows nothing
        return np.asarray((numbers[self._phi] / self._unit or nothing) ** self._powers)


def chart_of(camera: Camera, free: Indices) -> Chart | None:
    """The chart of a camera; None where Ceres moves the numbers as they are."""
    return Chart(camera, free) if camera.lens.acts_on_tangents and _PHI in free else None


def charts_of(estimate: Estimate, layout: Layout) -> dict[Owner, Chart]:
    """The charts of cameras that have one."""
    charts = {("camera", name): chart_of(camera, layout.free[name]) for name, camera in estimate.cameras.items()}
    return {owner: chart for owner, chart in charts.items() if chart is not None}
