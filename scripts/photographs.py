"""Accuracy of measurements in photographs: python scripts/photographs.py [--help]

The photographs are rendered with varied lenses, light, blur, wear and robots, and with known truth; one is real. Every
figure is printed beside its limit. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from pathlib import Path

from photos.auto import auto_rows, real_auto_rows
from photos.disturbed import KINDS, disturbed_rows, wrong_rows
from photos.real_data import real_folder
from photos.shared import shared_rows
from photos.shots import floor_rows, line_figures, real_rows, rings_rows, speed_rows, start_rows
from photos.straightness import all_straight_rows
from photos.templates import template_rows
from runner import Row, measured, parser

SHARED = sorted(Path(os.environ.get("CERES_CAL_SHARED", Path(__file__).parents[2] / "shared")).glob("photos*"))
CASES = (
    *("lines", "floor", "starts", "auto", "speed", "rings", "real", "straight", "shared"),
    *("disturbed", "wrong", "templates"),
)


def cases(real: Path | None, picture: Path | None, kinds: Sequence[str]) -> dict[str, Callable[[int], Iterable[Row]]]:
    """Cases by name; those with real photographs only where these exist."""
    own: dict[str, Callable[[int], Iterable[Row]]] = {
        "lines": lambda runs: line_figures(range(runs)),
        "floor": floor_rows,
        "starts": start_rows,
        "auto": lambda runs: chain(auto_rows(runs), real_auto_rows(real) if real is not None else ()),
        "speed": lambda runs: speed_rows(min(runs, 20)),
        "rings": lambda runs: rings_rows(min(runs, 20)),
        "disturbed": lambda runs: disturbed_rows(runs, kinds),
        "wrong": wrong_rows,
        "templates": lambda runs: template_rows(min(runs, 20)),
    }
    if real is not None:
        own["real"] = lambda runs: real_rows(real, picture)
        own["straight"] = lambda runs: all_straight_rows(real)
    if SHARED:
        own["shared"] = lambda runs: shared_rows(SHARED)
    return own


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__, (200, "photographs of each case"), CASES)
    options.add_argument("--real", type=Path, default=os.environ.get("CERES_CAL_REAL"), help="folder of real images")
    options.add_argument("--kind", nargs="+", choices=KINDS, default=[*KINDS], help="of disturbed ones (default all)")
    options.add_argument("--picture", type=Path, help="draw what was found in the real photograph into this file")
    given = options.parse_args(arguments)
    real = None if given.real is None else Path(given.real)
    if real is not None and not real.is_dir():
        raise SystemExit(f"{real}: there is no such folder of real images")
    if not SHARED and "shared" in (given.case or ()):
        raise SystemExit("the photographs of another renderer are not there: name their folder in CERES_CAL_SHARED")
    if real is None and {"real", "straight"} & set(given.case or ()):
        real = real_folder()
    return measured(cases(real, given.picture, given.kind), given)


if __name__ == "__main__":
    sys.exit(main())
