"""What has happened to a camera: explanations are tried on its observations, and supported ones are taken.

As long as the chosen freedom explains everything, no other is tried. Otherwise others are tried and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ceres_cal.base import CalibrationError, Frozen, Pose, SolutionError, attempt, replace, upper_tail
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.renaming import relabelled
from ceres_cal.moves.agreement import NOISIER, price_nats
from ceres_cal.moves.misplaced import FEW, SUPPORTED, is_good, seen_as, without_worst
from ceres_cal.moves.poses import PoseCandidate, PoseSearch, candidate_at, equations, movement, pose_candidates
from ceres_cal.moves.refit_plan import RefitPlan, mistaken_targets
from ceres_cal.posterior.posterior import LEAST_PROBABILITY
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.symmetry import MIRRORED, TURNED

# Share of the observations that another zoom must explain to be considered. Nothing changes from 0.33 to 0.67.
_HALF = 0.5
# Rate at which an unchanged lens is doubted. A doubt only costs time, because other explanations must be supported,
# too. Nothing changes from half to double.
_RARE = 1e-4
# Factor on the old calibration's noise from which on nothing counts as explained, unless most observations lie where
# they should. Nothing changes from half to double.
_TOO_NOISY = 4.0
# A camera whose labels are turned seems to have moved farther than the first (m); with the labels turned back it is
# within the second of its old place (m), turned by less than the third (rad). Nothing changes from half to double.
_FAR_M, _NEAR_M, _NEAR_RAD = 1.5, 1.0, np.pi / 4.0
_TURN = Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
_TURNED = "with the picture turned by 180 degrees they do: turn it back, or calibrate it anew"
_MIRRORED = "with mirrored labels they do: left and right are swapped, or the image is flipped: correct that"

_WIDER = {
    "pose-only": ("zoom", "iris", "everything"),
    "pose": ("zoom", "iris", "everything"),
    "zoom": ("everything",),
    "iris": ("everything",),
    "everything": (),
}
WORDS = {
    "pose": "the lens is unchanged",
    "zoom": "the zoom was changed",
    "iris": "the lens's distortion has changed (another iris or focus)",
    "everything": "this is another lens or camera, or a picture that was stretched, cropped or turned",
}


class NothingFitsError(SolutionError):
    """No explanation fits with the noise that was assumed."""


class OtherChangeError(SolutionError):
    """Something other than what was freed has changed.

    Attributes:
        what: one of `WHAT` that explains the observations. rivals: further explanations that may be true. found: the
            calibration if this one is, where it was solved for. is_doubtful: whether one misplaced feature explains as
            much.
    """

    def __init__(
        self,
        message: str,
        what: str,
        rivals: tuple[Rival, ...] = (),
        found: Calibration | None = None,
        *,
        is_doubtful: bool = False,
    ) -> None:
        super().__init__(f"{message}: refit with --what {what}")
        self.what, self.rivals, self.found, self.is_doubtful = what, rivals, found, is_doubtful


def labels_turned(pose: Pose, old: Pose) -> tuple[float, float] | None:
    """Return how far (m) the camera moved with the labels as given and with the field's labels turned by half a turn,
    where the latter is likelier: a camera near its old place, not across the field; else None.
    """
    given_m, _ = movement(pose, old)
    turned_m, turn = movement(pose @ _TURN, old)
    likelier = given_m > _FAR_M and turned_m < min(_NEAR_M, given_m / 3.0) and turn < _NEAR_RAD
    return (given_m, turned_m) if likelier else None


def require_labels(plan: RefitPlan, poses: Mapping[str, Pose]) -> None:
    """Raise SolutionError where the field's labels look turned by half a turn."""
    for name, pose in poses.items():
        old = plan.calibration.estimate.stations.get(name)
        moves = None if old is None else labels_turned(pose, old.cam_from_world)
        if moves is not None and relabelled(plan.sights.observations, TURNED) is not None:
            raise SolutionError(
                f"station {name!r}: its labels seem to be swapped: as given, they move the camera by {moves[0]:.2f} m; "
                f"turned by 180 degrees, by {moves[1]:.2f} m: correct them with --labels turned, or confirm them with "
                "--labels as-given"
            )


def require_still(plan: RefitPlan) -> None:
    """Raise SolutionError where a station that is said to stay observes the world from another pose."""
    for name, sight in plan.sights.of_world.items():
        search, old = PoseSearch(sight, plan.known, plan.scales), plan.known.stations[name].cam_from_world
        if name in plan.moved or candidate_at(search, old).fits:
            continue
        if any(one.fits for one in pose_candidates(search, [old], patience=0)):
            raise SolutionError(
                f"station {name!r} was not named with --moved, but its observations show that it moved: name it, too"
            )


def old_poses(plan: RefitPlan, search: PoseSearch) -> list[Pose]:
    """Return the old poses of a search's camera, those of the search's own station first."""
    stations, key = plan.calibration.estimate.stations, search.sight.key
    names = sorted((n for n in stations if stations[n].camera == key.camera), key=lambda name: name != key.station)
    return [stations[name].cam_from_world for name in names]


# ---- where nothing fits ---------------------------------------------------------------------------------------------


def why_nothing_fits(plan: RefitPlan, searches: Sequence[PoseSearch]) -> SolutionError:
    """Return the error that refuses the observations of the stations, and says what else they could be; an
    OtherChangeError where another refit explains them.
    """
    names = ", ".join(repr(search.sight.key.station) for search in searches)
    return _other_explanation(plan, searches) or NothingFitsError(
        f"station {names}: no explanation fits: no move, no other zoom or lens, no mirrored labels, no other field. "
        "Check the labels, the camera and the field, or state sigma_px of clicks that are noisier than those of the "
        "calibration"
    )


def _other_explanation(plan: RefitPlan, searches: Sequence[PoseSearch]) -> SolutionError | None:
    """Return the first explanation that fits better than the known lens and field; None where none does."""
    return next((error for search in searches for error in _others(plan, search)), None)


def _others(plan: RefitPlan, search: PoseSearch) -> Iterator[SolutionError]:
    """Yield explanations that fit, and fit better than the known lens and field, with what to do."""
    misfit, old = _does_not_fit(search), old_poses(plan, search)
    known = min((one.misfit for one in pose_candidates(search, old, patience=0)), default=np.inf)
    if (flipped := _flipped(search, old, known)) is not None:
        yield SolutionError(f"{misfit}{flipped}")
    for name, observations in mistaken_targets(search.sight.observations).items():
        if _fits(seen_as(search, observations), old, known):
            yield SolutionError(f"{misfit}on {name} they do: this is the wrong field: correct the target's dimensions")
    without = without_worst(search, old)
    if without is not None and without.is_better(known):
        yield SolutionError(f"{misfit}{without.words}")
    zoomed = zoomed_search(search, old)
    if zoomed is not None and is_good(zoomed[1], known) and plan.what not in ("zoom", "everything"):
        phi = zoomed[0].camera.phi
        before = search.camera.phi
        message = f"{misfit}with phi {phi:.0f} px in place of {before:.0f} they do: {WORDS['zoom']}"
        yield OtherChangeError(message, "zoom")
    own = search.sight.observations.of_station(search.sight.key.station)
    fresh = attempt(lambda: calibrate(own, replace(plan.options, priors=())))  # quiet: one hint less in a refusal
    if isinstance(fresh, CalibrationError):
        return
    noise = max(fresh.fit.point_scale / search.scales[0], fresh.fit.curve_scale / search.scales[1])
    if noise < NOISIER and len(fresh.outliers) < FEW * (fresh.fit.points + fresh.fit.curves):
        yield SolutionError(f"{misfit}with another lens they do: {WORDS['everything']}: calibrate it anew")


def _does_not_fit(search: PoseSearch) -> str:
    return f"station {search.sight.key.station!r}: its observations do not fit the known lens and field; "


def _flipped(search: PoseSearch, old: list[Pose], known: float, *, confirms: bool = False) -> str | None:
    """Return how labels or the picture were flipped, where that explains the observations; else None. A picture is
    flipped about its middle, which is not the principal point, so flipped labels alone may not explain it.

    A turned picture is one with the principal point on the other side of its middle. That also explains a part of one
    misplaced line, so it must be better without the feature, too, that is explained worst.

    Args:
        confirms: whether this is that second answer, without a feature.
    """
    # Equations with which flipped pictures are tried: a pose has six numbers, and of five noisy clicks a flipped
    # picture explains some by chance.
    enough = 8 if confirms else 12
    observations, last = search.sight.observations, np.array(search.camera.image_size) - 1.0
    mirrored = relabelled(observations, MIRRORED)
    every = [] if mirrored is None else [(mirrored, _MIRRORED)]
    pictures = ((True, True), _TURNED), ((True, False), _MIRRORED), ((False, True), _MIRRORED)
    for flips, words in pictures if equations(search.sight) >= enough else ():
        points, curves = (
            replace(one, pixels=np.where(flips, last - one.pixels, one.pixels))
            for one in (observations.points, observations.curves)
        )
        every.append((replace(observations, points=points, curves=curves), words))
    found = [(pose_candidates(seen_as(search, seen), old, patience=0)[:1], words) for seen, words in every]
    good = [
        (one.misfit, words, n)
        for n, (best, words) in enumerate(found)
        for one in best
        if is_good(one, known) and one.share > 1.0 - FEW
    ]
    if not good:
        return None
    _, words, number = min(good)
    is_picture = number >= len(every) - len(pictures)
    if is_picture and not confirms and (without := without_worst(search, old)) is not None:
        return _flipped(without.search, old, without.misfit, confirms=True)
    return words


def _fits(search: PoseSearch, old: list[Pose], known: float) -> bool:
    candidates = pose_candidates(search, old, patience=0)
    return bool(candidates) and is_good(candidates[0], known)


def zoomed_search(search: PoseSearch, old: list[Pose]) -> tuple[PoseSearch, PoseCandidate] | None:
    """Return the search with the phi that explains it best, and the pose there; None where none explains half of it."""
    zooms = 15
    best: tuple[PoseSearch, PoseCandidate] | None = None
    for width in (2.0, 1.05, 1.008):  # each grid is finer, around the best of the one before
        middle = search.camera.phi if best is None else best[0].camera.phi
        for phi in middle * np.geomspace(1.0 / width, width, zooms):
            for zoomed in map(search.with_camera, search.camera.zoomed(float(phi))):
                for candidate in pose_candidates(zoomed, old, patience=0)[:1]:
                    if best is None or candidate.misfit < best[1].misfit:
                        best = zoomed, candidate
    return best if best is not None and best[1].share >= _HALF else None


# ---- where a solve is to be judged ----------------------------------------------------------------------------------


class RefitVerdict(Frozen, eq=True):
    """The agreement of a solved refit with what was known before.

    Attributes:
        strain: squared distance of intrinsics, structure and stations that stay from their prior, in its sigmas.
        rank: upper limit of the expected strain. noise: relative to the old calibration's.
    """

    strain: float
    rank: int
    noise: float

    @property
    def noisy(self) -> bool:
        """Whether the noise is to be reported."""
        return self.noise > NOISIER

    @property
    def doubtful(self) -> bool:
        """Whether other explanations are to be tried."""
        return self.noisy or (upper_tail(self.strain, self.rank) < _RARE)


def judged(plan: RefitPlan, what: str, result: Calibration) -> RefitVerdict:
    """Return strain and noise of a result."""
    off = plan.prior_for(what, result.estimate).residuals(result.estimate)
    fit, (points, curves) = result.fit, plan.scales
    ratios = ((fit.points, fit.point_scale / points), (fit.curves, fit.curve_scale / curves))
    noise = [ratio for count, ratio in ratios if count]
    return RefitVerdict(float(off @ off), len(off), max(noise, default=1.0))


class Rival(NamedTuple):
    """Another explanation, which the observations do not distinguish from the one that is taken.

    Attributes:
        what: one of `WHAT`. probability: of it. found: the calibration if it is true.
    """

    what: str
    probability: float
    found: Calibration


def supported(
    plan: RefitPlan, result: Calibration, searches: Sequence[PoseSearch], solved_with: Callable[..., Calibration]
) -> tuple[Rival, ...]:
    """Return what else may be true besides the chosen explanation, where the user stated none.

    Args:
        searches: of each station that moved. solved_with: solves again with another freedom, from an estimate.

    Raises:
        OtherChangeError: another explanation is supported.
        SolutionError: nothing fits.
    """
    doubtful, wider = judged(plan, plan.what, result).doubtful, _WIDER[plan.what]
    results = {plan.what: result}
    for what in wider if doubtful else wider[:2]:
        # quiet: another freedom that is no explanation; what was asked for is judged by itself
        found = attempt(partial(solved_with, what, result.estimate, tested=False))
        if isinstance(found, Calibration):
            results[what] = found
    quiet = {w: r for w, r in results.items() if judged(plan, w, r).noise < _TOO_NOISY or w == plan.what}
    # More support is needed by what absorbs a wrong statement, by another lens, and by what the user did not state.
    is_free = not plan.is_stated and not any(conflict.kind == "prior" for conflict in result.conflicts)
    easily = {plan.what, *(wider[:2] if is_free else ())}
    misfits, let_go = _misfits(plan, quiet), {what: len(plan.loosened(what)) for what in quiet}
    scores = {w: misfits[w] + _price(plan, w) + SUPPORTED * (w not in easily) for w in quiet}
    best = min(scores, key=scores.__getitem__)
    # An explanation that gains no more than chance does with a freed number (Akaike's criterion) is no reason to doubt.
    speak_for = [w for w in quiet if w in easily and misfits[w] + let_go[w] <= misfits[plan.what] + let_go[plan.what]]
    rivals = tuple(_rivals({what: scores[what] for what in speak_for}, best, results, solved_with))
    if best != plan.what:
        misplaced = ""
        for search, solved in zip(searches, _solved_searches(plan, results[best]), strict=True):
            pose = solved.estimate.stations[search.sight.key.station].cam_from_world
            freed = candidate_at(solved, pose).misfit + _price(plan, best)
            old = old_poses(plan, search)
            if (without := without_worst(search, old)) is not None and without.is_better(freed):
                misplaced = f"{_does_not_fit(search)}{without.words}; or else "
            if (flipped := _flipped(search, old, freed)) is not None:
                raise SolutionError(f"{_does_not_fit(search)}{flipped}")
        # A noisy explanation may be something else; one with no more noise than what was asked for may have is taken.
        if judged(plan, best, results[best]).noisy and (other := _other_explanation(plan, searches)) is not None:
            raise other
        gain = scores[plan.what] - scores[best]
        raise OtherChangeError(
            f"{misplaced}the data show that {WORDS[best]}{_changes(plan, best, results[best])}; the known lens "
            f"explains them less well (by {gain:.0f} nats)",
            best,
            rivals,
            results[best],
            is_doubtful=bool(misplaced),
        )
    if judged(plan, plan.what, result).noise >= _TOO_NOISY:
        if not _explains(plan, result):
            raise why_nothing_fits(plan, searches)
        if (other := _other_explanation(plan, searches)) is not None:
            raise other
    if result.outliers:
        _require_unmirrored(plan, result)
    return rivals


def _require_unmirrored(plan: RefitPlan, result: Calibration) -> None:
    """Raise SolutionError where mirrored labels explain what was taken out, too. Most of a field is symmetric, so a
    mirrored picture of it fits except for some lines.
    """
    for search in _solved_searches(plan, result):
        pose = result.estimate.stations[search.sight.key.station].cam_from_world
        flipped = _flipped(search, [*old_poses(plan, search), pose], candidate_at(search, pose).misfit)
        if flipped is not None:
            station = search.sight.key.station
            raise SolutionError(f"station {station!r}: some of its observations do not fit the others; {flipped}")


def _rivals(
    scores: Mapping[str, float], best: str, results: Mapping[str, Calibration], solved_with: Callable[..., Calibration]
) -> Iterator[Rival]:
    """Yield explanations besides the best one that are probable enough, with the calibration if each is true."""
    likely = {what: float(np.exp(scores[best] - score)) for what, score in scores.items() if best in scores}
    for what, odds in likely.items():
        probability = odds / sum(likely.values())
        if what != best and probability >= LEAST_PROBABILITY:
            # quiet: an explanation that cannot be solved for is no alternative
            found = attempt(partial(solved_with, what, results[what].estimate))
            if isinstance(found, Calibration):
                yield Rival(what, probability, found)


def _explains(plan: RefitPlan, result: Calibration) -> bool:
    """Return whether most observations of each moved station lie where the result puts them.

    The noise of its few points alone does not show that: three of five may be strays.
    """
    stations, searches = result.estimate.stations, _solved_searches(plan, result)
    return all(candidate_at(one, stations[one.sight.key.station].cam_from_world).fits for one in searches)


def _solved_searches(plan: RefitPlan, result: Calibration) -> list[PoseSearch]:
    moved = (sight for name, sight in plan.sights.of_world.items() if name in plan.moved)
    return [PoseSearch(sight, result.estimate, plan.scales) for sight in moved]


def _changes(plan: RefitPlan, what: str, result: Calibration) -> str:
    if what == "iris":
        return ""
    old = plan.calibration.cameras
    changes = [f"{name!r} {old[name].phi:.1f} -> {result.cameras[name].phi:.1f} px" for name in plan.moved_cameras]
    return f" (phi of camera {', '.join(changes)})"


def _misfits(plan: RefitPlan, results: Mapping[str, Calibration]) -> dict[str, float]:
    """Return the misfit of observations and prior with each explanation, in nats."""
    fits = [result.fit for result in results.values()]
    scales = (
        max(plan.scales[0], min(fit.point_scale for fit in fits)),
        max(plan.scales[1], min(fit.curve_scale for fit in fits)),
    )
    return {what: _misfit(plan, what, result, scales) for what, result in results.items()}


def _misfit(plan: RefitPlan, what: str, result: Calibration, scales: tuple[float, float]) -> float:
    sights, there = plan.sights, residuals(plan.sights, result.estimate)
    seen = sum(there.misfit(sights.of_camera(name), result.cameras[name], scales) for name in sights.cameras)
    return float(0.5 * judged(plan, what, result).strain + seen)


def _price(plan: RefitPlan, what: str) -> float:
    return price_nats(len(plan.loosened(what)), len(plan.sights.point_rows) + len(plan.sights.curve_rows))


def explained_nats(plan: RefitPlan, what: str, result: Calibration, scales: tuple[float, float]) -> float:
    """Return the misfit of observations and prior with an explanation at these noise scales, in nats, with the price of
    the numbers that it frees.
    """
    return _misfit(plan, what, result, scales) + _price(plan, what)
