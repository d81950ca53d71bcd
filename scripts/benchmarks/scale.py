"""Growth beyond memory and beyond one process, for scripts/benchmark.py --scale."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.peers import Corners, peak_mib, reset_peak
from benchmarks.problems import corner_observations, field_observations, wide_lens
from ceres_cal.base.arrays import Array
from ceres_cal.observations import NO_CURVES, Observations
from ceres_cal.observations.columns import NO_POINTS, View
from ceres_cal.observations.files import HEADER, Content, header_of

FOLDER = "CERES_CAL_BENCHMARK"  # environment variable with the folder of the observations
_FRAMES = 2000  # written at once
_WARM_UP = 20_000  # line points at most
_TIMES = 10  # repetitions of the smallest size between two runs of a larger one
_ASKED = 50  # requests, for the time that a request takes
_BYTES = 40  # of disk for a line point, including its share of a frame


@contextmanager
def folder_for(line_points: int) -> Iterator[Path]:
    """A temporary folder with room for so many line points; it is removed at the end, also after SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if free < _BYTES * line_points:
        where, needed = tempfile.gettempdir(), _BYTES * line_points / 2**30
        sys.exit(
            f"{where}: {needed:.1f} GiB are needed, {free / 2**30:.1f} are free: set TMPDIR to where there is room"
        )
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def write_field(path: Path, line_points: int) -> None:
    """`field_observations` as a folder of columns, of which only a part is in memory at any time."""
    one = field_observations(min(line_points, _WARM_UP))
    per_frame = int(np.count_nonzero(one.curves.view == 0))
    frames = -(-line_points // per_frame)
    counts = {"points": frames * int(np.count_nonzero(one.points.view == 0)), "curves": line_points}
    views = tuple(View(str(frame), "overhead", "overhead", "field") for frame in range(frames))
    path.mkdir()
    (path / HEADER).write_bytes(
        msgspec.json.encode(header_of(Content(one.targets, one.cameras, views, NO_POINTS, NO_CURVES, one.priors)))
    )
    columns = {
        f"{kind}_{name}": np.lib.format.open_memmap(
            path / f"{kind}_{name}.npy", "w+", array.dtype, (counts[kind], *array.shape[1:])
        )
        for kind, column in (("points", one.points), ("curves", one.curves))
        for name, array in vars(column).items()
    }
    start = {"points": 0, "curves": 0}
    for first in range(0, frames, _FRAMES):
        part = field_observations(min(_FRAMES * per_frame, line_points - first * per_frame), seed=first)
        for kind, column in (("points", part.points), ("curves", part.curves)):
            for name, array in vars(column).items():
                rows = array + np.int32(first) if name == "view" else array
                columns[f"{kind}_{name}"][start[kind] : start[kind] + len(rows)] = rows
            start[kind] += len(column)


def stored_growth(line_points: int, workers: int) -> dict[str, Any]:
    """Time of a calibration from the folder, peak memory of the process and of a worker, and the cost of an iteration.

    Args:
        workers: number of Dask's worker processes, each with one thread; 0 for none.
    """
    from ceres_cal.calibration.calibrating import calibrate
    from ceres_cal.problem.parameters import Options

    warm_up = partial(_warm_up, min(line_points, _WARM_UP))
    warm_up()
    with ExitStack() as stack:
        client = stack.enter_context(_cluster(workers)) if workers else None
        if client is not None:
            client.run(warm_up)
        before, start = _processor(client), time.perf_counter()
        observations = Observations.load(os.environ[FOLDER])
        opened = time.perf_counter()
        trips = _watched(stack, client)
        calibration = calibrate(observations, Options(lens="radial"), client=client)
        seconds = time.perf_counter() - start
        processor = [now - then for now, then in zip(_processor(client), before, strict=True)]
        return {
            "size": line_points,
            "workers": workers,
            "seconds": seconds,
            "processor": sum(processor),
            "longest": processor[0] + max(processor[1:], default=0.0),
            "open_seconds": opened - start,
            "focal_error_px": calibration.cameras["overhead"].phi - 600.0,
            "phi": calibration.cameras["overhead"].phi,
            "peak_mib": peak_mib(),
            "worker_mib": max(client.run(peak_mib).values()) if client else None,
            "iterations": len(trips),
            "iteration_seconds": float(np.median([seconds for seconds, _ in trips])) if trips else None,
            "iteration_bytes": max(size for _, size in trips) if client else None,
            "overhead_ms": 1e3 * _overhead_s(client, observations) if client else None,
        }


def _warm_up(line_points: int) -> None:
    """Work that a process does once: imports, compiled kernels."""
    from ceres_cal.calibration.calibrating import calibrate
    from ceres_cal.problem.parameters import Options

    calibrate(field_observations(line_points), Options(lens="radial"))


def _processor(client: Any) -> list[float]:
    """Processor seconds of this process, and of each worker."""
    return [time.process_time(), *(client.run(time.process_time).values() if client else ())]


def _overhead_s(client: Any, observations: Observations) -> float:
    """Median time of a request to the workers and their answers, without the work itself."""
    from ceres_cal.problem.engines import OnWorkers
    from ceres_cal.problem.shares import cut

    engine, seconds = OnWorkers(client, list(cut(observations))), []
    for _ in range(_ASKED):
        start = time.perf_counter()
        engine.ask(_nothing)
        seconds.append(time.perf_counter() - start)
    engine.close()
    return float(np.median(seconds))


def _nothing(_: Any) -> int:
    return 0


def frames_in_turns(sizes: Sequence[int], turns: int) -> list[dict[str, Any]]:
    """Time of a frame (a board in front of a wide lens) for each size, and its ratio to that of the smallest size.

    Each run of a size is compared with the runs of the smallest size before and after it, since the speed of a
    processor may change by half within a minute.
    """
    from ceres_cal.calibration.calibrating import calibrate
    from ceres_cal.problem.parameters import Options

    options, few = Options(lens="brown", free_aspect=True), wide_lens(min(sizes)).corners

    def spent(corners: Corners, times: int = 1) -> Array:
        each = []
        for _ in range(times):
            observations = corner_observations(corners)
            before = time.process_time(), time.perf_counter()
            calibrate(observations, options)
            each.append((time.process_time() - before[0], time.perf_counter() - before[1]))
        return np.asarray(np.mean(each, axis=0) / corners.frames)

    spent(few, 3)
    rows = []
    for frames in sizes:
        corners, times = wide_lens(frames).corners, int(np.clip(frames // min(sizes), 1, _TIMES))
        reset_peak()
        spent(corners)
        own, ratios, before = [], [], spent(few, times)
        for _ in range(turns):
            own.append(spent(corners))
            after = spent(few, times)
            ratios.append(own[-1] / (0.5 * (before + after)))
            before = after
        (processor, wall), (times_processor, times_wall) = np.median(own, axis=0), np.median(ratios, axis=0)
        rows.append({
            "frames": frames, "processor_us": 1e6 * processor, "wall_us": 1e6 * wall,
            "times_processor": times_processor, "times_wall": times_wall, "peak_mib": peak_mib(),
        })  # fmt: skip
    return rows


@contextmanager
def _cluster(workers: int) -> Iterator[Any]:
    """A client of so many worker processes on this machine."""
    import dask
    from distributed import Client, LocalCluster

    with (
        dask.config.set(temporary_directory=str(Path(os.environ[FOLDER]).parent)),
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0", memory_limit=0) as cluster,
        Client(cluster) as client,
    ):
        yield client


def _watched(stack: ExitStack, client: Any) -> list[tuple[float, int]]:
    """Seconds of each evaluation from now on, and the largest number of bytes sent to a worker and back for it."""
    from ceres_cal.problem import engines
    from ceres_cal.problem.shares import Share

    trips: list[tuple[float, int]] = []
    sent = [0]

    def run(function: Any, *given: Any, **named: Any) -> Any:
        replies = type(client).run(client, function, *given, **named)
        sent[0] = len(pickle.dumps(given)) + max(len(pickle.dumps(reply)) for reply in replies.values())
        return replies

    if client is not None:
        client.run = run
        stack.callback(delattr, client, "run")
    for engine in (engines.InProcess, engines.OnWorkers):
        whole: Callable[..., Any] = engine.ask

        def ask(self: Any, answer: Callable[..., Any], *request: Any, whole: Callable[..., Any] = whole) -> Any:
            start = time.perf_counter()
            told = whole(self, answer, *request)
            if answer is Share.blocks:
                trips.append((time.perf_counter() - start, sent[0]))
            return told

        engine.ask = ask  # type: ignore[method-assign]
        stack.callback(setattr, engine, "ask", whole)
    return trips
