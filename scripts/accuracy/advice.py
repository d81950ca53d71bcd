"""Whether the promises of `advise` are kept: python scripts/run.py advice [--help]

For each scene the calibration is asked what to measure next. Each measurement that it proposes is simulated many times
with new noise, and the calibration is repeated with it. Each promise (worst and mean error of located points at 150 mm)
is compared with the error that the new calibration states and with its true error. Where today's observations do not
determine phi, a promise depends on phi. Then the stated error is compared with the promise for the phi that is found,
the true error with the promise for the true phi, and the stated error must lie within the promised range. A promise
that is marked as rough is shown but not judged. Exits with 1 when a figure is missed by more than two standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from runner import Row, mean_and_error, script, share_error
from scenery import field_scene, overhead_pose

from accuracy.bound import attempts
from accuracy.scenes import CLEAN_NOISE, FIELD, Problem, tilted
from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.words import ROBOT_TOP_M
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics.advice import Measurement, Promise, advise, promised
from ceres_cal.observations import Observations, combine
from ceres_cal.problem.parameters import Options, Station
from ceres_cal.scene.targets import custom
from ceres_cal.simulate import Scene, simulate

WITHIN = 0.1
LEAST_IN_RANGE = 0.9
OTHER_NOISE = 1_000_000  # added to a seed, so that the additional measurements have noise of their own


def half_field(tilt_deg: float) -> Problem:
    """The left half of a field, densely observed, by a camera in its middle."""
    cameras = tilted(0.0).scene.cameras
    pose = overhead_pose(-2.3, 0.1, 4.0, tilt_x_deg=0.6 * tilt_deg, tilt_y_deg=-0.8 * tilt_deg, yaw_deg=91.0)
    narrow = {"overhead": replace(cameras["overhead"], phi=868.0)}
    stations = {"overhead": Station("overhead", pose)}
    return Problem(field_scene(FIELD, narrow, stations, frames=2, points=(), spacing_m=0.2), Options(lens="radial"))


CASES: Mapping[str, Callable[[], Problem]] = {
    "whole field, 8 deg": partial(tilted, 8.0),
    "whole field, 3 deg": partial(tilted, 3.0),
    "whole field, 1 deg": partial(tilted, 1.0),
    "half field, 8 deg": partial(half_field, 8.0),
    "half field, 3 deg": partial(half_field, 3.0),
    "whole field, 3 deg, height": partial(tilted, 3.0, 0.01),
    "whole field, 1 deg, 6 boards": partial(tilted, 1.0, None, 6),
}


def followed(
    measurement: Measurement, calibration: Calibration, observations: Observations, scene: Scene, seed: int
) -> Calibration:
    """The calibration repeated with the additional measurement, simulated in the true scene with its own noise."""
    rng = np.random.default_rng([OTHER_NOISE, seed])
    options = calibration.options
    (station,) = scene.stations
    priors = tuple(
        replace(prior, value=tuple(rng.normal(scene.camera_at(station).position[-len(prior.sigma) :], prior.sigma)))
        for prior in measurement.priors
    )
    observations = replace(observations, priors=(*observations.priors, *priors))
    if measurement.views:
        true = measurement.before(calibration.stations[station].cam_from_world, scene.stations[station].cam_from_world)
        aside = {
            name: custom(_moved(measurement.targets[name].points, tolerance.points_m, rng))
            for name, tolerance in measurement.tolerances.items()
        }
        there = Scene(
            {**scene.targets, **measurement.targets, **aside},
            scene.cameras,
            scene.stations,
            true.placements,
            measurement.views,
        )
        seen = simulate(there, CLEAN_NOISE, seed + OTHER_NOISE).observations
        named = {name: measurement.targets.get(name, target) for name, target in seen.targets.items()}
        observations = combine([observations, replace(seen, targets=named)])
    return calibrate(observations, replace(options, tolerances={**options.tolerances, **measurement.tolerances}))


def _moved(
    points: Mapping[str, tuple[float, float, float]], sigma_m: float, rng: np.random.Generator
) -> dict[str, tuple[float, float, float]]:
    return {name: (rng.normal(x, sigma_m), rng.normal(y, sigma_m), z) for name, (x, y, z) in points.items()}


@dataclass
class FollowUp:
    """Results of one measurement that is simulated many times; there is one object for rough promises, one for others.

    Attributes:
        promised, stated: (runs, 2) worst and mean error, mm; promised for the phi that was found.
        at_truth: (runs, 2) the same promise for the true phi.
        sd_mm: (runs, N) the stated map. off_m: (runs, N, 2) its true errors; the worst error is taken where the stated
            map is worst.
        in_range: whether the worst stated error lies within the range that was promised for all possible phi.
    """

    promised: list[tuple[float, float]] = field(default_factory=list)
    stated: list[tuple[float, float]] = field(default_factory=list)
    at_truth: list[tuple[float, float]] = field(default_factory=list)
    sd_mm: list[Array] = field(default_factory=list)
    off_m: list[Array] = field(default_factory=list)
    in_range: list[bool] = field(default_factory=list)

    def add(self, promise: Promise, found: Calibration, scene: Scene) -> None:
        """Adds the result of one run."""
        (name,) = scene.stations
        camera = scene.stations[name].camera
        stated = found.uncertainty.map_sd_mm(name, ROBOT_TOP_M)
        self.promised.append(promised_for(promise, found.cameras[camera].phi))
        self.stated.append((stated.worst_mm, stated.mean_mm))
        self.at_truth.append(promised_for(promise, scene.cameras[camera].phi))
        self.sd_mm.append(stated.sd_mm.ravel())
        x, y = np.meshgrid(stated.x_m, stated.y_m)
        self.off_m.append(errors_m(found, scene, np.column_stack([x.ravel(), y.ravel()])))
        if promise.valley:
            low, high = promise.worst_range_mm
            self.in_range.append(low / (1.0 + WITHIN) <= stated.worst_mm <= high * (1.0 + WITHIN))

    def rows(self, case: str, words: str) -> Iterator[Row]:
        """The stated and the true errors, divided by the promised ones."""
        promised, stated, at_truth = (np.array(v) for v in (self.promised, self.stated, self.at_truth))
        runs, limits = len(promised), (1.0 - WITHIN, 1.0 + WITHIN)
        rms = 1e3 * np.sqrt(np.mean(np.sum(np.array(self.off_m) ** 2, axis=2), axis=0))
        fact = (rms[np.nanargmax(np.mean(self.sd_mm, axis=0))], np.nanmean(rms))
        for column, what in enumerate(("worst", "mean")):
            ratios = stated[:, column] / promised[:, column]
            told = (
                f"{np.mean(promised[:, column]):.2f} mm promised, {np.mean(stated[:, column]):.2f} stated, {runs} runs"
            )
            yield Row(case, f"{words}: {what} stated", *mean_and_error(ratios), *limits, told)
            expected = float(np.sqrt(np.mean(at_truth[:, column] ** 2)))
            ratio = float(fact[column]) / expected
            told = f"{expected:.2f} mm promised, {fact[column]:.2f} in fact"
            yield Row(case, f"{words}: {what} in fact", ratio, ratio / np.sqrt(2.0 * runs), *limits, told)
        if self.in_range:
            share = float(np.mean(self.in_range))
            yield Row(case, f"{words}: in the range", share, share_error(share, runs), LEAST_IN_RANGE)

    def rough_row(self, case: str, words: str) -> Row:
        """Rough promises, shown but not judged: worst stated over worst promised error, where both are finite."""
        promised, stated = (np.array(v)[:, 0] for v in (self.promised, self.stated))
        told = np.isfinite(promised) & np.isfinite(stated)
        both = np.count_nonzero(np.isinf(promised) & np.isinf(stated))
        note = f"{np.count_nonzero(told)} of {len(told)} runs; {both} unknown as promised"
        ratio = float(np.median(stated[told] / promised[told])) if told.any() else 0.0
        return Row(case, f"{words}: rough, worst, median", ratio, note=note)


def promised_for(promise: Promise, phi_px: float) -> tuple[float, float]:
    """Worst and mean error; of a promise that depends on phi, those for this phi."""
    if not promise.valley:
        return promise.after.worst_mm, promise.after.mean_mm
    phi, errors = zip(*(each for each in promise.valley if np.isfinite(each[1].worst_mm)), strict=True)
    logs = np.log([[e.worst_mm, e.mean_mm] for e in errors])
    worst, mean = (float(np.exp(np.interp(np.log(phi_px), np.log(phi), column))) for column in logs.T)
    return worst, mean


def errors_m(calibration: Calibration, scene: Scene, places: Array) -> Array:
    """(N, 2) errors of places at ROBOT_TOP_M that the calibration locates; NaN where the true camera does not see."""
    (name,) = scene.stations
    camera, truth = calibration.station(name), scene.camera_at(name)
    pixels = truth.project(np.column_stack([places, np.full(len(places), ROBOT_TOP_M)]))
    with np.errstate(invalid="ignore"):
        shown = np.all((pixels >= -0.5) & (pixels <= np.array(truth.image_size) - 0.5), axis=1)
    return np.asarray(np.where(shown[:, None], camera.locate(pixels, ROBOT_TOP_M) - places, np.nan))


def rows(case: str, make: Callable[[], Problem], runs: int) -> Iterator[Row]:
    """The advice of the first run, followed in all runs, with the promises of each run."""
    problem = make()
    measurements: list[Measurement] = []
    kept: list[tuple[FollowUp, FollowUp]] = []
    failed: list[str] = []
    for seed, (trial, calibration) in enumerate(attempts(problem, CLEAN_NOISE, range(runs))):
        if calibration is None:
            failed.append("at first")
            continue
        (name,) = calibration.stations
        here = calibration.stations[name].cam_from_world
        if not measurements:
            first = here
            measurements = [promise.measurement for promise in advise(calibration, name, ROBOT_TOP_M).promises]
            kept = [(FollowUp(), FollowUp()) for _ in measurements]
        now = [measurement.before(first, here) for measurement in measurements]
        for ones, promise in zip(kept, promised(calibration, now, name, ROBOT_TOP_M), strict=True):
            try:
                found = followed(promise.measurement, calibration, trial.observations, problem.scene, seed)
            except CalibrationError as error:
                failed.append(f"{short_name(promise.measurement)}, seed {seed}: {error}")
            else:
                ones[promise.rough].add(promise, found, problem.scene)
    for measurement, (sure, rough) in zip(measurements, kept, strict=True):
        if len(sure.stated) > 1:
            yield from sure.rows(case, short_name(measurement))
        if rough.stated:
            yield rough.rough_row(case, short_name(measurement))
    yield Row(case, "runs without a calibration", len(failed), most=0.0, note="; ".join(failed))


def short_name(measurement: Measurement) -> str:
    """The kind of the measurement, with its sigma or its number of steps."""
    if measurement.priors:
        prior = measurement.priors[0]
        return f"{prior.quantity.removesuffix('_m')} to {1e3 * prior.sigma[0]:.0f} mm"
    return f"{measurement.kind} x {len(measurement.steps) or len(measurement.views[0].frames)}"


def over_all(every: Sequence[Row]) -> Iterator[Row]:
    """Stated and true errors divided by the promised ones: mean and range over all scenes and measurements."""
    for what in ("stated", "in fact"):
        ratios = [row.value for row in every if row.what.endswith(f" {what}")]
        if ratios:
            note = f"{min(ratios):.2f} to {max(ratios):.2f}"
            yield Row("everything", f"{what}, over what was promised, mean", float(np.mean(ratios)), note=note)


_cases = {name: partial(rows, name, make) for name, make in CASES.items()}
main = script(_cases, __doc__, (100, "simulated calibrations of each scene"), 2, over_all)
