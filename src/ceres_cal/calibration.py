"""The result: calibrated cameras, stations and placements, how they came about, and their file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.arrays import Mask
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert, read_json, write_json
from ceres_cal.base.transforms import Pose, euler_from_rotation
from ceres_cal.model.keys import Key
from ceres_cal.model.parameters import Estimate, Options, Station, make_layout
from ceres_cal.model.priors import GaussianPrior, gather_priors, gather_stated, tolerances
from ceres_cal.model.structure import EXACT, make_structure
from ceres_cal.observations import Observations, prior_from_json, prior_to_json
from ceres_cal.observations.sights import gather_sights
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.files import CameraFile, PoseFile, Vector, camera_to_json, pose_to_json
from ceres_cal.scene.targets import Target, target_from_spec
from ceres_cal.solve import Problem, Weighting
from ceres_cal.uncertainty import (
    Disagreement,
    Posterior,
    PosteriorFile,
    Uncertainty,
    disagreement,
    information_from,
    lower_triangle,
    posterior_from_file,
    posterior_to_file,
)

FORMAT, VERSION = "ceres-cal/calibration", 1


@dataclass(frozen=True)
class Rejected:
    """One observation that was taken out: its permanent id (kind and row), what it shows, and why it was taken out."""

    kind: str
    row: int
    frame: str
    feature: str
    reason: str


@dataclass(frozen=True)
class Fit:
    """How well the observations fit.

    Attributes:
        points, curves: numbers of observations that took part.
        points_rms_px: root mean square length of the points' residual vectors, of those that took part (OpenCV's rms).
            curves_rms_px: the same of the distances to the curves. They say how consistent the data are with the model,
            not how well the camera is known.
        point_scale, curve_scale: estimated factors on the stated sigmas.
        unknowns: free numbers.
    """

    points: int
    curves: int
    points_rms_px: float
    curves_rms_px: float
    point_scale: float
    curve_scale: float
    unknowns: int

    @property
    def rms_px(self) -> float:
        """Root mean square residual over points and curves together."""
        total = self.points * self.points_rms_px**2 + self.curves * self.curves_rms_px**2
        return float((total / max(self.points + self.curves, 1)) ** 0.5)


@dataclass(frozen=True, eq=False)
class Refitted:
    """How a calibration came from an earlier one.

    Attributes:
        what: was free, one of `moves.WHAT`. moved: stations whose poses were sought.
        explanation: what the observations say has happened, in words.
        prior: what was known beforehand of everything that was carried over.
        scales: noise scales of points and curves of the calibration before.
        digests: of the observations that are in the prior.
    """

    what: str
    moved: tuple[str, ...]
    explanation: str
    prior: GaussianPrior
    scales: tuple[float, float]
    digests: tuple[str, ...]


@cache
def package_versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {}
    for name in ("ceres-cal", "pyceres", "numpy", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated cameras and where they stood.

    Attributes:
        estimate: cameras, stations, placements, and the targets as built. targets: as drawn, by name.
        fit: residuals and noise. rejected: every observation that was taken out.
        termination: why the last solve stopped. converged: whether it had come to rest.
        rounds: solves it took. history: cost at each iteration of the last one.
        phi_from: camera -> "fixed", "views", "prior" or "guess": what the start for phi rested on; after a refit
            "posterior", where phi is under what was known of it.
        warnings: what to know before using it, each one line.
        posterior: what is known of every number; None where nothing was minimised, or a file says nothing of it.
        options: how it was solved. digest: SHA-256 of the observations. versions: of the packages that solved it.
        refitted: how it came from an earlier calibration; None for one from scratch.
    """

    estimate: Estimate
    targets: Mapping[str, Target]
    fit: Fit
    rejected: tuple[Rejected, ...]
    termination: str
    converged: bool
    rounds: int
    history: tuple[float, ...]
    phi_from: Mapping[str, str]
    warnings: tuple[str, ...]
    options: Options
    digest: str
    posterior: Posterior | None = None
    versions: Mapping[str, str] = field(default_factory=package_versions)
    refitted: Refitted | None = None

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras by name, at no particular pose."""
        return self.estimate.cameras

    @cached_property
    def stations(self) -> Mapping[str, Camera]:
        """The camera at each station, by the station's name."""
        return {name: self.estimate.camera_at(name) for name in self.estimate.stations}

    @property
    def placements(self) -> Mapping[str, Pose]:
        """world_from_target of each placement."""
        return self.estimate.placements

    def station(self, name: str | None = None) -> Camera:
        """The camera at a station; without a name, at the only one there is.

        Raises:
            InputError: no such station, or no name where there are several.
        """
        if name is None and len(self.stations) == 1:
            return next(iter(self.stations.values()))
        if name is None or name not in self.stations:
            raise InputError(f"station {name!r} is not there: there are {', '.join(map(repr, self.stations))}")
        return self.stations[name]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """How well everything is known: verdicts, weak directions, maps in mm.

        Raises:
            InputError: nothing was minimised, or the file says nothing of it.
        """
        if self.posterior is None:
            raise InputError("this calibration does not say how well it is known: calibrate again")
        return Uncertainty(self.estimate, self.posterior, self.targets)

    def disagreement(self, observations: Observations, first: str, second: str) -> Disagreement:
        """What two stations say of what both observed in the observations that this calibration was made from.

        Raises:
            InputError: there is no uncertainty to compare with, see `uncertainty`; or other observations.
        """
        if observations.digest != self.digest:
            raise InputError("these are not the observations that the calibration was made from: give those")
        masks = self.inlier_masks(observations)
        scales = (self.fit.point_scale, self.fit.curve_scale)
        known = self.uncertainty
        return disagreement(observations, known.estimate, known.posterior, masks, scales, first, second)

    def inlier_masks(self, observations: Observations) -> tuple[Mask, Mask]:
        """(N,) of points and (M,) of curve observations: which rows took part."""
        masks = np.ones(len(observations.points), bool), np.ones(len(observations.curves), bool)
        for entry in self.rejected:
            masks[entry.kind == "curve"][entry.row] = False
        return masks

    def problem(self, observations: Observations, *, new_data: bool = False) -> Problem:
        """The problem of which this is the solution, of all the observations, at the noise that was found.

        Args:
            new_data: that the observations are others: then as if they were calibrated with the same options.
        """
        sights, options = gather_sights(observations), self.options
        prior = None if self.refitted is None else self.refitted.prior
        weighting = Weighting(self.fit.point_scale, self.fit.curve_scale, options.loss, options.loss_scale)
        if new_data or prior is None or self.posterior is None:
            priors = gather_priors(observations, options, self.estimate.structure)
            return Problem(sights, make_layout(observations, options), priors, weighting, options)
        lenses = {name: camera.lens for name, camera in self.cameras.items()}
        fresh = tolerances(self.estimate.structure, prior.keys)
        priors = (prior, *gather_stated(observations, options, lenses), *fresh)
        return Problem(sights, self.posterior.layout(self.estimate), priors, weighting, options)

    @property
    def rms_px(self) -> float:
        """Root mean square residual over all observations that took part, px."""
        return self.fit.rms_px

    def save(self, path: str | Path) -> None:
        """Write the calibration as JSON; every number comes back exactly."""
        write_json(path, calibration_to_json(self))

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration.

        Raises:
            InputError: one line that names the file and the place; also for a radial lens that folds inside the image.
        """
        data = convert(read_json(path, FORMAT, VERSION), _CalibrationFile, str(path))
        try:
            return _from_file(data)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


class _StationFile(PoseFile, forbid_unknown_fields=True):
    camera: str
    position_m: Vector
    euler_rad: Vector


class _PriorFile(msgspec.Struct, forbid_unknown_fields=True):
    """A prior; its mean by number, or, in files of 0.1, as the cameras, stations and structure that it is around."""

    keys: list[Key]
    information: list[float]
    mean: list[float] | None = None
    rotations: dict[str, tuple[Vector, Vector, Vector]] | None = None
    cameras: dict[str, CameraFile] | None = None
    stations: dict[str, PoseFile] | None = None
    structure_m: dict[str, float] | None = None


class _RefittedFile(msgspec.Struct, forbid_unknown_fields=True):
    what: str
    moved: tuple[str, ...]
    explanation: str
    prior: _PriorFile
    scales: tuple[float, float]
    digests: tuple[str, ...]


class _CalibrationFile(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    version: int
    units: str
    pixel_origin: str
    cameras: dict[str, CameraFile]
    stations: dict[str, _StationFile]
    placements: dict[str, PoseFile]
    targets: dict[str, Any]
    structure_m: dict[str, float]
    fit: Fit
    rejected: list[Rejected]
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
    refitted: _RefittedFile | None = None


def calibration_to_json(calibration: Calibration) -> dict[str, Any]:
    """The calibration as its file has it. Position and Euler angles (the paper's) are there for people."""
    estimate, known = calibration.estimate, calibration.posterior
    options = {**asdict(calibration.options), "priors": [prior_to_json(p) for p in calibration.options.priors]}
    return {
        "format": FORMAT,
        "version": VERSION,
        "units": "metres, radians, pixels",
        "pixel_origin": "centre of the top-left pixel",
        "cameras": {name: camera_to_json(camera) for name, camera in estimate.cameras.items()},
        "stations": {
            name: {
                "camera": station.camera,
                **pose_to_json(station.cam_from_world),
                "position_m": station.cam_from_world.position.tolist(),
                "euler_rad": list(euler_from_rotation(station.cam_from_world.rotation)),
            }
            for name, station in estimate.stations.items()
        },
        "placements": {name: pose_to_json(pose) for name, pose in estimate.placements.items()},
        "targets": {name: target.spec for name, target in calibration.targets.items()},
        "structure_m": dict(zip(estimate.structure.names, estimate.structure.values.tolist(), strict=True)),
        "fit": asdict(calibration.fit),
        "rejected": [asdict(entry) for entry in calibration.rejected],
        "termination": calibration.termination,
        "converged": calibration.converged,
        "rounds": calibration.rounds,
        "history": list(calibration.history),
        "phi_from": dict(calibration.phi_from),
        "warnings": list(calibration.warnings),
        "options": options,
        "digest": calibration.digest,
        "versions": dict(calibration.versions),
        "posterior": known and msgspec.to_builtins(posterior_to_file(known)),
        "refitted": None if calibration.refitted is None else _refitted_to_json(calibration.refitted),
    }


def _refitted_to_json(refitted: Refitted) -> dict[str, Any]:
    prior = refitted.prior
    return {
        "what": refitted.what,
        "moved": list(refitted.moved),
        "explanation": refitted.explanation,
        "prior": {
            "keys": [list(key) for key in prior.keys],
            "information": lower_triangle(prior.information),
            "mean": prior.mean.tolist(),
            "rotations": {name: rotation.tolist() for name, rotation in prior.rotations.items()},
        },
        "scales": list(refitted.scales),
        "digests": list(refitted.digests),
    }


def _refitted_from_file(data: _RefittedFile) -> Refitted:
    prior = _prior_from_file(data.prior)
    return Refitted(data.what, data.moved, data.explanation, prior, data.scales, data.digests)


def _prior_from_file(data: _PriorFile) -> GaussianPrior:
    information = information_from(data.information, data.keys, "refitted.prior.information")
    if data.mean is not None:
        if len(data.mean) != len(data.keys):
            raise InputError("refitted.prior.mean does not fit its keys: calibrate again")
        rotations = {name: np.array(rotation) for name, rotation in (data.rotations or {}).items()}
        return GaussianPrior(information, np.array(data.mean), rotations)
    cameras = {name: entry.camera() for name, entry in (data.cameras or {}).items()}
    stations = {name: Station("", entry.pose()) for name, entry in (data.stations or {}).items()}
    structure_m = data.structure_m or {}
    structure = replace(EXACT, names=tuple(structure_m), values=np.array(list(structure_m.values())))
    around = Estimate(cameras, stations, {}, structure)
    return GaussianPrior.about(information, around)


def _from_file(data: _CalibrationFile) -> Calibration:
    cameras = {}
    for name, entry in data.cameras.items():
        cameras[name] = entry.camera()
        if not cameras[name].lens.may_fold:  # others may, in corners that nobody saw: `locate` gives NaN there
            cameras[name].require_monotone(name)
    stations = {}
    for name, station in data.stations.items():
        if station.camera not in cameras:
            raise InputError(f"station {name!r} names camera {station.camera!r}, which is not there")
        stations[name] = Station(station.camera, station.pose())
    placements = {name: entry.pose() for name, entry in data.placements.items()}
    settings = dict(data.options)
    settings["priors"] = tuple(prior_from_json(entry, "options.priors") for entry in settings.get("priors", []))
    options = convert(settings, Options, "options")
    targets = {name: target_from_spec(spec, f"target {name!r}") for name, spec in data.targets.items()}
    structure = make_structure(targets, options.tolerances)
    if structure.names != tuple(data.structure_m):
        raise InputError("structure_m does not fit the targets and the tolerances: calibrate again")
    return Calibration(
        Estimate(cameras, stations, placements, structure.with_values(np.array(list(data.structure_m.values())))),
        targets,
        data.fit,
        tuple(data.rejected),
        data.termination,
        data.converged,
        data.rounds,
        data.history,
        data.phi_from,
        data.warnings,
        options,
        data.digest,
        None if data.posterior is None else posterior_from_file(data.posterior),
        data.versions,
        None if data.refitted is None else _refitted_from_file(data.refitted),
    )
