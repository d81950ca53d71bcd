"""The last resort: a lens without a formula, where what all others leave behind goes together from place to place.

It takes longer than all of them, so that their residuals must ask for it: by the mean squares of residuals between
cells of the image and within them (analysis of variance).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.lens_choice.forms import without_formula
from ceres_cal.lens_choice.kinds import Candidate, Kind
from ceres_cal.lens_choice.seen import Seen
from ceres_cal.solve.in_cells import cells_of

# Between cells over within them, from which on residuals go together: in white noise it is 1.0 by 0.17. From half to
# double it decides which observations are asked, seldom what is chosen.
_TOGETHER = 1.5


def last_resort(seen: Seen, chosen: Candidate) -> Iterator[Candidate]:
    """The lenses without a formula, where even the longest lens of the chosen kind leaves what goes together.

    Not of so few placements that their features are held out one by one: what goes together within each would be
    predicted, too. Nor of one view of a floor: a line that is painted aside bends there as by a lens.
    """
    if len(seen.sights) > 1 and not seen.splits_placements and _between_cells(seen, chosen.of) > _TOGETHER:
        for forms in without_formula():
            yield from seen.solved(forms, chosen.of.estimate).candidates(first=True)


def _between_cells(seen: Seen, kind: Kind) -> float:
    """Mean square of residuals between cells over that within them; the x and y of points and each curve apart."""
    points, curves = seen.in_sigmas(kind.estimate)
    left = np.concatenate([points[:, 0], points[:, 1], curves])
    cell = cells_of(seen.sights, seen.observations.cameras)
    counts = np.bincount(cell)
    seen_in = counts > 0
    counts = counts[seen_in]
    between = np.bincount(cell, left)[seen_in] ** 2 / counts
    within = float(left @ left - between.sum()) / max(len(left) - len(counts), 1)
    return float(between.mean()) / within
