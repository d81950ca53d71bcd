"""Photographs by another renderer, with their truth: `python scripts/photographs.py --case shared`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from runner import Row, over
from scipy.interpolate import griddata

from ceres_cal.detect.photographs import Auto, Clicks, Facing
from ceres_cal.scene.targets import targets_by_name
from photos.outcomes import MOST_BEYOND, MOVED_MM, STATED, USUAL_MM, Outcome, Places, outcome, rows_of_foreseen

CLICK_PX = 8.0
_CORNERS = (
    *("TopLeftCorner", "BottomLeftCorner", "TopRightCorner", "BottomRightCorner"),
    *("BottomHalfwayCrossing", "TopHalfwayCrossing"),
)
_SEEN = {0.0: "field_m_at_0_mm", 0.15: "field_m_at_150_mm"}  # height, m -> its places in the truth
_LEAST_AREA = 0.01  # share of the picture, for the triangle of any three clicked places
_SOUND = 0.9  # share of correct calibrations that must be trusted for something
ALLOWED_MM = {"combo": MOVED_MM, "camera": MOVED_MM}  # by kind


@dataclass(frozen=True, eq=False)
class KnownPhotograph:
    """A photograph and its truth."""

    path: Path
    truth: dict[str, Any]

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def is_wrong(self) -> bool:
        """Whether it shows another field than the one that is asked for."""
        return bool(self.truth["kind"].startswith("wrong"))

    @property
    def ways(self) -> tuple[str, ...]:
        """Possible kinds of start. A mirrored picture can only be noticed with corners, so "auto" is left out for it;
        "clicks" needs four corners with a name in the picture.
        """
        mirrored = "mirrored" in self.truth.get("what", "")
        return (*(() if mirrored else ("auto",)), *(("clicks",) if self._shown else ()))

    @property
    def floor(self) -> Places:
        """What shows the field."""
        return self._part(0.0, inside=True)

    @property
    def outside(self) -> tuple[Places, ...]:
        """What shows anything beside the field, on the floor and above it."""
        return tuple(self._part(height_m, inside=False) for height_m in _SEEN)

    def _part(self, height_m: float, inside: bool) -> Places:
        pixels, places = (np.array(one, dtype=float) for one in self._seen(_SEEN[height_m]))
        painted = self.truth["field_as_painted"]
        own = np.all(np.abs(places) <= 0.5 * np.array([painted["L"], painted["W"]]), axis=1) == inside
        return Places(pixels[own], places[own], height_m)

    def _seen(self, height: str) -> tuple[Any, ...]:
        every = zip(self.truth["pixels"], self.truth[height], strict=True)
        return tuple(zip(*((pixel, place) for pixel, place in every if place is not None), strict=True))

    @cached_property
    def _shown(self) -> tuple[str, ...]:
        """Names of four corners or crossings, well apart; those of the outline where they are in the picture."""
        corners, target = self.truth["corners_px"], targets_by_name()[self.truth["asked_as"]]
        if sum(name in corners for name in _CORNERS) < 4:
            pixels, places = (np.array(one) for one in self._seen(_SEEN[0.0]))
            there = griddata(places, pixels, target.point_array[:, :2])
            corners |= {
                name: pixel.tolist()
                for name, pixel in zip(target.point_names, there, strict=True)
                if np.all((pixel > 0.0) & (pixel < self.truth["image_size"]))
            }
        names = [name for name in _CORNERS if name in corners]
        fours = list(combinations(names if len(names) >= 4 else corners, 4))
        best = max(fours, key=lambda four: spread(corners, four), default=())
        least = 2.0 * _LEAST_AREA * float(np.prod(self.truth["image_size"]))
        return best if best and spread(corners, best) > least else ()

    def clicks(self) -> Clicks:
        """These corners, clicked with random errors."""
        rng = np.random.default_rng([5, sum(map(ord, self.name))])
        corners = self.truth["corners_px"]
        return Clicks({name: tuple(np.array(corners[name]) + rng.normal(0.0, CLICK_PX, 2)) for name in self._shown})


def spread(corners: Mapping[str, Sequence[float]], names: Sequence[str]) -> float:
    """The smallest area of a triangle of these points, times two, px^2."""
    areas = [
        np.linalg.det(np.column_stack([[corners[name] for name in three], np.ones(3)]))
        for three in combinations(names, 3)
    ]
    return float(np.min(np.abs(areas)))


def known_photographs(folder: Path) -> list[KnownPhotograph]:
    """The photographs of a folder that have a truth beside them."""
    known = []
    for path in sorted(folder.glob("*.truth.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        known.append(KnownPhotograph(folder / truth["picture"], truth))
    return known


def shared_rows(folders: Iterable[Path]) -> Iterator[Row]:
    """Every photograph without a start and from four rough clicks; other fields must be refused or not trusted."""
    every = [shown for folder in folders for shown in known_photographs(folder)]
    asked = [(shown, how) for shown in every for how in shown.ways]
    found: dict[str, list[Outcome]] = {}
    for (shown, how), came in zip(asked, over(came_of_known, *zip(*asked, strict=True)), strict=True):
        yield from _rows(shown, how, came)
        if not shown.is_wrong:
            found.setdefault(shown.name, []).append(came)
    yield from _of_all(found)


def came_of_known(shown: KnownPhotograph, how: str) -> Outcome:
    """Result for one photograph, started by "auto" or by "clicks"."""
    start = shown.clicks() if how == "clicks" else Auto((Facing(*shown.truth["facing"].split("=")),))
    return outcome(shown.path, targets_by_name()[shown.truth["asked_as"]], start, shown.floor, outside=shown.outside)


def _rows(shown: KnownPhotograph, how: str, came: Outcome) -> Iterator[Row]:
    case = f"{shown.name}, {how}"
    note = f"{came.seconds:.1f} s, {came.lens}"
    print(f"{case}: {came.why or came.verdict}", file=sys.stderr)
    if shown.is_wrong:
        yield Row(case, "refused, or not trusted", float(not came.trusted), least=1.0, note=note)
        return
    yield Row(case, "found", float(not came.why), least=1.0, note=note)
    if not came.why:
        most = ALLOWED_MM.get(shown.truth["kind"], USUAL_MM)
        yield Row(case, "mean error of the map, mm", came.mean_mm, most=most, note=f"median {came.median_mm:.2f} mm")
        yield Row(case, "rms error over stated", came.over_stated, least=1.0 / STATED, most=STATED)
        note = "trusted" if came.trusted else "not trusted"
        yield Row(case, "share far beyond its 95 % radius", came.beyond, most=MOST_BEYOND, note=note)
        if came.beyond_outside >= 0.0:
            what = "share far beyond its 95 % radius, outside the field"
            yield Row(case, what, came.beyond_outside, most=MOST_BEYOND, note=note)


def _of_all(found: Mapping[str, Sequence[Outcome]]) -> Iterator[Row]:
    note = f"{len(found)} photographs"
    both = float(np.mean([not any(one.why for one in ways) for ways in found.values()]))
    yield Row("all photographs", "share found in every way", both, least=0.95, note=note)
    every = [one for ways in found.values() for one in ways if not one.why]
    ratios = np.sqrt(np.mean([one.over_stated**2 for one in every if np.isfinite(one.stated_mm)]))
    yield Row("all photographs", "rms error over stated", float(ratios), least=1.0 / STATED, most=STATED)
    yield Row("all photographs", "wrong, but trusted", sum(one.certified for one in every), most=0.0)
    once = [next(one for one in ways if not one.why) for ways in found.values() if not all(one.why for one in ways)]
    yield from rows_of_foreseen("each once", once)  # both ways of a photograph have the same error
    sound = [one for one in every if not one.beyond > MOST_BEYOND and one.mean_mm < MOVED_MM]
    trusted = float(np.mean([one.trusted for one in sound]))
    yield Row("sound", "share trusted for something", trusted, least=_SOUND, note=f"{len(sound)} calibrations")
