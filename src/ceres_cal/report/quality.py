"""How well a calibration is known, gathered once for the commands' answers and for the report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from msgspec import Struct

from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics import Diagnosis, diagnose
from ceres_cal.observations import Observations
from ceres_cal.observations.thinning import thinned
from ceres_cal.posterior.maps import FieldMap
from ceres_cal.posterior.seam import Disagreement
from ceres_cal.posterior.uncertainty import Uncertainty
from ceres_cal.posterior.weak import Verdict
from ceres_cal.scene.heights import HEIGHTS_M
from ceres_cal.scene.targets import Target

_DIAGNOSED = 5_000  # observations that a calibration's own answer reads; `diagnose` and the report read all


class Seam(Struct, frozen=True, eq=False):
    """What two stations disagree about: predicted at HEIGHTS_M, and measured in what both observed."""

    stations: tuple[str, str]
    predicted: tuple[FieldMap, ...]
    measured: Disagreement


def quality_of(calibration: Calibration, observations: Observations, diagnosis: Diagnosis | None = None) -> Quality:
    """A calibration diagnosed on its own observations, on a sample of very many; not where nothing was minimised. Where
    that fails, the verdict says so.
    """
    observations = calibration.drawn_alike(observations)
    if not calibration.rounds:
        return Quality(calibration, observations, diagnosis)
    try:
        few = thinned(observations, _DIAGNOSED)
        diagnosis = diagnosis or diagnose(calibration, few, new_data=few is not observations)
    except CalibrationError as error:
        # reads: "Its residuals could not be judged, so nothing says whether the model is right: ..."
        return Quality(calibration, observations, None, str(error))
    return Quality(calibration, observations, diagnosis)


@dataclass(frozen=True, eq=False)
class Quality:
    """A calibration, the observations beside it, and how well it is known.

    Attributes:
        diagnosis: what the residuals say; None where they cannot be read, or nothing was minimised.
        undiagnosed: why they cannot be read.
    """

    calibration: Calibration
    observations: Observations
    diagnosis: Diagnosis | None
    undiagnosed: str = ""

    @cached_property
    def uncertainty(self) -> Uncertainty | None:
        """None where nothing was minimised."""
        return None if self.calibration.posterior is None else self.calibration.uncertainty

    @cached_property
    def verdicts(self) -> dict[tuple[str, str, str], Verdict]:
        """By kind, owner and quantity; what was held is not there."""
        if self.uncertainty is None:
            return {}
        return {verdict.key[:3]: verdict for verdict in self.uncertainty.verdicts}

    @cached_property
    def fields(self) -> tuple[Target, ...]:
        """Targets that lie in the world."""
        names = dict.fromkeys(view.target for view in self.observations.views if view.placement is None)
        return tuple(self.observations.targets[name] for name in names)

    @cached_property
    def placed(self) -> tuple[str, ...]:
        """Stations that have a place over a field."""
        if not self.fields:
            return ()
        return tuple(name for name in self.calibration.stations if ("station", name, "height") in self.verdicts)

    @cached_property
    def maps(self) -> dict[str, tuple[FieldMap, ...]]:
        """Of each placed station, at HEIGHTS_M."""
        if self.uncertainty is None:
            return {}
        return {name: tuple(self.uncertainty.map_sd_mm(name, h) for h in HEIGHTS_M) for name in self.placed}

    def each_seam(self) -> Iterator[Seam]:
        """Of stations of different cameras that see some place both."""
        owners = self.calibration.estimate.stations
        for pair in combinations(self.placed, 2):
            if self.uncertainty is None or owners[pair[0]].camera == owners[pair[1]].camera:
                continue
            maps = tuple(self.uncertainty.seam_sd_mm(*pair, height_m) for height_m in HEIGHTS_M)
            if not np.all(np.isnan(maps[0].sd_mm)):
                yield Seam(pair, maps, self.calibration.disagreement(self.observations, *pair))
