"""Observations stored by Dask's workers: the same result, whatever happens to a worker."""

from __future__ import annotations

import errno
import os
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import RADIAL
from test_bulk import OUTLIERS
from test_competing import half_field

from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.observations import Observations, sights
from ceres_cal.observations.columns import FileRows, read_rows
from ceres_cal.problem import engines, shares
from ceres_cal.problem.bundle import Progress
from ceres_cal.problem.quantities import difference
from ceres_cal.robust import bulk
from ceres_cal.simulate import simulate

dask = pytest.importorskip("dask", reason="Dask is an extra: pip install 'ceres-cal[dask]'")
distributed = pytest.importorskip("distributed", reason="Dask is an extra: pip install 'ceres-cal[dask]'")


@pytest.fixture(autouse=True)
def in_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sights, "MANY", 100)
    monkeypatch.setattr(bulk, "_PART", 2_000)
    monkeypatch.setattr(bulk, "_FEWEST_VIEWS", 16)
    monkeypatch.setattr(shares, "_ROWS", 250)


@pytest.fixture(scope="module")
def cluster_client() -> Iterator[Any]:
    """A client of two workers in their own processes."""
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def client(cluster_client: Any) -> Any:
    """The client with both workers, where an earlier test has killed some."""
    cluster_client.wait_for_workers(2, timeout=60)
    return cluster_client


@pytest.fixture(scope="module")
def observations() -> Observations:
    return simulate(half_field(32), OUTLIERS, 4).observations


def test_workers_give_the_answer_of_one_process(client: Any, observations: Observations, tmp_path: Path) -> None:
    here = calibrate(observations, RADIAL)
    observations.save(tmp_path / "day.columns")
    for given in (observations, Observations.load(tmp_path / "day.columns")):
        there = calibrate(given, RADIAL, client=client)
        posterior = here.uncertainty.posterior
        steps = difference(there.estimate, here.estimate, posterior.keys) / posterior.sd
        assert not np.any(steps)  # to the last bit
        assert there.rejected == here.rejected
        np.testing.assert_allclose(there.uncertainty.posterior.sd, posterior.sd, rtol=1e-9)
    assert _kept_by(client) == 0
    assert max(client.run(_page_faults).values()) < 1_000  # 0 measured; 5160 as Dask starts its workers


def _page_faults() -> int:
    """Page faults of ten arrays that are allocated one after the other."""
    start = 0
    for number in range(11):
        np.ones(1 << 20)
        start = start if number else resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - start


@pytest.mark.thorough
def test_workers_killed_twice_change_no_bit(
    client: Any, observations: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, killed, asked = calibrate(observations, RADIAL), list[int](), list[str]()
    ask = engines.OnWorkers.ask

    def killing(self: engines.OnWorkers, answer: Callable[..., Any], *request: Any) -> Any:
        asked.append(answer.__name__)
        if answer is shares.Share.blocks and asked.count("blocks") in (2, 4):
            killed.append(client.cluster.workers[len(killed)].pid)
            os.kill(killed[-1], 9)
        return ask(self, answer, *request)

    monkeypatch.setattr(engines.OnWorkers, "ask", killing)
    there = calibrate(observations, RADIAL, client=client)
    assert len(killed) == 2
    posterior = here.uncertainty.posterior
    assert not np.any(difference(there.estimate, here.estimate, posterior.keys))
    np.testing.assert_array_equal(there.uncertainty.posterior.sd, posterior.sd)
    assert there.rejected == here.rejected


def test_cancelled_it_leaves_nothing_behind(client: Any, observations: Observations) -> None:
    def stop(_: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate(observations, RADIAL, stop, client=client)
    assert _kept_by(client) == 0


@pytest.mark.parametrize(
    ("stop", "words"),
    [
        ("memory", r"a worker ran out of memory: give it more, or start more workers \(tcp://[\d.:]+\)"),
        ("disk", r"/spill/1: a worker's disk is full: make room, or .* --local-directory \(worker tcp://[\d.:]+\)"),
        ("file", r"/away/curves_pixels.npy: cannot be read: .* \(worker tcp://[\d.:]+\)"),
        ("killed", r"workers were lost again and again: have they enough memory\? \(tcp://[\d.:]+\)"),
    ],
)
def test_what_stops_a_worker_is_one_line_that_names_it(
    client: Any, stop: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "_RETRIES", 0)
    (share,) = shares.cut(simulate(half_field(1), OUTLIERS, 1).observations)
    engine = engines.OnWorkers(client, [share])
    with pytest.raises((SolutionError, InputError), match=words) as error:
        engine.ask(_stopped, stop)
    engine.close()
    assert "\n" not in str(error.value)


def _stopped(_: object, stop: str) -> int:
    if stop == "memory":
        raise MemoryError
    if stop == "disk":
        raise OSError(errno.ENOSPC, "No space left on device", "/spill/1")
    if stop == "file":
        read_rows(FileRows("/away/curves_pixels.npy", 0, "<f8", (1, 2)))
    os._exit(1)


def test_no_scheduler_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    sample = Path(__file__).parents[1] / "data" / "ssl_field" / "observations.json"
    assert main(["calibrate", str(sample), "--scheduler", "nonsense://nowhere"]) == 2
    assert "--scheduler nonsense://nowhere: no scheduler answers there" in capsys.readouterr().err


@pytest.mark.thorough
def test_workers_are_seen_while_the_client_polls(cluster_client: Any) -> None:
    """For a moment after each poll, the client's information about its scheduler contains no worker."""
    often = dask.config.set({"distributed.client.scheduler-info-interval": "1ms"})
    with often, distributed.Client(cluster_client.cluster.scheduler_address) as polling:
        share: Any = "a share"
        for _ in range(60):  # by that information one in twelve finds no worker
            engines.OnWorkers(polling, [share]).close()


def _kept_by(client: Any) -> int:
    """Number of keys that workers hold after released ones are gone."""
    for _ in range(50):
        kept = sum(len(keys) for keys in client.has_what().values())
        if not kept:
            break
        time.sleep(0.1)
    return kept


def test_workers_that_keep_nothing_are_lost_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """No worker can be asked or named."""

    class DeadClient:
        scheduler = None

        def __getattr__(self, name: str) -> Callable[..., Any]:
            answers = {"nthreads": {"a": 1}, "submit": self, "who_has": {}, "run": {}}
            return lambda *_, **__: answers.get(name)

        key = "a"

    monkeypatch.setattr(DeadClient, "scheduler", DeadClient())
    monkeypatch.setattr(engines, "_PAUSE_S", 0.0)
    share: Any = "a share"
    with pytest.raises(SolutionError, match=r"lost again and again: have they enough memory\?$"):
        engines.OnWorkers(DeadClient(), [share]).ask(lambda _: None)
