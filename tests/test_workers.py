"""Observations that Dask's workers keep: the same answer, whatever becomes of a worker."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import RADIAL
from test_bulk import OUTLIERS
from test_competing import half_field

from ceres_cal.base.errors import SolutionError
from ceres_cal.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.model.quantities import difference
from ceres_cal.observations import Observations
from ceres_cal.simulate import simulate
from ceres_cal.solve import Progress, bulk, engines, shares

distributed = pytest.importorskip("distributed", reason="Dask is an extra: pip install 'ceres-cal[dask]'")


@pytest.fixture(autouse=True)
def in_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bulk, "MANY", 100)
    monkeypatch.setattr(bulk, "_PART", 2_000)
    monkeypatch.setattr(bulk, "_FEWEST_VIEWS", 16)
    monkeypatch.setattr(shares, "_ROWS", 500)


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    """Of two workers, in processes of their own."""
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


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
        assert np.max(np.abs(steps)) < 1e-9  # 1e-11 measured
        assert there.rejected == here.rejected
        np.testing.assert_allclose(there.uncertainty.posterior.sd, posterior.sd, rtol=1e-9)
    assert _kept_by(client) == 0


def test_what_a_lost_worker_kept_is_made_again(client: Any, observations: Observations) -> None:
    here, killed = calibrate(observations, RADIAL), list[int]()
    iterations = 0

    def kill(_: Progress) -> None:
        nonlocal iterations
        iterations += 1
        if iterations == 12:
            workers = client.run(os.getpid)
            killed.append(sorted(workers.values())[0])
            os.kill(killed[-1], 9)

    there = calibrate(observations, RADIAL, kill, client=client)
    assert killed
    posterior = here.uncertainty.posterior
    assert np.max(np.abs(difference(there.estimate, here.estimate, posterior.keys) / posterior.sd)) < 1e-9
    assert there.rejected == here.rejected


def test_cancelled_it_leaves_nothing_behind(client: Any, observations: Observations) -> None:
    def stop(_: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate(observations, RADIAL, stop, client=client)
    assert _kept_by(client) == 0


def test_out_of_memory_on_a_worker_is_one_line(client: Any) -> None:
    (share,) = shares.cut(simulate(half_field(1), OUTLIERS, 1).observations)
    engine = engines.OnWorkers(client, [share])
    with pytest.raises(SolutionError, match="a worker ran out of memory: give it more"):
        engine.ask(_too_much)


def _too_much(_: object) -> int:
    raise MemoryError


def test_no_scheduler_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    sample = Path(__file__).parents[1] / "data" / "ssl_field" / "observations.json"
    assert main(["calibrate", str(sample), "--scheduler", "nonsense://nowhere"]) == 2
    assert "--scheduler nonsense://nowhere: no scheduler answers there" in capsys.readouterr().err


def _kept_by(client: Any) -> int:
    """Keys that workers hold once what was let go has gone."""
    for _ in range(50):
        kept = sum(len(keys) for keys in client.has_what().values())
        if not kept:
            break
        time.sleep(0.1)
    return kept
