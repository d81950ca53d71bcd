"""Calibrations compared with the Cramer-Rao bound, and with the best estimate, for which the truth is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from runner import mean_and_error, over

from accuracy.scenes import Problem, without_noise
from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.problem import bundle, quantities, reduced
from ceres_cal.problem import problem as least_squares
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Estimate, Options, Station, make_layout
from ceres_cal.problem.priors import gather_priors
from ceres_cal.problem.structure import make_structure
from ceres_cal.simulate import CLEAN, Disturbance, Simulation, simulate


@dataclass(frozen=True, eq=False)
class Trial:
    """One simulation of a problem: the input of the calibration, and the truth.

    Attributes:
        observations: with each prior drawn from its own distribution around the truth.
        clean: without noise, priors at the truth. used: selects the sights of `clean` that are neither outliers nor
            mislabelled.
    """

    observations: Observations
    truth: Estimate
    clean: Observations
    used: Callable[[Sights], Sights]
    options: Options

    def problem(self, observations: Observations) -> least_squares.Problem:
        """The least-squares problem with every sigma known and without the wrong observations."""
        return least_squares.Problem(
            self.used(gather_sights(observations, predicted=True)),
            make_layout(self.clean, self.options),
            gather_priors(observations, self.options, self.truth.structure),
            least_squares.Weighting(1.0, 1.0, "trivial"),
            self.options,
        )


def make_trial(problem: Problem, disturbance: Disturbance, seed: int) -> Trial:
    """The same problem, disturbance and seed give the same trial."""
    simulation = simulate(problem.scene, disturbance, seed)
    rng = np.random.default_rng([seed, len(problem.priors)])
    drawn = tuple(
        replace(prior, value=tuple(rng.normal(prior.value, prior.sigma).tolist())) for prior in problem.priors
    )
    return Trial(
        replace(simulation.observations, priors=drawn),
        true_estimate(simulation, problem.options),
        replace(without_noise(simulation), priors=problem.priors),
        lambda sights: sights.used(simulation.points.flag == CLEAN, simulation.curves.flag == CLEAN),
        problem.options,
    )


def true_estimate(simulation: Simulation, options: Options) -> Estimate:
    """The truth in the solver's terms."""
    scene = simulation.scene
    stations = {name: Station(place.camera, place.cam_from_world) for name, place in scene.stations.items()}
    structure = make_structure(simulation.observations.targets, options.tolerances)
    return Estimate(scene.cameras, stations, scene.placements, structure)


def bound(trial: Trial) -> Information:
    """Information at the truth about everything shared; its inverse is the Cramer-Rao bound."""
    return reduced.information(trial.problem(trial.clean), trial.truth).shared


def best(trial: Trial) -> Estimate:
    """The estimate from a start at the truth, with every sigma known and without the wrong observations."""
    return bundle.solve(trial.problem(trial.observations), trial.truth).estimate


def difference(trial: Trial, estimate: Estimate) -> Array:
    """Estimate less truth (P,) in the order of `bound`'s keys."""
    problem = trial.problem(trial.clean)
    keys = quantities.free_keys(trial.truth, problem.layout, problem.private)
    return quantities.difference(estimate, trial.truth, keys)


@dataclass(frozen=True, eq=False)
class Efficiency:
    """Many calibrations of one problem, compared with its Cramer-Rao bound.

    Attributes:
        keys: (P) of the shared numbers. errors: (N, P) estimate less truth.
        squared, best_squared: (N,) squared Mahalanobis length of the errors over P, of the calibration and of `best`.
            The mean is 1 where the bound is reached.
        failed: number of runs without a calibration. rejected: mean number of rejected observations.
    """

    keys: tuple[Key, ...]
    errors: Array
    squared: Array
    best_squared: Array
    failed: int
    rejected: float

    @property
    def ratio(self) -> tuple[float, float]:
        """Mean of `squared` and its standard error."""
        return mean_and_error(self.squared)

    @property
    def excess(self) -> tuple[float, float]:
        """Mean difference to `best_squared`, which has the same noise, and its standard error."""
        return mean_and_error(self.squared - self.best_squared)

    @property
    def bias(self) -> tuple[float, str]:
        """The largest mean error in its own standard errors, and the name of its number."""
        mean = np.mean(self.errors, axis=0)
        sigmas = np.abs(mean) / (np.std(self.errors, axis=0, ddof=1) / np.sqrt(len(self.errors)))
        return float(np.max(sigmas)), " ".join(self.keys[int(np.argmax(sigmas))][:3])


def attempts(
    problem: Problem, disturbance: Disturbance, seeds: Sequence[int]
) -> Iterator[tuple[Trial, Calibration | None]]:
    """A trial for each seed and its calibration without an initial estimate, None where it fails."""
    return over(partial(_attempt, problem, disturbance), seeds)


def _attempt(problem: Problem, disturbance: Disturbance, seed: int) -> tuple[Trial, Calibration | None]:
    trial = make_trial(problem, disturbance, seed)
    try:
        return trial, calibrate(trial.observations, problem.options)
    except CalibrationError:
        return trial, None


def efficiency(problem: Problem, disturbance: Disturbance, seeds: Sequence[int]) -> Efficiency:
    """Calibrate the problem once per seed, without an initial estimate."""
    every = over(partial(_error_of, problem, disturbance), seeds)
    keys, errors, squared, best_squared, rejected = zip(*(one for one in every if one is not None), strict=True)
    return Efficiency(
        keys[0],
        np.array(errors),
        np.array(squared),
        np.array(best_squared),
        len(seeds) - len(squared),
        float(np.mean(rejected)),
    )


def _error_of(
    problem: Problem, disturbance: Disturbance, seed: int
) -> tuple[tuple[Key, ...], Array, float, float, int] | None:
    """Keys, errors, squared error, that of `best` on the same noise, number of rejected rows; None where it fails."""
    trial, calibration = _attempt(problem, disturbance, seed)
    if calibration is None:
        return None
    known, error, ideal = bound(trial), difference(trial, calibration.estimate), difference(trial, best(trial))
    ours, least = (float(one @ known.matrix @ one) / len(known.keys) for one in (error, ideal))
    return known.keys, error, ours, least, len(calibration.rejected)
