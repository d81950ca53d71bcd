"""Calibrations in JSON files (docs/files.md): every number comes back exactly."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.errors import InputError, naming
from ceres_cal.base.files import PixelOrigin, Units, convert
from ceres_cal.base.transforms import euler_from_rotation, require_rotation, rotation_from_euler
from ceres_cal.calibration.origin import Fit, LensChoice, Refitted, Rejected
from ceres_cal.effects.effect import AsBuilt, EffectEstimate
from ceres_cal.observations import prior_from_json, prior_to_json
from ceres_cal.posterior.files import PosteriorFile, information_from, lower_triangle, require_keys
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Estimate, Options, Station
from ceres_cal.problem.priors import GaussianPrior
from ceres_cal.problem.structure import EXACT, WARP, make_structure
from ceres_cal.robust.stated import Conflict
from ceres_cal.scene.files import CameraFile, Matrix, PoseFile, Vector
from ceres_cal.scene.targets import Target

FORMAT, VERSION = "ceres-cal/calibration", 1
_ALIKE = 1e-5  # somebody who edits a file rounds

_ALSO_WARPED = tuple(f"/{part}" for part in WARP[2:])


class StationFile(PoseFile, forbid_unknown_fields=True):
    """A station; position, Euler angles and H of the floor (the paper's) are there for people and other programs."""

    camera: str
    position_m: Vector
    euler_rad: Vector
    homography: Matrix | msgspec.UnsetType = msgspec.UNSET

    @classmethod
    def of_station(cls, station: Station) -> StationFile:
        """As a file has it."""
        pose = station.cam_from_world
        rotation, translation, position = (part.tolist() for part in (pose.rotation, pose.translation, pose.position))
        homography = np.column_stack([pose.rotation[:, :2], pose.translation]).tolist()
        return cls(rotation, translation, station.camera, position, euler_from_rotation(pose.rotation), homography)

    def station(self) -> Station:
        """The station; InputError where what is there for people says something else than the pose."""
        station = Station(self.camera, self.pose())
        again, reach_m = StationFile.of_station(station), 1.0 + float(np.linalg.norm(self.translation_m))
        turned = np.max(np.abs(rotation_from_euler(*self.euler_rad) - station.cam_from_world.rotation))
        if not np.allclose(again.position_m, self.position_m, rtol=0.0, atol=_ALIKE * reach_m) or turned > _ALIKE:
            raise InputError("position_m or euler_rad is another one than that of rotation and translation_m")
        return station


class PriorFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A prior; its mean by number, or, in files of 0.1, as the cameras, stations and structure that it is around."""

    keys: list[Key]
    information: list[float]
    mean: list[float] | None = None
    rotations: dict[str, Matrix] | None = None
    cameras: dict[str, CameraFile] | None = None
    stations: dict[str, PoseFile] | None = None
    structure_m: dict[str, float] | None = None

    @classmethod
    def of(cls, prior: GaussianPrior) -> PriorFile:
        """As a file has it."""
        rotations = {name: rotation.tolist() for name, rotation in prior.rotations.items()}
        return cls(list(prior.keys), lower_triangle(prior.information), prior.mean.tolist(), rotations)

    def prior(self, known: Collection[Key]) -> GaussianPrior:
        """The prior; InputError where its numbers do not fit its keys, or one is none of those known."""
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


class RefittedFile(msgspec.Struct, forbid_unknown_fields=True):
    """How a calibration came from an earlier one."""

    what: str
    moved: tuple[str, ...]
    explanation: str
    prior: PriorFile
    scales: tuple[float, float]
    digests: tuple[str, ...]

    @classmethod
    def of(cls, refitted: Refitted) -> RefittedFile:
        """As a file has it."""
        return cls(**{**vars(refitted), "prior": PriorFile.of(refitted.prior)})

    def refitted(self, known: Collection[Key]) -> Refitted:
        """What the file says; InputError where the prior's numbers do not fit, or are none of those known."""
        return Refitted(**{**msgspec.structs.asdict(self), "prior": self.prior.prior(known)})


class CalibrationFile(msgspec.Struct, forbid_unknown_fields=True):
    """A calibration."""

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
    rejected: tuple[Rejected, ...]
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
    refitted: RefittedFile | None = None
    conflicts: tuple[Conflict, ...] = ()
    lens_choice: LensChoice | None = None
    as_built: tuple[AsBuilt, ...] = ()
    effects: tuple[EffectEstimate, ...] = ()
    notes: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET

    def estimate(self, targets: Mapping[str, Target], options: Options) -> Estimate:
        """Cameras, stations, placements and the targets as built; InputError where one does not fit the others."""
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
        flat = {name: 0.0 for name in structure.names if name.endswith(_ALSO_WARPED)}  # which 0.1 did not have
        if not self.structure_m.keys() <= set(structure.names) <= self.structure_m.keys() | flat.keys():
            raise InputError("structure_m does not fit the targets and the tolerances: calibrate again")
        built = structure.with_values(np.array([(flat | self.structure_m)[name] for name in structure.names]))
        return Estimate(cameras, stations, placements, built)


def options_to_json(options: Options) -> dict[str, Any]:
    """Options as plain data, their priors as observations have them."""
    return {**asdict(options), "priors": [prior_to_json(prior) for prior in options.priors]}


def options_from_json(data: Mapping[str, Any]) -> Options:
    """The options that a file describes; InputError naming what is wrong."""
    entries = convert(data.get("priors", []), list[dict[str, Any]], "options.priors")
    priors = tuple(prior_from_json(entry, "options.priors") for entry in entries)
    before = {"lens": "radial", "usual_camera": False, "free_aspect": False}  # as in older files
    return convert({**before, **data, "priors": priors}, Options, "options")
