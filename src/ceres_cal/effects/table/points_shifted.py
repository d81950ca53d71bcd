"""Two detectors that count pixels from different places."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.effects.amounts import amounts
from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case, Effect, Evidence, Words

# How near to half a pixel a shift must be to be called that: in standard deviations, and px.
_HALF_SD, _HALF_PX = 3.0, 0.1
_HALF = "this is the half pixel between counting from the centre and from the corner of the top-left pixel: "


class PointsShifted(Effect):
    """A camera's points lie aside of its curves: two detectors that count pixels from different places."""

    kind = "points shifted"
    absorbed = True

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        is_curve, camera = case.equations.is_curve, case.camera
        both = np.isin(camera, camera[is_curve & case.model.used])
        group = np.where(~is_curve & both, camera, -1)
        yield EffectColumns(self.kind, case.equations.direction * ~is_curve[:, None], group, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        px, sd = evidence.score.amount, evidence.score.sd
        half = bool(np.all(np.abs(np.abs(px) - 0.5) < np.maximum(_HALF_SD * sd, _HALF_PX)))
        return Words(
            f"camera {evidence.score.subject!r}: its points are shifted against its curves by ({px[0]:+.2f} ± "
            f"{sd[0]:.2f}, {px[1]:+.2f} ± {sd[1]:.2f}) px ({evidence.size})",
            f"{_HALF if half else ''}let both detectors count from the centre of the top-left pixel",
            amounts(("x", "y"), px, sd, "px"),
        )


EFFECTS = (PointsShifted(),)
