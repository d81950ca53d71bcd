"""The report: chapters in reading order, as one self-contained page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from ceres_cal.base import StepProgress, checked, counted, first_of, write_bytes
from ceres_cal.calibration import Calibration, LensChoice
from ceres_cal.diagnostics import Diagnosis, diagnose
from ceres_cal.observations import Observations
from ceres_cal.problem import Options
from ceres_cal.report import findings
from ceres_cal.report.document import Chapter, Details, Figure, Gallery, Piece, Text
from ceres_cal.report.grounds import promises
from ceres_cal.report.maps import image_figure, lens_image_figure, map_figure
from ceres_cal.report.page import page
from ceres_cal.report.quality import FramePhotographs, Material
from ceres_cal.report.residual_pictures import against_radius, by_frame, outliers, support, vectors
from ceres_cal.report.solve_pictures import against_closed_form, convergence, correlation, distortion
from ceres_cal.report.summary import numbers_chapter, verdict_chapter

_CHAPTERS = 8  # largest number of chapters
MOST_CAMERAS = 8
"""Largest number of cameras, and of stations, with pictures of their own; the others are only in the tables."""

_OF_MAPS = (
    "How far off a located point may be because of the calibration: 95 % are within the mm shown. Blue is good, amber "
    "is usable with limits, brown is not to be used; the colours are the same in every report. The noise of the "
    "located pixel is not included, nor are model errors."
)
_NO_PROMISE = "The verdict above states no accuracy. These maps hold only after its reasons are corrected."


def make_report(
    calibration: Calibration,
    observations: Observations,
    diagnosis: Diagnosis | None = None,
    choices: Mapping[str, LensChoice] | None = None,
    photographs: FramePhotographs | None = None,
    progress: StepProgress | None = None,
) -> str:
    """Return one self-contained HTML page on a calibration: verdict, findings, numbers, pictures.

    Args:
        observations: those the calibration was made from; or others, with a diagnosis of them (`new_data`).
        diagnosis: of these observations; computed here if it is None.
        choices: camera -> choice of its lens by held-out error.
        photographs: of the frames, for a chapter with the model drawn into them.
        progress: called after each chapter.

    Raises:
        InputError: the observations are not those of the calibration, and no diagnosis says so; or a photograph cannot
            be read.
    """
    diagnosis = diagnose(calibration, observations) if diagnosis is None else diagnosis
    material = Material(calibration, observations, diagnosis, choices=choices, photographs=photographs)
    chapters = []
    for number, chapter in enumerate(_chapters(material), start=1):
        chapters.append(chapter)
        if progress is not None:
            progress(number, _CHAPTERS, f"report: {chapter.title}")
    return page(", ".join(list(observations.cameras)[:4]), _about(material), chapters, _foot(calibration))


@checked
def write_report(
    path: str | Path,
    calibration: Calibration,
    observations: Observations,
    diagnosis: Diagnosis | None = None,
    choices: Mapping[str, LensChoice] | None = None,
    photographs: FramePhotographs | None = None,
) -> None:
    """Write the page of `make_report`.

    Raises:
        InputError: see `make_report`; or the file cannot be written.
    """
    write_bytes(path, make_report(calibration, observations, diagnosis, choices, photographs).encode())


def _chapters(material: Material) -> Iterator[Chapter]:
    yield verdict_chapter(material)
    if material.photographs is not None:
        from ceres_cal.report.in_photographs import in_photographs  # imports OpenCV, only for photographs

        yield in_photographs(material, material.photographs)
    supported = tuple(support(material, name) for name in list(material.observations.cameras)[:MOST_CAMERAS])
    yield Chapter("support", "What was observed", (Gallery(supported),))
    yield findings.chapter(material.diagnosis, material.choices, material.calibration.options)
    yield numbers_chapter(material, material.seams)
    yield from _pictures(material)


def _pictures(material: Material) -> Iterator[Chapter]:
    cameras = list(material.observations.cameras)
    shown = cameras[:MOST_CAMERAS]
    pictures = [vectors(material, name) for name in shown]
    for name in shown:
        pictures += [against_radius(material, name), distortion(material, name)]
    pictures += [picture for picture in (by_frame(material), outliers(material)) if picture is not None]
    yield Chapter("residuals", "Residuals and the lens", (*_left_out(cameras), Gallery(tuple(pictures))))
    places = tuple(_places(material))
    if places:
        yield Chapter("maps", "Accuracy on the field", places)
    yield _solve(material)


def _places(material: Material) -> Iterator[Piece]:
    """Yield maps over the image beside those over the field; for cameras without a place over a field, over the image
    alone.
    """
    if material.uncertainty is None:
        return
    stations = list(material.maps)
    pictures = []
    for name in stations[:MOST_CAMERAS]:
        pictures += [map_figure(material, name, 0), image_figure(material, name), map_figure(material, name, 1)]
    owners = {material.observations.stations[name] for name in stations}
    without = [name for name in material.observations.cameras if name not in owners]
    pictures += [lens_image_figure(material, name) for name in without[:MOST_CAMERAS]]
    if stations:
        yield Text(_OF_MAPS)
    if not promises(material):
        yield Text(_NO_PROMISE, "warning")
    yield from _left_out(stations)
    yield from _left_out(without)
    yield Gallery(tuple(pictures))


def _left_out(names: list[str]) -> tuple[Text, ...]:
    rest = names[MOST_CAMERAS:]
    return (Text(f"Without pictures here: {first_of(rest, 12)}."),) if rest else ()


def _solve(material: Material) -> Chapter:
    closed = material.closed_form
    figures: list[Figure | None] = [convergence(material), correlation(material)]
    if not isinstance(closed, str):
        figures.insert(1, against_closed_form(material, *closed))
    texts = (Text(f"No closed form to compare with: {closed}.", "note"),) if isinstance(closed, str) else ()
    gallery = Gallery(tuple(figure for figure in figures if figure is not None))
    folded = Details("Convergence, closed form, and correlations", (gallery, *texts))
    return Chapter("solve", "The solve", (folded,))


def _about(material: Material) -> str:
    words = ("view", "camera", "station", "placement", "point observation", "curve observation")
    counts = zip(material.observations.counts.values(), words, strict=True)
    return ", ".join(counted(number, word) for number, word in counts if number)


def _foot(calibration: Calibration) -> str:
    options = calibration.options
    lenses = dict.fromkeys(_lens_words(options.of_camera(name)) for name in calibration.cameras)
    versions = ", ".join(f"{name} {version}" for name, version in calibration.versions.items())
    return (
        f"Solved with the {' and the '.join(lenses)}, {options.loss} loss from {options.loss_scale:g} sigma, outliers "
        f"from {options.reject_sigma:g} sigma. {calibration.termination.rstrip('.')}. Observations SHA-256 "
        f"{calibration.digest[:16]}…; {versions}."
    )


def _lens_words(options: Options) -> str:
    powers = f" with powers {', '.join(map(str, options.powers))}" if options.blank_lens.powers else ""
    return f"{options.lens} lens{powers}"
