"""What was seen in a photograph that was refused: the best candidate, and which of its lines were missing."""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Image, Image8
from ceres_cal.detect.photographs.followed import Followed
from ceres_cal.detect.strokes import find_strokes
from ceres_cal.report.pictures.overlay import Marks, draw_overlay, in_8_bit_colour
from ceres_cal.scene.targets import Target

_NAMES = 4  # of missing lines in the legend


def draw_seen(photograph: Image, seen: Followed | None, target: Target) -> Image8:
    """A photograph with the lines found in it, and, of the best candidate, where paint was found and where not."""
    grey = in_8_bit_colour(photograph).mean(axis=2).astype(np.float32)
    marks = [Marks(find_strokes(grey).ends.reshape(-1, 2), "lines seen", "before")]
    if seen is not None:
        lines = seen.lines
        missing = [target.curve_names[number] for number in seen.absent]
        names = ", ".join(missing[:_NAMES]) + (f" and {len(missing) - _NAMES} more" if len(missing) > _NAMES else "")
        marks += [
            Marks(lines.pixels[lines.found], "best candidate: paint", "after"),
            Marks(
                lines.course.pixels[~lines.found],
                f"best candidate: no paint{f', all along {names}' if names else ''}",
                "taken out",
                crosses=True,
            ),
        ]
    return draw_overlay(photograph, (), marks)
