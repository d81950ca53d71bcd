"""How often a field is found in a photograph without an initial camera: `scripts/photographs.py --case auto`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from rendering.photograph import photograph
from rendering.photography import taken_as
from runner import Row
from scenery import field_scene, overhead_pose

from ceres_cal.base.errors import InputError
from ceres_cal.detect.images import read_light
from ceres_cal.detect.photographs import Auto, Facing
from ceres_cal.detect.photographs.search import search
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import KannalaBrandt, Radial
from ceres_cal.scene.targets import Target, ssl_field
from ceres_cal.simulate import Station
from photos.shots import LENSES, NOT_PAINTED, Shot, distances_px, real_target, take, varied

FACING = Auto((Facing("LeftGoalLine", "top"),))  # as the cameras of `take` are mounted
WIDE = (
    (548.0, KannalaBrandt((-0.012, 0.004, -0.003, 0.0006))),
    (620.0, Radial((-8.0e-4, 2.232e-6), (2, 3))),
)
RIGHT_PX, RIGHT_SHARE = 2.0, 0.99  # distance of the line centres from their curve, and share of them
COMMAND = "import sys; from ceres_cal.cli import main; sys.exit(main(sys.argv[1:]))"


def whole(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """x, y, height (m), tilt and yaw (degrees) of a camera that sees the whole field, or nearly all of it."""
    yaw = float(rng.choice([0.0, 180.0]) + rng.uniform(-12.0, 12.0))
    return (*rng.normal(0.0, 0.3, 2), rng.uniform(6.5, 8.0), rng.uniform(0.0, 12.0), yaw)


def half(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """Either half of the field, with any yaw."""
    return (
        float(rng.choice([-2.2, 2.2]) + rng.normal(0.0, 0.2)),
        float(rng.normal(0.0, 0.2)),
        rng.uniform(4.0, 5.0),
        rng.uniform(0.0, 12.0),
        rng.uniform(0.0, 360.0),
    )


def quarter(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """A quarter with part of the centre circle."""
    x, y = rng.choice([-2.2, 2.2]), rng.choice([-1.5, 1.5])
    away = rng.normal(0.0, 0.2, 2)
    return (x + away[0], y + away[1], rng.uniform(2.8, 4.0), rng.uniform(0.0, 10.0), rng.uniform(0.0, 360.0))


def tilted(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """Tilted by 20 to 45 degrees; x and y are the place it looks at, not its position."""
    return (*rng.uniform((-1.5, -0.3), (1.5, 0.3)), rng.uniform(3.5, 5.0), rng.uniform(20.0, 45.0), rng.uniform(0, 360))


def beside(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """Taken by hand beside the field; x and y are the place it looks at."""
    return (*rng.uniform((-1.5, -0.5), (1.5, 0.5)), rng.uniform(1.7, 3.5), rng.uniform(50.0, 70.0), rng.uniform(0, 360))


def near(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """So near that the picture often does not determine the place; a result must be right nevertheless."""
    return (*rng.uniform((-4.2, -2.7), (4.2, 2.7)), rng.uniform(1.2, 2.8), rng.uniform(0.0, 25.0), rng.uniform(0, 360))


VIEWS = {
    **{"whole": whole, "half": half, "quarter": quarter, "tilted 20 to 45 degrees": tilted},
    **{"tilted 50 to 70 degrees": beside, "wide lens": half},
}


def take_view(name: str, view: Callable[[np.random.Generator], tuple[float, ...]], seed: int) -> Shot:
    """Photograph number `seed` of a kind of view, with the light and wear of `varied`."""
    rng = np.random.default_rng([11, seed, len(name)])
    phi, lens = WIDE[seed % len(WIDE)] if name.startswith("wide") else LENSES[seed // 2 % len(LENSES)]
    optics = Camera((1280, 960), phi, (640.0 + rng.normal(0.0, 8.0), 480.0 + rng.normal(0.0, 8.0)), lens)
    x, y, height, tilt, yaw = (float(value) for value in view(rng))
    direction = rng.uniform(0.0, 2.0 * np.pi)
    tilts = tilt * np.cos(direction), tilt * np.sin(direction)
    if name.startswith("tilted"):
        looked_at = optics.at(overhead_pose(0.0, 0.0, height, *tilts, yaw)).locate([[640.0, 480.0]])[0]
        x, y = x - float(looked_at[0]), y - float(looked_at[1])
    pose = overhead_pose(x, y, height, *tilts, yaw)
    field = ssl_field("B")
    scene = field_scene(field, {"overhead": optics}, {"overhead": Station("overhead", pose)})
    scene = taken_as(scene, varied(seed))
    picture = photograph(scene, "overhead", "0001", seed=seed)
    return Shot(scene, scene.camera_at("overhead"), field, picture, seed % 2 == 0)


@dataclass(frozen=True)
class Outcome:
    """Result for one photograph: "right", "wrong", "miss" or "several ways"; seconds; and the reason."""

    what: str
    seconds: float
    why: str = ""


def outcome(shot: Shot, auto: Auto, other: Target | None = None) -> Outcome:
    """Search one photograph for its field, or for another one, for which any result is wrong."""
    target, grey = other or shot.target, shot.grey
    began = time.perf_counter()
    try:
        found = search(grey, target, target.curve_names, auto)
    except InputError as error:
        return Outcome("several ways", time.perf_counter() - began, str(error))
    seconds = time.perf_counter() - began
    if found.followed is None:
        return Outcome("miss", seconds, found.reason)
    lines = found.followed.lines
    error_px = np.abs(distances_px(shot, lines.course.curve[lines.found], lines.pixels[lines.found]))
    right = other is None and float(np.mean(error_px < RIGHT_PX)) >= RIGHT_SHARE
    return Outcome("right" if right else "wrong", seconds)


def rows_for(case: str, outcomes: Sequence[Outcome], least: float = -np.inf) -> Iterator[Row]:
    """Shares of the results of these photographs."""
    count, missed = len(outcomes), [one for one in outcomes if one.what in ("miss", "several ways")]
    found = sum(one.what == "right" for one in outcomes) / count
    note = f"{count} photographs, {len(missed)} misses that say so"
    yield Row(case, "share that is found", found, least=least, note=note)
    yield Row(case, "wrong without saying so", sum(one.what == "wrong" for one in outcomes), most=0.0)
    for one in missed:
        print(f"{case}: {one.what}: {one.why}", file=sys.stderr)


def searched(shots: Iterator[Shot]) -> list[Outcome]:
    """Outcomes where an older calibration, rotated by up to 60 degrees, resolves the field's symmetry."""
    every = []
    for number, shot in enumerate(shots):
        turn = np.random.default_rng([17, number]).uniform(-60.0, 60.0)
        before = overhead_pose(yaw_deg=float(turn)).rotation @ overhead_pose().rotation.T
        pose = shot.camera.cam_from_world
        turned = replace(pose, rotation=before @ pose.rotation, translation=before @ pose.translation)
        every.append(outcome(shot, Auto(before=shot.camera.at(turned))))
    return every


def auto_rows(runs: int) -> Iterator[Row]:
    """The photographs of `take`, other views of the field, another field, and photographs without `--facing`."""
    album = [outcome(take(seed), FACING) for seed in range(runs)]
    yield from rows_for("auto", album, 0.95)
    seconds = [one.seconds for one in album]
    yield Row("auto", "a frame is searched, s, median", float(np.median(seconds)), most=5.0)
    yield Row("auto", "a frame is searched, s, the slowest", float(np.max(seconds)))
    yield Row("auto", "the command, as a whole process, s", process_seconds(min(runs, 5)), most=5.0)
    few = max(runs // 10, 1)
    for name, view in VIEWS.items():
        outcomes = searched(take_view(name, view, seed) for seed in range(few))
        yield from rows_for(f"auto, {name}", outcomes, 0.95)
    outcomes = searched(take_view("near", near, seed) for seed in range(2 * few))
    yield from rows_for("auto, very near", outcomes)
    silent = [outcome(take(seed), Auto()).what for seed in range(few)]
    yield Row("auto, no --facing", "refused, both ways named", silent.count("several ways") / few, least=1.0)
    other = [outcome(take(seed), FACING, ssl_field("A")).what for seed in range(few)]
    yield Row("auto, for a division A field", "found", other.count("wrong"), most=0.0, note=f"{few} photographs")


def process_seconds(runs: int) -> float:
    """Median time of `ceres-cal detect field --auto` as a whole process."""
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(runs):
            path = Path(folder) / "photograph.png"
            cv2.imwrite(str(path), take(seed).picture.image)
            options = ["--auto", "--facing", "LeftGoalLine=top", "--target", "ssl-b", "-o", f"{folder}/field.json"]
            command = [sys.executable, "-c", COMMAND, "detect", "field", str(path), *options, "--quiet"]
            began = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def real_auto_rows(folder: Path) -> Iterator[Row]:
    """The real photograph, without clicks."""
    grey = read_light(folder / "ssl_tigers_line_corners" / "camera_frame_1224x1024_crop.png")
    target = real_target()
    painted = [name for name in target.curve_names if name not in NOT_PAINTED]
    began = time.perf_counter()
    found = search(grey, target, painted, Auto((Facing("LeftGoalLine", "left"),)))
    yield Row("real photograph, auto", "found", float(found.followed is not None), least=1.0)
    yield Row("real photograph, auto", "searched, s", time.perf_counter() - began, most=5.0)
    if found.followed is not None:
        corner = found.followed.camera.project([target.points["BottomLeftCorner"]])[0]
        off = float(np.linalg.norm(corner - (55.0, 984.0)))
        yield Row("real photograph, auto", "BottomLeftCorner off its published click, px", off, most=15.0)
