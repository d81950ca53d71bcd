"""The posterior with what may be otherwise in it: statements in conflict, wholes that may not belong, other minima,
lenses rougher than their model, and other lenses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.model.information import Information
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import difference, moved
from ceres_cal.observations import Observations
from ceres_cal.solve import Conflicts, RobustSolution, Solution, shifts_to
from ceres_cal.solve.explanation import Explanation
from ceres_cal.uncertainty.posterior import Posterior

if TYPE_CHECKING:
    from ceres_cal.uncertainty.other_lenses import OtherLenses


def with_doubts(
    posterior: Posterior,
    end: RobustSolution,
    conflicts: Conflicts,
    explanations: Sequence[Explanation],
    others: Sequence[Solution],
) -> Posterior:
    """Wider by how far the numbers move with each of them.

    Args:
        explanations: of which the less probable one counts as far as it is probable. others: minima beside the end.
    """
    estimate = end.solution.estimate
    posterior = posterior.in_doubt(conflicts.keys, conflicts.shifts)
    doubtful = [one for one in explanations if one.is_doubtful]
    shifts = [one.doubt**0.5 * difference(one.other, estimate, posterior.keys) for one in doubtful]
    posterior = posterior.in_doubt(posterior.keys, shifts)
    if posterior.profiles:  # a valley that is followed has its other places in it
        return posterior
    known = posterior.by_model or posterior.information
    return posterior.in_doubt(posterior.keys, shifts_to(others, estimate, known, posterior.half_width))


def with_roughness(posterior: Posterior, end: RobustSolution, observations: Observations) -> Posterior:
    """Wider by what a lens without a formula leaves in the same places of all views."""
    if not end.problem.options.blank_lens.roughness:
        return posterior
    from ceres_cal.uncertainty.rough import shifts_by_roughness

    return posterior.in_doubt(*shifts_by_roughness(end, observations))


def with_other_lenses(posterior: Posterior, estimate: Estimate, lenses: OtherLenses) -> Posterior:
    """Wider by what other lenses would say, each as far as it is probable; across a valley along phi at each node."""
    if not lenses.others:
        return posterior
    from ceres_cal.uncertainty.other_lenses import shifts_to_lenses

    followed = {profile.keys[0] for profile in posterior.profiles.values()}
    # A lens shows nothing of how targets are built or lie, and was compared with these as drawn and as seen in part.
    keys = [key for key in posterior.keys if key.kind in ("camera", "station") and key not in followed]
    wider = posterior.in_doubt(keys, shifts_to_lenses(lenses, keys, lenses.near))
    profiles = dict(posterior.profiles)
    for name, valley in profiles.items():
        nodes = [moved(estimate, valley.keys, step) for step in valley.steps]
        shifts = [np.array(shifts_to_lenses(lenses, valley.keys[1:], node)) for node in nodes]
        across = [
            posterior.wider(known, partial(Information.widened, shifts=here))
            for known, here in zip(valley.across, shifts, strict=True)
        ]
        profiles[name] = replace(valley, across=tuple(across))
    return replace(wider, profiles=profiles)
