"""Scenes for which an initial estimate must be found: python scripts/run.py starts [--help]

"middle" and "quarter": cameras of a division A field as in halls, with and without a stated height. The middle one
sees a touch line, the halfway line and the circle (and the centre line), the other one lines of a quarter's corner,
with 30 points on each. "drawn": 2 to 8 features of a field, and a camera whose phi is known or not. Counted are
refusals of scenes that are solvable (by the rank of finite differences of the exact scene), and calibrations in which
a number called "known" has an error above 5 standard deviations. "labels": two points or two curves of one of ten
fields with exchanged names. "lines": the same of 4 to 12 curves of a part of a field, without points. "advice": four
points and 24 line points, and then each measurement that `advise` proposes, including three poles. "clicks": four
corners of each photograph of ../shared, clicked with errors of 8 px, and six of a football pitch seen from its
stands. Exits with 1 where there are any.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from photos.real_data import real_place
from photos.shared import CLICK_PX, KnownPhotograph, known_photographs, spread
from runner import Row, over, script
from scenery import field_scene, overhead_pose

from accuracy.advice import followed
from accuracy.odd_scenes import MOST_SIGMAS, farthest
from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.renaming import find_renaming
from ceres_cal.detect.photographs.by_hand import Clicks, starts_from_clicks
from ceres_cal.diagnostics.advice import advise
from ceres_cal.diagnostics.labels import mended, renamings
from ceres_cal.observations import Observations, Prior
from ceres_cal.observations.columns import taken
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import along_curve, nearest_on_curve
from ceres_cal.scene.lens import Brown, Radial
from ceres_cal.scene.targets import Target, ssl_field, targets_by_name
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

_FIELD = ssl_field("A")
_SIZE = (1280, 1024)
_MOST_ON_A_CURVE = 30
_NOISE_PX = 0.3
_SOLVABLE = 1e-5  # least over largest singular value, each number in its own unit; no random scene is near it
_STEP = 1e-6
_MIDDLE = ("TopTouchLine", "HalfwayLine", "CenterCircle", "CenterLine")
_QUARTER = ("TopTouchLine", "LeftGoalLine", "LeftPenaltyStretch", "LeftFieldRightPenaltyStretch", "HalfwayLine")
_HELD = dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)


@dataclass(frozen=True)
class Outcome:
    """The result for one scene: the message of a refusal, or the largest error of a known number in standard
    deviations, and which of phi and height are called known.
    """

    refused: str = ""
    sigmas: float = 0.0
    which: str = ""
    known: tuple[str, ...] = ()


def middle(runs: int) -> Iterator[Row]:
    found = list(over(_middle, range(runs)))
    yield from _rows("middle", found)
    free = [one for seed, one in enumerate(found) if not _is_stated(seed)]
    what = f"no height stated: phi and height said to be open, of {len(free)}"
    yield Row("middle", what, sum(not one.refused and not one.known for one in free), least=len(free))


def quarter(runs: int) -> Iterator[Row]:
    yield from _rows("quarter", list(over(_quarter, range(runs))))


def drawn(runs: int) -> Iterator[Row]:
    found = list(over(_drawn, range(runs)))
    yield Row("drawn", "scenes that are solvable", sum(one is not None for one in found))
    yield from _rows("drawn", [one for one in found if one is not None])


def labels(runs: int) -> Iterator[Row]:
    found = list(over(_exchanged, range(runs)))
    yield Row("labels", f"exchanged in pairs, named and mended, of {runs}", sum(found), least=runs)


def _exchanged(seed: int) -> bool:
    """Whether two exchanged points or curves of a field are found, and nothing else is renamed."""
    rng = np.random.default_rng([seed, 24])
    fields = targets_by_name()
    field = fields[list(fields)[seed % len(fields)]]
    size = 0.1 * float(np.ptp(field.point_array, axis=0).max())  # of a tenth of it
    camera = Camera(_SIZE, rng.uniform(500.0, 700.0), (639.5, 511.5), Radial((rng.uniform(-6e-5, 0.0), 5e-7)))
    x, y, height = size * rng.uniform(-1.0, 1.0), size * rng.uniform(-1.0, 1.0), size * rng.uniform(5.0, 6.5)
    pose = overhead_pose(x, y, height, rng.uniform(-15.0, 15.0), rng.uniform(-15.0, 15.0))
    scene = field_scene(field, {"c": camera}, {"c": Station("c", pose)}, spacing_m=0.02 * size)
    right = _thinned(simulate(scene, Disturbance(_NOISE_PX, _NOISE_PX), seed).observations)
    kind = "points" if rng.random() < len(field.points) / (len(field.points) + len(field.curves)) else "curves"
    columns = getattr(right, kind)
    first, second = rng.permutation(np.unique(columns.feature))[:2]
    feature = columns.feature.copy()
    feature[columns.feature == first], feature[columns.feature == second] = second, first
    wrong = replace(right, **{kind: replace(columns, feature=feature)})
    try:
        calibration = calibrate(wrong, Options(lens="radial"))
    except CalibrationError:
        return False
    again = mended(wrong, tuple(renamings(wrong, calibration)))
    found = getattr(again, kind).feature, again.points.feature, again.curves.feature
    return all(map(np.array_equal, found, (columns.feature, right.points.feature, right.curves.feature)))


def lines(runs: int) -> Iterator[Row]:
    found = [one for one in over(_lines, range(runs)) if one]
    share = found.count("mended") / len(found)
    yield Row("lines", f"exchanged in pairs, named and mended, share of {len(found)}", share, least=0.7)
    yield Row("lines", "other names given", found.count("other"), most=0)
    yield Row("lines", "right names doubted", found.count("doubted"), most=0)


def _lines(seed: int) -> str:
    """What is said of two exchanged curves of a part of a field: "mended", "other" names, or "nothing"; "doubted" where
    the right names are; "" where more or fewer curves are shown.
    """
    rng, most = np.random.default_rng([seed, 28]), 12
    field = ssl_field("AB"[seed % 2])
    camera = Camera(_SIZE, rng.uniform(700.0, 1000.0), (639.5, 511.5), Radial((rng.uniform(-6e-5, 0.0), 5e-7)))
    x, y, height = rng.uniform(-2.5, 2.5), rng.uniform(-2.0, 2.0), rng.uniform(4.0, 5.5)
    pose = overhead_pose(x, y, height, rng.uniform(-12.0, 12.0), rng.uniform(-12.0, 12.0))
    scene = field_scene(field, {"c": camera}, {"c": Station("c", pose)}, points=(), spacing_m=0.2)
    right = simulate(scene, Disturbance(_NOISE_PX, _NOISE_PX), seed).observations
    curves = right.curves
    if not 4 <= len(np.unique(curves.feature)) <= most:
        return ""
    if find_renaming(right, Options()):
        return "doubted"
    first, second = rng.permutation(np.unique(curves.feature))[:2]
    feature = curves.feature.copy()
    feature[curves.feature == first], feature[curves.feature == second] = second, first
    wrong = replace(right, curves=replace(curves, feature=feature))
    found = find_renaming(wrong, Options())
    mended_now = found is not None and np.array_equal(found.corrected(wrong).curves.feature, curves.feature)
    return "mended" if mended_now else "other" if found else "nothing"


def advice(runs: int) -> Iterator[Row]:
    every = [one for some in over(_advised, range(runs)) for one in some]
    refused = [why for _, why in every if why]
    yield Row("advice", f"refused, of {len(every)} that were proposed", len(refused), most=0, note="".join(refused[:1]))
    poles = [why for what, why in every if what == "pole x 3"]
    yield Row("advice", f"refused, of {len(poles)} with three poles", sum(map(bool, poles)), most=0)


def _advised(seed: int) -> list[tuple[str, str]]:
    """Measurements proposed for four points and 24 line points, and why each is refused, "" where it is not."""
    rng = np.random.default_rng([seed, 25])
    camera = Camera(_SIZE, rng.uniform(700.0, 900.0), (639.5, 511.5), Radial((-5e-5, 6e-7)))
    tilts = rng.uniform(-12.0, 12.0, 2)
    place = rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(5.0, 6.5)
    scene = field_scene(_FIELD, {"c": camera}, {"c": Station("c", overhead_pose(*place, tilts[0], tilts[1]))})
    every = simulate(scene, Disturbance(_NOISE_PX, _NOISE_PX), seed).observations
    points, curves = np.zeros(len(every.points), bool), np.zeros(len(every.curves), bool)
    points[rng.permutation(len(points))[:4]] = True
    curves[rng.permutation(len(curves))[:24]] = True
    few = replace(every, points=taken(every.points, points), curves=taken(every.curves, curves))
    options = Options(lens="radial")
    try:
        calibration = calibrate(few, options)
    except CalibrationError as error:
        return [("four points and 24 line points", str(error))]
    found = [("four points and 24 line points", "")]
    for promise in advise(calibration).promises:
        one = promise.measurement
        try:
            followed(one, calibration, few, scene, seed)
            found.append((f"{one.kind} x {len(one.steps)}", ""))
        except CalibrationError as error:
            found.append((f"{one.kind} x {len(one.steps)}", f"{one.words}: {error}"))
    return found


def clicks(runs: int) -> Iterator[Row]:
    photographs = [
        one for one in _photographs() if len(_corners(one)) >= 4 and one.truth.get("what") != "mirrored picture"
    ]
    if photographs:
        some = [(photographs[k % len(photographs)], k) for k in range(runs)]
        refused = [why for why in over(_clicked, *zip(*some, strict=True)) if why]
        what = f"refused, of {runs} clicks of {len(photographs)} photographs"
        yield Row("clicks", what, len(refused), most=0, note="".join(refused[:1]))
    refused = [why for why in over(_pitch, range(runs)) if why]
    yield Row("clicks", f"refused, of {runs} of a pitch", len(refused), most=0, note="".join(refused[:1]))


@cache
def _photographs() -> list[KnownPhotograph]:
    shared = real_place().parent
    every = [one for name in ("photos", "photos3") for one in known_photographs(shared / name)]
    return [one for one in every if not one.is_wrong]


def _corners(shown: KnownPhotograph) -> Mapping[str, Sequence[float]]:
    target, corners = targets_by_name()[shown.truth["asked_as"]], shown.truth.get("corners_px", {})
    return {name: pixel for name, pixel in corners.items() if name in target.point_index}


def _clicked(shown: KnownPhotograph, seed: int) -> str:
    """Why four correct clicks on a photograph are refused, "" where they are not."""
    corners, target = _corners(shown), targets_by_name()[shown.truth["asked_as"]]
    four = {name: corners[name] for name in max(combinations(corners, 4), key=lambda four: spread(corners, four))}
    why = _refusal(np.random.default_rng([seed, 26]), four, target, tuple(shown.truth["image_size"]))
    return f"{shown.name}: {why}" if why else ""


def _pitch(seed: int) -> str:
    """Why six correct clicks on a football pitch are refused, "" where they are not."""
    rng, pitch = np.random.default_rng([seed, 27]), targets_by_name()["football"]
    camera = Camera((1920, 1080), rng.uniform(1200.0, 2500.0), (959.5, 539.5), Brown((0.0,) * 5))
    stands, to = np.array([rng.uniform(-20.0, 20.0), -60.0, 15.0]), np.array([rng.uniform(-30.0, 30.0), -10.0, 0.0])
    ahead = (to - stands) / np.linalg.norm(to - stands)
    aside = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(ahead[:2])
    rotation = np.array([aside, np.cross(ahead, aside), ahead])
    there = camera.at(Pose(rotation, -rotation @ stands))
    pixels = dict(zip(pitch.point_names, there.project(pitch.point_array), strict=True))
    shown = [name for name, pixel in pixels.items() if np.all((pixel > 0.0) & (pixel < camera.image_size))]
    if len(shown) < 6:
        return ""
    six = {name: tuple(pixels[name].tolist()) for name in rng.permutation(shown)[:6].tolist()}
    return _refusal(rng, six, pitch, camera.image_size)


def _refusal(
    rng: np.random.Generator, pixels: Mapping[str, Sequence[float]], target: Target, size: tuple[int, int]
) -> str:
    off = {name: tuple(np.array(pixel) + rng.normal(0.0, CLICK_PX, 2)) for name, pixel in pixels.items()}
    try:
        starts_from_clicks(Clicks(off), target, size)
    except InputError as error:
        return str(error)
    return ""


def _rows(case: str, found: Sequence[Outcome]) -> Iterator[Row]:
    refused = [one.refused for one in found if one.refused]
    yield Row(case, f"refused, of {len(found)}", len(refused), most=0, note=refused[0][:60] if refused else "")
    wrong = [one for one in found if one.sigmas > MOST_SIGMAS]
    yield Row(case, 'a number called "known" over 5 sd off', len(wrong), most=0, note=wrong[0].which if wrong else "")


def _is_stated(seed: int) -> bool:
    return seed % 4 > 1


def _middle(seed: int) -> Outcome:
    rng = np.random.default_rng([seed, 21])
    position = (rng.uniform(-0.5, 0.5), rng.uniform(1.6, 2.4), rng.uniform(4.5, 6.0))
    return _hall(rng, _MIDDLE[: 3 + seed % 2], position, stated=_is_stated(seed))


def _quarter(seed: int) -> Outcome:
    rng = np.random.default_rng([seed, 22])
    position = (rng.uniform(-3.5, -2.5), rng.uniform(1.8, 2.6), rng.uniform(4.5, 6.0))
    return _hall(rng, _QUARTER, position, stated=_is_stated(seed))


def _hall(
    rng: np.random.Generator, curves: tuple[str, ...], position: tuple[float, float, float], *, stated: bool
) -> Outcome:
    """A camera above a field in a hall, with or without a stated height."""
    tilts = rng.uniform(-6.0, 6.0, 2)
    camera = Camera(_SIZE, rng.uniform(700.0, 900.0), (639.5, 511.5), Radial((rng.uniform(-6e-5, 0.0), 5e-7)))
    pose = overhead_pose(*position, tilts[0], tilts[1], yaw_deg=rng.uniform(-180.0, 180.0))
    scene = field_scene(_FIELD, {"c": camera}, {"c": Station("c", pose)}, points=(), curves=curves, spacing_m=0.02)
    priors = (Prior("station", "c", "height_m", (position[2],), (0.003,)),) if stated else ()
    observations = replace(_thinned(simulate(scene, Disturbance(_NOISE_PX, _NOISE_PX), 1).observations), priors=priors)
    return _outcome(scene, observations, Options(lens="radial"))


def _drawn(seed: int) -> Outcome | None:
    """The outcome of a random scene; None where the scene is not solvable."""
    rng = np.random.default_rng([seed, 23])
    phi_known = bool(rng.random() < 0.5)
    camera = Camera(_SIZE, rng.uniform(500.0, 1400.0), (639.5, 511.5), Brown((0.0,) * 5))
    tilt, to = rng.uniform(0.0, 45.0), rng.uniform(0.0, 2.0 * np.pi)
    place = rng.uniform(-4.0, 4.0), rng.uniform(-3.0, 3.0), rng.uniform(3.0, 7.0)
    pose = overhead_pose(
        place[0], place[1], place[2], tilt * np.cos(to), tilt * np.sin(to), yaw_deg=rng.uniform(-180.0, 180.0)
    )
    scene = field_scene(_FIELD, {"c": camera}, {"c": Station("c", pose)}, spacing_m=0.02)
    try:
        every = _thinned(simulate(scene, Disturbance(), 1).observations)
    except CalibrationError:  # the camera does not see the field
        return None
    seen = [(0, f) for f in np.unique(every.points.feature)] + [(1, f) for f in np.unique(every.curves.feature)]
    if len(seen) < 2:
        return None
    chosen = {tuple(seen[k]) for k in rng.permutation(len(seen))[: rng.integers(2, 9)]}
    exact = _of_features(every, chosen)
    if not _is_solvable(exact, camera, pose, phi_known=phi_known):
        return None
    noisy = _of_features(_thinned(simulate(scene, Disturbance(_NOISE_PX, _NOISE_PX), 1).observations), chosen)
    fixed = {**_HELD, **({"phi": camera.phi} if phi_known else {})}
    return _outcome(scene, noisy, Options(lens="brown", fixed=fixed, free_principal_point=False))


def _outcome(scene: Scene, observations: Observations, options: Options) -> Outcome:
    try:
        calibration = calibrate(observations, options)
    except CalibrationError as error:
        return Outcome(refused=str(error))
    sigmas, which, _ = farthest(calibration, scene)
    known = [one.key.quantity for one in calibration.uncertainty.verdicts if one.verdict == "known"]
    return Outcome("", sigmas, which, tuple(name for name in known if name in ("phi", "height")))


def _thinned(observations: Observations) -> Observations:
    """The observations with at most so many on each curve, evenly spaced."""
    kept = np.zeros(len(observations.curves), dtype=bool)
    for feature in np.unique(observations.curves.feature):
        own = np.flatnonzero(observations.curves.feature == feature)
        kept[own[np.unique(np.linspace(0, len(own) - 1, _MOST_ON_A_CURVE).round().astype(int))]] = True
    return replace(observations, curves=taken(observations.curves, kept))


def _of_features(observations: Observations, chosen: set[tuple[int, int]]) -> Observations:
    points, curves = observations.points, observations.curves
    shown = (
        np.array([(kind, feature) in chosen for feature in columns.feature.tolist()], dtype=bool)
        for kind, columns in enumerate((points, curves))
    )
    first, second = shown
    return replace(observations, points=taken(points, first), curves=taken(curves, second))


def _is_solvable(exact: Observations, camera: Camera, pose: Pose, *, phi_known: bool) -> bool:
    """Whether the observations determine the pose, and phi, to first order: by differences of `Camera.project`."""
    field = next(iter(exact.targets.values()))
    curves = list(field.curves.values())
    places, beside = [field.point_array[exact.points.feature], np.empty((0, 3))], [np.empty((0, 3))]
    there = camera.at(pose)
    for feature in np.unique(exact.curves.feature):
        own = exact.curves.pixels[exact.curves.feature == feature]
        on = np.column_stack([there.locate(own), np.zeros(len(own))])
        s = nearest_on_curve(curves[feature], on)
        places.append(along_curve(curves[feature], s))
        beside.append(along_curve(curves[feature], s + 1e-4))
    along = _project(camera, pose, np.concatenate(beside)) - _project(camera, pose, np.concatenate(places[1:]))
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    columns = []
    for number in range(6 if phi_known else 7):
        step = np.zeros(7)
        step[number] = _STEP
        moved = replace(camera, phi=camera.phi * (1.0 + step[6]))
        off = _project(moved, Pose.exp(step[:6]) @ pose, np.concatenate(places))
        off = (off - _project(camera, pose, np.concatenate(places))) / _STEP
        of_points, of_curves = off[: len(places[0])], off[len(places[0]) :]
        columns.append(np.concatenate([of_points.ravel(), np.sum(of_curves * across, axis=1)]))
    matrix = np.array(columns).T
    if len(matrix) < matrix.shape[1]:
        return False
    sizes = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
    return bool(sizes[-1] > _SOLVABLE * sizes[0])


def _project(camera: Camera, pose: Pose, places: Array) -> Array:
    return camera.at(pose).project(places)


main = script(
    {
        "middle": middle,
        "quarter": quarter,
        "drawn": drawn,
        "labels": labels,
        "lines": lines,
        "advice": advice,
        "clicks": clicks,
    },
    __doc__,
    (144, "scenes of each case"),
)
