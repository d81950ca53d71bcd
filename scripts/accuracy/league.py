"""The set-ups of the league, calibrated one by one: python scripts/run.py league [--help]

1, 2 and 4 cameras above a division B field; tilts of 0, 1, 3, 8 and 20 degrees; the lens chosen or stated; with and
without boards; with and without a height measured to 10 mm. A result is correct if it is a calibration or a refusal of
one line, without a warning of NumPy, within five seconds of processor time. No number called "known" may have an error
above 5 standard deviations, no place an error above 2.5 of its stated 95 % radii. The median standard deviation of the
floor must be below 20 mm, and no standard deviation may exceed that of its own prior. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scenery import BoardRanges, board_scene, field_scene, join, overhead_pose

from accuracy.odd_scenes import LENSES, MOST_RADII, MOST_SIGMAS, farthest
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Prior
from ceres_cal.problem.parameters import AUTO, Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

MOST_SECONDS, MOST_FLOOR_MM = 5.0, 20.0
NOISE_PX, TAPE_M = 0.3, 0.01
_BOARD, _BOARDS = checkerboard(9, 6, 0.1), 5
# Cameras -> their places (x, y) and their height, m: each sees its part of the field of 9 x 6 m and some of the next.
_PLACES = {
    1: (((0.0, 0.0),), 5.2),
    2: (((-2.3, 0.0), (2.3, 0.0)), 4.4),
    4: (((-2.3, -1.5), (-2.3, 1.5), (2.3, -1.5), (2.3, 1.5)), 3.6),
}


class SetUp(NamedTuple):
    """One combination."""

    cameras: int
    tilt_deg: float
    lens: str
    boards: bool
    height: bool

    def __str__(self) -> str:
        boards, height = "boards" if self.boards else "no boards", "height" if self.height else "no height"
        return f"{self.cameras} cameras, {self.tilt_deg:g} deg, {self.lens}, {boards}, {height}"


_FACTORS = ((1, 2, 4), (0.0, 1.0, 3.0, 8.0, 20.0), (AUTO, "radial", "brown"), (False, True), (False, True))
SET_UPS = [SetUp(*one) for one in product(*_FACTORS)]


def pairwise() -> list[SetUp]:
    """Set-ups in which each two values of two factors occur together; those with fewer cameras first."""
    missing = {pair for one in SET_UPS for pair in combinations(enumerate(one), 2)}
    chosen = []
    while missing:
        best = max(SET_UPS, key=lambda one: len(missing & set(combinations(enumerate(one), 2))))
        missing -= set(combinations(enumerate(best), 2))
        chosen.append(best)
    return chosen


@dataclass(frozen=True)
class Outcome:
    """The result of one set-up.

    Attributes:
        refused: the message of a refusal, "" otherwise. fault: what is wrong with the result, "" where nothing is.
        seconds: of processor time.
    """

    set_up: SetUp
    seed: int
    seconds: float
    refused: str = ""
    fault: str = ""


def scene_of(set_up: SetUp, rng: np.random.Generator) -> Scene:
    """The scene: its lens is the stated one, or one of the two kinds where the lens is chosen."""
    places, height_m = _PLACES[set_up.cameras]
    lens = set_up.lens if set_up.lens != AUTO else str(rng.choice(["radial", "brown"]))
    phi, model = LENSES[lens](rng)
    cameras, stations = {}, {}
    for number, (x_m, y_m) in enumerate(places):
        direction, name = rng.uniform(0.0, 2.0 * np.pi), f"c{number}"
        tilts = set_up.tilt_deg * np.cos(direction), set_up.tilt_deg * np.sin(direction)
        centre = (639.5 + rng.uniform(-12.0, 12.0), 479.5 + rng.uniform(-12.0, 12.0))
        cameras[name] = Camera((1280, 960), phi * rng.uniform(0.99, 1.01), centre, model)
        off = rng.uniform(-0.1, 0.1, 3)
        yaw_deg = rng.uniform(-5.0, 5.0) + float(rng.choice([0.0, 180.0]))
        pose = overhead_pose(x_m + off[0], y_m + off[1], height_m + off[2], *tilts, yaw_deg)
        stations[name] = Station(name, pose)
    scenes = [field_scene(ssl_field("B"), cameras, stations, spacing_m=0.2)]
    for number, name in enumerate(cameras if set_up.boards else ()):
        held = BoardRanges((0.4 * height_m, 0.7 * height_m))
        own = board_scene(_BOARD, {name: cameras[name]}, {name: stations[name]}, _BOARDS, number, held)
        names = {old: f"{name}_{old}" for old in own.placements}
        placements = {names[old]: pose for old, pose in own.placements.items()}
        views = tuple(replace(view, placement=names[str(view.placement)]) for view in own.views)
        scenes.append(replace(own, placements=placements, views=views))
    return join(*scenes)


def outcome(set_up: SetUp, seed: int, most_seconds: float = MOST_SECONDS) -> Outcome:
    """Calibrate one scene; the same set-up and seed give the same scene."""
    rng = np.random.default_rng([seed, SET_UPS.index(set_up)])
    scene = scene_of(set_up, rng)
    priors: tuple[Prior, ...] = ()
    if set_up.height:
        heights = {name: float(scene.camera_at(name).position[2]) for name in scene.stations}
        taped = {name: (height + TAPE_M * float(rng.standard_normal()),) for name, height in heights.items()}
        priors = tuple(Prior("station", name, "height_m", height, (TAPE_M,)) for name, height in taped.items())
    observations = simulate(scene, Disturbance(NOISE_PX, NOISE_PX), seed).observations
    refused, fault, calibration = "", "", None
    start = time.process_time()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            calibration = calibrate(observations, Options(lens=set_up.lens, priors=priors))
        except CalibrationError as error:
            refused = str(error)
        except Exception as error:  # this is what is looked for
            fault = f"{type(error).__name__}: {error}"
        seconds = time.process_time() - start
        fault = fault or ("" if calibration is None else _fault(calibration, scene, priors))
    fault = fault or "".join(f"warned: {one.message}" for one in warned[:1])
    fault = fault or ("a refusal of several lines" if "\n" in refused else "")
    fault = fault or (f"{seconds:.1f} s" if seconds > most_seconds else "")
    return Outcome(set_up, seed, seconds, refused, fault)


def _fault(calibration: Calibration, scene: Scene, priors: Sequence[Prior]) -> str:
    """What is wrong with a calibration; "" where nothing is."""
    sigmas, which, radii = farthest(calibration, scene)
    if sigmas > MOST_SIGMAS:
        return f"{which} is called known, {sigmas:.1f} sd off"
    if radii > MOST_RADII:
        return f"a place is {radii:.1f} radii off"
    for name in scene.stations:
        sd_mm = calibration.uncertainty.map_sd_mm(name, 0.0).sd_mm
        if (median := float(np.nanmedian(sd_mm))) > MOST_FLOOR_MM:
            return f"half of the floor that {name} sees is known to {median:.0f} mm only"
    for prior in priors:
        sd = calibration.uncertainty.verdict("station", prior.name, "height").sd
        said = (one for one in calibration.warnings if f"the stated height of station {prior.name!r}" in one)
        if sd > prior.sigma[0] * (1.0 + 1e-9) and not any("It may be wrong" in one for one in said):
            return f"height is stated to {1e3 * prior.sigma[0]:.1f} mm and known to {1e3 * sd:.1f} mm"
    return ""


def outcomes(set_ups: Sequence[SetUp], runs: int, first: int) -> Iterator[Outcome]:
    """Each set-up with `runs` seeds; faults are printed immediately."""
    for seed in range(first, first + runs):
        for set_up in set_ups:
            one = outcome(set_up, seed)
            if one.fault:
                print(f"{set_up}, seed {seed}: {one.fault}", flush=True)
            yield one


def _print_table(found: Sequence[Outcome]) -> None:
    print(f"{'':36}{'scenes':>8}{'refused':>9}{'wrong':>7}{'median s':>10}{'most s':>8}")
    for field in SetUp._fields:
        for value in dict.fromkeys(getattr(one.set_up, field) for one in found):
            own = [one for one in found if getattr(one.set_up, field) == value]
            counts = len(own), sum(bool(one.refused) for one in own), sum(bool(one.fault) for one in own)
            seconds = [one.seconds for one in own]
            row = f"{counts[0]:>8}{counts[1]:>9}{counts[2]:>7}{np.median(seconds):>10.2f}{max(seconds):>8.2f}"
            print(f"  {field.replace('_', ' ') + ' ' + str(value):34}{row}")
    for refused, count in Counter(one.refused for one in found if one.refused).most_common():
        print(f"  refused {count} times: {refused}")


def main(arguments: Sequence[str]) -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0], allow_abbrev=False)
    parser.add_argument("--runs", type=int, default=1, help=f"scenes of each of the {len(SET_UPS)} set-ups (default 1)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one (default 0)")
    parser.add_argument(
        "--cameras", type=int, nargs="+", choices=list(_PLACES), default=list(_PLACES), help="only these"
    )
    parser.add_argument("--pairs", action="store_true", help="only set-ups in which each two values come together")
    given = parser.parse_args(arguments)
    chosen = [one for one in (pairwise() if given.pairs else SET_UPS) if one.cameras in given.cameras]
    found = list(outcomes(chosen, given.runs, given.first))
    _print_table(found)
    return int(any(one.fault for one in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
