"""`ceres_cal.run`: the command as a function. It has a module of its own, since `--help` reads the commands without
NumPy.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

from ceres_cal.base import Images, checked
from ceres_cal.calibration import Calibration
from ceres_cal.cli.command import COMMANDS
from ceres_cal.cli.run import RunArguments
from ceres_cal.scene.targets import Target


@checked
def run(
    images: Images,
    output: str | PathLike[str],
    *,
    target: Target | str | None = None,
    facing: Mapping[str, str] | None = None,
    not_painted: Sequence[str] = (),
    board: Target | str | None = None,
    lens: str = "auto",
    prior: Sequence[str] = (),
    estimate: Sequence[str] = (),
    camera: str = "camera",
    to: Sequence[str] = (),
    frames: int = 30,
) -> Calibration:
    """Calibrate one camera or several from photographs or videos in one call, as `ceres-cal run` does.

    Args:
        images: photographs of one camera, a folder of them, or a video; for several cameras a folder or a video each,
            or the folder that contains these. output: folder for all results.
        target: the field, such as `ssl_field("B")` or "ssl-b". board: such as "9x6x25mm", or a target of circles or
            AprilTags.
        facing: which way round the field is, such as {"LeftGoalLine": "top"}; for several cameras {"left.LeftGoalLine":
            "top"}. not_painted: lines that it lacks.
        lens: as in `Options`. prior: such as "height_m=4.02:20mm". estimate: dimensions of the field to estimate.
        camera: name of the camera. to: formats to export to. frames: number of photographs to take from a video.

    Raises:
        InputError: an argument does not fit, or no photograph shows the target.
        SolutionError: no usable camera.
    """
    given = RunArguments(
        images=(str(images),) if isinstance(images, str | PathLike) else tuple(map(str, images)),
        output=Path(output),
        target=json.dumps(target.spec) if isinstance(target, Target) else target,
        facing=tuple(f"{name}={side}" for name, side in (facing or {}).items()),
        not_painted=",".join(not_painted),
        board=json.dumps(board.spec) if isinstance(board, Target) else board,
        lens=lens,
        prior=tuple(prior),
        estimate=tuple(estimate),
        camera=camera,
        to=tuple(to),
        frames=frames,
        quiet=True,
    )
    COMMANDS["run"].run(given)
    return Calibration.load(given.output / "calibration.json")
