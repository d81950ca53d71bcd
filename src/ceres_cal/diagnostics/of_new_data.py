"""The diagnostic of observations that the calibration was not made from: whether it holds on them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from ceres_cal.base.tails import log_f_tail
from ceres_cal.diagnostics.diagnostic import Case, Diagnostic, Tested
from ceres_cal.diagnostics.findings import Finding, Wrong


class DoesNotHold(Diagnostic):
    """A refit to new observations would fit them better than chance explains.

    The gain of a refit is chi-square where the calibration is exact; its own uncertainty adds as much again for every
    time that the new observations are as many as those it was made from. That holds where both see the same part of the
    image: what is new at places that the calibration never saw is held against it.
    """

    kind = "does not hold"
    wrong: ClassVar[Wrong] = "calibration"

    def tests(self, case: Case) -> int:
        return 1

    def findings(self, tested: Tested) -> Iterator[Finding]:
        case, model = tested.case, tested.case.model
        step, used = model.step, model.used
        if case.calibration is None or not len(step):
            return
        own = 2 * case.calibration.fit.points + case.calibration.fit.curves
        inflation = 1.0 + np.count_nonzero(used) / max(own, 1)
        left = model.left_over
        variance = float(left @ left) / max(model.spare, 1)
        statistic = float(step @ step) / (inflation * len(step) * variance)
        log_p = float(log_f_tail(statistic, len(step), max(model.spare, 1)))
        if log_p > tested.selection.log_level:
            return
        px, mm, count = case.effect(np.where(used, (model.shared @ step) / model.weight, 0.0), used)
        sentence = (
            "the calibration does not hold on these observations: a refit would move it by "
            f"{px:.2f} px, {mm:.1f} mm rms"
        )
        yield Finding(
            self.kind, self.wrong, ", ".join(case.observations.stations), None, sentence,
            "find out with `ceres-cal check` whether the camera was moved, and refit", px, mm,
            px / case.noise_px(left, used), (), tested.log10_p(log_p), count,
        )  # fmt: skip
