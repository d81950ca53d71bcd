"""What could be wrong with the model, as columns over the equations: lens, target as built, camera that moved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.transforms import skew
from ceres_cal.diagnostics.equations import Equations
from ceres_cal.diagnostics.linear_model import structure_columns
from ceres_cal.diagnostics.scores import Family
from ceres_cal.model.parameters import Estimate, Layout, unit_px
from ceres_cal.model.structure import Tolerance, make_structure
from ceres_cal.observations import Observations
from ceres_cal.scene.targets import Target
from ceres_cal.solve import Problem

_RADIAL_BASIS = 3  # powers of the radius past those of the lens: enough for any smooth trend that one more power mends
# Observations that say whether a curve lies aside: three numbers of an arc, and as many left to contradict them.
# Nothing changes from half to double.
_FEWEST_ON_CURVE = 8
# Observations that say whether a point lies aside: one could be an outlier that was just not taken out. Nothing
# changes from half to double.
_FEWEST_OF_POINT = 2


def all_families(
    observations: Observations, equations: Equations, estimate: Estimate, problem: Problem, used: Mask
) -> list[Family]:
    """Every alternative worth a test, by kind."""
    return [
        *_lens_families(equations, estimate, problem.layout),
        *target_families(observations, equations, estimate, used),
        *_frame_families(observations, equations, estimate, problem.private),
    ]


# ---- the lens -------------------------------------------------------------------------------------------------------


def _lens_families(equations: Equations, estimate: Estimate, layout: Layout) -> Iterator[Family]:
    """Radial polynomial, decentring, and each number that is held."""
    names = tuple(estimate.cameras)
    owner = _camera_of(equations, names)
    radial, decentring = np.zeros((len(equations), _RADIAL_BASIS)), np.zeros((len(equations), 2))
    open_lens = np.full(len(equations), -1)
    for number, name in enumerate(names):
        own = owner == number
        for k, power in enumerate(missing_powers(estimate, layout, name)[:_RADIAL_BASIS]):
            radial[own, k] = radial_column(equations, estimate, name, power)[own]
        if not _has_decentring(estimate, layout, name):
            decentring[own] = _decentring_columns(equations, estimate, name)[own]
            open_lens[own] = number
    yield Family("radius", radial, owner, names)
    yield Family("decentring", decentring, open_lens, names)
    for kind, places in (("aspect", [1]), ("principal point", [2, 3]), ("phi", [0])):
        held = np.array([not set(places) & set(layout.free[name].tolist()) for name in names])
        group = np.where(held[owner], owner, -1)
        yield Family(kind, equations.intrinsics[:, places], group, names, units=("",) if kind == "aspect" else ("px",))


def _camera_of(equations: Equations, names: tuple[str, ...]) -> Indices:
    """(E,) number of each equation's camera."""
    of_sight = np.array([names.index(key.camera) for key in equations.sights.keys])
    return np.asarray(of_sight[equations.sight])


def missing_powers(estimate: Estimate, layout: Layout, camera: str) -> list[int]:
    """Powers of the radius that the lens does not solve for, lowest first."""
    lens = estimate.cameras[camera].lens
    free = [int(i) - 4 for i in layout.free[camera] if i >= 4]
    solved = {lens.orders[i] for i in free if lens.names[i] not in lens.decentring}
    return [power for power in lens.missing_powers if power not in solved]


def _offsets(equations: Equations, estimate: Estimate, camera: str) -> Array:
    """(E, 2) of every predicted pixel from the principal point, in half image diagonals."""
    one = estimate.cameras[camera]
    return one.offsets(equations.pixel) / unit_px(one)


def radial_column(equations: Equations, estimate: Estimate, camera: str, power: int) -> Array:
    """(E,) px per unit of a coefficient more in the lens's polynomial, scaled to be of order one."""
    one = estimate.cameras[camera]
    offsets = _offsets(equations, estimate, camera)
    radius = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    outward = np.sum(equations.direction * offsets * (1.0, one.aspect), axis=1) / radius
    growth = one.lens.radial_change(one.offsets(equations.pixel), one.phi, unit_px(one), power)
    return np.asarray(outward * growth)


def _has_decentring(estimate: Estimate, layout: Layout, camera: str) -> bool:
    lens, free = estimate.cameras[camera].lens, layout.free[camera].tolist()
    return bool(lens.decentring) and all(4 + lens.names.index(name) in free for name in lens.decentring)


def _decentring_columns(equations: Equations, estimate: Estimate, camera: str) -> Array:
    """(E, 2) px of Brown's tangential displacements, 1 px at half the image diagonal."""
    x, y = _offsets(equations, estimate, camera).T
    r2 = x * x + y * y
    first = np.column_stack([2.0 * x * y, r2 + 2.0 * y * y])
    second = np.column_stack([r2 + 2.0 * x * x, 2.0 * x * y])
    return np.column_stack([np.sum(equations.direction * field, axis=1) for field in (first, second)])


# ---- the target as built --------------------------------------------------------------------------------------------


def target_families(
    observations: Observations, equations: Equations, estimate: Estimate, used: Mask
) -> Iterator[Family]:
    """Each line, arc and point aside, each board bent, of which enough is used; not what a tolerance solves for."""
    targets = observations.targets
    structure = make_structure(targets, {name: _everything(target) for name, target in targets.items()})
    slots, values = structure_columns(equations, structure)
    solved = _solved_slots(equations, estimate)
    curves, points = equations.is_curve, ~equations.is_curve
    for kind, rows, places, fewest in (
        ("curve aside", curves, slice(0, 3), _FEWEST_ON_CURVE),
        ("point aside", points, slice(0, 2), 2 * _FEWEST_OF_POINT),
        ("board bent", points, slice(2, 4), 2 * _FEWEST_OF_POINT),
    ):
        first = slots[:, places.start]
        there = rows & (first >= 0) & ~solved[:, places.start]
        numbers, group = _numbered(first, there)
        counts = np.bincount(group[there & used], minlength=len(numbers))
        group = np.where((group >= 0) & (counts[group] >= fewest), group, -1) if len(numbers) else group
        names = tuple(_feature_of(structure.names[number]) for number in numbers)
        yield Family(kind, values[:, places], group, names, units=("m",) * (places.stop - places.start))


def _everything(target: Target) -> Tolerance:
    return Tolerance(1.0, 1.0, 1.0 if target.bows else 0.0)


def _feature_of(name: str) -> str:
    """field/CenterCircle.x -> field/CenterCircle"""
    for ending in (".x", ".y"):
        name = name.removesuffix(ending)
    return name.removesuffix("/bow")


def _solved_slots(equations: Equations, estimate: Estimate) -> Mask:
    """(E, 4) whether the calibration solved for what moves an equation, as in `structure_columns`."""
    if not len(estimate.structure.values):
        return np.zeros((len(equations), 4), dtype=bool)
    return structure_columns(equations, estimate.structure)[0] >= 0


def _numbered(values: Indices, rows: Mask) -> tuple[Indices, Indices]:
    """The different values in the chosen rows, and which of them each row (N,) has, -1 for the others."""
    numbers, inverse = np.unique(values[rows], return_inverse=True)
    group = np.full(len(values), -1)
    group[rows] = inverse
    return numbers, group


# ---- a camera that moved --------------------------------------------------------------------------------------------


def _frame_families(
    observations: Observations, equations: Equations, estimate: Estimate, private: frozenset[str | None]
) -> Iterator[Family]:
    """Each station moved from some frame on, or in one frame alone: turned about the camera's axes, shifted in the
    world.
    """
    order = frame_order(observations)
    frame = np.array([order[view.station][view.frame] for view in observations.views])[equations.view]
    several = np.array([_several_frames(equations, frame, i) for i in range(len(equations.sights))])
    tied = np.array([key.placement not in private for key in equations.sights.keys])
    for station, frames in order.items():
        own = equations.of_sights(
            np.array([key.station == station for key in equations.sights.keys]) & (tied | several)
        )
        present, group = _numbered(frame, own)
        if len(present) < 2:
            continue
        columns = motion_columns(equations, estimate)
        names = tuple(f"{station}\n{tuple(frames)[number]}" for number in present)
        units = ("rad",) * 3 + ("m",) * 3
        yield Family("moved after", columns, group, names, onwards=True, units=units)
        if len(present) > 2:  # the first or last alone is the same as from there on
            inner = np.where((group > 0) & (group < len(present) - 1), group, -1)
            yield Family("moved in", columns, inner, names, units=units)


def frame_order(observations: Observations) -> Mapping[str, Mapping[str, int]]:
    """Station -> its frames in order of appearance, numbered."""
    order: dict[str, dict[str, int]] = {}
    for view in observations.views:
        frames = order.setdefault(view.station, {})
        frames.setdefault(view.frame, len(frames))
    return order


def _several_frames(equations: Equations, frame: Indices, sight: int) -> bool:
    own = frame[equations.bounds[sight] : equations.bounds[sight + 1]]
    return bool(np.any(own != own[0]))


def motion_columns(equations: Equations, estimate: Estimate) -> Array:
    """(E, 6) px per radian about the camera's axes through its own position, and per metre along the world's."""
    columns = np.empty((len(equations), 6))
    for number, key in enumerate(equations.sights.keys):
        here = slice(equations.bounds[number], equations.bounds[number + 1])
        turned = equations.motion[here] @ -skew(equations.poses[number, :, 3])
        columns[here, :3] = equations.pose[here, :3] + turned
        columns[here, 3:] = -equations.motion[here] @ estimate.stations[key.station].cam_from_world.rotation
    return columns
