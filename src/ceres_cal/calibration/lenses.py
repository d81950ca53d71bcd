"""The lens of each camera, chosen by its own observations: cameras of a rig may have lenses of different kinds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import TypeVar

import numpy as np

from ceres_cal.base import CalibrationError, Frozen, Mask, Poses, cached_property, replace
from ceres_cal.calibration.lens_choice import LensDecision, choose_lens
from ceres_cal.calibration.lens_forms import papers
from ceres_cal.observations import Sights
from ceres_cal.posterior.other_lenses import OtherLenses, together
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import Estimate, Options
from ceres_cal.robust.as_built import AS_DRAWN, Construction
from ceres_cal.start.initialise import Start
from ceres_cal.start.world import chained_poses

_T = TypeVar("_T")


class LensDecisions(Frozen):
    """The lens that was chosen for each camera.

    Attributes:
        sights: of all observations. asked: options that leave the lens open. first: a start with the paper's lens.
        each: camera -> its lens.
    """

    sights: Sights
    asked: Options
    first: Start
    each: Mapping[str, LensDecision]

    @cached_property
    def options(self) -> Options:
        """The options that were asked for, with the chosen lenses."""
        each = self.each.items()
        views = {name: len(self.sights.of_camera(name)) for name in self.each}
        return self.asked.with_lenses({name: one.options.with_first_power(views[name]) for name, one in each})

    @cached_property
    def start(self) -> Start:
        """The start of everything: each camera as it was compared, combined through what they observed in common."""
        own = {name: one.start for name, one in self.each.items()}
        if len(own) == 1:
            return next(iter(own.values()))
        cameras = {name: one.estimate.cameras[name] for name, one in own.items()}
        numbers = [self.sights.numbers(camera=name) for name in own]
        poses = [one.estimate.pose_stack(self.sights.of_camera(name).keys) for name, one in own.items()]
        stations, placements = chained_poses(self.sights, np.concatenate(numbers), np.concatenate(poses))
        estimate = Estimate(cameras, stations, placements, self.first.estimate.structure)
        others = tuple(replace(other, cameras=cameras) for other in self.first.others)
        return replace(self.first, estimate=estimate, others=others)

    @property
    def built(self) -> Construction:
        """Targets as built, as estimated when lenses were compared."""
        return next((one.built for one in self.each.values() if one.built.every), AS_DRAWN)

    @property
    def far_better(self) -> set[str]:
        """Cameras for which a lens without a formula leaves far smaller residuals than any other."""
        return {name for name, one in self.each.items() if one.among is not None and one.among.is_far_better}

    @property
    def labels(self) -> list[str]:
        """Labels of the lenses."""
        return [one.choice.chosen for one in self.each.values()]

    @property
    def caveats(self) -> list[str]:
        """Warnings about the lenses that were taken."""
        several = len(self.each) > 1
        said = {name: one.choice.caveat for name, one in self.each.items()}
        return [f"camera {name!r}: {words}" if several else words for name, words in said.items() if words]

    def first_solved(self, solved: Callable[[LensDecisions], _T]) -> tuple[_T, LensDecisions]:
        """Return the solution with these lenses, and the lenses. A lens with which all of the observations cannot be
        calibrated is replaced by another one.

        Raises:
            CalibrationError: no lens makes a calibration.
        """
        try:
            return solved(self), self
        except CalibrationError as error:  # reads: "..." beside that lens, why it failed
            blamed = {error.camera or ""} & {*self.each} or self.each
            parts = {name: start_of(self.first, self.sights, name) for name in blamed}
            found = {n: self.each[n].otherwise(str(error), papers(self.asked), part) for n, part in parts.items()}
            others = {name: other for name, other in found.items() if other is not None}
            if not others:
                raise
        return self._with(others).first_solved(solved)

    def anew(
        self, cameras: Collection[str], near: Estimate, built: Construction, by_most: Collection[str]
    ) -> LensDecisions:
        """Choose once more for some cameras, from another estimate and with targets as built; for the cameras in
        `by_most` by most of their observations.
        """
        start = replace(self.first, estimate=near, keys=())
        return self._with({
            name: _chosen(self.sights, self.asked, start, name, built, by_most=name in by_most) for name in cameras
        })  # fmt: skip

    def instead(self, taken_out: tuple[Mask, Mask], scales: tuple[float, float]) -> LensDecisions | None:
        """Return other lenses where these explain what is rejected, see `Comparison.instead`; None where none does."""
        seen, others = self.sights.observations, {}
        for name, one in self.each.items():
            own = np.array([view.camera == name for view in seen.views])
            points, curves = (out[own[c.view]] for out, c in zip(taken_out, (seen.points, seen.curves), strict=True))
            other = None
            if one.among is not None:
                other = one.among.instead((points, curves), scales, is_alone=len(self.each) == 1)
            if other is not None:
                others[name] = other
        return self._with(others) if others else None

    def others(self, posterior: Posterior, end: Estimate, options: Options) -> OtherLenses:
        """Return the estimates of all cameras with other lenses, weighted by their probabilities. Stations that see no
        floor stand as at `end`, and numbers that the options hold are held.
        """
        floors = {key.station for key in self.sights.keys if key.placement is None}
        ends = {name: _part(end, self.sights, name) for name in self.each}
        each = [one.others(posterior, ends[name], options) for name, one in self.each.items()]
        return together(each, floors, end)

    def _with(self, others: Mapping[str, LensDecision]) -> LensDecisions:
        return replace(self, each={**self.each, **others})


def choose_lenses(sights: Sights, options: Options, start: Start) -> LensDecisions:
    """Choose each camera's lens by its observations.

    Args:
        options: their lens is ignored. start: of everything, with the paper's lens.
    """
    each = {name: _chosen(sights, options, start, name, AS_DRAWN) for name in sights.observations.cameras}
    return LensDecisions(sights, options, start, each)


def _chosen(
    sights: Sights, options: Options, start: Start, camera: str, built: Construction, *, by_most: bool = False
) -> LensDecision:
    own = sights.observations.of_camera(camera)
    asked = replace(options, priors=own.about_shown(options.priors))
    return choose_lens(own, asked, start_of(start, sights, camera), built, by_most=by_most)


def start_of(start: Start, sights: Sights, camera: str) -> Start:
    """Return the part of a start that is about one camera, with the poses of its own sights where these are known."""
    if len(start.estimate.cameras) == 1:
        return start
    posed = [i for i, key in enumerate(start.keys) if key.camera == camera and key.placement is not None]
    there = start.estimate.with_placements([start.keys[i] for i in posed], start.poses[posed])
    estimate = _part(there, sights, camera)
    return replace(start, estimate=estimate, phi_from={camera: start.phi_from[camera]}, others=())


def _part(of: Estimate, sights: Sights, camera: str) -> Estimate:
    """Return the part of an estimate that is about one camera and what it sees."""
    if len(of.cameras) == 1:
        return of
    names = list(dict.fromkeys(key.placement for key in sights.of_camera(camera).keys if key.placement is not None))
    return Estimate(
        {camera: of.cameras[camera]},
        {name: station for name, station in of.stations.items() if station.camera == camera},
        Poses.stacked(names, Poses.of(of.placements).of_names(names)),
        of.structure,
    )
