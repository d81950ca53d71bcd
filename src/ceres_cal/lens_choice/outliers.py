"""Whether the chosen lens takes out observations that another one explains: then these tell the lens, too.

Where lenses predict alike, a few corners at the rim may be all that tells them apart, and the lens that is wrong there
calls them outliers. By the odds of a mixture of good and bad observations (Aitkin and Wilson, Technometrics 22, 1980)
what is taken out has its price, and so has every coefficient (Schwarz, Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from ceres_cal.base.arrays import Mask
from ceres_cal.base.errors import CalibrationError
from ceres_cal.lens_choice.kinds import Candidate
from ceres_cal.lens_choice.seen import Seen
from ceres_cal.model.parameters import Estimate

# Sigmas up to which an observation is explained: between it and what is taken out lies what any lens may leave.
_EXPLAINED = 3.0
# Twice the log-odds of an observation that is taken out: one of a hundred is bad, somewhere within twenty sigmas.
_PRICE = 13.0


def explained_by_another(seen: Seen, tried: Sequence[Candidate], chosen: Candidate, points: Mask, curves: Mask) -> bool:
    """Whether another lens explains so much of what the chosen one takes out that it is the likelier one.

    Args:
        points, curves: (N,), (M,) what the chosen one takes out of all observations.
    """
    sights = seen.sights
    out = points[sights.point_rows], curves[sights.curve_rows]
    if not (out[0].any() or out[1].any()):
        return False
    price = float(np.log(sights.equations))
    for other in tried:
        if other is chosen or other.squares is None:
            continue
        with suppress(CalibrationError):  # quiet: a lens that cannot be solved for explains nothing
            explained = _explained(seen, seen.solved_near(other), out)
            if _PRICE * explained > price * max(other.form.size - chosen.form.size, 0):
                return True
    return False


def _explained(seen: Seen, there: Estimate, out: tuple[Mask, Mask]) -> int:
    """How many equations of what is taken out are explained there, less those that would be taken out instead."""
    farthest = seen.options.reject_sigma
    points, curves = seen.in_sigmas(there)
    count = 0
    for off, own, equations in ((np.linalg.norm(points, axis=1), out[0], 2), (np.abs(curves), out[1], 1)):
        count += equations * int(np.count_nonzero(own & (off < _EXPLAINED)))
        count -= equations * int(np.count_nonzero(~own & (off > farthest)))
    return count
