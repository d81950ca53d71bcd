"""Small photographs of disturbed floors, and of other fields than asked for: `python scripts/photographs.py --case
disturbed --case wrong --runs N`.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rendering.moustache import Moustache
from rendering.photograph import photograph
from rendering.photography import Photography
from runner import Row, over
from scenery import field_scene, overhead_pose

from ceres_cal.base.arrays import Array, Image8
from ceres_cal.detect.photographs import Auto, Facing
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial
from ceres_cal.scene.targets import Target, custom, ssl_field, targets_by_name
from ceres_cal.simulate import Station
from photos.outcomes import MOVED_MM, STATED, USUAL_MM, WRONG, Outcome, Places, outcome, rows_of_foreseen
from photos.painters import (
    Painter,
    as_farmers_do,
    askew,
    with_another_sport,
    with_boundary,
    with_cables,
    with_old_field,
    worn,
)

SIZE = (780, 580)
MOST_S = 15.0
AUTO = Auto((Facing("LeftGoalLine", "left"),))
LENSES: dict[str, tuple[float, Lens]] = {
    "radial 2,3": (345.0, Radial((-1.1e-4, 1.6e-6), (2, 3))),
    "radial 3,5": (345.0, Radial((1.0e-6, 1.4e-12), (3, 5))),
    "brown": (350.0, Brown((-0.17, 0.03, 4e-4, -3e-4, -0.002))),
    "kannala-brandt": (330.0, KannalaBrandt((-0.012, 0.004, -0.003, 0.0006))),
    "moustache": (310.0, Moustache((0.2, 0.75))),
    "fisheye": (300.0, KannalaBrandt((-0.03, 0.002, 0.0, 0.0))),
}


@dataclass(frozen=True, eq=False)
class DisturbedShot:
    """A photograph, the camera that took it, and the field that is painted in it."""

    camera: Camera
    painted: Target
    image: Image8


def drawn_out() -> tuple[Array, Array]:
    """Point spread of lateral colour, or of a simple coma: light spread outwards, with less light farther out.

    Returns shifts (N,), complex, as shares of 1 along the radius and across it, and weights (N,).
    """
    share = np.linspace(0.0, 1.0, 13)
    return share.astype(complex), 1.0 - share


def comatic() -> tuple[Array, Array]:
    """Point spread of real coma: zones of the pupil make circles, larger and farther out, in a wedge of 60 degrees."""
    zone, turn = (one.ravel() for one in np.meshgrid((np.arange(4) + 0.5) / 4.0, np.arange(9) * 2.0 * np.pi / 9.0))
    return zone * (2.0 + np.exp(1j * turn)) / 3.0, np.ones(len(zone))


@dataclass(frozen=True)
class Kind:
    """A kind of disturbance: what is painted otherwise, how the photograph is taken, the lenses, the largest mean error
    `most_mm`, the field, a change of the camera, and the amount of coma at the rim with its shape.
    """

    painter: Painter | None = None
    how: Callable[[Photography, np.random.Generator], Photography] = lambda how, rng: how
    most_mm: float = USUAL_MM
    lenses: tuple[str, ...] = tuple(LENSES)[:4]
    field: str = "ssl-b"
    camera: Callable[[Camera, np.random.Generator], Camera] = lambda camera, rng: camera
    coma_px: float = 0.0
    coma: Callable[[], tuple[Array, Array]] = drawn_out


def cropped(camera: Camera, rng: np.random.Generator) -> Camera:
    """A part of a larger sensor, away from the centre of its lens."""
    away = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.15, 0.3, 2) * np.array(SIZE)
    x, y = np.array(camera.principal_point) + away
    return replace(camera, principal_point=(float(x), float(y)))


def with_coma(image: Image8, camera: Camera, rim_px: float, shape: tuple[Array, Array]) -> Image8:
    """The picture convolved with a point spread of these shifts and weights, centred at their mean. Its size is
    proportional to the distance from the principal point, and `rim_px` at the rim.
    """
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    cx, cy = camera.principal_point
    place, (shifts, weights) = x - cx + 1j * (y - cy), shape
    total = np.zeros(image.shape, np.float32)
    for part, weight in zip(shifts - np.average(shifts, weights=weights), weights / weights.sum(), strict=True):
        there = place / (1.0 + part * rim_px / camera.corner_radius)
        places = ((there.real + cx).astype(np.float32), (there.imag + cy).astype(np.float32))
        total += np.float32(weight) * cv2.remap(image.astype(np.float32), *places, cv2.INTER_LINEAR)
    return np.asarray(np.round(total), np.uint8)


KINDS: dict[str, Kind] = {
    "plain": Kind(),
    "sun": Kind(how=lambda how, rng: replace(how, sun=rng.uniform(0.6, 2.0), exposure=150.0)),
    "boundary": Kind(with_boundary),
    "cables": Kind(with_cables),
    "worn": Kind(worn),
    "seams": Kind(how=lambda how, rng: replace(how, strips=rng.uniform(0.1, 0.35))),
    "askew": Kind(askew),
    "glare": Kind(how=lambda how, rng: replace(how, glare=rng.uniform(0.3, 1.0))),
    "motion": Kind(how=lambda how, rng: replace(how, motion_px=rng.uniform(3.0, 8.0)), most_mm=MOVED_MM),
    "sharp": Kind(how=lambda how, rng: replace(how, blur_px=0.0)),
    "fisheye": Kind(lenses=("fisheye",)),
    "shadows": Kind(how=lambda how, rng: replace(how, shadows=4, unevenness=0.3, wear=0.1)),
    "another sport": Kind(with_another_sport),
    "an old field": Kind(with_old_field),
    "large": Kind(as_farmers_do, field="football", most_mm=60.0, how=lambda how, rng: replace(how, robots=0, balls=0)),
    "cropped": Kind(camera=cropped, most_mm=MOVED_MM),
    "stretched": Kind(camera=lambda camera, rng: replace(camera, aspect=rng.uniform(0.93, 1.07))),
    "dark": Kind(how=lambda how, rng: replace(how, carpet=rng.uniform(0.45, 0.65), paint=rng.uniform(0.08, 0.2))),
    "coma": Kind(coma_px=6.0, most_mm=MOVED_MM),
    "moustache": Kind(lenses=("moustache",)),
    "covered": Kind(how=lambda how, rng: replace(how, robots=25, boxes=int(rng.integers(12, 25)), shadows=3)),
    "comatic": Kind(coma_px=6.0, most_mm=MOVED_MM, coma=comatic),
}


def taken(name: str, seed: int, field: Target) -> DisturbedShot:
    """Photograph number `seed` of a kind of disturbance, with this field."""
    kind = KINDS[name]
    rng = np.random.default_rng([23, seed, *name.encode()])
    phi, lens = LENSES[kind.lenses[seed % len(kind.lenses)]]
    middle = 0.5 * (np.array(SIZE) - 1.0) + rng.normal(0.0, 5.0, 2)
    size = max(field.dimensions["field_length_m"] / 9.0, field.dimensions["field_width_m"] / 6.0)
    x, y, height = *(size * rng.normal(0.0, 0.2, 2)), size * rng.uniform(4.7, 5.6)
    tilt_x, tilt_y, yaw = rng.uniform(-8.0, 8.0, 3)
    pose = overhead_pose(x, y, height, tilt_x, tilt_y, yaw)
    camera = Camera(SIZE, phi * rng.uniform(0.97, 1.03), (float(middle[0]), float(middle[1])), lens, 1.0, pose)
    camera = kind.camera(camera, rng)
    how = Photography(
        blur_px=float(rng.uniform(0.0, 0.7)),
        unevenness=float(rng.uniform(0.0, 0.2)),
        robots=int(rng.integers(2, 9)),
        balls=1,
        carpet_texture=float(rng.uniform(0.02, 0.1)),
        read_noise=float(rng.uniform(1.0, 3.0)),
        mosaic=bool(seed % 3),
        jpeg_quality=int(rng.choice([0, 0, 90])),
    )
    how = kind.how(how, rng)
    curves = dict(field.curves)
    painted = custom(curves=curves if kind.painter is None else kind.painter(curves, field, rng))
    scene = field_scene(painted, {"overhead": camera}, {"overhead": Station("overhead", pose)})
    image = photograph(scene, "overhead", "0001", how, seed).image
    return DisturbedShot(
        camera, painted, with_coma(image, camera, kind.coma_px, kind.coma()) if kind.coma_px else image
    )


# ---- results --------------------------------------------------------------------------------------------------------


def came_of(shot: DisturbedShot, asked: Target) -> Outcome:
    """The field is found without an initial camera, calibrated, and compared with the truth."""
    length, width = (asked.dimensions[f"field_{side}_m"] for side in ("length", "width"))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 10) * length, np.linspace(-0.5, 0.5, 7) * width)
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    pixels = shot.camera.project(floor)
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(SIZE) - 1.0), axis=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photograph.png"
        cv2.imwrite(str(path), shot.image)
        return outcome(path, asked, AUTO, Places(pixels[inside], floor[inside, :2]))


def disturbed_rows(runs: int, kinds: Sequence[str] = tuple(KINDS)) -> Iterator[Row]:
    """For each kind: share found, time, accuracy, and honesty of the stated accuracy."""
    all_kinds = list[Outcome]()
    for name in kinds:
        kind, every = KINDS[name], list[Outcome]()
        for seed, one in enumerate(over(partial(_disturbed, name), range(runs))):
            every.append(one)
            said = one.why or f"{one.mean_mm:.2f} mm, {one.over_stated:.2f} of stated"
            wrong = f", WRONG BUT TRUSTED ({100.0 * one.beyond:.0f} % beyond)" if one.certified else ""
            print(f"{name} {seed}: {said}, {one.lens} {one.seconds:.1f} s{wrong}", file=sys.stderr)
        yield from _rows(name, every, kind.most_mm)
        all_kinds += [one for one in every if not one.why]
    yield from rows_of_foreseen("all kinds", all_kinds)


def _disturbed(name: str, seed: int) -> Outcome:
    field = targets_by_name()[KINDS[name].field]
    return came_of(taken(name, seed, field), field)


def _rows(name: str, every: Sequence[Outcome], most_mm: float) -> Iterator[Row]:
    found = [one for one in every if not one.why]
    note = f"{len(every)} photographs"
    yield Row(name, "share that is found", len(found) / len(every), least=0.95, note=note)
    slow = float(np.mean([one.seconds > MOST_S for one in every]))
    yield Row(name, f"share that takes more than {MOST_S:.0f} s", slow, most=0.05)
    if not found:
        return
    yield Row(name, "mean error of the map, mm", float(np.mean([one.mean_mm for one in found])), most=most_mm)
    yield Row(name, "the same of the worst, mm", float(np.max([one.mean_mm for one in found])))
    ratios = np.array([one.over_stated for one in found])
    known = ratios[ratios > 0.0]
    ratio = float(np.sqrt(np.mean(known**2))) if len(known) else np.nan
    note = f"{len(ratios) - len(known)} without a statement"
    yield Row(name, "rms error over stated", ratio, 0.0, 1.0 / STATED, STATED, note)
    yield Row(name, "wrong without saying so", int(np.sum(ratios > WRONG)), most=0.0)
    yield from rows_of_foreseen(name, found)
    yield Row(name, "share trusted for something", float(np.mean([one.trusted for one in found])))


# ---- other fields ---------------------------------------------------------------------------------------------------

B = ssl_field("B").dimensions
OTHERS: dict[str, dict[str, float]] = {
    **{
        f"{100.0 * abs(share):.0f} % {'larger' if share > 0.0 else 'smaller'}": {
            name: (1.0 + share) * B[name] for name in ("field_length_m", "field_width_m")
        }
        for share in (-0.08, -0.05, -0.03, 0.03, 0.05, 0.08)
    },
    "5.6 m wide": {"field_width_m": 5.6},
    "6.3 m wide": {"field_width_m": 6.3},
    "other areas": {"penalty_area_depth_m": 1.3, "penalty_area_width_m": 2.6},
}


def other(name: str, seed: int) -> tuple[DisturbedShot, Target]:
    """A photograph of another field, or of none, and the target that is asked for."""
    kind = ("plain", "boundary", "cables", "seams")[seed % 4]
    if name == "B for A":
        return taken(kind, seed, ssl_field("B")), ssl_field("A")
    if name == "A for B":
        return taken(kind, seed, ssl_field("A")), ssl_field("B")
    if name == "none":
        shot = taken("cables", seed, ssl_field("B"))
        rng = np.random.default_rng([29, seed])
        lines = with_cables(with_cables({}, ssl_field("B"), rng), ssl_field("B"), rng)
        scene = field_scene(custom(curves=lines), {"o": shot.camera}, {"o": Station("o", shot.camera.cam_from_world)})
        return replace(shot, image=photograph(scene, "o", "0001", Photography(robots=6), seed).image), ssl_field("B")
    return taken(kind, seed, ssl_field("B", **OTHERS[name])), ssl_field("B")


def wrong_rows(runs: int) -> Iterator[Row]:
    """Photographs of other fields than asked for: all must be refused, or not trusted."""
    names = (*OTHERS, "B for A", "A for B", "none")
    certified: dict[str, list[str]] = {name: [] for name in names}
    asked = [(names[number % len(names)], number // len(names)) for number in range(runs)]
    for (name, seed), came in zip(asked, over(_wrong, *zip(*asked, strict=True)), strict=True):
        print(f"{name} {seed}: {came.why or came.verdict}, {came.seconds:.1f} s", file=sys.stderr)
        if came.trusted:
            certified[name].append(f"{seed}: {came.mean_mm:.0f} mm")
    for name in names[: min(runs, len(names))]:
        yield Row("another field", name, len(certified[name]), most=0.0, note=", ".join(certified[name]))


def _wrong(name: str, seed: int) -> Outcome:
    return came_of(*other(name, seed))
