"""The model drawn into photographs of the observed frames: does it lie on the paint?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceres_cal.calibration import Calibration
from ceres_cal.pictures.files import jpeg_of_at_most, read_photograph
from ceres_cal.pictures.frames import Frame, frames_of, marks_of, model_of
from ceres_cal.pictures.overlay import AFTER, BEFORE, Layer, draw_overlay
from ceres_cal.report.material import ClosedForm, Material
from ceres_cal.report.page import Chapter, Gallery, Photograph, Text
from ceres_cal.report.words import count, fixed, listed

MOST_PHOTOGRAPHS = 4
_WIDEST_PX, _MOST_BYTES = 1400, 230_000  # of one picture: four of them are 1.2 MB in a page
_READING = (
    "Magenta: lines, arcs and corners where this calibration puts them, wide paint by its two edges. Where they do not "
    "lie on the paint, the residuals cannot tell it: a line that nobody observed, another field, a label gone wrong."
)


@dataclass(frozen=True, eq=False)
class Album:
    """Photographs by the names of their frames, and the calibration to compare with.

    Attributes:
        paths: frame -> image file. before: an earlier calibration, drawn in cyan; None for the closed form, where there
            is one.
    """

    paths: Mapping[str, Path]
    before: Calibration | None = None


def in_photographs(material: Material, album: Album) -> Chapter:
    """The chapter: of each station its first frame, then those with the largest residuals, at most four.

    Raises:
        InputError: an image cannot be read, or has not the size of its camera.
    """
    frames = [frame for frame in frames_of(material.observations) if frame.name in album.paths]
    chosen = _chosen(material, frames)
    without = [frame.name for frame in frames_of(material.observations) if frame.name not in album.paths]
    notes = [Text(_READING)]
    if without:
        notes.append(Text(f"No photograph of {count(len(without), 'frame')}: {listed(without, 8)}.", "note"))
    if len(frames) > len(chosen):
        shown = f"{len(chosen)} of {len(frames)} photographs: the first of each station, then the largest residuals"
        notes.append(Text(f"{shown}; `ceres-cal undistort --overlay` draws any other.", "note"))
    pictures = tuple(_picture(material, album, frame, number) for number, frame in enumerate(chosen))
    return Chapter("photographs", "In the photograph", (*notes, Gallery(pictures)))


def _chosen(material: Material, frames: list[Frame]) -> list[Frame]:
    first = {frame.station: frame for frame in reversed(frames)}
    size = {frame: _rms_px(material, frame) for frame in frames}
    order = sorted(frames, key=lambda frame: (first[frame.station] is not frame, -size[frame]))
    return order[:MOST_PHOTOGRAPHS]


def _rms_px(material: Material, frame: Frame) -> float:
    """Of the residuals that took part in a frame; 0 without any."""
    table = material.diagnosis.table
    found = table.distance_px[np.isin(table.view, frame.views) & table.inlier]
    return float(np.sqrt(np.mean(found**2))) if len(found) else 0.0


def _picture(material: Material, album: Album, frame: Frame, number: int) -> Photograph:
    calibration, path = material.calibration, album.paths[frame.name]
    model = model_of(calibration, frame)
    owner = calibration.estimate.stations[frame.station].camera
    photograph = read_photograph(path, model.image_size, owner)
    layers, said = [Layer(model, "this calibration", AFTER)], []
    for before, name in _before(material, album, frame):
        layers.insert(0, Layer(model_of(before, frame), name, BEFORE))
        median, worst = model.apart_px(layers[0].model)
        said.append(f"Cyan: {name}, {fixed(median, 2)} px away in the median and {fixed(worst, 2)} px at most.")
    marks = [one for one in marks_of(calibration, material.observations, frame) if one.crosses]  # dots would hide paint
    said += [f"Crosses: {count(len(one.pixels), 'observation')} taken out." for one in marks]
    drawn = draw_overlay(photograph, layers, marks)
    return Photograph(
        f"photograph-{number}",
        f"Frame {frame.name}, {frame.station}",
        f"{' '.join(said)} Residuals {fixed(_rms_px(material, frame), 2)} px rms.",
        jpeg_of_at_most(drawn, _WIDEST_PX, _MOST_BYTES),
    )


def _before(material: Material, album: Album, frame: Frame) -> Iterator[tuple[Calibration, str]]:
    """What to compare with, as far as it knows the frame."""
    before, name = album.before, "the calibration before"
    if before is None and isinstance(material.closed_form, ClosedForm):
        before, name = material.closed_form.calibration, "the paper's closed form"
    if before is None or frame.station not in before.stations:
        return
    if all(placement is None or placement in before.placements for _, placement in frame.shown):
        yield before, name
