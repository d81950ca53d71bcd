"""How well photographs are read: python scripts/photographs.py [--help]

Rendered photographs of varied lens, light, blur, wear and robots, whose truth is known, and a real one. Every figure
stands beside the value it must keep to. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from cases import Row, exit_code, json_text, printed
from photograph_shots import floor_rows, line_figures, real_rows, rings_rows, speed_rows, start_rows
from photographs_auto import auto_rows, real_auto_rows
from photographs_disturbed import disturbed_rows, wrong_rows
from photographs_shared import shared_rows
from photographs_templates import template_rows
from real_data import real_folder
from straightness import observed_boards, straight_rows

SHARED = Path(os.environ.get("CERES_CAL_SHARED", Path(__file__).parents[2] / "shared")) / "photos"
CASES = (
    "lines",
    "floor",
    "starts",
    "auto",
    "speed",
    "rings",
    "real",
    "straight",
    "shared",
    "disturbed",
    "wrong",
    "templates",
)


def rows_of(case: str, runs: int, real: Path | None, picture: Path | None) -> Iterator[Row]:
    if case == "lines":
        yield from line_figures(range(runs))
    elif case == "floor":
        yield from floor_rows(runs)
    elif case == "starts":
        yield from start_rows(runs)
    elif case == "auto":
        yield from auto_rows(runs)
        if real is not None:
            yield from real_auto_rows(real)
    elif case == "templates":
        yield from template_rows(min(runs, 20))
    elif case == "disturbed":
        yield from disturbed_rows(runs)
    elif case == "wrong":
        yield from wrong_rows(runs)
    elif case == "speed":
        yield from speed_rows(min(runs, 20))
    elif case == "rings":
        yield from rings_rows(min(runs, 20))
    elif case == "shared" and SHARED.is_dir():
        yield from shared_rows(SHARED)
    elif real is not None and case == "straight":
        boards = observed_boards(real)
        for keep_scale in (False, True):
            yield from straight_rows(real, boards, keep_scale)
    elif real is not None:
        yield from real_rows(real, picture)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--case", choices=CASES, action="append", help="only this one; repeatable")
    parser.add_argument("--runs", type=int, default=200, help="photographs of each case; default: 200")
    parser.add_argument("--real", type=Path, default=os.environ.get("CERES_CAL_REAL"), help="folder of real images")
    parser.add_argument("--picture", type=Path, help="draw what was found in the real photograph into this file")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    real = None if options.real is None else Path(options.real)
    if real is not None and not real.is_dir():
        raise SystemExit(f"{real}: there is no such folder of real images")
    if not SHARED.is_dir() and "shared" in (options.case or ()):
        raise SystemExit(
            f"{SHARED}: the photographs of another renderer are not there: name their folder in CERES_CAL_SHARED"
        )
    if real is None and {"real", "straight"} & set(options.case or ()):
        real = real_folder()
    rows = (row for case in options.case or CASES for row in rows_of(case, options.runs, real, options.picture))
    found = list(rows if options.json else printed(rows))
    if options.json:
        print(json_text(found))
    return exit_code(found)


if __name__ == "__main__":
    sys.exit(main())
