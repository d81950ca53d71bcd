"""`ceres-cal join`: the observations of a rig's cameras in one file, with consistent frames and labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal import start
from ceres_cal.base.words import plural
from ceres_cal.cli.arguments import output_option
from ceres_cal.cli.command import argument, command, option
from ceres_cal.cli.files import read_observations, require_different, require_observations_output, save
from ceres_cal.report.document import Document, Section, wrapped

if TYPE_CHECKING:
    from ceres_cal.observations import Observations


@command(
    "join",
    "a rig's observations as one: same frames, same labels",
    "left.json right.json --same-frame 'left*,right*' -o rig.json",
)
def _run(
    observations: tuple[str, ...] = argument("OBS", "files of observations, of all cameras"),
    same_frame: str | None = option(
        "which frames are one moment: 'left*,right*' (the part at * names it), index (the n-th of each "
        "camera), or within:0.01 (frames are named by time stamps); default: those of one name",
        "RULE",
    ),
    output: Path = output_option("the joined observations (.json or .npz)"),
) -> Document:
    require_different(observations)
    require_observations_output(output, observations)
    seen = read_observations(observations)
    from ceres_cal.observations.same_frame import with_same_frames

    if same_frame is not None:
        seen = with_same_frames(seen, same_frame)
    labels = start.with_same_labels(seen)
    save(output, labels.observations)
    return Document((*_sections(labels, same_frame), Section("written", [str(output)], {"output": str(output)})))


def _moments(observations: Observations) -> Counter[int]:
    """Number of moments by the number of cameras that saw them."""
    cameras: dict[str, set[str]] = {}
    for view in observations.views:
        cameras.setdefault(view.frame, set()).add(view.camera)
    return Counter(len(seen) for seen in cameras.values())


def _sections(labels: start.Labels, same_frame: str | None) -> Iterator[Section]:
    by_count = sorted(_moments(labels.observations).items())
    rule = "of one name" if same_frame is None else f"by {same_frame!r}"
    seen = ", ".join(f"{number} seen by {plural(count, 'camera')}" for count, number in reversed(by_count))
    moments = {str(count): number for count, number in by_count}
    yield Section("moments", wrapped(f"{seen} (frames {rule})"), {"moments_by_cameras": moments})
    which = ", ".join(f"{placement!r} of {station!r}" for station, placement in labels.turned)
    turned = wrapped(f"labels turned to match the first camera: {which}") if which else []
    yield Section("labels", turned, {"turned": labels.turned, "open": labels.open})
    for station in labels.open:
        yield Section("warning", wrapped(start.open_words(station)))
