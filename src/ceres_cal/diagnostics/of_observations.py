"""Diagnostics of the observations: wrong labels, shifted points, noise larger than stated, neighbours that agree."""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.diagnostics.alternatives import Family
from ceres_cal.diagnostics.diagnostic import Case, Diagnostic, Evidence, ScoreTest, Tested, Words
from ceres_cal.diagnostics.findings import Amount, Finding, Wrong, amounts
from ceres_cal.diagnostics.labels import Mislabelled
from ceres_cal.diagnostics.leftover import Noise

_MOST_NAMED = 5
# How near to half a pixel a shift must be to be called that: in standard deviations, and px.
_HALF_SD, _HALF_PX = 3.0, 0.1
_HALF = "this is the half pixel between counting from the centre and from the corner of the top-left pixel: "


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


class PointsShifted(ScoreTest):
    """A camera's points lie aside of its curves: two detectors that count pixels from different places."""

    kind = "points shifted"
    absorbed = True

    def families(self, case: Case) -> Iterator[Family]:
        is_curve, camera = case.equations.is_curve, case.camera
        both = np.isin(camera, camera[is_curve & case.model.used])
        group = np.where(~is_curve & both, camera, -1)
        yield Family(self.kind, case.equations.direction * ~is_curve[:, None], group, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        px, sd = evidence.score.amount, evidence.score.sd
        half = bool(np.all(np.abs(np.abs(px) - 0.5) < np.maximum(_HALF_SD * sd, _HALF_PX)))
        return Words(
            f"camera {evidence.score.subject!r}: its points are shifted against its curves by ({px[0]:+.2f} ± "
            f"{sd[0]:.2f}, {px[1]:+.2f} ± {sd[1]:.2f}) px ({evidence.size})",
            f"{_HALF if half else ''}let both detectors count from the centre of the top-left pixel",
            amounts(("x", "y"), px, sd, "px"),
        )


class _OfNoise(Diagnostic):
    """What the noise of points and of curves is like."""

    wrong: ClassVar[Wrong] = "observations"

    def tests(self, case: Case) -> int:
        return 2

    @abstractmethod
    def about(self, noise: Noise) -> tuple[float, float, Words]:
        """log P of as much by chance, px that it is of, and its words."""

    def findings(self, tested: Tested) -> Iterator[Finding]:
        case = tested.case
        for noise in tested.noise:
            log_p, px, words = self.about(noise)
            if log_p <= tested.selection.log_level:
                rows = case.model.used & (case.equations.is_curve == (noise.kind == "curves"))
                all_px, all_mm, _ = case.effect(case.equations.residual, rows)
                mm = px * all_mm / all_px if all_px > 0.0 else float("nan")
                yield Finding(
                    self.kind, self.wrong, noise.kind, None, words.sentence, words.advice, px, mm, px / noise.sigma_px,
                    words.amounts, tested.log10_p(log_p), noise.observations,
                )  # fmt: skip


class LargerNoise(_OfNoise):
    """Noise beyond what was stated."""

    kind = "noise"

    def about(self, noise: Noise) -> tuple[float, float, Words]:
        sentence = (
            f"the noise of {noise.kind} is {noise.scale:.2f} times what was stated: {noise.sigma_px:.3f} px, not "
            f"{noise.sigma_px / noise.scale:.3f}"
        )
        amount = Amount("scale", noise.scale, noise.scale / float(np.sqrt(2.0 * noise.observations)), "")
        advice = "state the larger sigma where sigmas are taken as stated; the estimated scale is right already"
        return noise.log_p, noise.sigma_px, Words(sentence, advice, (amount,))


class Correlated(_OfNoise):
    """Neighbouring residuals that agree."""

    kind = "correlated"

    def about(self, noise: Noise) -> tuple[float, float, Words]:
        sentence = (
            f"neighbouring residuals of {noise.kind} agree (correlation {noise.correlation:.2f}): "
            f"{noise.observations} observations say as much as {noise.effective:.0f} independent ones"
        )
        amount = Amount("correlation", noise.correlation, 1.0 / float(np.sqrt(noise.observations)), "")
        advice = "look for what shifts whole features; the standard deviations have it in them"
        shared_px = noise.sigma_px * float(np.sqrt(max(noise.correlation, 0.0)))
        return noise.correlation_log_p, shared_px, Words(sentence, advice, (amount,))
