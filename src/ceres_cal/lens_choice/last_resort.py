"""The last resort: a lens without a formula, where what all others leave behind goes together from place to place.

It takes longer than all of them, so that their residuals must ask for it: by the mean squares of residuals between
cells of the image and within them (analysis of variance).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.lens_choice.forms import without_formula
from ceres_cal.lens_choice.kinds import Candidate, Kind
from ceres_cal.lens_choice.seen import Seen

# Between cells over within them, from which on residuals go together: in white noise it is 1.0 by 0.17. From half to
# double it decides which observations are asked, seldom what is chosen.
_TOGETHER = 1.5
_IN_A_CELL, _MOST_CELLS = 8, 8  # observations on average; cells along the image


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
    sights, (points, curves) = seen.sights, seen.in_sigmas(kind.estimate)
    cells = [_cells(seen, sights.point_bounds, sights.pixels), _cells(seen, sights.curve_bounds, sights.curve_pixels)]
    apart = [cells[0] * 2, cells[0] * 2 + 1, (cells[1] * len(sights.tracks) + sights.track_index) * -1 - 1]
    left = np.concatenate([points[:, 0], points[:, 1], curves])
    cell = np.unique(np.concatenate(apart), return_inverse=True)[1]
    counts = np.bincount(cell)
    between = np.bincount(cell, left) ** 2 / counts
    within = float(left @ left - between.sum()) / max(len(left) - len(counts), 1)
    return float(between.mean()) / within


def _cells(seen: Seen, bounds: Indices, pixels: Array) -> Indices:
    """(N,) number of the cell of each observation of the sights, in its own camera's image."""
    sights = seen.sights
    names = sorted(seen.observations.cameras)
    owner = np.repeat([names.index(key.camera) for key in sights.keys], np.diff(bounds))
    sizes = np.array([seen.observations.cameras[name] for name in names])[owner]
    count = (len(sights.point_rows) + len(sights.curve_rows)) / (_IN_A_CELL * len(names))
    side = min(_MOST_CELLS, max(2, int(np.sqrt(count))))
    x, y = np.clip((pixels / sizes * side).astype(int), 0, side - 1).T
    return np.asarray((owner * side + y) * side + x)
