"""Warnings of what the observations leave open: phi that they do not tell, or that rests on what is usual."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ceres_cal.base.words import bounds_text, two_digits
from ceres_cal.model.keys import Key
from ceres_cal.solve import Problem, RobustSolution
from ceres_cal.uncertainty import Posterior, Uncertainty

_UNKNOWN = (
    "camera {!r}: its views are too frontal to tell phi, which is {} at 95 %, and its heights go with phi: the floor "
    "is right, what is above it is not: add boards tilted by 20 degrees, or a prior on height_m where it sees the field"
)
# Times the standard deviation of phi without what is usual of principal points: what rests on it is said.
_RESTING = 1.5
_USUAL = (
    "camera {!r}: phi, and what goes with it, rests on its principal point lying near the middle of the image, as is "
    "usual: by the observations alone its standard deviation is {}: show tilted views, or state the principal point"
)


def unknown_phi(end: RobustSolution, posterior: Posterior) -> Iterator[str]:
    """Warnings of cameras whose phi the observations leave open."""
    known = Uncertainty(end.solution.estimate, posterior, {})
    for name in posterior.profiles:
        verdict = known.verdict("camera", name, "phi")
        if verdict.verdict == "unknown":
            yield _UNKNOWN.format(name, bounds_text(verdict.low, verdict.high, "px"))


def resting_phi(end: RobustSolution, problem: Problem) -> Iterator[str]:
    """Warnings of cameras whose phi rests on where principal points usually lie."""
    estimate, reduced = end.solution.estimate, end.reduced
    usual = [prior for prior in problem.priors_at(estimate) if prior.is_usual]
    if reduced is None or not usual:
        return
    without = reduced.shared
    for prior in usual:
        without = without + replace(prior.information, matrix=-prior.information.matrix)
    for name in estimate.cameras:
        key = Key("camera", name, "phi", "px")
        if key in reduced.shared.keys:
            at = reduced.shared.columns([key])[0]
            sd, alone = reduced.shared.spread.sd[at], without.spread.sd[at]
            if alone > _RESTING * sd:
                yield _USUAL.format(name, _share_text(alone / estimate.cameras[name].phi))


def _share_text(share: float) -> str:
    return f"{two_digits(100.0 * share)} %" if share < 1.0 else "larger than itself"
