"""Records of how a calibration was made, and its JSON file (docs/files.md), which restores every number exactly."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict
from functools import cache
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np

from ceres_cal.base import Frozen, InputError, PixelOrigin, Units, __version__, convert, field, naming, replace
from ceres_cal.base.transforms import euler_from_rotation, require_rotation, rotation_from_euler
from ceres_cal.effects.effect import AsBuilt, EffectEstimate
from ceres_cal.observations import prior_from_json, prior_to_json
from ceres_cal.posterior.files import PosteriorFile, information_from, lower_triangle, require_keys
from ceres_cal.problem import Estimate, GaussianPrior, Key, Options, Station, solver_version
from ceres_cal.problem.structure import EXACT, WARP, make_structure
from ceres_cal.robust.stated import Conflict
from ceres_cal.scene import CameraFile, Matrix, PoseFile, Target, Vector

COPY = "a copy"
"""Beginning of the reason of an observation that repeats another one, and was not rejected for its residual."""


class Rejection(Frozen, eq=True):
    """A rejected observation: its permanent id (kind and row), what it shows, and why it was rejected."""

    kind: str
    row: int
    frame: str
    feature: str
    reason: str

    @property
    def is_of_whole(self) -> bool:
        """Whether it was rejected together with all others of its line, frame or placement, which the reason names."""
        return self.reason.startswith("the whole of ")


TOO_FEW = "there are too few observations to compare lenses"
_NOT_THE_BEST = (
    "the lens that predicts best cannot be calibrated with all observations, so {} was used, which predicts {:.1f} "
    "standard errors worse. Its map may be off by more than is stated: name another lens (--lens)"
)
_NOT_CHOSEN = (
    "no lens could be chosen ({}), so {} was used. The stated uncertainties do not consider lenses with more "
    "coefficients: name the camera's lens (--lens)"
)


class TriedLens(Frozen, eq=True):
    """A lens that was compared with others.

    Attributes:
        label: kind with powers or free coefficients. coefficients: number of free ones.
        rms_px: rms error of predicting held-out views or features from all others; None where the lens cannot be used.
        worse: by how many standard errors of the paired difference it predicts worse than the chosen lens.
        failed: why it cannot be used, else "".
        probability: that it predicts best; None where it cannot be used, and in older files.
    """

    label: str
    coefficients: int
    rms_px: float | None = None
    worse: float | None = None
    failed: str = ""
    probability: float | None = None


class LensChoice(Frozen, eq=True):
    """The choice of a lens, with the lenses that it was compared with.

    Attributes:
        chosen: its label. tried: every lens that was compared, the chosen one first, the others by prediction error.
        groups: number of views, placements or features held out in turn. share: of the observations that took part.
    """

    chosen: str
    tried: tuple[TriedLens, ...]
    groups: int
    share: float

    @property
    def words(self) -> str:
        """One line for people."""
        if not self.groups:
            return f"{self.chosen}, not compared with other lenses: {self.tried[0].failed or TOO_FEW}"
        others = [one for one in self.tried if one.worse is not None and one.label != self.chosen]
        if not others or self.tried[0].rms_px is None:
            return f"{self.chosen}, the only one that can be calibrated"
        over = ", ".join(f"{one.label} {one.rms_px:.4f} px ({one.worse:+.1f})" for one in others[:3])
        return (
            f"{self.chosen} of {len(self.tried)} lenses: predicts {self.groups} held-out parts to "
            f"{self.tried[0].rms_px:.4f} px; next {over} (in parentheses: standard errors worse)"
        )

    @property
    def caveat(self) -> str:
        """Warning about the lens that was taken, "" where there is none."""
        taken = self.tried[0]
        if taken.worse:
            return _NOT_THE_BEST.format(taken.label, taken.worse)
        return _NOT_CHOSEN.format(taken.failed, taken.label) if taken.failed else ""


class Fit(Frozen, eq=True):
    """Statistics of the residuals and of the noise.

    Attributes:
        points, curves: numbers of observations that took part.
        points_rms_px: root mean square length of the residual vectors of points that took part (OpenCV's rms).
            curves_rms_px: root mean square distance to the curves. Both say how consistent the data are with the model,
            not how well the camera is known.
        point_scale, curve_scale: estimated factors on the stated sigmas.
        unknowns: number of free numbers.
        point_sigma_px, curve_sigma_px: root mean square of the stated sigmas of those that took part; None in files of
            version 0.1, which do not have them.
        of_cameras: camera, or "camera/target" where there are several targets, -> its own factor on the stated sigmas,
            multiplied by these scales; empty where all factors are equal.
    """

    points: int
    curves: int
    points_rms_px: float
    curves_rms_px: float
    point_scale: float
    curve_scale: float
    unknowns: int
    point_sigma_px: float | None = None
    curve_sigma_px: float | None = None
    of_cameras: Mapping[str, float] = field(default_factory=dict, hash=False)

    @property
    def noise_px(self) -> tuple[float, float]:
        """Standard deviation of a point's coordinate and of the distance to a curve, px; 0 where there are none.

        Where the stated sigmas are unknown, it is computed from the residuals, as if every equation had the same
        leverage.
        """
        if self.point_sigma_px is not None and self.curve_sigma_px is not None:
            return self.point_scale * self.point_sigma_px, self.curve_scale * self.curve_sigma_px
        spare = max(1.0 - self.unknowns / max(2 * self.points + self.curves, 1), 1e-3)
        return self.points_rms_px / (2.0 * spare) ** 0.5, self.curves_rms_px / spare**0.5

    @property
    def scales(self) -> tuple[float, float]:
        """Noise scales of points and of curves."""
        return self.point_scale, self.curve_scale

    @property
    def rms_px(self) -> float:
        """Root mean square residual over points and curves together."""
        total = self.points * self.points_rms_px**2 + self.curves * self.curves_rms_px**2
        return float((total / max(self.points + self.curves, 1)) ** 0.5)


_P = TypeVar("_P")
_Q = TypeVar("_Q")


class RefitRecord(msgspec.Struct, Generic[_P], frozen=True, eq=False, forbid_unknown_fields=True):
    """The record of a refit: how a calibration was derived from an earlier one.

    Attributes:
        what: what was free, one of `moves.WHAT`. moved: stations whose poses were solved for.
        explanation: what happened according to the observations, in words.
        prior: what was known beforehand of all numbers that were carried over; in a file as `PriorFile`.
        scales: noise scales of points and curves in the earlier calibration.
        digests: of the observations that the prior already contains.
    """

    what: str
    moved: tuple[str, ...]
    explanation: str
    prior: _P
    scales: tuple[float, float]
    digests: tuple[str, ...]

    def with_prior(self, prior: _Q) -> RefitRecord[_Q]:
        """Return a copy with the prior in its other form."""
        return RefitRecord(self.what, self.moved, self.explanation, prior, self.scales, self.digests)


@cache
def package_versions() -> dict[str, str]:
    """Versions of the packages on which the numbers depend."""
    return {"ceres-cal": __version__, "pyceres": solver_version, "numpy": np.__version__}


FORMAT, VERSION = "ceres-cal/calibration", 1

_ALSO_WARPED = tuple(f"/{part}" for part in WARP[2:])


class StationFile(PoseFile, forbid_unknown_fields=True):
    """A station; position, Euler angles and the floor's H (the paper's) are redundant, for people and other tools."""

    camera: str
    position_m: Vector
    euler_rad: Vector
    homography: Matrix | msgspec.UnsetType = msgspec.UNSET

    @classmethod
    def of_station(cls, station: Station) -> StationFile:
        """Return the station in the form of a file."""
        pose = station.cam_from_world
        rotation, translation, position = (part.tolist() for part in (pose.rotation, pose.translation, pose.position))
        homography = np.column_stack([pose.rotation[:, :2], pose.translation]).tolist()
        return cls(rotation, translation, station.camera, position, euler_from_rotation(pose.rotation), homography)

    def station(self) -> Station:
        """Return the station; raise InputError where the redundant numbers contradict the pose."""
        alike = 1e-5  # tolerance (rad, and share of the distance plus 1 m): people who edit a file round
        station = Station(self.camera, self.pose())
        again, reach_m = StationFile.of_station(station), 1.0 + float(np.linalg.norm(self.translation_m))
        turned = np.max(np.abs(rotation_from_euler(*self.euler_rad) - station.cam_from_world.rotation))
        if not np.allclose(again.position_m, self.position_m, rtol=0.0, atol=alike * reach_m) or turned > alike:
            raise InputError("position_m or euler_rad disagrees with rotation and translation_m: correct one")
        return station


class PriorFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A prior; its mean by number, or, in files of 0.1, as the cameras, stations and structure that have the mean."""

    keys: list[Key]
    information: list[float]
    mean: list[float] | None = None
    rotations: dict[str, Matrix] | None = None
    cameras: dict[str, CameraFile] | None = None
    stations: dict[str, PoseFile] | None = None
    structure_m: dict[str, float] | None = None

    @classmethod
    def of(cls, prior: GaussianPrior) -> PriorFile:
        """Return the prior in the form of a file."""
        rotations = {name: rotation.tolist() for name, rotation in prior.rotations.items()}
        return cls(list(prior.keys), lower_triangle(prior.information), prior.mean.tolist(), rotations)

    def prior(self, known: Collection[Key]) -> GaussianPrior:
        """Return the prior; raise InputError where its numbers do not fit its keys, or where a key is unknown."""
        require_keys(self.keys, known, "refitted.prior.keys")
        information = information_from(self.information, self.keys, "refitted.prior.information")
        if self.mean is not None:
            if len(self.mean) != len(self.keys):
                raise InputError("refitted.prior.mean does not fit its keys: calibrate again")
            turns = (self.rotations or {}).items()
            rotations = {name: require_rotation(turn, f"rotation of {name}") for name, turn in turns}
            return GaussianPrior(information, np.array(self.mean), rotations)
        cameras = {name: entry.camera() for name, entry in (self.cameras or {}).items()}
        stations = {name: Station("", entry.pose()) for name, entry in (self.stations or {}).items()}
        structure_m = self.structure_m or {}
        structure = replace(EXACT, names=tuple(structure_m), values=np.array(list(structure_m.values())))
        return GaussianPrior.about(information, Estimate(cameras, stations, {}, structure))


class CalibrationFile(msgspec.Struct, forbid_unknown_fields=True):
    """A calibration; `lens_choice`, in older files, is the choice of all cameras."""

    format: str
    version: int
    units: Units
    pixel_origin: PixelOrigin
    cameras: dict[str, CameraFile]
    stations: dict[str, StationFile]
    placements: dict[str, PoseFile]
    targets: dict[str, Any]
    structure_m: dict[str, float]
    fit: Fit
    rejected: tuple[Rejection, ...]
    termination: str
    converged: bool
    rounds: int
    history: tuple[float, ...]
    phi_from: dict[str, str]
    warnings: tuple[str, ...]
    options: dict[str, Any]
    digest: str
    versions: dict[str, str]
    posterior: PosteriorFile | None = None
    refitted: RefitRecord[PriorFile] | None = None
    conflicts: tuple[Conflict, ...] = ()
    lens_choices: dict[str, LensChoice] = {}
    aspects_alone: dict[str, tuple[float, float]] = {}
    lens_choice: LensChoice | msgspec.UnsetType | None = msgspec.UNSET
    as_built: tuple[AsBuilt, ...] = ()
    effects: tuple[EffectEstimate, ...] = ()
    remarks: tuple[str, ...] = ()
    ambiguities: tuple[str, ...] = ()
    notes: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET

    @property
    def chosen_lenses(self) -> Mapping[str, LensChoice]:
        """Camera -> how its lens was chosen."""
        return dict.fromkeys(self.cameras, self.lens_choice) if self.lens_choice else self.lens_choices

    def estimate(self, targets: Mapping[str, Target], options: Options) -> Estimate:
        """Cameras, stations, placements and the targets as built; InputError where these do not fit each other."""
        cameras = {}
        for name, entry in self.cameras.items():
            cameras[name] = entry.camera()
            if not cameras[name].lens.may_fold:  # others may, in corners that nobody saw: `locate` gives NaN there
                cameras[name].require_monotone(name)
        stations = {}
        for name, station in self.stations.items():
            if station.camera not in cameras:
                raise InputError(f"station {name!r} names camera {station.camera!r}, which is not there")
            with naming(f"station {name!r}"):
                stations[name] = station.station()
        placements = {}
        for name, placement in self.placements.items():
            with naming(f"placement {name!r}"):
                placements[name] = placement.pose()
        structure = make_structure(targets, options.tolerances, options.dimensions)
        flat = {name: 0.0 for name in structure.names if name.endswith(_ALSO_WARPED)}  # numbers that 0.1 did not have
        if not self.structure_m.keys() <= set(structure.names) <= self.structure_m.keys() | flat.keys():
            raise InputError("structure_m does not fit the targets and the tolerances: calibrate again")
        built = structure.with_values(np.array([(flat | self.structure_m)[name] for name in structure.names]))
        return Estimate(cameras, stations, placements, built)


def options_to_json(options: Options) -> dict[str, Any]:
    """Return options as plain data, with their priors in the form of observation files."""
    return {**asdict(options), "priors": [prior_to_json(prior) for prior in options.priors]}


def options_from_json(data: Mapping[str, Any]) -> Options:
    """Return the options that a file describes; raise InputError naming what is wrong."""
    entries = convert(data.get("priors", []), list[dict[str, Any]], "options.priors")
    priors = tuple(prior_from_json(entry, "options.priors") for entry in entries)
    before = {"lens": "radial", "usual_camera": False, "free_aspect": False}  # defaults of older files
    return convert({**before, **data, "priors": priors}, Options, "options")
