"""Photographs by another renderer, with their truth: `python scripts/photographs.py --case shared`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from runner import Row, over

from ceres_cal.base.arrays import Array
from ceres_cal.detect.photographs import Auto, Clicks, Facing
from ceres_cal.scene.targets import targets_by_name
from photos.outcomes import MOVED_MM, STATED, USUAL_MM, Outcome, outcome

CLICK_PX = 8.0
CORNERS = (
    *("TopLeftCorner", "BottomLeftCorner", "TopRightCorner", "BottomRightCorner"),
    *("BottomHalfwayCrossing", "TopHalfwayCrossing"),
)
ALLOWED_MM = {"combo": MOVED_MM, "camera": MOVED_MM}  # by kind


@dataclass(frozen=True, eq=False)
class Known:
    """A photograph and what is known of it."""

    path: Path
    truth: dict[str, Any]

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def is_wrong(self) -> bool:
        """Whether it shows another field than the one that is asked for."""
        return self.name.startswith("wrong")

    def floor(self, height: str = "field_m_at_0_mm") -> tuple[Array, Array]:
        """Pixels (N, 2) that show the field, and where on it they lie, m."""
        rows = [
            (pixel, place)
            for pixel, place in zip(self.truth["pixels"], self.truth[height], strict=True)
            if place is not None
        ]
        pixels, places = (np.array(one, dtype=float) for one in zip(*rows, strict=True))
        painted = self.truth["field_as_painted"]
        inside = np.all(np.abs(places) <= 0.5 * np.array([painted["L"], painted["W"]]), axis=1)
        return pixels[inside], places[inside]

    def clicks(self) -> Clicks:
        """Four corners, or crossings where those are not in the picture, clicked roughly."""
        rng = np.random.default_rng([5, sum(map(ord, self.name))])
        corners = self.truth["corners_px"]
        names = max(
            combinations([name for name in CORNERS if name in corners], 4), key=lambda four: spread(corners, four)
        )
        return Clicks({name: tuple(np.array(corners[name]) + rng.normal(0.0, CLICK_PX, 2)) for name in names})


def spread(corners: Mapping[str, Sequence[float]], names: Sequence[str]) -> float:
    """The least area of three of these points, px^2."""
    areas = [
        np.linalg.det(np.column_stack([[corners[name] for name in three], np.ones(3)]))
        for three in combinations(names, 3)
    ]
    return float(np.min(np.abs(areas)))


def known_photographs(folder: Path) -> list[Known]:
    """Those of a folder that have a truth beside them."""
    known = []
    for path in sorted(folder.glob("*.truth.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        known.append(Known(folder / truth["picture"], truth))
    return known


def shared_rows(folder: Path) -> Iterator[Row]:
    """Every photograph without a start and from four rough clicks; other fields must be refused."""
    asked = [(shown, how) for shown in known_photographs(folder) for how in ("auto", "clicks")]
    for (shown, how), came in zip(asked, over(_came_of, *zip(*asked, strict=True)), strict=True):
        yield from _rows(shown, how, came)


def _came_of(shown: Known, how: str) -> Outcome:
    start = shown.clicks() if how == "clicks" else Auto((Facing(*shown.truth["facing"].split("=")),))
    return outcome(shown.path, targets_by_name()[shown.truth["asked_as"]], start, shown.floor())


def _rows(shown: Known, how: str, came: Outcome) -> Iterator[Row]:
    case, refused = f"{shown.name}, {how}", float(bool(came.why))
    note = f"{came.seconds:.1f} s, {came.lens}"
    if came.why:
        print(f"{case}: {came.why}", file=sys.stderr)
    if shown.is_wrong:
        yield Row(case, "refused", refused, least=1.0, note=note)
        return
    yield Row(case, "found", 1.0 - refused, least=1.0, note=note)
    if not came.why:
        most = ALLOWED_MM.get(shown.truth["kind"], USUAL_MM)
        yield Row(case, "mean error of the map, mm", came.mean_mm, most=most, note=f"median {came.median_mm:.2f} mm")
        yield Row(case, "rms error over stated", came.over_stated, least=1.0 / STATED, most=STATED)
