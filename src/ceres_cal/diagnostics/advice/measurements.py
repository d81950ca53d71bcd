"""Something that could still be measured, as a simulation would have it, and what it would tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.base.transforms import Pose
from ceres_cal.observations import NO_CURVES, NO_POINTS, Observations, Prior
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.priors import stated_prior, tolerances
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.quantities import layout_of
from ceres_cal.problem.reduced import information
from ceres_cal.problem.structure import Tolerance, make_structure
from ceres_cal.scene.targets import Target
from ceres_cal.simulate import Scene, ViewPlan, simulate


@dataclass(frozen=True, eq=False)
class Measurement:
    """What to measure besides what was observed.

    Attributes:
        kind: "tape", "pole", "board", "line" or "frames".
        words: one line that says what to do. steps: one line for each part of it, where it has parts.
        priors: what would be known of a station. Their values are the estimate's: what counts is the sigma.
        targets, tolerances: what is brought along and how exactly it stands where it should.
        placements: world_from_target. views: what the frames taken then would show.
    """

    kind: str
    words: str
    steps: tuple[str, ...] = ()
    priors: tuple[Prior, ...] = ()
    targets: Mapping[str, Target] = field(default_factory=dict)
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)
    placements: Mapping[str, Pose] = field(default_factory=dict)
    views: tuple[ViewPlan, ...] = ()

    def before(self, cam_from_world: Pose, other: Pose) -> Measurement:
        """The same with every placement as far before a camera at another pose as it is before one at this."""
        moved = other.inverse @ cam_from_world
        return replace(self, placements={name: moved @ pose for name, pose in self.placements.items()})


def together(parts: Sequence[Measurement], words: str) -> Measurement:
    """Several measurements of one kind as one; their names must differ."""
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


@dataclass(frozen=True, eq=False)
class Ground:
    """What a measurement would add to.

    Attributes:
        estimate: where everything is thought to be. keys: (P) its free numbers. targets: as drawn.
        tolerances: those it was calibrated with. weighting: noise, px, of points and of curves, and the loss.
    """

    estimate: Estimate
    keys: tuple[Key, ...]
    targets: Mapping[str, Target]
    tolerances: Mapping[str, Tolerance]
    weighting: Weighting

    def information_of(self, measurement: Measurement) -> Information:
        """What a measurement would say of the free numbers, its own unknowns integrated out.

        A placement is one of those, and so is how far a pole stands aside. It is nothing where the camera sees nothing,
        or cannot project what it sees. Tolerances that the calibration had already are no news.
        """
        try:
            return self._told_by(measurement)
        except (InputError, SolutionError):  # quiet: what tells nothing ranks last
            return Information.nothing(self.keys)

    def _told_by(self, measurement: Measurement) -> Information:
        """The same; raises where nothing is told."""
        targets = {**self.targets, **measurement.targets}
        estimate = self._with(measurement, targets)
        observations = replace(_observed(estimate, targets, measurement.views), targets=targets)
        layout = layout_of(self.keys, estimate, measurement.placements)
        lenses = {name: camera.lens for name, camera in estimate.cameras.items()}
        stated = (stated_prior(prior, lenses[estimate.stations[prior.name].camera]) for prior in measurement.priors)
        priors = (*stated, *tolerances(estimate.structure, self.keys))
        problem = Problem(gather_sights(observations, predicted=True), layout, priors, self.weighting)
        return information(problem, estimate).shared.marginal(self.keys)

    def _with(self, measurement: Measurement, targets: Mapping[str, Target]) -> Estimate:
        """The estimate with what the measurement brings along; of the placements those that are still free."""
        solved = tuple(self.estimate.structure.dimensions)
        structure = make_structure(targets, {**self.tolerances, **measurement.tolerances}, solved)
        shared = dict.fromkeys(key.owner for key in self.keys if key.kind == "placement")
        return replace(
            self.estimate,
            placements={**{name: self.estimate.placements[name] for name in shared}, **measurement.placements},
            structure=structure.carrying(self.estimate.structure),
        )


def _observed(estimate: Estimate, targets: Mapping[str, Target], views: tuple[ViewPlan, ...]) -> Observations:
    """What the views would show where everything is as estimated, without noise, in units of sigma 1."""
    if not views:
        return Observations(targets, {}, (), NO_POINTS, NO_CURVES)
    stations = {plan.station: estimate.stations[plan.station] for plan in views}
    cameras = {station.camera: estimate.cameras[station.camera] for station in stations.values()}
    return simulate(Scene(targets, cameras, stations, estimate.placements, views)).observations
