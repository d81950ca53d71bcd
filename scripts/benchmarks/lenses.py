"""Time of a lens and of the automatic choice: processor seconds for the wide lens. Run benchmark.py --lenses."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import Any

from benchmarks.problems import corner_observations, wide_lens
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options

_BROWN, _SPLINE, _AUTO = Options(lens="brown"), Options(lens="spline"), Options()


def lens_rows(sizes: Sequence[int], repeat: int, warm_up_s: float) -> list[dict[str, Any]]:
    """For each number of frames, in turns: brown, spline, auto, and, by its name, the lens that auto chooses."""
    return [_row(frames, repeat, warm_up_s) for frames in sizes]


def _row(frames: int, repeat: int, warm_up_s: float) -> dict[str, Any]:
    observations = corner_observations(wide_lens(frames).corners)
    auto = calibrate(observations, _AUTO)
    every = {"brown": _BROWN, "spline": _SPLINE, "auto": _AUTO, "by_name": auto.options}
    start = time.perf_counter()
    while time.perf_counter() - start < warm_up_s:
        calibrate(observations, _BROWN)
    turns = [{name: _seconds(observations, options) for name, options in every.items()} for _ in range(repeat)]
    row: dict[str, Any] = {name: median(turn[name] for turn in turns) for name in every}
    row["spline_times"] = median(turn["spline"] / turn["brown"] for turn in turns)
    row["auto_adds"] = median(100.0 * (turn["auto"] / turn["by_name"] - 1.0) for turn in turns)
    return {"frames": frames, "chosen": auto.lens_choice.chosen if auto.lens_choice else "", **row}


def _seconds(observations: Observations, options: Options) -> float:
    fresh = replace(observations)  # without cached results
    start = time.process_time()  # other processes hardly change it
    calibrate(fresh, options)
    return time.process_time() - start
