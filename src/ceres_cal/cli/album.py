"""The photographs of `--report PAGE --images FOLDER`."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.detect import image_files

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations
    from ceres_cal.report import Album


def album_of(
    args: Namespace, observations: Observations, before: Calibration | None = None, observed: Sequence[Path] = ()
) -> Album | None:
    """The photographs that belong to the observations' frames; None where none were asked for.

    Args:
        observed: photographs that the observations were just found in: a report shows them without being asked.

    Raises:
        InputError: --images without --report, or none of the images is called like a frame.
    """
    if args.images and args.report is None:
        raise InputError("--images is for the report: name a page with --report, or leave it out")
    images = list(image_files(args.images)) if args.images else list(observed)
    if not images or args.report is None:
        return None
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # what it warns of in an image, we say ourselves
    from ceres_cal.pictures.frames import photographs_by_frame
    from ceres_cal.report import Album

    paths = photographs_by_frame(images)
    frames = dict.fromkeys(view.frame for view in observations.views)
    known = {frame: paths[frame] for frame in frames if frame in paths}
    if not known:
        raise InputError(
            f"none of the {len(paths)} images is called like a frame of the observations, such as "
            f"{next(iter(frames))!r}: --images takes the photographs that were observed"
        )
    return Album(known, before)
