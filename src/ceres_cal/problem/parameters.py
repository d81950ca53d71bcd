"""Which numbers are free, fixed, shared or under a prior: the one owner of the solver's layout.

The solver sees one block per camera with its free intrinsics (in the order of `intrinsic_names`, coefficients scaled to
be of order one) and one 6-vector (rotation vector, translation) per free station and per placement.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter

import numpy as np

from ceres_cal.base import Array, Indices, InputError, Pose, Poses, brief, chained, inverted, no_such, take_types
from ceres_cal.base.frozen import Frozen, cached_property, field, replace
from ceres_cal.observations import Observations, Owner, Prior, SightKey
from ceres_cal.problem.structure import Structure, Tolerance, make_structure
from ceres_cal.scene import Camera, Target
from ceres_cal.scene.lens import Lens, lens_class, make_lens

AUTO = "auto"
"""The lens that the data ask for: which it is, a calibration says in its options (`calibration.lens_choice`)."""
PAPERS_POWERS = (2, 3)
_OF_POWERS = "radial"  # the lens that powers stand for where none is named
OF_PIXELS = ("phi", "aspect", "cx", "cy")
"""The intrinsics that every camera has, in the order of the solver's vector; skew comes behind the coefficients."""
LOSSES = ("trivial", "huber", "soft_l1", "cauchy", "tukey")


class OneLens(Frozen, eq=True):
    """The lens of one camera, see `Options`."""

    lens: str
    powers: tuple[int, ...] = ()
    coefficients: tuple[str, ...] | None = None
    terms: tuple[str, ...] = ()
    free_skew: bool = False


class Options(Frozen, eq=True):
    """What to solve for and how.

    Attributes:
        lens: one of `scene.lens.LENSES`, or "auto": the one that the data ask for. powers: of a lens that leaves the
            choice, as "radial" does, which powers alone stand for; () for (2, 3), of "spline" for as many as the
            residuals ask for from there on (`calibration.solving`).
        coefficients: names of those of the lens that are solved for, the others are 0; None: all.
        free_principal_point: else it is held at the image centre, or where `fixed` says.
        free_aspect: whether fy / fx is free, with nothing known of it (True), or held (False) at 1 or what `fixed`
            says. None: free under what is usual of cameras, and held without that.
        free_skew: whether the lean of the pixels' columns is free; else it is 0, or what `fixed` says. That of a
            "spline" whose powers are open is free from eight views on.
        usual_camera: whether what is usual of cameras is taken to hold of numbers that nobody states: a principal point
            near the middle of its image, square pixels, little decentring, a phi that lenses have
            (`priors.usual_cameras`), under distributions with heavy tails that give way to observations.
        terms: of the lens, besides those that it always has: names of its `more_terms`.
        fixed: numbers held, by name: phi, aspect, cx, cy (px), skew and the lens's coefficients in the units of the
            files.
            They hold for every camera.
        priors: what is known beforehand, besides the observations' own.
        tolerances: target -> how far it may have been built from its drawing.
        dimensions: lengths of targets that are solved for, "target/dimension" such as "field/field_length_m": from what
            a prior says of them, or from the target as drawn. Those that a prior is about are among them.
        as_built: of a target without a tolerance "estimate" how far it was built from its drawing, where residuals
            repeat over the views (what it is, a calibration says in its tolerances), or take it "as drawn".
        loss: robust loss of each observation: one of LOSSES. loss_scale: where it starts to bend, in standard
            deviations; from half to double of 2.5 the squared error changes by under a tenth.
        reject_sigma: observations farther off than this many standard deviations are taken out and listed. At half of 5
            good ones go, and the squared error of boards grows by a quarter; at double of it, with 20 % outliers over a
            field, by three quarters.
        noise_scale: "estimate" the factor on the stated sigmas of points and curves from the residuals, or "stated".
        closed_form_only: stop at the paper's own method (radial fit, four points, max-norm lambda): a baseline to
            compare with, not a calibration.
        max_iterations: of each solve. threads: of the solver; 0 chooses.
        lens_by_camera: camera -> its lens, where that is another one than `lens`, as it may be where each was chosen by
            itself.
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
        # Standard deviations that somebody may mean: a bound below takes every observation out, one above takes out
        # none.
        sigmas = (1e-3, 1e9)
        largest = 2**31 - 1  # whole number that Ceres counts with
        take_types(self)
        if self.lens == AUTO and self.powers:
            object.__setattr__(self, "lens", _OF_POWERS)
        if self.lens != AUTO:
            lens_class(self.lens)
            left_open = () if lens_class(self.lens).set_at_start else PAPERS_POWERS
            object.__setattr__(self, "powers", tuple(self.powers) or left_open)
        elif self.terms:
            raise InputError("terms are of a lens that is named: leave them out, or name it")
        if self.loss not in LOSSES:
            raise InputError(no_such("loss", self.loss, LOSSES))
        if self.noise_scale not in ("estimate", "stated"):
            raise InputError(f"noise_scale must be 'estimate' or 'stated', not {self.noise_scale!r}")
        if self.as_built not in ("estimate", "as drawn"):
            raise InputError(f"as_built must be 'estimate' or 'as drawn', not {self.as_built!r}")
        stated = (prior.dimension for prior in self.priors if prior.dimension)
        object.__setattr__(self, "dimensions", tuple(dict.fromkeys((*self.dimensions, *stated))))
        names = self.intrinsic_names  # which refuses unknown terms, too
        if unknown := [name for name in self.coefficients or () if name not in names[len(OF_PIXELS) : -1]]:
            raise InputError(f"cannot solve for {unknown[0]!r}: {self._which} has {', '.join(names)}")
        for name, value in self.fixed.items():
            if name not in names:
                raise InputError(f"cannot fix {name!r}: {self._which} has {', '.join(names)}")
            if not np.isfinite(value):
                raise InputError(f"cannot fix {name} at {value}: give a finite number")
        if self.reject_sigma == np.inf:  # as far as anything counts, which files can hold
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
        _ = self._own  # which refuses a lens that is none

    @property
    def _which(self) -> str:
        return "a lens that is still to be chosen (name it)" if self.lens == AUTO else f"the {self.lens} lens"

    def of_camera(self, name: str) -> Options:
        """These options with a camera's own lens."""
        return self._own.get(name, self)

    def with_lenses(self, each: Mapping[str, Options]) -> Options:
        """These options with the lens of each camera as others have it."""
        parts = ("lens", "powers", "coefficients", "terms", "free_skew")
        named = {name: OneLens(*(getattr(one, part) for part in parts)) for name, one in each.items()}
        first = next(iter(named.values()))
        return replace(self, **vars(first), lens_by_camera={name: one for name, one in named.items() if one != first})

    @property
    def is_rough(self) -> bool:
        """Whether the lens of a camera has no formula."""
        return any(one.blank_lens.roughness for one in (self, *self._own.values()))

    def structure_of(self, targets: Mapping[str, Target]) -> Structure:
        """What may be built otherwise than it is drawn of the targets, all of it as drawn."""
        return make_structure(targets, self.tolerances, self.dimensions)

    @cached_property
    def held(self) -> Mapping[str, float]:
        """What `fixed` holds, and at 0 the coefficients that are not solved for."""
        if self.coefficients is None:
            return self.fixed
        names = self._unset.names
        return {**{name: 0.0 for name in names if name not in self.coefficients}, **self.fixed}

    @cached_property
    def intrinsic_names(self) -> tuple[str, ...]:
        """What the camera can be told of beforehand: of a lens that is still to be chosen no coefficients."""
        return (*OF_PIXELS, "skew") if self.lens == AUTO else intrinsic_names(self.blank_lens)

    @cached_property
    def blank_lens(self) -> Lens:
        """The chosen lens with its fixed coefficients; the others are 0."""
        lens = self._unset
        return lens.with_values([self.fixed.get(name, 0.0) for name in lens.names]) if self.fixed else lens

    def with_first_power(self, views: int) -> Options:
        """These options with a skew, which displaces by the first power, of a lens whose powers are left open, where so
        many views tell it.
        """
        enough_views = 8  # that tell a skew beside a lens without a formula: no test decides there
        if self.powers or views < enough_views or not self.usual_camera:
            return self
        return replace(self, free_skew="skew" not in self.fixed)

    @cached_property
    def _own(self) -> dict[str, Options]:
        """Camera -> these options with its lens, where that is another one."""
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
    """The solver's numbers of a camera, (4 + coefficients + 1,)."""
    scaled = np.asarray(camera.lens.values) * camera.lens.scales(unit_px(camera))
    return np.array([camera.phi, camera.aspect, *camera.principal_point, *scaled, camera.skew])


def intrinsics_scales(camera: Camera) -> Array:
    """What a camera's numbers in the files' units are multiplied with to become the solver's."""
    return np.concatenate([np.ones(4), camera.lens.scales(unit_px(camera)), np.ones(1)])


def with_intrinsics(camera: Camera, vector: Array) -> Camera:
    """The camera with the solver's numbers put in."""
    phi, aspect, cx, cy = (float(v) for v in vector[:4])
    lens = camera.lens.with_values(vector[4:-1] / camera.lens.scales(unit_px(camera)))
    return replace(camera, phi=phi, aspect=aspect, principal_point=(cx, cy), lens=lens, skew=float(vector[-1]))


def as_held(estimate: Estimate, options: Options) -> Estimate:
    """The estimate with the numbers of its cameras put in that the options hold."""
    return replace(estimate, cameras={name: _as_held(camera, options) for name, camera in estimate.cameras.items()})


def _as_held(camera: Camera, options: Options) -> Camera:
    """The camera with the numbers put in that the options hold."""
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
    """A value for everything the solve is about: cameras (at no particular pose), stations, placements, by name."""

    cameras: Mapping[str, Camera]
    stations: Mapping[str, Station]
    placements: Mapping[str, Pose]
    """world_from_target of each placement."""
    structure: Structure
    """The targets as built."""

    __repr__ = brief

    def __post_init__(self) -> None:
        object.__setattr__(self, "placements", Poses.of(self.placements))  # which costs nothing from then on

    @property
    def has_floor(self) -> bool:
        """Whether the world is a field: of boards alone a camera is the world, and in its plane z = 0 lies nothing."""
        return not any(np.array_equal(one.cam_from_world.matrix, np.eye(3, 4)) for one in self.stations.values())

    def station_name(self, name: str | None) -> str:
        """The name of a station; without one, that of the only one there is.

        Raises:
            InputError: no such station, or no name where there are several.
        """
        if name is None and len(self.stations) == 1:
            return next(iter(self.stations))
        if name is None:
            raise InputError(f"which station? Name one of {', '.join(self.stations)}")
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
        """cam_from_frame of each sight as [R t], (S, 3, 4)."""
        stations = self._station_stack(keys)
        return chained(stations, Poses.of(self.placements).of_names(list(map(itemgetter(2), keys))))

    def with_placements(self, keys: Sequence[SightKey], cam_from_target: Array) -> Estimate:
        """The estimate with the placement of each key where its station sees it, cam_from_target (S, 3, 4)."""
        names = [key.placement for key in keys if key.placement is not None]
        stations = self._station_stack(keys)
        moved = chained(inverted(stations), cam_from_target)
        return replace(self, placements=Poses.of(self.placements).updated(names, moved))

    def _station_stack(self, keys: Sequence[SightKey]) -> Array:
        """cam_from_world of each sight, (S, 3, 4); (3, 4) where one station has them all."""
        names = list(map(itemgetter(1), keys))
        poses = {name: self.stations[name].cam_from_world for name in dict.fromkeys(names)}
        if len(poses) == 1:
            return poses[names[0]].matrix
        return Poses.of(poses).of_names(names)


class Layout(Frozen, eq=True):
    """Which numbers the solver may move.

    Attributes:
        free: camera -> indices into its intrinsics vector.
        stations, placements: names of the poses that are free.
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
        """The layout of a problem with these sights alone: no placement that they do not show is free."""
        return replace(self, placements=self.placements & {key.placement for key in keys})


def make_layout(observations: Observations, options: Options) -> Layout:
    """The layout of a calibration: everything free but what the options fix and what nothing can tell."""
    views = observations.shown_views
    return Layout(
        {name: _free_intrinsics(options.of_camera(name)) for name in observations.cameras},
        frozenset(view.station for view in views) - anchored_stations(observations),
        frozenset(view.placement for view in views if view.placement is not None),
    )


def _free_intrinsics(options: Options) -> Indices:
    """Indices into the vector of a camera with the lens of these options."""
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
    """One station of each group that no view ties to the world: its camera frame serves as the world.

    Boards alone tell poses among themselves only; holding one station removes that freedom.
    """
    views = observations.shown_views
    times = Counter([view.placement for view in views])
    group = {view.station: view.station for view in views}
    first_seen: dict[str, str] = {}
    tied: set[str] = set()

    def root(name: str) -> str:
        while group[name] != name:
            name = group[name]
        return name

    for view in views:
        if view.placement is None:
            tied.add(view.station)
        elif times[view.placement] > 1:
            group[root(view.station)] = root(first_seen.setdefault(view.placement, view.station))
    tied_groups = {root(name) for name in tied}
    anchors: dict[str, str] = {}
    for name in group:
        if root(name) not in tied_groups:
            anchors.setdefault(root(name), name)
    return frozenset(anchors.values())


# ---- the numbers of a camera as Ceres moves them --------------------------------------------------------------------

# A picture taken straight down tells phi over height alone: with another phi everything looks the same from another
# height, through a lens whose coefficients of tan^n have grown with phi^(n - 1). Along this curve Gauss-Newton creeps.
# In coefficients over phi^(n - 1), which act on pixels as the paper's do, it is a line (a chart).

_PHI = 0  # of the intrinsics


class Chart:
    """What of a camera's free numbers Ceres moves in their stead; Ceres' own word is a manifold, which pyceres cannot
    have made in Python.
    """

    def __init__(self, camera: Camera, free: Indices) -> None:
        powers = np.array([0.0] * 4 + [order - 1.0 for order in camera.lens.orders] + [0.0])
        self._powers, self._phi, self._unit = powers[free], free.tolist().index(_PHI), unit_px(camera)

    def moved(self, numbers: Array) -> Array:
        """(K,) what Ceres moves, of the free numbers (K,)."""
        return np.asarray(numbers / self._scales(numbers))

    def numbers(self, moved: Array) -> Array:
        """(K,) the free numbers again."""
        return np.asarray(moved * self._scales(moved))

    def chained(self, jacobian: Array, numbers: Array) -> Array:
        """(N, K) derivatives by what Ceres moves, from those by the free numbers (K,)."""
        chained = jacobian * self._scales(numbers)
        chained[:, self._phi] += jacobian @ (self._powers * numbers) / numbers[self._phi]
        return np.asarray(chained)

    def _scales(self, numbers: Array) -> Array:
        nothing = 1e-30  # phi may be 0 on the way: no camera, which shows nothing
        return np.asarray((numbers[self._phi] / self._unit or nothing) ** self._powers)


def chart_of(camera: Camera, free: Indices) -> Chart | None:
    """None where the numbers are moved as they are."""
    return Chart(camera, free) if camera.lens.acts_on_tangents and _PHI in free else None


def charts_of(estimate: Estimate, layout: Layout) -> dict[Owner, Chart]:
    """Of the cameras whose numbers are not moved as they are."""
    charts = {("camera", name): chart_of(camera, layout.free[name]) for name, camera in estimate.cameras.items()}
    return {owner: chart for owner, chart in charts.items() if chart is not None}
