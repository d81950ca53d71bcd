"""The model drawn into photographs of the observed frames, to see whether it lies on the paint."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ceres_cal.base import counted, first_of, fixed, rms
from ceres_cal.calibration import Calibration
from ceres_cal.report.document import Chapter, Details, Figure, Gallery, Text
from ceres_cal.report.pictures.frames import Frame, frames_of, jpeg_of_at_most, marks_of, model_of, read_photograph
from ceres_cal.report.pictures.overlay import Layer, Model, draw_overlay
from ceres_cal.report.quality import FramePhotographs, Material

MOST_PHOTOGRAPHS = 4
_READING = (
    "Magenta: lines, arcs and corners as the calibration predicts them; wide paint is drawn by its two edges. Look "
    "whether they lie on the paint. Residuals do not show a line without observations, another field, or a wrong label."
)


def in_photographs(material: Material, photographs: FramePhotographs) -> Chapter:
    """Make the chapter with at most four photographs: the first frame of each station (of a field if it saw one), then
    those with the largest residuals.

    Raises:
        InputError: an image cannot be read, or has not the size of its camera.
    """
    every = frames_of(material.observations)
    frames = [frame for frame in every if (frame.name, frame.station) in photographs.paths]
    without = [frame.name for frame in every if frame not in frames]
    chosen = _chosen(material, frames)
    notes = [Text(_READING)]
    if without:
        notes.append(Text(f"No photograph of {counted(len(without), 'frame')}: {first_of(without, 8)}.", "note"))
    if len(frames) > len(chosen):
        which = "the first of each station, of a field if it saw one, then the largest residuals"
        shown = f"{len(chosen)} of {len(frames)} photographs: {which}"
        notes.append(Text(f"{shown}; `ceres-cal undistort --overlay` draws any other.", "note"))
    pictures = tuple(_picture(material, photographs, frame, number) for number, frame in enumerate(chosen))
    more = (Details("More photographs", (Gallery(pictures[1:]),)),) if len(pictures) > 1 else ()
    return Chapter("photographs", "In the photograph", (Gallery(pictures[:1]), *notes, *more))


def _chosen(material: Material, frames: list[Frame]) -> list[Frame]:
    first = first_of_each(frames)
    size = {frame: _rms_px(material, frame) for frame in frames}
    order = sorted(frames, key=lambda frame: (first[frame.station] is not frame, -size[frame]))
    return order[:MOST_PHOTOGRAPHS]


def first_of_each(frames: Iterable[Frame]) -> dict[str, Frame]:
    """By station: the first frame that shows the world, or boards alone where none does."""
    world_first = sorted(frames, key=lambda frame: all(placement is not None for _, placement in frame.shown))
    return {frame.station: frame for frame in reversed(world_first)}


def _rms_px(material: Material, frame: Frame) -> float:
    """Root mean square of a frame's residuals of inliers, px; 0 without any."""
    table = material.diagnosis.table
    distances = table.distance_px[np.isin(table.view, frame.views) & table.inlier]
    return rms(distances, 0.0)


def _picture(material: Material, photographs: FramePhotographs, frame: Frame, number: int) -> Figure:
    widest_px, most_bytes = 1400, 230_000  # limits of one picture: four of them are 1.2 MB in a page
    calibration, path = material.calibration, photographs.paths[frame.name, frame.station]
    model = model_of(calibration, frame)
    owner = calibration.estimate.stations[frame.station].camera
    photograph = read_photograph(path, model.image_size, owner)
    layers, notes = [Layer(model, "this calibration", "after")], []
    for before, name in _before(material, photographs, frame):
        earlier = model_of(before, frame)
        layers.insert(0, Layer(earlier, name, "before"))
        median, worst = model.apart_px(earlier)
        notes.append(f"Cyan: {name}, median distance {fixed(median, 2)} px, at most {fixed(worst, 2)} px.")
    for one in marks_of(calibration, material.observations, frame):
        if one.crosses and not isinstance(one.shown, Model):  # dots would hide paint
            layers.append(one)
            notes.append(f"Crosses: {counted(len(one.shown), 'observation')} taken out.")
    drawn = draw_overlay(photograph, layers)
    return Figure(
        f"photograph-{number}",
        f"Frame {frame.name}, {frame.station}",
        f"{' '.join(notes)} Residuals {fixed(_rms_px(material, frame), 2)} px rms.",
        jpeg_of_at_most(drawn, widest_px, most_bytes),
    )


def _before(material: Material, photographs: FramePhotographs, frame: Frame) -> Iterator[tuple[Calibration, str]]:
    """Yield the calibration to compare with and its name, if it knows the frame."""
    before, name = photographs.before, "the calibration before"
    if before is None and not isinstance(material.closed_form, str):
        before, name = material.closed_form[0], "the paper's closed form"
    if before is None or frame.station not in before.stations:
        return
    if all(placement is None or placement in before.placements for _, placement in frame.shown):
        yield before, name
