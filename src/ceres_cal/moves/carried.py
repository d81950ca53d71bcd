"""What of an old calibration is carried into the next one: its estimate as a start, its posterior as a prior."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.base.transforms import Pose
from ceres_cal.calibrating import Again
from ceres_cal.calibration import Calibration
from ceres_cal.model.joint import JointPrior
from ceres_cal.model.parameters import Estimate, Layout, Options, Station, intrinsic_names
from ceres_cal.model.keys import Key
from ceres_cal.model.quantities import intrinsic_keys
from ceres_cal.model.structure import Structure, make_structure
from ceres_cal.observations import Observations, Prior

WHAT = ("pose", "pose-only", "zoom", "iris", "everything")


@dataclass(frozen=True, eq=False)
class Plan:
    """A refit as it was asked for.

    Attributes:
        calibration: the old one. observations: the new ones, with the targets of both. options: of the solves.
        what: one of WHAT. stations: the observed stations and their cameras. moved: those whose poses are sought.
        stays: stations of the old calibration that are where they were, under its posterior.
        hold_others: whether `stays` and their cameras are held, too.
        prior: what is known beforehand, `what` not yet taken into account. scales: noise scales of points and curves
            seen before.
    """

    calibration: Calibration
    observations: Observations
    options: Options
    what: str
    stations: dict[str, str]
    moved: frozenset[str]
    stays: frozenset[str]
    hold_others: bool
    prior: JointPrior
    scales: tuple[float, float]

    @property
    def moved_cameras(self) -> frozenset[str]:
        """Cameras with a station that moved."""
        return frozenset(self.stations[name] for name in self.moved)

    def loosened(self, what: str) -> frozenset[Key]:
        """The intrinsics of which nothing is taken to be known any more."""
        found: set[Key] = set()
        for name in self.moved_cameras:
            camera = self.calibration.cameras[name]
            names = intrinsic_names(camera.lens)
            which = {"zoom": ("phi",), "iris": camera.lens.names, "everything": names}.get(what, ())
            found |= {key for key in camera_keys(name, camera, range(len(names))) if key.quantity in which}
        return frozenset(found)


def make_plan(
    calibration: Calibration,
    observations: Observations,
    what: str,
    moved: Collection[str] | None,
    hold_others: bool,
    priors: tuple[Prior, ...] = (),
) -> Plan:
    """Who moved, who stays, and what is known of everything.

    Raises:
        InputError: a name that is not there, or a calibration that does not say how well it is known.
        SolutionError: another camera or another field than those calibrated, by image size or dimensions.
    """
    if what not in WHAT:
        raise InputError(f"what={what!r} is unknown: choose one of {', '.join(WHAT)}")
    if calibration.posterior is None:
        raise InputError("the calibration does not say how well it is known: calibrate again")
    require_same_things(calibration, observations)
    stations = observations.stations
    chosen = frozenset(stations if moved is None else moved)
    for name in chosen - stations.keys():
        raise InputError(f"station {name!r} is to be refitted but was not observed: observed are {', '.join(stations)}")
    old = calibration.estimate.stations
    for name in stations.keys() - chosen - old.keys():
        raise InputError(f"station {name!r} is to stay where it was, but the calibration has no such station")
    elsewhere = {stations[name] for name in stations}  # a camera that was observed is where it was observed
    stays = frozenset(n for n, s in old.items() if n not in chosen and (n in stations or s.camera not in elsewhere))
    observed = replace(observations, targets={**calibration.targets, **observations.targets})
    same = calibration.digest == observations.digest  # then the question is the same, too
    options = replace(calibration.options, priors=priors or (calibration.options.priors if same else ()))
    prior = prior_for(calibration, observations, stays)
    fit, before = calibration.fit, calibration.refitted
    scales = before.scales if same and before is not None else (fit.point_scale, fit.curve_scale)
    return Plan(calibration, observed, options, what, stations, chosen, stays, hold_others, prior, scales)


def require_same_things(calibration: Calibration, observations: Observations) -> None:
    """Raise an error where cameras, image sizes or targets are not those that were calibrated."""
    for name, size in observations.cameras.items():
        if name not in calibration.cameras:
            known = ", ".join(map(repr, calibration.cameras))
            raise InputError(f"camera {name!r} is not in the calibration, which has {known}: name the camera as there")
        known_size = calibration.cameras[name].image_size
        if known_size != tuple(size):
            raise SolutionError(
                f"wrong camera: {name!r} was calibrated with images of {known_size[0]} x {known_size[1]} px, the "
                f"observations are of {size[0]} x {size[1]} px: calibrate it anew"
            )
    for name, target in observations.targets.items():
        if name in calibration.targets and calibration.targets[name] != target:
            raise SolutionError(
                f"wrong field: target {name!r} has other dimensions in the observations than in the calibration: "
                "correct them, or give it another name"
            )
    for name, camera in observations.stations.items():
        station = calibration.estimate.stations.get(name)
        if station is not None and station.camera != camera:
            raise InputError(f"station {name!r} is one of camera {station.camera!r}, not of {camera!r}: name another")


def prior_for(calibration: Calibration, observations: Observations, stays: frozenset[str]) -> JointPrior:
    """What is known of intrinsics, structure and stations that stay, without these observations.

    The posterior of the calibration, all else integrated out. Where it has these same observations in it already, it is
    what had been known before them: nothing counts twice.
    """
    if calibration.digest == observations.digest:
        before = calibration.refitted.prior if calibration.refitted is not None else _nothing()
        return _among(before, calibration, stays)
    posterior = calibration.posterior
    assert posterior is not None
    return kept_prior(calibration, [i for i, key in enumerate(posterior.keys) if _is_kept(key, stays)], stays)


def kept_prior(calibration: Calibration, kept: Sequence[int], stations: frozenset[str]) -> JointPrior:
    """What the posterior says of the keys at these places, all others integrated out."""
    posterior, estimate = calibration.posterior, calibration.estimate
    assert posterior is not None
    return JointPrior(
        tuple(posterior.keys[i] for i in kept),
        posterior.marginal(np.array(kept, dtype=np.int64)),
        estimate.cameras,
        {name: estimate.stations[name].cam_from_world for name in stations},
        dict(zip(estimate.structure.names, estimate.structure.values.tolist(), strict=True)),
    )


def _is_kept(key: Key, stays: frozenset[str]) -> bool:
    return key.kind in ("camera", "structure") or (key.kind == "station" and key.owner in stays)


def _nothing() -> JointPrior:
    return JointPrior((), np.empty((0, 0)), {}, {}, {})


def _among(prior: JointPrior, calibration: Calibration, stays: frozenset[str]) -> JointPrior:
    """The prior without the stations that are said to have moved now."""
    gone = [key for key in prior.keys if not _is_kept(Key(*key), stays)]
    return without_keys(prior, gone) if gone else prior


def without_keys(prior: JointPrior, gone: Collection[tuple[str, str, str, str]]) -> JointPrior:
    """The prior with some numbers integrated out: nothing is known of them any more."""
    from ceres_cal.uncertainty import Posterior

    if not any(key in gone for key in prior.keys):
        return prior
    kept = [i for i, key in enumerate(prior.keys) if key not in gone]
    whole = Posterior(tuple(Key(*key) for key in prior.keys), prior.information)
    keys = tuple(prior.keys[i] for i in kept)
    return replace(prior, keys=keys, information=whole.marginal(np.array(kept, dtype=np.int64)))


def layouts(plan: Plan, what: str, estimate: Estimate, placements: Collection[str]) -> tuple[Layout, Layout]:
    """What the solver may move, and what is known at all: the posterior speaks of everything, held or not."""
    calibration = plan.calibration
    posterior = calibration.posterior
    assert posterior is not None
    free = {}
    for name, camera in calibration.cameras.items():
        names = intrinsic_names(camera.lens)
        mine = [names.index(key.quantity) for key in posterior.keys if key[:2] == ("camera", name)]
        free[name] = np.array(sorted(mine), dtype=np.int64)
    joint = without_keys(plan.prior, plan.loosened(what))
    told = {key.owner for key in posterior.keys if key.kind == "station"}
    stations = plan.moved | (plan.stays & told)
    priors = (*plan.observations.priors, *plan.options.priors)
    known = Layout(free, frozenset(stations), frozenset(placements), priors, joint)
    held = {name for name in free if what == "pose-only" or (plan.hold_others and name not in plan.moved_cameras)}
    moving = plan.moved if plan.hold_others else stations
    solved = replace(known, free={n: f[:0] if n in held else f for n, f in free.items()}, stations=frozenset(moving))
    return replace(solved, joint=joint.given(_free_keys(solved, estimate))), known


def _free_keys(layout: Layout, estimate: Estimate) -> set[tuple[str, str, str, str]]:
    keys: list[Key] = []
    for name, numbers in layout.free.items():
        keys += camera_keys(name, estimate.cameras[name], numbers)
    for name in layout.stations:
        keys += pose_keys("station", name)
    for name in estimate.structure.names:
        target, _, feature = name.partition("/")
        keys.append(Key("structure", target, feature, "m"))
    return set(keys)


def first_estimate(plan: Plan, poses: dict[str, Pose], placements: dict[str, Pose]) -> Estimate:
    """The old cameras, structure and stations that stay, with poses for what is sought."""
    old = plan.calibration.estimate
    stations = {name: old.stations[name] for name in old.stations if name in plan.stays}
    stations |= {name: Station(plan.stations[name], pose) for name, pose in poses.items()}
    structure = with_structure(old, plan.observations, plan.options)
    return Estimate(old.cameras, _ordered(stations, [*old.stations, *plan.stations]), placements, structure)


def with_structure(old: Estimate, observations: Observations, options: Options) -> Structure:
    """The targets as they were found built, in the order of the observations' targets; new ones as drawn."""
    structure = make_structure(observations.targets, options.tolerances)
    known = dict(zip(old.structure.names, old.structure.values.tolist(), strict=True))
    return structure.with_values(np.array([known.get(name, 0.0) for name in structure.names]))


def _ordered(stations: dict[str, Station], names: Sequence[str]) -> dict[str, Station]:
    return {name: stations[name] for name in dict.fromkeys(names) if name in stations}


def again(plan: Plan, known: Layout, *, assessed: bool) -> Again:
    """How the shared steps take the old calibration up."""
    return Again(known, plan.scales, assessed)
