"""What to measure next, and how far it would reduce errors, in mm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from ceres_cal.base import ROBOT_TOP_M, Frozen, checked, each, for_small_matrices, numerical, replace, text_of
from ceres_cal.base.errors import InputError, StepProgress
from ceres_cal.base.words import short
from ceres_cal.calibration import Calibration, Fit
from ceres_cal.diagnostics.advice.candidates import BOARD, CandidateSearch, Ground, Measurement, added_information
from ceres_cal.diagnostics.advice.outlook import BENT, Errors, Outlook
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import Estimate, Information, Weighting
from ceres_cal.scene.targets import Target, still

_LARGER, _LESS = 0.5, 0.2
"""A measurement with less work is nearly as good as the best one if the error that it leaves is larger by no more than
the first share of the best's, and the reduction smaller by no more than the second share of the best's."""
# Share of today's worst error; what leaves more is not advised: less than a tenth is within the error of advice.
# Nothing changes from 0.82 to 0.95.
_MUST_LEAVE = 0.9


class Promise(Frozen):
    """The result that one measurement promises.

    Attributes:
        after: the errors that it leaves, if everything is as estimated.
        valley: where phi is followed along its profile today, and the measurement determines it: phi (px) and the
            remaining errors if that is phi, over its 95 % bounds.
        rough: whether phi is followed along its profile and might still have to be. Then `after` is a guess: in
            simulations errors were from a tenth to five times of it, or known where it says unknown.
    """

    measurement: Measurement
    after: Errors
    rough: bool = False
    valley: tuple[tuple[float, Errors], ...] = ()

    @property
    def worst_range_mm(self) -> tuple[float, float]:
        """Least and largest worst error, over the possible values of phi."""
        worst = [self.after.worst_mm, *(errors.worst_mm for _, errors in self.valley)]
        return min(worst), max(worst)


class Advice(Frozen):
    """Measurements and their promises, the one that leaves the smallest worst error first.

    Attributes:
        station, height_m: of the map. before: its errors today; worst_place_m: where they are largest.
        promises: best first. best: the one to follow, with the least work of those that are nearly as good as the best;
            None where nothing improves enough. then: what to do after it, with the errors that both together leave.
        good_enough_mm: the acceptable worst error; None where nobody stated it.
    """

    station: str
    height_m: float
    before: Errors
    worst_place_m: tuple[float, float]
    promises: tuple[Promise, ...]
    best: Promise | None
    then: Promise | None
    good_enough_mm: float | None

    def __repr__(self) -> str:
        rows = [(f"{short(one.after.worst_mm)} mm", one.measurement.words) for one in self.promises]
        title = f"Advice for station {self.station!r}: {short(self.before.worst_mm)} mm at worst, which becomes"
        return text_of((title, rows))


@checked
@numerical("the advice")
@for_small_matrices()
def advise(
    calibration: Calibration,
    station: str | None = None,
    height_m: float = ROBOT_TOP_M,
    good_enough_mm: float | None = None,
    board: Target | None = None,
    progress: StepProgress | None = None,
    executor: Executor | None = None,
) -> Advice:
    """Return what to measure next, ranked by the worst error that it leaves on a station's map.

    It is computed from the posterior and the information that each measurement would add at the estimate (no
    observations are needed), with the noise that the calibration found. It promises what the next calibration will
    report; errors of the model (a lens with too few coefficients, a field painted off its nominal position) are in
    neither.

    Args:
        station: may be omitted where there is only one. board: one that could be shown; by default the calibration's
            own, or one of 9 x 6 corners, 100 mm apart. progress: called after each measurement that was examined.
        executor: evaluates the measurements; the advice does not depend on it.

    Raises:
        InputError: no such station, one that was held as the world, or a calibration without a posterior.
    """
    if board is not None and board.grid is None:
        raise InputError(f"a board to show is a checkerboard, not of kind {board.kind!r}")
    ground, outlook = _prepared(calibration, station, height_m)
    search = CandidateSearch(ground, outlook, _board(calibration.targets, board), calibration.fit.curves > 0)
    candidates = list(search.candidates())
    informations = list(each(partial(added_information, ground=ground, outlook=outlook), candidates, executor=executor))
    promises = []
    one_promise = partial(_promise, ground=ground, outlook=outlook)
    for promise in each(one_promise, candidates, informations, executor=executor):
        promises.append(promise)
        if progress is not None:
            progress(len(promises), len(candidates), promise.measurement.words)
    enough = 0.0 if good_enough_mm is None else good_enough_mm
    number, today = _chosen(promises, outlook.before, enough), outlook.today
    best = None if number is None else promises[number]
    then = None if number is None else _next(number, candidates, informations, outlook, enough)
    ranked = tuple(sorted(promises, key=lambda promise: (promise.after.worst_mm, promise.after.mean_mm)))
    place_m = today.worst_place_m
    return Advice(today.station, height_m, outlook.before, place_m, ranked, best, then, good_enough_mm)


def promised(
    calibration: Calibration,
    measurements: Sequence[Measurement],
    station: str | None = None,
    height_m: float = ROBOT_TOP_M,
) -> tuple[Promise, ...]:
    """Return what measurements of one's own would achieve, each by itself.

    Raises:
        InputError: see `advise`.
    """
    ground, outlook = _prepared(calibration, station, height_m)
    return tuple(_promise(one, added_information(one, ground, outlook), ground, outlook) for one in measurements)


def _prepared(calibration: Calibration, station: str | None, height_m: float) -> tuple[Ground, Outlook]:
    """Return the ground and the outlook, both of the numbers that a measurement at this station can determine."""
    known = calibration.uncertainty
    if not still(calibration.targets):
        raise InputError("advice needs the map of a field, but all targets are movable: observe a field")
    today = known.map_sd_mm(station, height_m)
    if not np.any(today.sd_mm >= 0.0):
        raise InputError(f"station {today.station!r} sees nothing of the field at {1e3 * height_m:.0f} mm")
    camera = known.estimate.stations[today.station].camera
    posterior = _of_camera(known.posterior, known.estimate, camera)
    tolerances, weighting = calibration.options.tolerances, _weighting(calibration.fit, camera)
    ground = Ground(known.estimate, posterior.keys, calibration.targets, tolerances, weighting)
    return ground, Outlook.of(known.estimate, posterior, today)


def _of_camera(posterior: Posterior, estimate: Estimate, camera: str) -> Posterior:
    """Return the posterior of a camera, its stations and the targets as built, all else integrated out."""
    owners = {("camera", camera), *(("station", name) for name, s in estimate.stations.items() if s.camera == camera)}
    keys = [key for key in posterior.keys if key[:2] in owners or key.is_structure]
    stated = posterior.stated.over(posterior.keys).marginal(keys)
    mixtures = {name: posterior.mixtures[name] for name in posterior.followed}
    known, model = posterior.information.marginal(keys), posterior.by_model
    by_model = None if model is None else model.marginal(keys)
    return replace(posterior, information=known, mixtures=mixtures, by_model=by_model, stated=stated)


def _weighting(fit: Fit, camera: str) -> Weighting:
    """Return the noise in px of a camera's points and curves, by the fit. A kind that nobody observed gets the other's;
    of targets with different noise ("camera/target") it is the largest.
    """
    points, curves = (mine or other for mine, other in (fit.noise_px, fit.noise_px[::-1]))
    if not points > 0.0:
        raise InputError("the calibration's noise is 0, so advice is impossible: use measured pixels")
    own = max((one for name, one in fit.of_cameras.items() if camera in (name, name.rpartition("/")[0])), default=1.0)
    return Weighting(own * points, own * curves, "trivial")


def _board(targets: Mapping[str, Target], board: Target | None) -> tuple[str, Target]:
    for name, target in targets.items():
        if target.grid is not None and board in (None, target):
            return name, target
    name = "board"
    while name in targets:
        name += "_"
    return name, board or BOARD


def _promise(measurement: Measurement, added: Information, ground: Ground, outlook: Outlook) -> Promise:
    """Return a promise; it is not rough where phi is not followed along its profile, or would not have to be any more,
    whatever its value.

    Values of phi at which the camera would not see what is measured do not count: it will be seen when it is measured.
    """
    after = outlook.after(added)
    if outlook.valley is None:
        return Promise(measurement, after)
    valley = tuple(outlook.along_valley(lambda there: _information_there(measurement, ground, there, outlook)))
    known = [sd for _, sd, _ in valley if np.isfinite(sd)]
    if not known or max(known) > BENT or not np.isfinite(after.worst_mm):
        return Promise(measurement, outlook.shrunk(added), rough=True)
    return Promise(measurement, after, valley=tuple((phi, errors) for phi, _, errors in valley))


def _information_there(measurement: Measurement, ground: Ground, there: Estimate, outlook: Outlook) -> Information:
    """Return its information if everything were elsewhere: boards are held before the camera, wherever that is."""
    here, other = (e.stations[outlook.today.station].cam_from_world for e in (ground.estimate, there))
    return added_information(measurement.before(here, other), replace(ground, estimate=there), outlook)


def _chosen(promises: Sequence[Promise], before: Errors, enough_mm: float) -> int | None:
    """Return the index of the least work that is good enough for each phi, or nearly as good as the best; else None."""
    worst = np.array([promise.after.worst_mm for promise in promises])
    least = float(np.min(worst))
    if before.worst_mm <= enough_mm or not least < _MUST_LEAVE * before.worst_mm:
        return None
    surely = np.array([promise.worst_range_mm[1] for promise in promises])
    nearly = least + min(_LARGER * least, _LESS * (before.worst_mm - least))
    return int(np.argmax((worst <= nearly) | (surely <= enough_mm)))


def _next(
    first: int,
    candidates: Sequence[Measurement],
    informations: Sequence[Information],
    outlook: Outlook,
    enough_mm: float,
) -> Promise | None:
    """Return what improves most after the first, of another kind; None where nothing does or the first is enough."""
    kind, again = candidates[first].kind, candidates[first].is_seen_again
    others = [
        number
        for number, candidate in enumerate(candidates)
        if candidate.kind != kind and not (again and candidate.is_seen_again)
    ]
    after = outlook.after_each(informations[first], [informations[number] for number in others])
    promises = [Promise(candidates[number], one) for number, one in zip(others, after, strict=True)]
    chosen = _chosen(promises, outlook.after(informations[first]), enough_mm) if promises else None
    return None if chosen is None else promises[chosen]
