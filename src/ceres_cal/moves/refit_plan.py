"""The use of an old calibration for the next one: its estimate is the start, its posterior a prior.

Also the same observations of a target of other dimensions.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ceres_cal.base import Frozen, InputError, Pose, no_such, replace
from ceres_cal.calibration import Calibration, RefitRecord
from ceres_cal.calibration.calibration import loosened, still_known
from ceres_cal.calibration.renaming import relabelled
from ceres_cal.moves.agreement import matched, require_posterior
from ceres_cal.observations import Observations, Prior, Sights, gather_sights
from ceres_cal.posterior import OtherLenses
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import GaussianPrior, Problem, gather_priors, require_possible_numbers
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Estimate, Layout, Options, Station
from ceres_cal.problem.quantities import natural_sizes
from ceres_cal.scene import TURNED, Target, target_from_spec


def mistaken_targets(observations: Observations) -> dict[str, Observations]:
    """Return the observations with a target replaced by each one that it may be mistaken for, such as the other
    division's field, and that has all observed features; the keys are the other targets in words.
    """
    every = {
        words: _seen_as(observations, name, target_from_spec(spec, words))
        for name, target in observations.targets.items()
        for words, spec in target.mistaken_for.items()
    }
    return {words: seen for words, seen in every.items() if seen is not None}


def _seen_as(observations: Observations, name: str, other: Target) -> Observations | None:
    """Return the observations with features of the same names in another target; None where one does not exist."""
    target, points, curves = observations.targets[name], observations.points, observations.curves
    of_it = np.array([view.target == name for view in observations.views], dtype=bool)
    p, c = points.feature.copy(), curves.feature.copy()
    for feature, view, names, index in (
        (p, points.view, target.point_names, other.point_index),
        (c, curves.view, target.curve_names, other.curve_index),
    ):
        to, own = np.array([index.get(one, -1) for one in names], dtype=feature.dtype), of_it[view]
        feature[own] = to[feature[own]]
    if np.any(p < 0) or np.any(c < 0):
        return None
    targets = {**observations.targets, name: other}
    return replace(observations, targets=targets, points=replace(points, feature=p), curves=replace(curves, feature=c))


# Usual change of a freed number, as a share of its natural size.
_CHANGED = 0.05

WHAT = ("auto", "pose", "pose-only", "zoom", "iris", "everything")
LABELS = ("check", "as-given", "turned")


class RefitOptions(Frozen, eq=True):
    """Assumptions of a refit.

    Attributes:
        hold_others: whether stations that stay and their cameras are held exactly; their posterior is still updated.
        labels: "check" them against a turn by 180 degrees, take them "as-given", or "turned".
        priors: new knowledge, such as a height measured after the move.

    Raises:
        InputError: unknown labels.
    """

    hold_others: bool = False
    labels: str = "check"
    priors: tuple[Prior, ...] = ()

    def __post_init__(self) -> None:
        if self.labels not in LABELS:
            raise InputError(no_such("way to take labels", self.labels, LABELS))


class RefitPlan(Frozen):
    """A refit as it was requested.

    Attributes:
        calibration: the old one. sights: of the new observations, with the targets of both.
        options: of the solves. what: one of WHAT except "auto". is_stated: whether the user stated `what`. asked:
            options of the refit.
        stations: observed stations -> their cameras. moved: those whose poses are solved for.
        stays: stations of the old calibration that have not moved, with its posterior as a prior.
        known: the old cameras, structure and stations that stay; stations that moved have no particular pose.
        prior: prior knowledge before `what` is taken into account. scales: earlier noise scales of points and curves.
        before: the old calibration with the lens that was chosen then; None where that is `calibration` itself.
        lens: number of the lens in the old posterior; 0 is the one that was chosen then. others: the other lenses by
            which the old calibration predicted as well, as the new observations see them. near: where solves start.
    """

    calibration: Calibration
    sights: Sights
    options: Options
    what: str
    is_stated: bool
    asked: RefitOptions
    stations: dict[str, str]
    moved: frozenset[str]
    stays: frozenset[str]
    known: Estimate
    prior: GaussianPrior
    scales: tuple[float, float]
    before: Calibration | None = None
    lens: int = 0
    others: OtherLenses | None = None
    near: Estimate | None = None

    @property
    def moved_cameras(self) -> frozenset[str]:
        """Cameras with a station that moved."""
        return frozenset(self.stations[name] for name in self.moved)

    def of_lens(self, number: int) -> RefitPlan:
        """Return the plan with another lens of the old posterior for the cameras that moved."""
        calibration = of_other_lens(self.calibration, number, self.moved_cameras)
        here, stations = calibration.estimate, self.known.stations
        stays = {name: here.stations[name] for name in stations if name in self.stays}
        known = replace(self.known, cameras=calibration.cameras, stations={**stations, **stays})
        kept = [key for key in calibration.uncertainty.posterior.keys if _is_kept(key, self.stays)]
        return replace(
            self,
            calibration=calibration,
            options=replace(calibration.options, priors=self.options.priors),
            known=known,
            prior=calibration.prior_of(kept),
            before=self.calibration,
            lens=number,
        )

    @property
    def is_repeated(self) -> bool:
        """Whether the old calibration is a refit to these observations: it includes them already."""
        return _repeated(self.calibration, self.sights.observations) is not None

    @property
    def earlier(self) -> Calibration:
        """The old calibration with the lens that was chosen then."""
        return self.before or self.calibration

    def loosened(self, what: str) -> frozenset[Key]:
        """Return the intrinsics about which nothing counts as known any more."""
        cameras = self.calibration.cameras
        return frozenset().union(*(loosened(what, name, cameras[name].lens) for name in self.moved_cameras))

    def prior_for(self, what: str, near: Estimate) -> GaussianPrior:
        """Return the prior with these intrinsics freed. `near`: with the phi that cameras have now."""
        return still_known(self.prior, what, {name: near.cameras[name] for name in self.moved_cameras})

    def usual(self, what: str) -> GaussianPrior:
        """Return a prior by which freed numbers have changed by about the usual amount, or by far more."""
        gone = sorted(self.loosened(what))
        sigmas = _CHANGED * natural_sizes(self.known, gone)
        return replace(
            GaussianPrior.about(Information.of_sigmas(dict(zip(gone, sigmas, strict=True))), self.known), gives_way=True
        )


def make_plan(
    calibration: Calibration,
    observations: Observations,
    what: str,
    moved: Collection[str] | None = None,
    asked: RefitOptions | None = None,
) -> RefitPlan:
    """Return which stations moved and which stay, and what is known of everything; where `what` is not stated, only
    poses have changed.

    Raises:
        InputError: an unknown name, or a calibration without a posterior.
        SolutionError: another camera or another field than those calibrated, by image size or dimensions.
    """
    if what not in WHAT:
        raise InputError(no_such("kind of refit (what)", what, WHAT))
    what, is_stated = ("pose", False) if what == "auto" else (what, True)
    require_posterior(calibration)
    observed = matched(calibration, observations)
    observations = calibration.as_taken(observations)
    stations = observations.stations
    chosen = frozenset(stations if moved is None else moved)
    for name in chosen - stations.keys():
        raise InputError(f"station {name!r} is to be refitted but was not observed: name one of {', '.join(stations)}")
    old = calibration.estimate.stations
    for name in stations.keys() - chosen - old.keys():
        raise InputError(f"station {name!r} is to stay where it was, but the calibration has no such station")
    elsewhere = {stations[name] for name in stations}  # an observed camera is only where it was observed
    stays = frozenset(n for n, s in old.items() if n not in chosen and (n in stations or s.camera not in elsewhere))
    asked = asked or RefitOptions()
    observed = _turned(observed) if asked.labels == "turned" else observed
    repeated = _repeated(calibration, observations)
    if calibration.digest == observations.digest and repeated is None:
        raise InputError(
            "the calibration was made from these observations, so a refit to them changes nothing: give new "
            "observations, or calibrate again with additional priors"
        )
    options = replace(calibration.options, priors=asked.priors or (calibration.options.priors if repeated else ()))
    require_possible_numbers(observed, replace(options, fixed={}, tolerances={}))  # those are the old calibration's
    scales = repeated.scales if repeated else calibration.fit.scales
    prior = carried_prior(calibration, observations, stays, of_lens=what in ("pose", "pose-only"))
    placed = {name: old[name] for name in old if name in stays}
    placed |= {name: Station(stations[name], Pose.identity()) for name in chosen}
    return RefitPlan(
        calibration,
        gather_sights(observed),
        options,
        what,
        is_stated,
        asked,
        stations,
        chosen,
        stays,
        Estimate(
            calibration.cameras,
            {name: placed[name] for name in dict.fromkeys([*old, *stations]) if name in placed},
            {},
            options.structure_of(observed.targets).carrying(calibration.estimate.structure),
        ),
        prior,
        scales,
    )


def _repeated(calibration: Calibration, observations: Observations) -> RefitRecord[GaussianPrior] | None:
    """Return the refit by which the calibration was made from these observations; None where it was made otherwise."""
    return calibration.refitted if calibration.digest == observations.digest else None


def _turned(observations: Observations) -> Observations:
    turned = relabelled(observations, TURNED)
    if turned is None:
        raise InputError("labels turned: an observed feature has no counterpart after half a turn: correct its label")
    return turned


def carried_prior(
    calibration: Calibration, observations: Observations, stays: frozenset[str], *, of_lens: bool = False
) -> GaussianPrior:
    """Return the prior of intrinsics, structure and stations that stay, without these observations.

    It is the marginal posterior of the calibration. Where that already includes these same observations, it is the
    prior that was used before them: nothing counts twice. Other lenses that predicted as well do not count twice,
    either, where they are evaluated one by one.

    Args:
        of_lens: return the prior if the chosen lens is right.
    """
    if (repeated := _repeated(calibration, observations)) is not None:
        return repeated.prior.without([key for key in repeated.prior.keys if not _is_kept(key, stays)])
    kept = [key for key in calibration.uncertainty.posterior.keys if _is_kept(key, stays)]
    return calibration.prior_of(kept, of_lens=of_lens)


def of_other_lens(calibration: Calibration, number: int, cameras: Collection[str]) -> Calibration:
    """Return the calibration with another lens of its posterior for some cameras; where nothing is known of that lens's
    numbers, they count as exact.
    """
    posterior, estimate = calibration.uncertainty.posterior, calibration.estimate
    seen, known = posterior.lenses[number], Information.nothing()
    if number and posterior.lens_information:
        known = posterior.lens_information[number - 1]
    stations = {name: one for name, one in seen.stations.items() if one.camera in cameras}
    there = replace(
        estimate,
        cameras={**estimate.cameras, **{name: seen.cameras[name] for name in cameras}},
        stations={**estimate.stations, **stations},
    )
    owners = {*(("camera", name) for name in cameras), *(("station", name) for name in stations)}
    own = known.marginal([key for key in known.keys if key[:2] in owners])
    rest = [key for key in posterior.keys if key[:2] not in owners and key.kind != "placement"]
    information = own + posterior.normal_of_lens.marginal(rest)
    asked = {name: calibration.options.of_camera(name) for name in there.cameras}
    for name in cameras:
        lens, free = there.cameras[name].lens, {key.quantity for key in own.keys}
        names = tuple(one for one in lens.names if one in free)
        asked[name] = replace(asked[name], lens=lens.kind, powers=lens.powers, coefficients=names, terms=lens.terms)
    options = calibration.options.with_lenses(asked)
    return replace(calibration, estimate=there, options=options, posterior=Posterior(information))


def _is_kept(key: Key, stays: frozenset[str]) -> bool:
    return key.kind == "camera" or key.is_structure or (key.kind == "station" and key.owner in stays)


def refit_problem(plan: RefitPlan, what: str, start: Estimate) -> tuple[Problem, Layout]:
    """Return the problem to solve, and the layout of all that is known: the posterior includes everything, held or not.

    Few observations may not determine the freed numbers of an explanation that was not asked for: they get a prior of
    their usual change.
    """
    everything = plan.calibration.uncertainty.posterior.layout(plan.calibration.estimate)
    free, stations = everything.free, plan.moved | (plan.stays & everything.stations)
    known = Layout(free, stations, frozenset(start.placements))
    held = {name for name in free if what == "pose-only" or (plan.asked.hold_others and name not in plan.moved_cameras)}
    moving = plan.moved if plan.asked.hold_others else stations
    solved = replace(known, free={n: f[:0] if n in held else f for n, f in free.items()}, stations=moving)
    cameras = plan.calibration.cameras
    priors = gather_priors(
        plan.sights.observations, plan.options, start.structure, plan.prior_for(what, start), cameras
    )
    if what != plan.what and plan.loosened(what):
        priors = (*priors, plan.usual(what))
    return Problem(plan.sights, solved, priors, options=plan.options), known
