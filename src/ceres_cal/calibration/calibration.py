"""The result: calibrated cameras, stations and placements, and how they were obtained."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ceres_cal.base import Frozen, InputError, Mask, Pose, cached_property, field, html_of, naming, replace
from ceres_cal.base.files import PIXEL_ORIGIN, UNITS, decode_json, read_bytes, write_json
from ceres_cal.calibration.file import (
    COPY,
    FORMAT,
    VERSION,
    CalibrationFile,
    Fit,
    LensChoice,
    PriorFile,
    RefitRecord,
    Rejection,
    StationFile,
    options_from_json,
    options_to_json,
    package_versions,
)
from ceres_cal.effects.effect import AsBuilt, EffectEstimate
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.posterior.files import PosteriorFile
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import Estimate, GaussianPrior, Key, Options, every_key, gather_priors, make_layout, redrawn
from ceres_cal.problem.parameters import intrinsic_names
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.quantities import intrinsic_keys
from ceres_cal.robust.stated import Conflict, agreed
from ceres_cal.robust.unsteady import without_unsteadiness
from ceres_cal.scene import Camera, CameraFile, Lens, PoseFile, Target, targets_from_specs

if TYPE_CHECKING:
    from ceres_cal.posterior.seam import Disagreement
    from ceres_cal.posterior.uncertainty import Uncertainty

_ALIKE = (
    *("fit", "rejected", "termination", "converged", "rounds", "history"),
    *("phi_from", "warnings", "remarks", "ambiguities", "digest", "versions", "conflicts", "lens_choices", "as_built"),
    *("effects", "aspects_alone"),
)
"""Attributes that the file stores unchanged, under the same names."""


class Calibration(Frozen):
    """Calibrated cameras, their stations and the placements of targets.

    Attributes:
        estimate: cameras, stations, placements, and the targets as built. targets: as drawn, by name.
        fit: residuals and noise. rejected: every observation that did not take part.
        termination: why the last solve stopped. converged: whether it converged.
        rounds: number of solves. history: cost at each iteration of the last one.
        phi_from: camera -> source of the initial phi: "fixed", "views", "prior" or "guess"; after a refit "posterior",
            where the earlier calibration's posterior is a prior on phi.
        warnings: what may be wrong, one line each. remarks: how the observations were treated, without loss of trust.
            ambiguities: those warnings that say that the world looks the same from another place.
        posterior: what is known of every number; None where nothing was minimised, or where a file has none.
        options: how it was solved. digest: SHA-256 of the observations. versions: of the packages that solved it.
        refitted: how it was derived from an earlier calibration; None for one from scratch.
        conflicts: statements that everything else contradicts; the posterior includes what is in dispute.
        lens_choices: camera -> how its lens was chosen; empty where the lens was given.
        as_built: features of targets that are off their nominal position and were solved for, with the standard
            deviations that the data show; these are in the options' tolerances.
        effects: other effects that displace the observations and were solved for.
        aspects_alone: camera -> fy / fx and its standard deviation by the observations alone, for cameras whose aspect
            is 1 by the prior of usual cameras.
        notes: user data to keep with the calibration, plain data.
    """

    estimate: Estimate
    targets: Mapping[str, Target]
    fit: Fit
    rejected: tuple[Rejection, ...]
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
    refitted: RefitRecord[GaussianPrior] | None = None
    conflicts: tuple[Conflict, ...] = ()
    lens_choices: Mapping[str, LensChoice] = field(default_factory=dict)
    as_built: tuple[AsBuilt, ...] = ()
    effects: tuple[EffectEstimate, ...] = ()
    remarks: tuple[str, ...] = ()
    ambiguities: tuple[str, ...] = ()
    aspects_alone: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        cameras = ", ".join(f"{name!r}: {camera!r}" for name, camera in self.stations.items())
        return f"Calibration({cameras}; {self.rms_px:.3f} px rms)"

    def _repr_html_(self) -> str:
        shown = self.stations.items()
        rows = [(name, repr(camera).removeprefix("Camera(").removesuffix(")")) for name, camera in shown]
        return html_of((f"Calibration, {self.rms_px:.3f} px rms", rows))

    @property
    def lens_choice(self) -> LensChoice | None:
        """The choice of the first camera's lens; None where the lens was given."""
        return next(iter(self.lens_choices.values()), None)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras by name, without a particular pose."""
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
        """The camera at a station; without a name, at the only station.

        Raises:
            InputError: no such station, or no name where there are several.
        """
        return self.stations[self.estimate.station_name(name)]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """The uncertainty of everything: verdicts, weak directions, maps in mm.

        Raises:
            InputError: nothing was minimised, or the file has no posterior.
        """
        if self.posterior is None:
            raise InputError("this calibration does not say how well it is known: calibrate again")
        from ceres_cal.posterior.uncertainty import Uncertainty

        return Uncertainty(self.estimate, self.posterior, self.targets, self.conflicts)

    def disagreement(self, observations: Observations, first: str, second: str) -> Disagreement:
        """Return the disagreement of two stations about what both observed, in the observations of this calibration.

        Raises:
            InputError: there is no posterior, see `uncertainty`; or these are other observations.
        """
        if observations.digest != self.digest:
            raise InputError("these are not the observations that the calibration was made from: give those")
        from ceres_cal.posterior.seam import disagreement

        used = self.as_taken(observations).part(*self.inlier_masks(observations))
        return disagreement(used, self.estimate, self.uncertainty.posterior, self.fit.scales, (first, second))

    def inlier_masks(self, observations: Observations) -> tuple[Mask, Mask]:
        """(N,) of points and (M,) of curve observations: which rows took part."""
        points, curves = _rows_of(self.rejected, observations)
        return ~points, ~curves

    def outlier_masks(self, observations: Observations) -> tuple[Mask, Mask]:
        """(N,) of points and (M,) of curve observations: which rows were rejected for their own residual."""
        return _rows_of((entry for entry in self.outliers if not entry.is_of_whole), observations)

    def redrawn(self) -> Calibration:
        """Return a copy whose targets are drawn with the dimensions that were solved for."""
        found = self.estimate.structure.dimensions
        targets = {
            name: redrawn(
                target, {one: found[f"{name}/{one}"] for one in target.dimensions if f"{name}/{one}" in found}
            )
            for name, target in self.targets.items()
        }
        estimate = replace(self.estimate, structure=self.estimate.structure.redrawn())
        return replace(self, estimate=estimate, targets=targets) if found else self

    def as_taken(self, observations: Observations) -> Observations:
        """Return the observations as this calibration used them: with the dimensions of targets that were solved for,
        and with each camera's noise.
        """
        targets = dict(observations.targets)
        for name, target in targets.items():
            own = [one for one in target.dimensions if f"{name}/{one}" in self.options.dimensions]
            if own and name in self.targets:
                lengths_m = self.targets[name].dimensions
                targets[name] = redrawn(target, {one: lengths_m[one] for one in own if one in lengths_m})
            known = self.targets.get(name)
            if known is not None and targets[name] == known and target.movable != known.movable:
                targets[name] = known  # whether it is a board is as it was there
        return observations.with_targets(targets).at_noise(self.fit.of_cameras)

    @property
    def outliers(self) -> tuple[Rejection, ...]:
        """Observations that were rejected for their residuals: all rejected ones except copies of others."""
        return tuple(entry for entry in self.rejected if not entry.reason.startswith(COPY))

    def problem(self, observations: Observations, *, new_data: bool = False) -> Problem:
        """Return the problem of which this is the solution: all the observations, at the estimated noise.

        Args:
            new_data: whether the observations are new ones; they are then treated as in a calibration with these
                options.
        """
        observations, options = self.as_taken(observations), self.options
        sights, about = gather_sights(observations), self.refitted
        moved = {self.estimate.stations[name].camera for name in (about.moved if about else ())}
        changed = {name: self.cameras[name] for name in moved}
        prior = None if about is None else still_known(about.prior, about.what, changed)
        weighting = Weighting(*self.fit.scales, options.loss, options.loss_scale)
        if new_data or prior is None or self.posterior is None:
            priors = gather_priors(observations, options, self.estimate.structure)
            layout = make_layout(observations, options)
        else:
            priors = gather_priors(observations, options, self.estimate.structure, prior, self.cameras)
            layout = self.posterior.layout(self.estimate)
        problem = Problem(sights, layout, agreed(priors, self.conflicts), weighting, options)
        points, curves = len(observations.points), len(observations.curves)
        every = np.ones(points, dtype=bool), np.ones(curves, dtype=bool)
        taking_part = every if new_data else self.inlier_masks(observations)
        return without_unsteadiness(problem, self.estimate, taking_part, self.effects)

    def prior_of(self, keys: Sequence[Key], *, of_lens: bool = False) -> GaussianPrior:
        """Return the marginal posterior of some numbers as the prior of the next solve; on demand under the condition
        that the chosen lens is the right one.
        """
        known = self.uncertainty.posterior
        return GaussianPrior.about((known.normal_of_lens if of_lens else known.normal).marginal(keys), self.estimate)

    @property
    def rms_px(self) -> float:
        """Root mean square residual over all observations that took part, px."""
        return self.fit.rms_px

    def save(self, path: str | Path) -> None:
        """Write the calibration as JSON; every number is restored exactly by `load`."""
        write_json(path, self.to_file())

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration.

        Raises:
            InputError: one line that names the file and the place in it; also for a radial lens that folds inside the
                image.
        """
        if not (content := read_bytes(path)).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
            raise InputError(f"{path}: no calibration of ceres-cal: `ceres-cal import` makes one of another program's")
        data = decode_json(content, CalibrationFile, str(path), FORMAT, VERSION, finite=True)
        with naming(path):
            return cls.from_file(data)

    def to_file(self) -> CalibrationFile:
        """Return the calibration in the form of its file."""
        return self._file

    @cached_property
    def _file(self) -> CalibrationFile:
        estimate, about = self.estimate, self.refitted
        return CalibrationFile(
            format=FORMAT,
            version=VERSION,
            units=UNITS,
            pixel_origin=PIXEL_ORIGIN,
            cameras={name: CameraFile.of(camera) for name, camera in estimate.cameras.items()},
            stations={name: StationFile.of_station(station) for name, station in estimate.stations.items()},
            placements={name: PoseFile.of(pose) for name, pose in estimate.placements.items()},
            targets={name: target.spec for name, target in self.targets.items()},
            structure_m=dict(zip(estimate.structure.names, estimate.structure.values.tolist(), strict=True)),
            options=options_to_json(self.options),
            posterior=None if self.posterior is None else PosteriorFile.of(self.posterior),
            refitted=None if about is None else about.with_prior(PriorFile.of(about.prior)),
            notes=dict(self.notes) or msgspec.UNSET,
            **{name: getattr(self, name) for name in _ALIKE},
        )

    @classmethod
    def from_file(cls, data: CalibrationFile) -> Calibration:
        """Return the calibration that a file describes; raise InputError naming the place in the file."""
        options = options_from_json(data.options)
        targets = targets_from_specs(data.targets)
        estimate = data.estimate(targets, options)
        known, told, about = every_key(estimate), data.posterior, data.refitted
        posterior = None if told is None else told.posterior(known)
        if told is not None and posterior is not None and (told.profiles or told.bends):
            from ceres_cal.posterior.files import as_mixtures

            posterior = as_mixtures(told, posterior)
        return cls(
            estimate,
            targets,
            options=options,
            posterior=posterior,
            refitted=None if about is None else about.with_prior(about.prior.prior(known)),
            notes=data.notes if isinstance(data.notes, dict) else {},
            **{name: getattr(data, name) for name in _ALIKE} | {"lens_choices": data.chosen_lenses},
        )


def _rows_of(entries: Iterable[Rejection], observations: Observations) -> tuple[Mask, Mask]:
    """(N,) of points and (M,) of curve observations: the rows of the entries."""
    masks = np.zeros(len(observations.points), bool), np.zeros(len(observations.curves), bool)
    for entry in entries:
        masks[entry.kind == "curve"][entry.row] = True
    return masks


def loosened(what: str, camera: str, lens: Lens) -> frozenset[Key]:
    """Return the intrinsics of a camera about which a refit of `what` assumes nothing."""
    which = {"zoom": ("phi",), "iris": lens.names, "everything": intrinsic_names(lens)}.get(what, ())
    return frozenset(key for key in intrinsic_keys(camera, lens) if key.quantity in which)


def still_known(prior: GaussianPrior, what: str, cameras: Mapping[str, Camera]) -> GaussianPrior:
    """Return what counts of a prior after `what` has changed of some cameras. After another zoom, coefficients are
    known as far as both ways agree in which a lens may change with it.

    Args:
        cameras: those that changed, with the phi that they have now.
    """
    mean, half = prior.mean.copy(), np.zeros(len(prior.keys))
    for name, camera in cameras.items() if what == "zoom" else ():
        known = {key.quantity: i for i, key in enumerate(prior.keys) if key[:2] == ("camera", name)}
        if "phi" not in known:
            continue
        values = dict(zip(camera.lens.names, camera.lens.values, strict=True))
        values |= {one: float(mean[i]) for one, i in known.items() if one in values}
        before = camera.lens.with_values([*values.values()])
        both = np.array([lens.values for lens in before.after_zoom(camera.phi / float(mean[known["phi"]]))])
        own = [known[one] for one in values if one in known]
        there = [i for i, one in enumerate(values) if one in known]
        mean[own], half[own] = both.mean(axis=0)[there], 0.5 * np.diff(both, axis=0)[0][there]
    gone = frozenset().union(*(loosened(what, name, camera.lens) for name, camera in cameras.items()))
    return replace(prior, information=prior.information.widened(half[None]), mean=mean).without(gone)
