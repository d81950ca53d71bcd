"""How often fields of other leagues are found in photographs: `python scripts/photographs.py --case templates`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from rendering.photograph import photograph
from rendering.photography import Photography, taken_as
from runner import Row
from scenery import field_scene, overhead_pose

from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target, tape_grid, targets_by_name
from ceres_cal.simulate import Station
from photos.auto import rows_for, searched, whole
from photos.shots import LENSES, Shot, varied

USUAL_SIZE = np.array([9.0, 6.0])  # of the field that `whole` looks at
ROBOTS_FROM_M = 5.0  # on smaller fields the renderer's robots would hide everything
GREEN, GREY, WOOD, CLAY, BLUE = (
    *((0.55, 1.25, 0.65), (1.0, 1.0, 1.0), (0.75, 1.25, 1.75)),
    *((0.7, 1.1, 2.2), (1.9, 1.0, 0.5)),
)
WHITE, YELLOW = (1.0, 1.0, 1.0), (0.35, 1.0, 1.0)
FLOORS: dict[str, tuple[tuple[float, tuple[float, float, float], tuple[float, float, float]], ...]] = {
    "vss": ((0.05, GREY, WHITE), (0.08, BLUE, WHITE)),
    "basketball": ((0.25, WOOD, WHITE), (0.2, BLUE, YELLOW)),
    "tennis": ((0.25, CLAY, WHITE), (0.2, BLUE, WHITE)),
    "tape-grid": ((0.3, GREY, YELLOW), (0.15, GREY, WHITE)),
    "": ((0.2, GREEN, WHITE), (0.12, GREEN, WHITE)),
}
"""By the first letters of a target's name: brightness and colour of the floor, colour of its lines."""


SMOOTH = ("basketball", "tennis")  # floors that are no carpets


def known() -> dict[str, Target]:
    """The targets that are rendered."""
    every = {name: target for name, target in targets_by_name().items() if not name.startswith("ssl")}
    return {**every, "tape-grid": tape_grid(6, 4, 0.5, 0.02)}


def floored(name: str, target: Target, seed: int) -> Photography:
    """Light, blur and wear of `varied`, with a floor that is usual for the target."""
    floors = next(floors for begins, floors in FLOORS.items() if name.startswith(begins))
    carpet, carpet_colour, paint_colour = floors[seed // 2 % len(floors)]
    how = replace(varied(seed), carpet=carpet, carpet_colour=carpet_colour, paint_colour=paint_colour)
    if name in SMOOTH:
        how = replace(how, carpet_texture=0.5 * how.carpet_texture)
    small = float(np.max(np.ptp(target.box, axis=0))) < ROBOTS_FROM_M
    return replace(how, robots=min(how.robots, 1), balls=0) if small else how


def take_field(name: str, target: Target, seed: int) -> Shot:
    """Photograph number `seed` of a target that is seen whole, or nearly."""
    rng = np.random.default_rng([13, seed, len(name)])
    phi, lens = LENSES[seed // 2 % len(LENSES)]
    optics = Camera((1280, 960), phi, (640.0 + rng.normal(0.0, 8.0), 480.0 + rng.normal(0.0, 8.0)), lens)
    low, high = target.box
    scale = float(np.max((high - low) / USUAL_SIZE))
    x, y, height, tilt, yaw = (float(value) for value in whole(rng))
    direction = rng.uniform(0.0, 2.0 * np.pi)
    middle = 0.5 * (low + high) + scale * np.array([x, y])
    tilts = float(tilt * np.cos(direction)), float(tilt * np.sin(direction))
    pose = overhead_pose(float(middle[0]), float(middle[1]), scale * height, *tilts, yaw)
    scene = field_scene(target, {"overhead": optics}, {"overhead": Station("overhead", pose)})
    scene = taken_as(scene, floored(name, target, seed))
    picture = photograph(scene, "overhead", "0001", seed=seed)
    return Shot(scene, scene.camera_at("overhead"), target, picture, seed % 2 == 0)


def template_rows(runs: int) -> Iterator[Row]:
    """Every template, each in as many photographs; an older calibration resolves the symmetry."""
    for name, target in known().items():
        outcomes = searched(take_field(name, target, seed) for seed in range(runs))
        yield from rows_for(f"auto, {name}", outcomes, 0.95)
