"""The table of all diagnostics."""

from __future__ import annotations

from ceres_cal.diagnostics.diagnostic import Case, Diagnostic, ScoreTest
from ceres_cal.diagnostics.of_floor import FloorBowed, FloorUneven
from ceres_cal.diagnostics.of_lens import Aspect, Decentring, Phi, PrincipalPoint, Prism, Radius, Skew
from ceres_cal.diagnostics.of_motion import MovedAfter, MovedIn
from ceres_cal.diagnostics.of_observations import Correlated, DoesNotHold, LargerNoise, PointsShifted, WrongLabel
from ceres_cal.diagnostics.of_target import BoardBent, CurveAside, PointAside
from ceres_cal.diagnostics.scores import Family

DIAGNOSTICS: dict[str, Diagnostic] = {
    one.kind: one
    for one in (
        Radius(), Decentring(), Prism(), Aspect(), Skew(), PrincipalPoint(), Phi(), CurveAside(), PointAside(),
        BoardBent(), FloorBowed(), FloorUneven(), MovedAfter(), MovedIn(), WrongLabel(), PointsShifted(),
        LargerNoise(), Correlated(), DoesNotHold(),
    )
}  # fmt: skip


def all_families(case: Case) -> list[Family]:
    """Every alternative to the model."""
    tests = (one for one in DIAGNOSTICS.values() if isinstance(one, ScoreTest))
    return [family for test in tests for family in test.families(case)]
