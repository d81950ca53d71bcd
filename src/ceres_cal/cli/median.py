"""`--median`, and videos of a field: one picture of several of a camera that stands still."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.words import plural
from ceres_cal.cli.outputs import finishing, require_output
from ceres_cal.cli.progress import ProgressBar

if TYPE_CHECKING:
    from ceres_cal.base.arrays import Image
    from ceres_cal.detect.median import Merged

_MOST_NAMED = 3


def median_path(output: Path, inputs: Sequence[Path]) -> Path:
    """Where the one picture is written, beside the observations; InputError where that is one of the inputs."""
    path = output.with_name(f"{output.stem}_median.png")
    require_output(path, inputs)
    return path


def write_median(path: Path, images: Sequence[Path], videos: Sequence[Path], bar: ProgressBar) -> dict[str, Any]:
    """Write the one picture of photographs and videos, in 16 bits; what became of each of them, for --json.

    Raises:
        InputError: see `detect.median.merged`; an image or a video that cannot be read.
    """
    import numpy as np

    from ceres_cal.base.files import write_bytes
    from ceres_cal.detect.images import encoded
    from ceres_cal.detect.median import merged

    found: Merged = merged(_pictures(images, videos, bar))
    levels = np.round(found.picture * (65535 // found.white)).astype(np.uint16)
    with finishing():
        write_bytes(path, encoded(np.asarray(levels), ".png", 100))
    left_out = [{"image": name, "reason": reason} for name, reason in found.left_out]
    return {"picture": str(path), "used": list(found.used), "left_out": left_out}


def _pictures(images: Sequence[Path], videos: Sequence[Path], bar: ProgressBar) -> Iterator[tuple[str, Image]]:
    from ceres_cal.detect.images import read_colour
    from ceres_cal.detect.median import MOST_PICTURES
    from ceres_cal.detect.video import spread_frames

    each = max(1, MOST_PICTURES // (len(videos) + bool(images)))  # of every video, and of the photographs together
    for path in images[:: -(-len(images) // each) or 1]:
        yield str(path), read_colour(path)
    for video in videos[:MOST_PICTURES]:
        yield from spread_frames(video, each, bar.update)


def median_text(data: dict[str, Any]) -> str:
    """What became of the pictures, in one line."""
    used, left_out = len(data["used"]), data["left_out"]
    reasons: dict[str, list[str]] = {}
    for one in left_out:
        reasons.setdefault(one["reason"], []).append(one["image"])
    said = [
        f"{len(names)} left out, {reason} ({', '.join(names[:_MOST_NAMED])}{', ...' if names[_MOST_NAMED:] else ''})"
        for reason, names in reasons.items()
    ]
    return "; ".join([f"{data['picture']}: the median of {plural(used, 'picture')} of {used + len(left_out)}", *said])
