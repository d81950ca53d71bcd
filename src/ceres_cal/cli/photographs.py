"""What commands do with photographs and videos: take them beside observations, make one of many, and detect in time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from ceres_cal import base, detect
from ceres_cal.base.errors import InputError
from ceres_cal.base.images import image_files
from ceres_cal.base.words import plural
from ceres_cal.cli import arguments
from ceres_cal.cli.command import Arguments, QuietArguments, argument
from ceres_cal.cli.files import require_different, require_output, save
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Section

_T = TypeVar("_T")
_OBSERVATIONS = (".json", ".npz")


class InputArguments(QuietArguments):
    """A calibration, files of observations or photographs, and what is to be said of photographs."""

    calibration: Path = arguments.calibration_argument("the calibration from before")
    inputs: tuple[str, ...] = argument(
        "OBS|IMAGE", "files of new observations (.json, .npz), taken together; or photographs, or folders of them"
    )
    station: str | None = arguments.station_option("station that took the photographs; default: the only one")
    not_painted: str = arguments.not_painted_option("lines that the photographed field does not have")


class DetectArguments(Arguments):
    """What `detect board` and `detect rings` share."""

    timeout: float | None = arguments.timeout_option()
    camera: str = arguments.camera_option()
    station: str | None = arguments.station_option("name of the station; default: that of the camera")
    output: Path = arguments.output_option("the observations (.json or .npz)")


def photographs_in(args: InputArguments) -> list[Path]:
    """The photographs that are named, each once; none where observations are."""
    observed = [name for name in args.inputs if Path(name).suffix.lower() in _OBSERVATIONS]
    if len(observed) == len(args.inputs):
        require_different(observed)
        if args.station is not None or args.not_painted:
            raise InputError("--station and --not-painted are of photographs, which were not given: leave them out")
        return []
    if observed:
        raise InputError(
            f"{observed[0]}: observations beside photographs: give one kind, `ceres-cal detect field` makes "
            "observations of photographs"
        )
    images = image_files(args.inputs)
    require_different(images)
    return images


def shown(detections: detect.KnownDetections | None) -> Section:
    """What photographs showed; nothing where none were given."""
    if detections is None:
        return Section()
    missed = missed_section(detections.missed)
    counts = ", ".join(f"{name} in {count}" for name, count in detections.shown.items())
    first = f"{plural(detections.images, 'photograph')} of station {detections.station}: {counts}"
    images = {"images": detections.images, "shown": detections.shown, **missed.data}
    return Section("images", [first, *missed.lines], {"photographs": images})


def missed_section(missed: tuple[tuple[str, str], ...]) -> Section:
    """Images in which nothing was detected, a line each."""
    data = {"missed": [{"image": path, "reason": reason} for path, reason in missed]}
    return Section("", [f"{path}: {reason}" for path, reason in missed], data)


# ---- detection ------------------------------------------------------------------------------------------------------


def detected(timeout: float | None, detect: Callable[[], _T]) -> _T:
    """What `detect` returns; InputError where it takes longer than --timeout."""
    if timeout is not None and not timeout > 0.0:
        raise InputError(f"--timeout must be above 0 seconds, not {timeout:g}")

    try:
        return base.interruptibly(detect, timeout)
    except TimeoutError:
        raise InputError(
            f"--timeout: not done after {timeout:g} s, nothing was written: give fewer images, or more time"
        ) from None


# ---- videos and medians ---------------------------------------------------------------------------------------------


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

    found: detect.Merged = detect.merged(_pictures(images, videos, bar))
    levels = np.round(found.picture * (65535 // found.white)).astype(np.uint16)
    save(path, detect.encoded(np.asarray(levels), ".png", 100))
    left_out = [{"image": name, "reason": reason} for name, reason in found.left_out]
    return {"picture": str(path), "used": list(found.used), "left_out": left_out}


def _pictures(images: Sequence[Path], videos: Sequence[Path], bar: ProgressBar) -> Iterator[tuple[str, base.Image]]:
    each = max(
        1, detect.MOST_PICTURES // (len(videos) + bool(images))
    )  # of every video, and of the photographs together
    for path in images[:: -(-len(images) // each) or 1]:
        yield str(path), detect.read_colour(path)
    for video in videos[: detect.MOST_PICTURES]:
        yield from detect.spread_frames(video, each, bar.update)


def median_text(data: dict[str, Any]) -> str:
    """What became of the pictures, in one line."""
    most_named = 3
    used, left_out = len(data["used"]), data["left_out"]
    reasons: dict[str, list[str]] = {}
    for one in left_out:
        reasons.setdefault(one["reason"], []).append(one["image"])
    said = [
        f"{len(names)} left out, {reason} ({', '.join(names[:most_named])}{', ...' if names[most_named:] else ''})"
        for reason, names in reasons.items()
    ]
    return "; ".join([f"{data['picture']}: the median of {plural(used, 'picture')} of {used + len(left_out)}", *said])
