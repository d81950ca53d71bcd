"""The last step of a calibration: what is known of its numbers, and what to do where phi ran away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ceres_cal.camera import Camera
from ceres_cal.parameters import Estimate, unit_px
from ceres_cal.uncertainty.posterior import Posterior, make_posterior, student_95
from ceres_cal.uncertainty.profile import PHI_RANGE, Node, Setting, profile, valley

USUAL_PHI = 1.4
"""In half image diagonals: 71 degrees across the diagonal, a usual lens."""
_BENT = 0.05  # relative sigma of phi above which the quadratic picture is left


def assess(setting: Setting, estimate: Estimate, freedom: float) -> tuple[Estimate, Posterior]:
    """What is known at the estimate, and the estimate: another one where the least cost lies at a phi that no lens has.

    Nearly frontal views can be fitted a little better by a camera a hand's breadth over the floor, or in the clouds,
    than by the true one. Where a lens is known to be none of these, the nearest to a usual lens that the observations
    leave possible at 95 % is taken; the posterior says that phi is unknown.

    Args:
        freedom: spare equations behind the estimated noise, infinite where the sigmas were taken as stated.

    Raises:
        SolutionError: no possible lens fits.
    """
    width = student_95(freedom)
    free = [name for name, numbers in setting.layout.free.items() if 0 in numbers]
    astray = [name for name in free if not _is_lens(estimate.cameras[name])]
    for number, name in enumerate(astray):
        estimate = _usual(name, valley(name, _holding(setting, astray[:number]), estimate), width)
    posterior = make_posterior(setting.told(estimate), freedom)
    profiles = {}
    for name in free:
        if posterior.sd_of("camera", name, "phi") > _BENT * estimate.cameras[name].phi:
            others = _holding(setting, [other for other in astray if other != name])  # or they would go astray again
            profiles[name] = profile(name, valley(name, others, estimate), estimate, width)
    return estimate, replace(posterior, profiles=profiles)


def _holding(setting: Setting, cameras: Sequence[str]) -> Setting:
    for name in cameras:
        setting = setting.holding_phi(name)
    return setting


def _is_lens(camera: Camera) -> bool:
    unit = unit_px(camera)
    return PHI_RANGE[0] * unit <= camera.phi <= PHI_RANGE[1] * unit


def _usual(name: str, nodes: Sequence[Node], width: float) -> Estimate:
    """Of the places within the 95 % bound the one whose phi is nearest to a usual lens'."""
    least = min(node.cost for node in nodes)
    possible = [node.estimate for node in nodes if node.cost - least <= width**2]
    return min(possible, key=lambda e: abs(np.log(e.cameras[name].phi / (USUAL_PHI * unit_px(e.cameras[name])))))
