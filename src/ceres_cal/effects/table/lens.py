"""Effects of a lens: a polynomial that is too short, decentred parts, a thin prism before it; or another lens from some
frame on: knocked or zoomed, or pictures of another camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, log_f_tail, numbers_of, replace
from ceres_cal.effects.columns import EffectColumns, EffectSums, grouped, score_all
from ceres_cal.effects.effect import SMALL, Case, Effect, Evidence, Words, camera_effect, half_diagonals
from ceres_cal.problem import OF_PIXELS, USUAL_DECENTRING, unit_px
from ceres_cal.scene import LENSES, Camera, Lens

# Numbers of half waves over the observed radius, for a lens without a formula: it follows longer waves, and shorter
# ones have few observations each.
_WAVES = range(5, 25)


def _along_radius(case: Case, camera: str, pixels: Array) -> Array | None:
    """Residuals along the radius: the polynomial is too short."""
    radial_basis = 3  # powers beyond the lens's own: enough for any trend that one more power corrects
    if case.estimate.cameras[camera].lens.roughness:
        return _waves(case, camera, pixels)
    return _growing(case.estimate.cameras[camera], pixels, _missing_powers(case, camera)[:radial_basis])


def _of_radius(evidence: Evidence) -> Words:
    case, name, own = evidence.case, evidence.score.subject, evidence.case.camera == evidence.score.number
    if case.estimate.cameras[name].lens.roughness:
        return Words(
            f"camera {name!r}: residuals vary with the radius, up to {evidence.most_px(own):.2f} px "
            f"({evidence.size}): the spline has too few knots, and phi, the slope at its axis, may be off by more "
            "than its standard deviation",
            "rays are off by about as many pixels; to check phi, calibrate also with a lens that has a formula",
        )
    powers = _missing_powers(case, name)
    displaced = _growing(case.estimate.cameras[name], case.equations.pixel, powers)
    columns = np.sum(case.equations.direction[:, :, None] * displaced, axis=1) * own[:, None]
    decreases = evidence.others.decreases(columns)
    power, decrease = powers[int(np.argmax(decreases))], float(np.max(decreases))
    share = 100.0 * min(1.0, decrease / evidence.others.freed(evidence.score.columns).decrease)
    judged = "is too short" if evidence.noise_ratio >= SMALL else "is slightly too short"
    sentence = (
        f"camera {name!r}: residuals vary with the radius, up to {evidence.most_px(own):.2f} px ({evidence.size}): "
        f"the radial polynomial {judged}; one more power, r^{power}, explains {share:.0f} % of it"
    )
    return Words(sentence, _longer(case, name, power))


def _longer(case: Case, camera: str, power: int) -> str:
    """The advice on how to calibrate with one more power."""
    lens = case.estimate.cameras[camera].lens
    held = [key for key, order in zip(lens.names, lens.orders, strict=True) if order == power]
    held = [key for key in held if key not in _across(lens)]
    if lens.powers:
        return f"calibrate with --powers {','.join(map(str, sorted({*lens.powers, power})))}"
    if held:
        return f"solve for {held[0]} (no --fix {held[0]}=...)"
    if "rational" in lens.more_terms and "rational" not in lens.terms:
        return "calibrate with --terms rational, which has more radial coefficients, or with another lens"
    growing = " or ".join(kind for kind, other in LENSES.items() if other.trial_powers)
    return f"the {lens.kind} lens has no such power: try another lens or the {growing} one with more powers"


def _missing_powers(case: Case, camera: str) -> list[int]:
    """Powers of the radius that the lens does not solve for, lowest first."""
    lens = case.estimate.cameras[camera].lens
    free = case.free_coefficients(camera)
    solved = {order for name, order in zip(lens.names, lens.orders, strict=True) if name in free - _across(lens)}
    return [power for power in lens.missing_powers if power not in solved]


def _across(lens: Lens) -> set[str]:
    """Names of coefficients, which the lens has or may have, that displace across the radius."""
    return {*lens.decentring, *(name for term in ("tangential", "prism") for name in lens.more_terms.get(term, ()))}


def _outward(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """(N,) radius of pixels (N, 2), in half image diagonals, and (N, 2) px of a unit displacement outwards."""
    offsets = half_diagonals(camera, pixels)
    radius = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    return radius, np.asarray(offsets * (1.0, camera.aspect) / radius[:, None])


def _growing(camera: Camera, pixels: Array, powers: Sequence[int]) -> Array:
    """(N, 2, powers) px per unit of additional coefficients of the lens's polynomial, scaled to be of order one."""
    offsets, outward = camera.offsets(pixels), _outward(camera, pixels)[1]
    growth = camera.lens.radial_change(offsets, camera.phi, unit_px(camera), np.array(powers))
    return np.asarray(outward[:, :, None] * growth[:, None])


def _waves(case: Case, camera: str, pixels: Array) -> Array:
    """(N, 2, waves) px per px of displacements along the radius that oscillate over the observed radius."""
    one, own = case.estimate.cameras[camera], case.camera == case.cameras.index(camera)
    radius, outward = _outward(one, pixels)
    share = radius / np.max(_outward(one, case.equations.pixel[own])[0], initial=1e-12)
    return np.asarray(outward[:, :, None] * np.cos(np.pi * np.array(_WAVES) * share[:, None, None]))


def _decentred(case: Case, camera: str, pixels: Array) -> Array | None:
    """Brown's tangential displacement, where the lens does not solve for it."""
    one = case.estimate.cameras[camera]
    parts = _tangential(one.lens)
    if parts and set(parts) <= case.free_coefficients(camera):
        return None
    x, y = half_diagonals(one, pixels).T
    r2 = x * x + y * y
    return np.stack([[2.0 * x * y, r2 + 2.0 * x * x], [r2 + 2.0 * y * y, 2.0 * x * y]]).transpose(2, 0, 1)


def _of_decentring(evidence: Evidence) -> Words:
    name = evidence.score.subject
    lens = evidence.case.estimate.cameras[name].lens
    own = _tangential(lens)
    kind, names = next((kind, lens.decentring) for kind, lens in LENSES.items() if lens.decentring)
    if own and not set(own) <= set(lens.names):
        advice = f"calibrate with --terms tangential, which frees {' and '.join(own)}"
    elif own:
        advice = f"solve for {' and '.join(own)}"
    else:
        advice = f"calibrate with --lens {kind}, which has {' and '.join(names)}"
    away = f"a tangential displacement of up to {evidence.most_px():.2f} px"
    return evidence.words(f"camera {name!r}: its lens is not centred: {away}", advice)


def _tangential(lens: Lens) -> tuple[str, ...]:
    """Names of Brown's decentring coefficients, which the lens has or may have."""
    return lens.tangential or lens.more_terms.get("tangential", ())


def _one_way(case: Case, camera: str, pixels: Array) -> Array | None:
    """OpenCV's thin prism, where the lens does not solve for it: a displacement in one direction, by r^2 and r^4."""
    one = case.estimate.cameras[camera]
    parts = one.lens.more_terms.get("prism", ())
    if parts and set(parts) <= case.free_coefficients(camera):
        return None
    r2 = np.sum(half_diagonals(one, pixels) ** 2, axis=1)[:, None, None]
    return np.concatenate([r2 * np.eye(2), r2**2 * np.eye(2)], axis=2)


def _usual_px(case: Case, camera: str) -> float:
    """Usual size of decentring, px in the picture's corners; no more is known of a prism. Without it, a prism of 4 ± 2
    px moved the principal point of a rig, whose lens leaves 0.006 px, by 42 standard deviations.
    """
    one = case.estimate.cameras[camera]
    return USUAL_DECENTRING * unit_px(one) ** 2 / one.phi


def _of_prism(evidence: Evidence) -> Words:
    name = evidence.score.subject
    kind = next(kind for kind, lens in LENSES.items() if "prism" in lens.more_terms)
    own = evidence.case.estimate.cameras[name].lens.kind == kind
    return evidence.words(
        f"camera {name!r}: its picture is displaced in one direction, most at its edges, as by a thin prism, by up to "
        f"{evidence.most_px():.2f} px",
        f"calibrate with {'' if own else f'--lens {kind} '}--terms prism",
    )


_NUMBERS = ("phi", "cx", "cy")
_PLACES = [OF_PIXELS.index(name) for name in _NUMBERS]


def lens_changes(case: Case) -> Iterator[EffectColumns]:
    """A change of phi and the principal point of a camera after a frame, from boards that are held up."""
    frames = [(view.camera, view.frame) for view in case.problem.observations.views]
    known = list(dict.fromkeys(frames))
    frame = numbers_of(frames, known)[case.equations.view]
    # Over a field, a knock turns the camera as well, and a turn looks like another principal point.
    private = np.array([key.placement in case.problem.private for key in case.equations.sights.keys], dtype=bool)
    held_up = private[case.equations.sight]
    for number, name in enumerate(case.cameras):
        present, group = grouped(frame, held_up & (case.camera == number))
        names = tuple(known[one][1] for one in present)
        columns = case.equations.intrinsics[:, _PLACES]
        if len(names) > 1:
            yield from _where_likely(case, EffectColumns(columns, group, (name,) * len(names), names, onwards=True))


def _of_change(evidence: Evidence) -> Words:
    score = evidence.score
    parts = zip(_NUMBERS, score.amount, score.sd, strict=True)
    change = ", ".join(f"{name} {by:+.1f} ± {sd:.1f} px" for name, by, sd in parts)
    return evidence.words(
        f"camera {score.subject!r} has another lens after frame {score.frame!r}: {change}",
        "give the frames after it a camera of their own: it was knocked or zoomed, or they are another camera's",
        _NUMBERS,
    )


def _where_likely(case: Case, every: EffectColumns) -> Iterator[EffectColumns]:
    """The likeliest frame of all, where the change exceeds what single frames say of the lens otherwise.

    Errors that are correlated within a frame, as over a board that differs from its drawing, shift the lens of each
    frame by more than the noise does. So the change is compared with the scatter of frames about it (Fisher's F), not
    with the noise.
    """
    rate = 0.001  # probability of a false alarm over all frames: of nine real sets of boards none has one
    changes = score_all(case.model, [EffectSums.of(case.model, every)], by_chance=False)
    if not changes:
        return
    best = max(changes, key=lambda change: change.statistic)

    def is_likely(scatter: float, freedom: float) -> bool:
        ratio, rank = best.statistic / (scatter * best.rank), best.rank
        return bool(log_f_tail(*map(np.array, ([ratio], [rank], [freedom])))[0] < np.log(rate / len(changes)))

    if not is_likely(1.0, float(every.columns.shape[1] * len(every.subjects))):  # however well frames agree
        return
    beside = case.model.with_columns(best.columns)
    single = score_all(beside, [EffectSums.of(beside, replace(every, onwards=False))], by_chance=False)
    freedom = float(sum(one.rank for one in single)) - 2.0 * best.rank
    if freedom < 1.0:
        return
    scatter = max(sum(one.statistic for one in single) / freedom, 1.0)
    if is_likely(scatter, freedom):
        after = np.where(every.group < 0, -1, (every.group > best.number).astype(np.int64))
        names = (every.frames[best.number], every.frames[-1])
        yield replace(every, group=after, subjects=every.subjects[:2], frames=names)


EFFECTS = (
    camera_effect("radius", _along_radius, _of_radius),
    camera_effect("decentring", _decentred, _of_decentring, _usual_px),
    camera_effect("prism", _one_way, _of_prism, _usual_px),
    Effect("lens changed", lens_changes, _of_change),
)
