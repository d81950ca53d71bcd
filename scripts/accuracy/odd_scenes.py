"""Calibrations of few, flat or one-sided observations: python scripts/run.py odd_scenes [--help]

Random scenes as users have them: four to ten points, parallel lines, a field seen from straight above, one board or
two, an arc and a line, a few points beside many line points; with every lens, and with the stated noise. A refusal is
correct. Counted are calibrations in which a number called "known" has an error above 5 standard deviations, and those
that locate a place with an error above 2.5 times its stated 95 % radius. Exits with 1 where there are more than
allowed.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from runner import Row, finished, over, over_processes, parser
from scenery import BoardRanges, board_scene, field_scene, overhead_pose

from accuracy.scenes import FIELD, Problem, taped
from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.transforms import Pose
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations, Prior
from ceres_cal.posterior.maps import visible_pixels
from ceres_cal.problem.parameters import Estimate, Options
from ceres_cal.problem.quantities import difference
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial
from ceres_cal.scene.targets import checkerboard
from ceres_cal.simulate import Disturbance, Scene, Station, simulate, well_inside

MOST_SIGMAS, MOST_RADII = 5.0, 2.5
MOST_WRONG_KNOWN, MOST_WRONG_PLACES = 0, 2  # of 2000 scenes
NOISES_PX = (0.1, 0.3, 1.0)
_PLACES = np.array([[x, y] for x in np.linspace(-4.0, 4.0, 9) for y in np.linspace(-2.8, 2.8, 7)])
_ACROSS = ("LeftGoalLine", "RightGoalLine", "HalfwayLine", "LeftPenaltyStretch", "RightPenaltyStretch")
_ALONG = ("TopTouchLine", "BottomTouchLine", "CenterLine")
_STRAIGHT = tuple(name for name in FIELD.curve_names if name != "CenterCircle")

LENSES: dict[str, Callable[[np.random.Generator], tuple[float, Lens]]] = {
    "radial": lambda rng: (rng.uniform(700, 1000), Radial((rng.uniform(-8e-5, 0.0), rng.uniform(2e-7, 8e-7)))),
    "brown": lambda rng: (
        rng.uniform(700, 1000),
        Brown((rng.uniform(-0.28, -0.1), rng.uniform(0.03, 0.09), *rng.uniform(-5e-4, 5e-4, 2), 0.0)),
    ),
    "kannala-brandt": lambda rng: (
        rng.uniform(450, 650),
        KannalaBrandt((rng.uniform(-0.03, 0.02), rng.uniform(-0.005, 0.005), -0.002, 0.0004)),
    ),
}
"""phi and lens of cameras that see a field; the image has 1280 x 960 px."""


# ---- scenes ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RandomCamera:
    """A random camera, and the random generator for the rest of its scene."""

    rng: np.random.Generator
    camera: Camera

    def over_the_field(
        self, tilt_deg: tuple[float, float], points: tuple[int, int], curves: Sequence[str], spacing_m: float
    ) -> Scene:
        """The scene of one station above the field with some of the visible points, and curves; see `seen_from`."""
        rng = self.rng
        tilt, direction = rng.uniform(*tilt_deg), rng.uniform(0.0, 2.0 * np.pi)
        height_m = rng.uniform(4.0, 7.0) * (0.65 if self.camera.lens.kind == "kannala-brandt" else 1.0)
        x_m, y_m = rng.uniform(-1.0, 1.0, 2)
        tilts = tilt * np.cos(direction), tilt * np.sin(direction)
        pose = overhead_pose(x_m, y_m, height_m, *tilts, yaw_deg=rng.uniform(-180.0, 180.0))
        return self.seen_from(pose, points, curves, spacing_m)

    def seen_from(self, pose: Pose, points: tuple[int, int], curves: Sequence[str], spacing_m: float) -> Scene:
        """The scene from a pose with a random number of points (from, to), and with the curves of these names."""
        shown = well_inside(self.camera.at(pose), FIELD.point_array)
        seen = [name for name, inside in zip(FIELD.point_names, shown, strict=True) if inside]
        stations = {"a": Station("a", pose)}
        names = tuple(self.some(seen, *points)), tuple(curves)
        return field_scene(FIELD, {"a": self.camera}, stations, points=names[0], curves=names[1], spacing_m=spacing_m)

    def some(self, names: Sequence[str], least: int, most: int) -> list[str]:
        """Some of the names, at random."""
        return [str(name) for name in self.rng.permutation(names)[: self.rng.integers(least, most + 1)]]


def _few_points(drawn: RandomCamera) -> Scene:
    return drawn.over_the_field((0.0, 30.0), (4, 10), (), 1.0)


def _few_line_points(drawn: RandomCamera) -> Scene:
    return drawn.over_the_field((0.0, 30.0), (0, 0), drawn.some(_STRAIGHT, 5, 9), drawn.rng.uniform(0.3, 2.0))


def _points_and_few_line_points(drawn: RandomCamera) -> Scene:
    return drawn.over_the_field((0.0, 30.0), (4, 8), drawn.some(_STRAIGHT, 1, 4), drawn.rng.uniform(0.3, 2.0))


def _parallel(drawn: RandomCamera) -> Scene:
    lines = _ALONG if drawn.rng.random() < 0.5 else _ACROSS
    return drawn.over_the_field((0.0, 30.0), (0, 6), lines, drawn.rng.uniform(0.1, 0.5))


def _frontal(drawn: RandomCamera) -> Scene:
    return drawn.over_the_field((0.0, 2.0), (0, 12), FIELD.curve_names, drawn.rng.uniform(0.1, 0.5))


def _one_curve(drawn: RandomCamera) -> Scene:
    curves = ["CenterCircle", *drawn.some(_STRAIGHT, 1, 2)]
    return drawn.over_the_field((0.0, 30.0), (2, 6), curves, drawn.rng.uniform(0.05, 0.3))


def _boards(drawn: RandomCamera, most: int) -> Scene:
    rng = drawn.rng
    board = checkerboard(int(rng.integers(5, 10)), int(rng.integers(4, 7)), 0.1)
    low = rng.uniform(0.0, 40.0)
    near = rng.uniform(0.6, 3.0)
    held = BoardRanges((near, 1.3 * near), (low, low + 5.0))
    stations = {"a": Station("a", Pose.identity())}
    return board_scene(board, {"a": drawn.camera}, stations, most, int(rng.integers(1 << 30)), held)


def _points_beside_lines(drawn: RandomCamera) -> Scene:
    return drawn.over_the_field((5.0, 25.0), (5, 8), _STRAIGHT, 0.25)


_Maker = Callable[[RandomCamera], Scene]
ODD: dict[str, _Maker] = {
    "few points": _few_points,
    "few line points": _few_line_points,
    "points and few line points": _points_and_few_line_points,
    "parallel lines": _parallel,
    "frontal": _frontal,
    "one curve": _one_curve,
    "one board": partial(_boards, most=1),
    "two boards": partial(_boards, most=2),
}


def _above(drawn: RandomCamera) -> Scene:
    return drawn.over_the_field((0.0, 12.0), (6, 30), FIELD.curve_names, drawn.rng.uniform(0.2, 1.0))


BESIDE: dict[str, _Maker] = {"5 to 8 points beside lines": _points_beside_lines}
BY_DEFAULT: dict[str, _Maker] = {"above a field": _above, "three boards": partial(_boards, most=3)}


def odd_problem(make: _Maker, lens: str, seed: int, *, is_named: bool = True) -> Problem:
    """The same maker, lens and seed give the same problem; the value of each prior is the true one. Unless the lens is
    named, the default options choose it.
    """
    rng = np.random.default_rng([seed, 13])
    phi, model = LENSES[lens](rng)
    free_centre = bool(rng.random() < 0.7)
    centre = (639.5 + rng.uniform(-15.0, 15.0), 479.5 + rng.uniform(-15.0, 15.0)) if free_centre else (639.5, 479.5)
    options = Options(lens=lens, free_principal_point=free_centre) if is_named else Options()
    scene = make(RandomCamera(rng, Camera((1280, 960), phi, centre, model)))
    priors: tuple[Prior, ...] = ()
    if len(scene.placements) == 0 and rng.random() < 0.25:
        priors = (taped(scene, "a", 0.01),)
    return Problem(scene, options, priors)


# ---- results --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """The result for one scene.

    Attributes:
        refused: the message of a refusal, "" otherwise. sigmas, which: the largest error of a "known" number in
            standard deviations, and the quantity. radii: the largest error of a located place in stated 95 % radii.
            level: of the verdict, where one of these is too large. accused: correct statements that are reported as
            contradicted.
    """

    kind: str
    lens: str
    seed: int
    refused: str = ""
    sigmas: float = 0.0
    which: str = ""
    radii: float = 0.0
    level: str = ""
    accused: str = ""

    def __str__(self) -> str:
        verdict = f", verdict {self.level}" if self.level else ""
        off = f"{self.sigmas:.1f} sd ({self.which}), {self.radii:.2f} radii"
        accused = f", accused: {self.accused}" if self.accused else ""
        return f"{self.kind} / {self.lens} / {self.seed}: {off}{verdict}{accused}"

    @property
    def wrong(self) -> bool:
        """Whether the error of a "known" number is too large."""
        return self.sigmas > MOST_SIGMAS

    @property
    def misplaced(self) -> bool:
        """Whether the error of a place is too large."""
        return self.radii > MOST_RADII


def outcome(kind: str, make: _Maker, lens: str, seed: int) -> Outcome:
    """Calibrate one scene."""
    problem = odd_problem(make, lens, seed, is_named=kind not in BY_DEFAULT)
    try:
        seen = observed(problem, NOISES_PX, seed)
        calibration = calibrate(seen, problem.options)
    except CalibrationError as error:
        return Outcome(kind, lens, seed, refused=str(error))
    return judged(Outcome(kind, lens, seed), calibration, seen, problem.scene)


def observed(problem: Problem, noises_px: Sequence[float], seed: int) -> Observations:
    """Observations of a problem with one of these noises; each prior's value has an error with its stated sigma."""
    rng = np.random.default_rng([seed, 14])
    priors = [replace(p, value=tuple(rng.normal(p.value, p.sigma).tolist())) for p in problem.priors]
    sigma_px = float(rng.choice(noises_px))
    seen = simulate(problem.scene, Disturbance(sigma_px, sigma_px), seed).observations
    return replace(seen, priors=tuple(priors))


def judged(of: Outcome, calibration: Calibration, observations: Observations, scene: Scene) -> Outcome:
    """The outcome with the errors of the calibration."""
    sigmas, which, radii = farthest(calibration, scene)
    accused = ", ".join(f"{one.owner} {one.quantity}" for one in calibration.conflicts)
    found = replace(of, sigmas=sigmas, which=which, radii=radii, accused=accused)
    if found.wrong or found.misplaced:
        return replace(found, level=judge_quality(quality_of(calibration, observations)).level)
    return found


def farthest(calibration: Calibration, scene: Scene) -> tuple[float, str, float]:
    """Largest error of a "known" number in standard deviations, and its quantity; largest error of a located place in
    stated 95 % radii.
    """
    stations = {name: Station(place.camera, place.cam_from_world) for name, place in scene.stations.items()}
    truth = Estimate(scene.cameras, stations, scene.placements, calibration.estimate.structure)
    return *_farthest_known(calibration, truth), _farthest_place(calibration, truth)


def _farthest_known(calibration: Calibration, truth: Estimate) -> tuple[float, str]:
    known = [one for one in calibration.uncertainty.verdicts if one.verdict == "known"]
    farthest = (0.0, "")
    for one in known:
        kind, owner, quantity, _ = one.key
        if kind == "camera" and quantity != "phi" and not _is_within(truth, calibration, owner):
            continue
        if (kind, quantity) == ("camera", "phi"):
            off = truth.cameras[owner].phi - calibration.cameras[owner].phi
        else:
            off = float(difference(truth, calibration.estimate, [one.key])[0])
        farthest = max(farthest, (abs(off) / one.sd, quantity))
    return farthest


def _is_within(truth: Estimate, calibration: Calibration, camera: str) -> bool:
    """Whether the solved lens model contains the true lens.

    If it does not, its principal point and its coefficients have no true value in the scene. The places on the floor
    and above it that such a lens locates do have true values, and are always judged.
    """
    lens, solved = truth.cameras[camera].lens, calibration.cameras[camera].lens
    if lens.kind != solved.kind or lens.names != solved.names:
        return False
    free = {key.quantity for key in calibration.uncertainty.posterior.keys if key[:2] == ("camera", camera)}
    return all(name in free or value == 0.0 for name, value in lens.coefficients.items())


def _farthest_place(calibration: Calibration, truth: Estimate) -> float:
    farthest = 0.0
    for station in calibration.stations:
        if not calibration.uncertainty.posterior.knows_station(station):
            continue
        for height_m in HEIGHTS_M:
            pixels = visible_pixels(truth, station, _PLACES, height_m)
            shown = np.isfinite(pixels[:, 0])
            points = calibration.uncertainty.located(pixels[shown], height_m, station)
            off: Array = np.linalg.norm(points.located - _PLACES[shown], axis=1)
            with np.errstate(invalid="ignore"):
                farthest = max(farthest, float(np.nanmax(off / points.radius_95_m, initial=0.0)))
    return farthest


def _one(kinds: Mapping[str, _Maker], seed: int) -> Outcome:
    """One scene; the seed goes through all kinds and lenses."""
    every = [(kind, lens) for lens in LENSES for kind in kinds]
    kind, lens = every[seed % len(every)]
    return outcome(kind, kinds[kind], lens, seed)


def summary(title: str, found: Sequence[Outcome], worst: int) -> None:
    """Print counts by kind and lens, and the worst scenes."""
    print(f"{title}: {len(found)} scenes, {sum(bool(o.refused) for o in found)} refused")
    print(f"  {'':30}{'scenes':>8}{'refused':>9}{'known > 5 sd':>14}{'places > 2.5':>14}")
    for kind, lens in Counter((o.kind, o.lens) for o in found):
        own = [o for o in found if (o.kind, o.lens) == (kind, lens)]
        counts = [len(own), *map(sum, zip(*((bool(o.refused), o.wrong, o.misplaced) for o in own), strict=True))]
        print(f"  {kind + ', ' + lens:44}" + "".join(f"{count:>9}" for count in counts))
    for o in sorted(found, key=lambda o: -max(o.sigmas / MOST_SIGMAS, o.radii / MOST_RADII))[:worst]:
        print(f"  {o}")


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__, (2000, "scenes"))
    options.add_argument("--first", type=int, default=0, help="seed of the first one (default 0)")
    options.add_argument("--beside", action="store_true", help="only 5 to 8 points beside the lines of a field")
    options.add_argument(
        "--defaults", action="store_true", help="only cameras above a field and few boards, no lens named"
    )
    options.add_argument("--kind", nargs="+", choices=list(ODD), default=list(ODD), help="only these")
    options.add_argument("--worst", type=int, default=12, help="how many of the worst are printed (default 12)")
    given = options.parse_args(arguments)
    kinds = BESIDE if given.beside else BY_DEFAULT if given.defaults else {kind: ODD[kind] for kind in given.kind}
    found = []
    with over_processes(given.jobs):
        for one in over(partial(_one, kinds), range(given.first, given.first + given.runs)):
            found.append(one)
            if one.wrong or one.misplaced:
                print(one, file=sys.stderr, flush=True)
    title = "points beside lines" if given.beside else "odd scenes"
    if given.json != "-":
        summary(title, found, given.worst)
    most = 0 if given.beside else MOST_WRONG_PLACES
    rows = [
        Row(title, "known numbers over 5 sd off", sum(one.wrong for one in found), most=MOST_WRONG_KNOWN),
        Row(title, "places over 2.5 radii off", sum(one.misplaced for one in found), most=most),
    ]
    return finished(rows, given)
