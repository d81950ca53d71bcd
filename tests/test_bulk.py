"""Very many observations of the world: a part decides about outliers, and all are solved for, in shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from scenes import RADIAL, two_cameras
from test_competing import NOISE, half_field, moved_aside, wholes
from thorough import partly

from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations, sights
from ceres_cal.problem import shares
from ceres_cal.problem.bundle import Progress
from ceres_cal.problem.quantities import difference
from ceres_cal.robust import bulk
from ceres_cal.simulate import Disturbance, simulate

OUTLIERS = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3, outliers=0.05)


class CalibrateInShares(Protocol):
    def __call__(
        self, observations: Observations, progress: Callable[[Progress], None] | None = None
    ) -> Calibration: ...


@pytest.fixture
def in_shares(monkeypatch: pytest.MonkeyPatch) -> CalibrateInShares:
    """Calibrates few observations like very many: with a dozen shares, and a part of a quarter."""

    def calibrated(observations: Observations, progress: Callable[[Progress], None] | None = None) -> Calibration:
        with monkeypatch.context() as patch:
            patch.setattr(sights, "MANY", 100)
            patch.setattr(bulk, "_PART", 2_000)
            patch.setattr(bulk, "_FEWEST_VIEWS", 16)
            patch.setattr(bulk, "_STANDING_OUT", 2)
            patch.setattr(shares, "_ROWS", 500)
            return calibrate(observations, RADIAL, progress)

    return calibrated


def rejected(calibration: Calibration) -> list[tuple[str, int]]:
    return [(entry.kind, entry.row) for entry in calibration.rejected]


def assert_same(one: Calibration, other: Calibration) -> None:
    """Up to the tolerance of the loops, which end when noise scales change by less than one percent."""
    posterior = other.uncertainty.posterior
    steps = difference(one.estimate, other.estimate, posterior.keys) / posterior.sd
    assert np.max(np.abs(steps)) < 0.03  # 0.014 measured
    assert rejected(one) == rejected(other)
    for name, value in vars(other.fit).items():
        assert getattr(one.fit, name) == pytest.approx(value, rel=2e-3), name


def test_all_take_part_though_a_part_decides(in_shares: CalibrateInShares) -> None:
    observations = simulate(half_field(32), OUTLIERS, 4).observations
    of_shares = in_shares(observations)
    assert len(of_shares.rejected) > 100
    of_all = calibrate(observations, RADIAL)
    assert_same(of_shares, of_all)
    assert of_shares.digest == observations.digest
    sds = of_shares.uncertainty.posterior.sd / of_all.uncertainty.posterior.sd
    # 1.003 to 1.21 measured: scatter is estimated from other views, and the floor from the part alone.
    assert np.all((sds > 0.95) & (sds < 1.3))


@pytest.mark.parametrize("frame", partly([None, "0017"], ["0017"]))
def test_whole_that_does_not_belong_is_taken_out_of_all(frame: str | None, in_shares: CalibrateInShares) -> None:
    observations = moved_aside(simulate(half_field(32), NOISE, 4).observations, "HalfwayLine", 4.0, frame)
    of_shares, of_all = in_shares(observations), calibrate(observations, RADIAL)
    where = "all 32 frames" if frame is None else f"frame {frame!r}"
    assert wholes(of_shares) == {f"the whole of line 'HalfwayLine' in {where}"}
    assert_same(of_shares, of_all)


def test_boards_beside_the_world_stay_at_hand(in_shares: CalibrateInShares) -> None:
    observations = simulate(two_cameras("radial-2-3"), OUTLIERS, 4).observations
    assert_same(in_shares(observations), calibrate(observations, RADIAL))


def test_from_files_the_answer_is_the_same_to_the_last_bit(in_shares: CalibrateInShares, tmp_path: Path) -> None:
    observations = simulate(half_field(32), OUTLIERS, 4).observations
    observations.save(tmp_path / "day.columns")
    stored, at_hand = in_shares(Observations.load(tmp_path / "day.columns")), in_shares(observations)
    assert stored.estimate.stations["overhead"] == at_hand.estimate.stations["overhead"]
    assert stored.cameras["overhead"].phi == at_hand.cameras["overhead"].phi
    assert stored.fit == at_hand.fit
    assert stored.rejected == at_hand.rejected


def test_what_the_caller_raises_ends_it(in_shares: CalibrateInShares) -> None:
    observations = simulate(half_field(32), NOISE, 4).observations
    seen: list[Progress] = []
    in_shares(observations, seen.append)

    def late(_: Progress) -> None:
        seen.pop()
        if not seen:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_shares(observations, late)
