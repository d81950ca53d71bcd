"""Diagnostics of the observations: wrong labels, noise larger than stated, neighbours that agree."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.diagnostics.diagnostic import Case, Diagnostic, Tested
from ceres_cal.diagnostics.findings import Amount, Finding, Wrong
from ceres_cal.diagnostics.labels import Mislabelled
from ceres_cal.diagnostics.leftover import Noise

_MOST_NAMED = 5


class WrongLabel(Diagnostic):
    """A label that stands for another feature, over all its frames."""

    kind = "wrong label"
    wrong: ClassVar[Wrong] = "observations"

    def tests(self, case: Case) -> int:
        return case.labels.tried

    def findings(self, tested: Tested) -> Iterator[Finding]:
        groups: dict[tuple[bool, str, int, int], list[Mislabelled]] = defaultdict(list)
        for label in tested.case.labels.mislabelled:
            if label.log_p <= tested.selection.log_level:
                name = tested.case.observations.views[label.view].target
                groups[label.is_curve, name, label.feature, label.instead].append(label)
        for (_, target, _, _), labels in groups.items():
            yield self._finding(tested, target, labels)

    def _finding(self, tested: Tested, target: str, labels: list[Mislabelled]) -> Finding:
        observations, table, one = tested.case.observations, tested.case.table, labels[0]
        described = observations.targets[target]
        names = described.curve_names if one.is_curve else described.point_names
        kind = "curve" if one.is_curve else "point"
        rows = np.concatenate([label.rows for label in labels])
        at = rows + (len(observations.points) if one.is_curve else 0)
        frames = list(dict.fromkeys(observations.views[label.view].frame for label in labels))
        listing = ", ".join(map(repr, frames[:_MOST_NAMED])) + (" ..." if len(frames) > _MOST_NAMED else "")
        away = float(np.mean(np.concatenate([label.distance_px for label in labels])))
        px, mm = _mean(np.abs(table.distance_px[at])), _mean(np.abs(table.error_mm[at]))
        sentence = (
            f"frame {listing}: {names[one.feature]!r} observed where {names[one.instead]!r} projects ({len(rows)} "
            f"{kind} observation{'s' if len(rows) > 1 else ''}, {away:.2f} px from it)"
        )
        return Finding(
            self.kind, self.wrong, f"{target}/{names[one.feature]}", frames[0], sentence,
            "correct the label; it was taken out and did no harm", px, mm, px / away, (),
            tested.log10_p(min(label.log_p for label in labels)), len(rows), tuple((kind, int(row)) for row in rows),
        )  # fmt: skip


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else float("nan")


class LargerNoise(Diagnostic):
    """Noise of points or of curves beyond what was stated."""

    kind = "noise"
    wrong: ClassVar[Wrong] = "observations"

    def tests(self, case: Case) -> int:
        return 2

    def findings(self, tested: Tested) -> Iterator[Finding]:
        for one in tested.noise:
            if one.log_p <= tested.selection.log_level:
                sentence = (
                    f"the noise of {one.kind} is {one.scale:.2f} times what was stated: {one.sigma_px:.3f} px, not "
                    f"{one.sigma_px / one.scale:.3f}"
                )
                amount = Amount("scale", one.scale, one.scale / float(np.sqrt(2.0 * one.observations)), "")
                advice = "state the larger sigma where sigmas are taken as stated; the estimated scale is right already"
                yield Finding(
                    self.kind, self.wrong, one.kind, None, sentence, advice, one.sigma_px,
                    one.sigma_px * _mm_per_px(tested, one), 1.0, (amount,), tested.log10_p(one.log_p),
                    one.observations,
                )  # fmt: skip


class Correlated(Diagnostic):
    """Neighbouring residuals that agree."""

    kind = "correlated"
    wrong: ClassVar[Wrong] = "observations"

    def tests(self, case: Case) -> int:
        return 2

    def findings(self, tested: Tested) -> Iterator[Finding]:
        for one in tested.noise:
            if one.correlation_log_p <= tested.selection.log_level:
                sentence = (
                    f"neighbouring residuals of {one.kind} agree (correlation {one.correlation:.2f}): "
                    f"{one.observations} observations say as much as {one.effective:.0f} independent ones"
                )
                shared = one.sigma_px * float(np.sqrt(max(one.correlation, 0.0)))
                advice = "take every standard deviation of the calibration larger by the square root of that ratio"
                amount = Amount("correlation", one.correlation, 1.0 / float(np.sqrt(one.observations)), "")
                yield Finding(
                    self.kind, self.wrong, one.kind, None, sentence, advice, shared,
                    shared * _mm_per_px(tested, one), shared / one.sigma_px, (amount,),
                    tested.log10_p(one.correlation_log_p), one.observations,
                )  # fmt: skip


def _mm_per_px(tested: Tested, noise: Noise) -> float:
    """What residuals of its kind are on the targets' planes."""
    case = tested.case
    rows = case.model.used & (case.equations.is_curve == (noise.kind == "curves"))
    px, mm, _ = case.effect(case.equations.residual, rows)
    return mm / px if px > 0.0 else float("nan")
