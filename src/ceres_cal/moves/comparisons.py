"""The differences of two calibrations: on the field, over the image, between the cameras' poses, and whether their
uncertainties explain them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from ceres_cal.base import Array, InputError, grid_places, median, nearest_rotation, numerical, rotation_log, upper_tail
from ceres_cal.base.typed import checked
from ceres_cal.calibration import Calibration
from ceres_cal.moves.agreement import (
    FALSE_ALARMS,
    Agreement,
    Agreements,
    ImageDifference,
    NormalDistribution,
    change_of,
    contrast,
)
from ceres_cal.posterior import FieldGrid, field_grid, field_map
from ceres_cal.problem import EXACT, Estimate, Key, difference


@checked
@numerical("the comparison")
def compare(a: Calibration, b: Calibration, height_m: float = 0.0, station: str | None = None) -> Agreements:
    """Compare two calibrations, station by station: those with the same name, or the only one of each.

    The two count as independent. Where b is a refit of a, they share prior knowledge, and the expected difference is
    smaller than stated.

    Raises:
        InputError: no station that both have, or not the one named; no field to draw a map of.
    """
    pairs = _pairs("station", list(a.stations), list(b.stations), station)
    return Agreements({name: _compared(a, b, name, other, height_m) for name, other in pairs}, FALSE_ALARMS)


def _pairs(kind: str, first: Sequence[str], second: Sequence[str], asked: str | None) -> list[tuple[str, str]]:
    """Return pairs with the same name in both, or the only one of each; all pairs, or the one asked for."""
    pairs = [(name, name) for name in first if name in second]
    if not pairs and len(first) == len(second) == 1:
        pairs = [(first[0], second[0])]
    pairs = [pair for pair in pairs if asked in (None, pair[0])]
    if not pairs:
        which = f"no {kind} is" if asked is None else f"{kind} {asked!r} is not"
        raise InputError(f"{which} in both calibrations: one has {_listed(first)}, the other {_listed(second)}")
    return pairs


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names)) or "none"


def _compared(a: Calibration, b: Calibration, station: str, other: str, height_m: float) -> Agreement:
    grid, both = FieldGrid(height_m, *field_grid(a.targets)), ((a, station), (b, other))
    known = [(c, name) for c, name in both if c.posterior is not None and c.posterior.knows_station(name)]

    def expected_mm(grid: FieldGrid) -> Array:
        maps = [field_map(c.estimate, c.uncertainty.posterior, name, grid).sd_mm for c, name in known]
        return np.asarray(np.hypot(*maps))

    expected = expected_mm if len(known) == 2 else None
    change = change_of(a.estimate, station, b.station(other), [grid], expected)
    if len(known) < 2 or station != other:
        return Agreement(name=station, change=change, solution=b)
    keys, others = (c.uncertainty.posterior.keys_of(c.estimate, name) for c, name in known)
    tested = _tested(a, b, _only(a, station), _only(b, station), keys, others)
    return Agreement(name=station, change=change, solution=b, **tested)


def _tested(
    a: Calibration, b: Calibration, one: Estimate, other: Estimate, keys: Sequence[Key], others: Collection[Key]
) -> dict[str, Any]:
    """Return `holds`, probability, statistic and degrees of an answer: whether a and b contradict each other in `one`
    and `other`, the parts that are compared. The result is empty where these have another lens or other free numbers,
    or share none.
    """
    lenses = [[(camera.lens.kind, camera.lens.names) for camera in part.cameras.values()] for part in (one, other)]
    if set(keys) != set(others) or not keys or lenses[0] != lenses[1]:
        return {}
    off = difference(other, one, keys)
    first, second = (c.uncertainty.posterior for c in (a, b))
    apart = contrast(
        NormalDistribution(first.normal.marginal(keys), np.zeros(len(keys)), first.degrees_of_freedom),
        NormalDistribution(second.normal.marginal(keys), -off, second.degrees_of_freedom),
        keys,
    )
    if not apart.degrees:
        return {}
    probability = upper_tail(apart.statistic, apart.degrees)
    holds = probability >= FALSE_ALARMS
    return {"holds": holds, "probability": probability, "statistic": apart.statistic, "degrees": apart.degrees}


def _only(calibration: Calibration, station: str) -> Estimate:
    """Return one station and its camera."""
    old = calibration.estimate
    camera = old.stations[station].camera
    return Estimate({camera: old.cameras[camera]}, {station: old.stations[station]}, {}, old.structure)


# ---- over the image -------------------------------------------------------------------------------------------------


def compare_cameras(
    a: Calibration, b: Calibration, camera: str | None = None, *, without_turn: bool = False
) -> Agreements:
    """Compare the intrinsics of two calibrations, camera by camera; no field is needed.

    Args:
        camera: only this camera, by its name in both; by default all that both have, or the only one of each.
        without_turn: whether to subtract the rotation on which most directions agree: another principal point looks
            much like a turned camera.

    Raises:
        InputError: no camera that both have, or not the one named; images of other sizes.
    """
    pairs = _pairs("camera", list(a.cameras), list(b.cameras), camera)
    return Agreements({name: _camera_compared(a, b, name, other, without_turn) for name, other in pairs}, FALSE_ALARMS)


def _camera_compared(a: Calibration, b: Calibration, name: str, other: str, without_turn: bool) -> Agreement:
    columns = 41  # of the grid over an image
    first, second = a.cameras[name], b.cameras[other]
    if first.image_size != second.image_size:
        sizes = " and ".join(f"{w} x {h} px" for w, h in (first.image_size, second.image_size))
        raise InputError(f"camera {name!r}: its images are of {sizes}: give calibrations with images of one size")
    width, height = first.image_size
    x, y = (np.linspace(0.0, n - 1.0, max(2, round(columns * n / width))) for n in (width, height))
    pixels = grid_places(x, y)
    seen, also = first.rays(pixels), second.rays(pixels)
    both = np.isfinite(seen[:, 0]) & np.isfinite(also[:, 0])
    turn = _common_turn(seen[both], also[both]) if without_turn else np.eye(3)
    turned = seen @ turn.T
    angles = 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(turned - also, axis=1), 0.0, 1.0))
    grid = len(y), len(x)
    image = ImageDifference(
        (first.phi, second.phi),
        x,
        y,
        (second.project(turned) - pixels).reshape(*grid, 2),
        np.degrees(angles).reshape(grid),
        float(np.degrees(np.linalg.norm(rotation_log(turn)))),
    )
    tested = _intrinsics_tested(a, b, name) if name == other else {}
    return Agreement(name=name, image=image, solution=b, **tested)


def _common_turn(seen: Array, also: Array) -> Array:
    """(3, 3) rotation on which most of the directions (N, 3) agree, by Cauchy's weights at the median: lenses differ
    most in corners that nobody observed.
    """
    rounds = 20  # of reweighting
    turn = np.eye(3)
    for _ in range(rounds):
        away = np.linalg.norm(seen @ turn.T - also, axis=1)
        weights = 1.0 / (1.0 + (away / max(median(away), 1e-15)) ** 2)
        turn = nearest_rotation((also * weights[:, None]).T @ seen)
    return turn


def _intrinsics_tested(a: Calibration, b: Calibration, camera: str) -> dict[str, Any]:
    if a.posterior is None or b.posterior is None:
        return {}
    keys, others = ([key for key in c.uncertainty.posterior.keys if key[:2] == ("camera", camera)] for c in (a, b))
    first, second = (Estimate({camera: c.cameras[camera]}, {}, {}, EXACT) for c in (a, b))
    return _tested(a, b, first, second, keys, others)
