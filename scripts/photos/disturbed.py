"""Small photographs with what stands, lies and shines on other people's floors, and of other fields than those asked
for: `python scripts/photographs.py --case disturbed --case wrong --runs N`.
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
from msgspec import structs
from rendering.photograph import photograph
from runner import Row, over

from ceres_cal.base.arrays import Image8
from ceres_cal.detect.photographs import Auto, Facing
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import Arc, Curve, Segment
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial
from ceres_cal.scene.targets import Target, custom, ssl_field
from ceres_cal.simulate import Photography, Station, field_scene, overhead_pose
from photos.outcomes import MOVED_MM, STATED, USUAL_MM, WRONG, Outcome, outcome

SIZE = (780, 580)
MOST_S = 15.0
AUTO = Auto((Facing("LeftGoalLine", "left"),))
LENSES: dict[str, tuple[float, Lens]] = {
    "radial 2,3": (345.0, Radial((-1.1e-4, 1.6e-6), (2, 3))),
    "radial 3,5": (345.0, Radial((1.0e-6, 1.4e-12), (3, 5))),
    "brown": (350.0, Brown((-0.17, 0.03, 4e-4, -3e-4, -0.002))),
    "kannala-brandt": (330.0, KannalaBrandt((-0.012, 0.004, -0.003, 0.0006))),
    "fisheye": (300.0, KannalaBrandt((-0.03, 0.002, 0.0, 0.0))),
}


@dataclass(frozen=True, eq=False)
class Taken:
    """A photograph, the camera that took it, and the field that is painted in it."""

    camera: Camera
    painted: Target
    image: Image8


# ---- what is painted ------------------------------------------------------------------------------------------------


def with_boundary(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """A line around the field."""
    length, width = field.dimensions["field_length_m"], field.dimensions["field_width_m"]
    x, y = np.array([length, width]) / 2.0 + rng.uniform(0.15, 0.4)
    corners: list[tuple[float, float, float]] = [(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)]
    sides = zip(corners, [*corners[1:], corners[0]], strict=True)
    return curves | {f"boundary {n}": Segment(a, b, rng.uniform(0.015, 0.025)) for n, (a, b) in enumerate(sides)}


def with_cables(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """White cables across the field: straight ones, and arcs of large circles."""
    cables: dict[str, Curve] = {}
    for number in range(int(rng.integers(2, 5))):
        middle, direction = rng.uniform((-3.5, -2.2), (3.5, 2.2)), rng.uniform(0.0, np.pi)
        way = np.array([np.cos(direction), np.sin(direction)])
        half = rng.uniform(1.5, 4.0)
        if number % 2:
            a, b = middle - half * way, middle + half * way
            cables[f"cable {number}"] = Segment((a[0], a[1], 0.0), (b[0], b[1], 0.0), 0.012)
        else:
            radius = rng.uniform(6.0, 20.0)
            centre = middle + radius * np.array([-way[1], way[0]])
            turn, span = float(np.arctan2(-way[0], way[1])), half / radius
            here = (float(centre[0]), float(centre[1]), 0.0)
            cables[f"cable {number}"] = Arc(here, radius, turn - span, turn + span, 0.012)
    return curves | cables


def worn(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """A third to a half of every line is gone, piece by piece."""
    kept: dict[str, Curve] = {}
    share = rng.uniform(0.5, 0.7)
    for name, curve in curves.items():
        at, number = 0.0, 0
        low, high = curve.parameter_range
        while at < 1.0:
            on, off = rng.exponential(0.35 * share, 2) * (1.0, (1.0 - share) / share) / curve.length_m + 0.02
            first, last = low + (high - low) * np.array([at, min(at + on, 1.0)])
            kept[f"{name} {number}"] = _part(curve, float(first), float(last))
            at, number = at + on + off, number + 1
    return kept


def _part(curve: Curve, first: float, last: float) -> Curve:
    if isinstance(curve, Arc):
        return structs.replace(curve, from_rad=first, to_rad=last)
    a, b = np.array(curve.start), np.array(curve.end)
    start, end = a + first * (b - a), a + last * (b - a)
    return structs.replace(curve, start=tuple(start.tolist()), end=tuple(end.tolist()))


def askew(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """Three lines 15 to 30 mm aside."""
    moved = dict(curves)
    names = [name for name, curve in curves.items() if isinstance(curve, Segment)]
    for name in rng.choice(names, 3, replace=False):
        line = curves[name]
        assert isinstance(line, Segment)
        along = np.subtract(line.end, line.start) / line.length_m
        off = rng.choice([-1.0, 1.0]) * rng.uniform(0.015, 0.03) * np.array([-along[1], along[0], 0.0])
        start, end = (tuple((np.array(one) + off).tolist()) for one in (line.start, line.end))
        moved[str(name)] = structs.replace(line, start=start, end=end)
    return moved


Painter = Callable[[dict[str, Curve], Target, np.random.Generator], dict[str, Curve]]


@dataclass(frozen=True)
class Kind:
    """What is painted besides or otherwise, how it is taken, and by which lenses; `most_mm` of mean error."""

    painter: Painter | None = None
    how: Callable[[Photography, np.random.Generator], Photography] = lambda how, rng: how
    most_mm: float = USUAL_MM
    lenses: tuple[str, ...] = tuple(LENSES)[:4]


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
}


def taken(name: str, seed: int, field: Target) -> Taken:
    """Photograph number `seed` of a kind, of this field."""
    kind = KINDS[name]
    rng = np.random.default_rng([23, seed, *name.encode()])
    phi, lens = LENSES[kind.lenses[seed % len(kind.lenses)]]
    middle = 0.5 * (np.array(SIZE) - 1.0) + rng.normal(0.0, 5.0, 2)
    size = field.dimensions["field_length_m"] / 9.0
    x, y, height = rng.normal(0.0, 0.2), rng.normal(0.0, 0.2), size * rng.uniform(4.7, 5.6)
    tilt_x, tilt_y, yaw = rng.uniform(-8.0, 8.0, 3)
    pose = overhead_pose(x, y, height, tilt_x, tilt_y, yaw)
    camera = Camera(SIZE, phi * rng.uniform(0.97, 1.03), (float(middle[0]), float(middle[1])), lens, 1.0, pose)
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
    return Taken(camera, painted, photograph(scene, "overhead", "0001", how, seed).image)


# ---- what comes of it -----------------------------------------------------------------------------------------------


def came_of(shot: Taken, asked: Target) -> Outcome:
    """Found without a start, calibrated, and compared with the truth."""
    length, width = (asked.dimensions[f"field_{side}_m"] for side in ("length", "width"))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 10) * length, np.linspace(-0.5, 0.5, 7) * width)
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    pixels = shot.camera.project(floor)
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(SIZE) - 1.0), axis=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photograph.png"
        cv2.imwrite(str(path), shot.image)
        return outcome(path, asked, AUTO, (pixels[inside], floor[inside, :2]))


def disturbed_rows(runs: int) -> Iterator[Row]:
    """Each kind: how many are found, in time, how well, and whether the statement holds."""
    for name, kind in KINDS.items():
        every = []
        for seed, one in enumerate(over(partial(_disturbed, name), range(runs))):
            every.append(one)
            said = one.why or f"{one.mean_mm:.2f} mm, {one.over_stated:.2f} of stated"
            print(f"{name} {seed}: {said}, {one.lens} {one.seconds:.1f} s", file=sys.stderr)
        yield from _rows(name, every, kind.most_mm)


def _disturbed(name: str, seed: int) -> Outcome:
    return came_of(taken(name, seed, ssl_field("B")), ssl_field("B"))


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


def other(name: str, seed: int) -> tuple[Taken, Target]:
    """A photograph of another field, or of none, and what is asked for."""
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
    """Other fields than the one that is asked for: none may be certified."""
    names = (*OTHERS, "B for A", "A for B", "none")
    certified: dict[str, list[str]] = {name: [] for name in names}
    asked = [(names[number % len(names)], number // len(names)) for number in range(runs)]
    for (name, seed), came in zip(asked, over(_wrong, *zip(*asked, strict=True)), strict=True):
        print(f"{name} {seed}: {came.why or 'CERTIFIED'}, {came.seconds:.1f} s", file=sys.stderr)
        if not came.why:
            certified[name].append(f"{seed}: {came.mean_mm:.0f} mm")
    for name in names[: min(runs, len(names))]:
        yield Row("another field", name, len(certified[name]), most=0.0, note=", ".join(certified[name]))


def _wrong(name: str, seed: int) -> Outcome:
    return came_of(*other(name, seed))
