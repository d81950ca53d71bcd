"""Effects of a camera: that it moved, and errors of its pixel geometry: skew, aspect, principal point, phi, coma, and
points that are shifted against curves.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial

import numpy as np

from ceres_cal.base import Array, Pose, numbers_of, replace, skew
from ceres_cal.base.words import with_sd
from ceres_cal.effects.columns import EffectColumns, grouped
from ceres_cal.effects.effect import Case, Effect, Evidence, Words, amounts, camera_effect, half_diagonals
from ceres_cal.effects.evidence import AS_STATED
from ceres_cal.problem import intrinsic_names, pixel_slopes


def _moves(case: Case, *, onwards: bool) -> Iterator[EffectColumns]:
    """A turn about the camera's axes and a shift in the world of each station: from some frame on, or in one frame."""
    equations = case.equations
    frames = [(view.station, view.frame) for view in case.problem.observations.views]
    known = list(dict.fromkeys(frames))
    frame = numbers_of(frames, known)[equations.view]
    bounds = zip(equations.bounds, equations.bounds[1:], strict=False)
    several = np.array([bool(np.any(frame[start:stop] != frame[start])) for start, stop in bounds])
    tied = np.array([key.placement not in case.problem.private for key in equations.sights.keys])
    of_station = np.array([key.station for key in equations.sights.keys])
    columns = cache(partial(motion_columns, case))  # most cases need them for no station
    for station in case.problem.observations.stations:
        present, group = grouped(frame, equations.of_sights((of_station == station) & (tied | several)))
        names, last = tuple(known[number][1] for number in present), len(present) - 1
        # A motion in the first or last frame alone is the same as one from there on.
        tested = last > 0 if onwards else (group > 0) & (group < last)
        group = np.where(tested, group, -1)
        if np.any(group >= 0):
            yield EffectColumns(columns(), group, (station,) * len(names), names, onwards)


def _of_move(evidence: Evidence) -> Words:
    score, others = evidence.score, evidence.others
    turn, step, both = (others.freed(score.columns[:, part]) for part in (slice(3), slice(3, 6), slice(6)))
    angle, angle_sd = np.degrees(_length(turn.amount, turn.sd))
    mm, mm_sd = 1e3 * np.array(_length(step.amount, step.sd))
    ways = [
        (turn.decrease, f"turned by {with_sd(angle, angle_sd)} degrees"),
        (step.decrease, f"shifted by {with_sd(mm, mm_sd)} mm"),
    ]
    ways.sort(key=lambda way: -way[0])
    whole = max(both.decrease, 1e-300)
    how = " or ".join(f"{text} (explains {100.0 * min(part / whole, 1.0):.0f} %)" for part, text in ways)
    frames_after = f"after frame {score.frame!r}", "give the frames after it a station of their own"
    one_frame = f"in frame {score.frame!r} alone", "leave this frame out, or give it a station of its own"
    when, advice = frames_after if score.effect.onwards else one_frame
    turns, steps = [f"turn about the camera's {axis}" for axis in "xyz"], [f"shift along {axis}" for axis in "xyz"]
    every = (
        *amounts(turns, np.degrees(score.amount[:3]), np.degrees(score.sd[:3]), "deg"),
        *amounts(steps, 1e3 * score.amount[3:], 1e3 * score.sd[3:], "mm"),
    )
    columns = score.columns[evidence.case.model.used].T
    told = tuple(one for one, column in zip(every, columns, strict=True) if np.any(column))
    return Words(f"station {score.subject!r} moved {when}: {how}; {evidence.size}", advice, told)


def motion_columns(case: Case) -> Array:
    """(E, 6) px per radian about the camera's axes through its own position, and px per metre along the world's
    axes.
    """
    equations = case.equations
    columns = np.empty((len(equations), 6))
    for number, key in enumerate(equations.sights.keys):
        here = slice(equations.bounds[number], equations.bounds[number + 1])
        turned = equations.motion[here] @ -skew(equations.poses[number, :, 3])
        columns[here, :3] = equations.pose[here, :3] + turned
        shift = -equations.motion[here] @ case.estimate.stations[key.station].cam_from_world.rotation
        # A shift along all lines of a frame displaces none of them, but by rounding.
        along = np.abs(shift) < 1e-9 * np.linalg.norm(shift, axis=1, keepdims=True)
        columns[here, 3:] = np.where(along, 0.0, shift)
    return columns


def _length(vector: Array, sd: Array) -> tuple[float, float]:
    """Length of a vector, and its standard deviation from those of its components."""
    length = float(np.linalg.norm(vector))
    known = np.isfinite(sd)
    return length, float(np.linalg.norm(vector[known] * sd[known])) / max(length, 1e-300)


def _leaning(case: Case, camera: str, pixels: Array) -> Array | None:
    """A skew: the axes of the pixels are not perpendicular, and x grows with y."""
    one = case.estimate.cameras[camera]
    if intrinsic_names(one.lens).index("skew") in case.problem.layout.free[camera]:
        return None
    return np.asarray(one.offsets(pixels)[:, 1:, None] * [[1.0], [0.0]])


def _of_skew(evidence: Evidence) -> Words:
    skew, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
    return evidence.words(
        f"camera {evidence.score.subject!r}: its pixel axes are not perpendicular, by {skew[0]:.2f} ± {sd[0]:.2f} mrad",
        "take pictures as the sensor gives them, neither warped nor stabilised, or calibrate with --free-skew, which "
        "no other program can read",
        ["skew"],
        "mrad",
    )


def _held(places: list[int], case: Case, camera: str, pixels: Array) -> Array | None:
    """Held intrinsics of the pixels, by their positions in the intrinsics vector."""
    if set(places) & set(case.problem.layout.free[camera].tolist()):
        return None
    one = case.estimate.cameras[camera].at(Pose.identity())
    return pixel_slopes(one, one.rays(pixels)).intrinsics[:, :, places]


def _of_aspect(evidence: Evidence) -> Words:
    score = evidence.score
    held = evidence.case.estimate.cameras[score.subject].aspect
    return evidence.words(
        f"camera {score.subject!r}: its pixels are not square: aspect {held + score.amount[0]:.5f} ± "
        f"{score.sd[0]:.5f}, not {held:g}",
        "calibrate with --free-aspect",
        ["aspect"],
        "",
    )


def _of_principal_point(evidence: Evidence) -> Words:
    x, y = evidence.score.amount
    asked = f"the residuals indicate an offset of {x:+.1f}, {y:+.1f} px"
    sentence = f"camera {evidence.score.subject!r}: the principal point is held, but {asked}"
    return evidence.words(sentence, "solve for it", ["cx", "cy"])


def _of_phi(evidence: Evidence) -> Words:
    score = evidence.score
    asked = f"the residuals indicate a change of {score.amount[0]:+.2f} ± {score.sd[0]:.2f} px"
    sentence = f"camera {score.subject!r}: phi is held, but {asked}"
    return evidence.words(sentence, "solve for it, or give it as a prior with a sigma", ["phi"])


_HALF = "the half pixel suggests that one counts from the corner of the top-left pixel: "


def _shifted(case: Case) -> Iterator[EffectColumns]:
    """A shift of a camera's points against its curves: two detectors that count pixels from different origins."""
    is_curve, camera = case.equations.is_curve, case.camera
    both = np.isin(camera, camera[is_curve & case.model.used])
    group = np.where(~is_curve & both, camera, -1)
    yield EffectColumns(case.equations.direction * ~is_curve[:, None], group, case.cameras)


def _of_shift(evidence: Evidence) -> Words:
    # How near to half a pixel a shift must be to be reported as that: in standard deviations, and px.
    half_sd, half_px = 3.0, 0.1
    px, sd = evidence.score.amount, evidence.score.sd
    half = bool(np.all(np.abs(np.abs(px) - 0.5) < np.maximum(half_sd * sd, half_px)))
    return evidence.words(
        f"camera {evidence.score.subject!r}: its points are shifted against its curves by ({px[0]:+.2f} ± "
        f"{sd[0]:.2f}, {px[1]:+.2f} ± {sd[1]:.2f}) px",
        f"{_HALF if half else ''}let both detectors count from the centre of the top-left pixel",
        "xy",
    )


def _coma_px(case: Case, camera: str) -> float:
    """The stated standard deviation (px) of a camera's coma; 0 if none is stated."""
    stated = case.problem.observations.priors
    return max((prior.sigma[0] for prior in stated if prior.is_coma and prior.name == camera), default=0.0)


def _drawn_out(case: Case, camera: str, pixels: Array) -> Array | None:
    """An outward displacement by coma, where lines in a picture are lopsided. Each line moves only along its normal, so
    together they look like another lens, and no residual shows it.
    """
    if not _coma_px(case, camera):
        return None
    away = half_diagonals(case.estimate.cameras[camera], pixels)
    return np.asarray((away * np.linalg.norm(away, axis=1)[:, None])[:, :, None])


def _of_coma(evidence: Evidence) -> Words:
    px, sd = evidence.score.amount, evidence.score.sd
    drawn = f"displaces everything outwards by {px[0]:+.2f} ± {sd[0]:.2f} px at the corners of the image"
    sentence = f"camera {evidence.score.subject!r}: its lens has coma, which {drawn}"
    return evidence.words(sentence, "stop the lens down, or take another one", ["coma"])


EFFECTS = (
    replace(
        camera_effect("coma", _drawn_out, _of_coma),
        prior=AS_STATED,
        reach=lambda columns, number, case: _coma_px(case, columns.subjects[number]),
        concerns=lambda observations: any(prior.is_coma for prior in observations.priors),
    ),
    Effect("moved after", partial(_moves, onwards=True), _of_move),
    Effect("moved in", partial(_moves, onwards=False), _of_move),
    camera_effect("skew", _leaning, _of_skew),
    camera_effect("aspect", partial(_held, [1]), _of_aspect),
    camera_effect("principal point", partial(_held, [2, 3]), _of_principal_point),
    camera_effect("phi", partial(_held, [0]), _of_phi),
    Effect("points shifted", _shifted, _of_shift, absorbed=True),
)
