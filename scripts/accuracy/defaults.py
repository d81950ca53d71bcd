"""Accuracy of calibrations with default options: python scripts/run.py defaults [--help]

Scenes of one camera above a division B field are calibrated with the default options. Brown's lens has decentring drawn
from the range of real lenses; the paper's lens has none. With Brown's lens: how often the 95 % intervals of places at 0
and 150 mm contain the truth (90 to 99 % required), and whether any number called "known" has an error above 5 standard
deviations. With the paper's lens: the error at 150 mm over that with the lens stated. Then how often a contradiction is
reported: for a stated height or phi that is wrong by some per cent, for correct ones, and for fields that are longer or
wider than their drawing. Exits with 1 when a figure is missed by more than two standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from runner import Row, mean_and_error, over, script, share_error
from scenery import BoardRanges, board_scene, field_scene, join, overhead_pose

from accuracy.odd_scenes import farthest
from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.frozen import replace
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, Lens, Radial
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

_DECENTRED = 5e-4  # standard deviation of p1 and of p2
_NOISE_PX = 0.3
_PLACES = np.array([[x, y] for x in (-4.0, -2.0, 0.0, 2.0, 4.0) for y in (-2.8, -1.0, 1.0, 2.8)])
_SIZE = (1280, 960)
_FAR = 5.0  # standard deviations
_Drawn = Callable[[np.random.Generator], tuple[float, Lens]]
"""phi and a lens."""


def _brown(rng: np.random.Generator) -> tuple[float, Lens]:
    p1, p2 = rng.normal(0.0, _DECENTRED, 2)
    return 820.0 * rng.uniform(0.9, 1.1), Brown((-0.24, 0.08, p1, p2, -0.01))


def _round(rng: np.random.Generator) -> tuple[float, Lens]:
    return 868.0 * rng.uniform(0.9, 1.1), Radial((-5.2e-5, 6.1e-7))


def _scene(seed: int, lens: _Drawn, tilts_deg: tuple[float, ...], middle_m: float = 0.0, boards: int = 0) -> Scene:
    """A camera 4.2 m above a place of the field, once at each tilt; with boards in front of the first station."""
    rng = np.random.default_rng([seed, 34])
    phi, model = lens(rng)
    centre = (639.5 + rng.normal(0.0, 10.0), 479.5 + rng.normal(0.0, 10.0))
    cameras, stations = {"c": Camera(_SIZE, phi, centre, model)}, {}
    for number, tilt_deg in enumerate(tilts_deg):
        way = rng.uniform(0.0, 2.0 * np.pi)
        pose = overhead_pose(middle_m, 0.0, 4.2, tilt_deg * np.cos(way), tilt_deg * np.sin(way), rng.uniform(-5.0, 5.0))
        stations[f"s{number}"] = Station("c", pose)
    scene = field_scene(ssl_field("B"), cameras, stations, spacing_m=0.25)
    if boards:
        there = {"s0": stations["s0"]}
        board = checkerboard(9, 6, 0.1)
        scene = join(scene, board_scene(board, cameras, there, boards, seed, held=BoardRanges((1.5, 3.0))))
    return scene


_Maker = Callable[[int], Scene]
DECENTRED: dict[str, tuple[_Maker, int]] = {
    "one frame": (partial(_scene, lens=_brown, tilts_deg=(12.0,)), 1),
    "five frames of one pose": (partial(_scene, lens=_brown, tilts_deg=(12.0,)), 5),
    "half a field": (partial(_scene, lens=_brown, tilts_deg=(12.0,), middle_m=-2.3), 1),
    "with six boards": (partial(_scene, lens=_brown, tilts_deg=(6.0,), boards=6), 1),
    "four poses": (partial(_scene, lens=_brown, tilts_deg=(5.0, 10.0, 15.0, 20.0)), 1),
}


def observed(scene: Scene, frames: int, seed: int) -> Observations:
    """Observations of a scene in so many frames, simulated as one frame with less noise."""
    sigma_px = _NOISE_PX / frames**0.5
    return simulate(scene, Disturbance(sigma_px, sigma_px), seed).observations


@dataclass
class RunResult:
    """One run: which intervals contain the truth, the largest error of a "known" number, the verdict's level."""

    held: dict[float, Mask] = field(default_factory=dict)
    sigmas: float = 0.0
    which: str = ""
    level: str = ""
    failed: int = 0


def _located(calibration: Calibration, scene: Scene, height_m: float) -> Iterator[tuple[Array, Array, Array]]:
    """Errors of located places, and the ends of their intervals relative to the truth."""
    for station in scene.stations:
        camera = scene.camera_at(station)
        places = np.column_stack([_PLACES, np.full(len(_PLACES), height_m)])
        pixels = camera.project(places)
        inside = np.all((pixels > 0.0) & (pixels < np.array(_SIZE) - 1.0), axis=1)
        points = calibration.uncertainty.located(pixels[inside], height_m, station)
        yield points.located - _PLACES[inside], points.low - _PLACES[inside], points.high - _PLACES[inside]


def _decentred(maker: _Maker, frames: int, seed: int) -> RunResult:
    scene = maker(seed)
    observations = observed(scene, frames, seed)
    try:
        calibration = calibrate(observations)
    except CalibrationError:
        return RunResult(failed=1)
    found = RunResult(level=judge_quality(quality_of(calibration, observations)).level)
    for height_m in HEIGHTS_M:
        ends = [(low <= 0.0) & (high >= 0.0) for _, low, high in _located(calibration, scene, height_m)]
        found.held[height_m] = np.concatenate(ends).ravel()
    found.sigmas, found.which, _ = farthest(calibration, scene)
    return found


def decentred(name: str, runs: int) -> Iterator[Row]:
    """The figures for a lens with decentring."""
    every = list(over(partial(_decentred, *DECENTRED[name]), range(runs)))
    done = [one for one in every if not one.failed]
    yield Row(name, "runs without a calibration", sum(one.failed for one in every), most=0.0)
    for height_m in HEIGHTS_M:
        held = mean_and_error([np.mean(one.held[height_m]) for one in done])
        yield Row(name, f"places at {1e3 * height_m:.0f} mm in their 95 % intervals", *held, 0.90, 0.99)
    far = [one for one in done if one.sigmas > _FAR]
    note = ", ".join(sorted({one.which for one in far}))
    yield Row(name, "runs with a known number over 5 sd off", len(far), most=0.0, note=note)
    trusted = np.mean([one.level == "good" for one in done])
    yield Row(name, "called trusted", float(trusted), share_error(float(trusted), len(done)))


def _costs(tilt_deg: float, seed: int) -> tuple[float, float, bool]:
    scene = _scene(seed, _round, (tilt_deg,))
    observations, squares, is_paper = observed(scene, 1, seed), [], False
    for options in (Options(lens="radial"), Options()):
        calibration = calibrate(observations, options)
        off = np.concatenate([off for off, _, _ in _located(calibration, scene, HEIGHTS_M[-1])])
        squares.append(float(np.mean(off**2)))
        choice = calibration.lens_choice
        is_paper = choice is not None and choice.chosen == "radial 2,3"
    return squares[0], squares[1], is_paper


def round_lens(runs: int) -> Iterator[Row]:
    """What the default lens choice costs if the true lens is the paper's."""
    for tilt_deg in (3.0, 12.0, 20.0):
        named, auto, paper = np.array(list(over(partial(_costs, tilt_deg), range(runs))), dtype=float).T
        name = f"the paper's lens, {tilt_deg:g} deg"
        ratio = float(np.sqrt(auto.mean() / named.mean()))
        yield Row(name, "rms error at 150 mm, over the named lens's", ratio, most=1.5)
        yield Row(name, "recognised", float(paper.mean()), share_error(float(paper.mean()), runs), 0.95)


def _accused(quantity: str, off: float, tilt_deg: float, seed: int) -> tuple[bool, bool, float]:
    """Whether a stated height or phi is reported as contradicted, whether it is reported as contradicted or doubtful,
    and by how many standard deviations the observations alone, with the true lens, contradict it.
    """
    lens = "brown" if seed % 2 else "radial"
    scene = _scene(seed, _brown if seed % 2 else _round, (tilt_deg,))
    owner, name = ("station", "s0") if quantity == "height" else ("camera", "c")
    true = float(scene.camera_at("s0").position[2] if quantity == "height" else scene.camera_at("s0").phi)
    sigma = _TAPED_M if quantity == "height" else _OF_PHI * true
    stated = true * (1.0 + off) + (0.0 if off else sigma * np.random.default_rng([seed, 7]).standard_normal())
    seen = observed(scene, 1, seed)
    alone = calibrate(seen, Options(lens=lens)).uncertainty.verdict(owner, name, quantity).sd
    apart = float(abs(stated - true) / np.hypot(alone, sigma))
    prior = Prior(owner, name, "height_m" if quantity == "height" else quantity, (stated,), (sigma,))
    try:
        calibration = calibrate(seen, Options(priors=(prior,)))
    except CalibrationError:
        return off != 0.0, off != 0.0, apart
    named = any(one.quantity == quantity for one in calibration.conflicts)
    return named, named or any(f"stated {quantity}" in said for said in calibration.warnings), apart


_TAPED_M, _OF_PHI = 0.005, 0.002  # standard deviations of a stated height, m, and of a stated phi, relative
_WRONG = (
    ("height", 0.05, 12.0, 0.95, 1.0),
    ("height", 0.05, 20.0, 0.95, 1.0),
    ("height", -0.2, 20.0, 0.95, 1.0),
    ("height", 0.02, 20.0, 0.95, 1.0),
    ("height", 0.0, 12.0, 0.0, 0.005),
    ("phi", 0.05, 20.0, 0.95, 1.0),
    ("phi", 0.0, 12.0, 0.0, 0.005),
)
"""Stated quantity, its relative error, the tilt in degrees, and least and most share of runs with a contradiction."""


def stated(runs: int) -> Iterator[Row]:
    """How often a contradiction of a stated height or phi is reported."""
    for quantity, off, tilt_deg, least, most in _WRONG:
        named, said, apart = zip(*over(partial(_accused, quantity, off, tilt_deg), range(runs)), strict=True)
        name = f"a {quantity} {100.0 * off:g} % wrong, {tilt_deg:g} deg" if off else f"a {quantity} that is right"
        note = f"by the true lens alone it is off by {np.median(apart):.1f} sd, the median"
        share = float(np.mean(named))
        yield Row(name, "contradiction named", share, share_error(share, runs), least, most, note)
        yield Row(name, "contradicted, or said to be in doubt", float(np.mean(said)))


def _drawn(dimension: str, off: float, tilt_deg: float, seed: int) -> tuple[bool, bool, bool]:
    """For a field drawn with a wrong length: whether this length is named, whether any length is named, and whether the
    calibration is called trusted.
    """
    observations = observed(_scene(seed, _brown if seed % 2 else _round, (tilt_deg,)), 1, seed)
    field = observations.targets["field"]
    drawn = ssl_field("B", **{dimension: (1.0 + off) * field.dimensions[dimension]})
    observations = replace(observations, targets={"field": drawn})
    try:
        quality = quality_of(calibrate(observations), observations)
    except CalibrationError as error:
        return dimension in str(error), True, False
    # A finding also names the causes that these data do not distinguish from it.
    said = " ".join(one.sentence for one in (quality.diagnosis.findings if quality.diagnosis else ()))
    other = any(f"field/{one}" in said for one in field.dimensions)
    return f"field/{dimension}" in said, other, judge_quality(quality).level == "good"


def lengths(runs: int) -> Iterator[Row]:
    """How often a field that differs from its drawing is reported."""
    for off, tilt_deg in ((0.02, 7.0), (0.02, 12.0), (0.02, 20.0), (0.01, 12.0), (0.0, 12.0)):
        for dimension in ("field_length_m", "field_width_m")[: 2 if off else 1]:
            own, some, trusted = np.mean(list(over(partial(_drawn, dimension, off, tilt_deg), range(runs))), axis=0)
            name = f"{dimension} {100.0 * off:g} % wrong, {tilt_deg:g} deg" if off else "a field that is as drawn"
            least, most = (0.95, 1.0) if off else (0.0, 0.01)
            yield Row(name, "named", own, share_error(own, runs), least, most)
            yield Row(name, "it or another length named", some)
            yield Row(name, "called trusted", trusted, most=0.0 if off else 1.0)


_cases: dict[str, Callable[[int], Iterator[Row]]] = {
    **{name: partial(decentred, name) for name in DECENTRED},
    "round": round_lens,
    "stated": stated,
    "lengths": lengths,
}
main = script(_cases, __doc__, (200, "scenes of each case"))
