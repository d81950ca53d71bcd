"""Commands equivalent to a state of the page, as one would type them, and the files that they need."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ceres_cal.base import InputError, read_bytes, write_bytes, write_json
from ceres_cal.cli import arguments
from ceres_cal.cli.command import COMMANDS
from ceres_cal.cli.page.state import CommandResults, PageContext, Region, State, target_words
from ceres_cal.detect.images import encoded
from ceres_cal.detect.photographs.by_hand import FEWEST, FORMAT, VERSION
from ceres_cal.formats import export_format
from ceres_cal.report.document import Document
from ceres_cal.scene.targets import Target

CAMERA = "camera"


class PageStep(NamedTuple):
    """A command with its arguments, and what it writes."""

    name: str
    arguments: tuple[str, ...]
    output: Path

    @property
    def typed(self) -> str:
        return COMMANDS[self.name].typed(self.arguments)

    def answer(self) -> Document:
        return COMMANDS[self.name].answer(self.arguments, quiet=True)


def make(
    sitting: PageContext,
    state: State,
    target: Target | None,
    folder: Path,
    *,
    auto: bool = False,
    known: CommandResults | None = None,
) -> CommandResults:
    """Detect and calibrate into a folder, by the commands.

    Args:
        auto: without an initial estimate.
        known: earlier results for this state: its observations are written again, together with a report and exports.

    Raises:
        CalibrationError: as raised by a command, or there is nothing to look for.
    """
    write_inputs(state, sitting, folder, auto=auto)
    done: list[PageStep] = []
    boards = () if known is None else known.boards

    def observe(step: PageStep) -> Any:
        done.append(step)
        if known is None:
            return step.answer().data["found"]
        # The file that the command wrote when the lines were found.
        return write_bytes(step.output, known.observed[step.output.name])

    if state.board:
        boards = tuple(map(Path, observe(board_step(state, sitting, folder)) or boards))
    if target is not None:
        for step in field_steps(state, target, sitting, folder, boards, auto=auto):
            observe(step)
    if not done:
        raise InputError("say what the photographs show: choose a field, or give the size of a board")
    outputs = [step.output for step in done]
    calibrated = calibrate_step(state, outputs, folder, report=known is not None)
    for step in (calibrated, *(export_steps(state, folder) if known is not None else ())):
        step.answer()
        done.append(step)
    observed = {path.name: read_bytes(path) for path in outputs}
    return CommandResults(tuple(step.typed for step in done), observed, calibrated.output, boards)


def board_step(state: State, sitting: PageContext, folder: Path) -> PageStep:
    """Return the detection of boards in all photographs."""
    output = folder / "board.json"
    words = [*arguments.board_words(state.board), "--camera", CAMERA, "-o", str(output)]
    return PageStep("detect board", (*map(str, sitting.photographs), *words), output)


def field_steps(
    state: State, target: Target, sitting: PageContext, folder: Path, boards: Collection[Path], *, auto: bool
) -> Iterator[PageStep]:
    """Yield the detection of the field in photographs without a board; those with a mask of their own one by one.

    Raises:
        InputError: there is nothing to start from, or no photograph is left.
    """
    images = [path for path in sitting.photographs if path not in boards]
    if not images:
        raise InputError("every photograph shows the board, and none is left for the field: take one without it")
    masked = {one.photograph for one in state.regions}
    groups = [[path for path in images if path.name not in masked]]
    groups += [[path] for path in images if path.name in masked]
    for number, group in enumerate(filter(None, groups), start=1):
        words = ["--target", target_words(state, target)] if state.target else []
        if auto:
            words += ["--auto", *(["--facing", state.facing] if state.facing else [])]
            words += [] if sitting.start is None else ["--start", str(sitting.start)]
        elif len(state.points) >= FEWEST:
            words += ["--start", str(folder / "corners.json")]
        elif sitting.start is not None and not state.points and not state.places:
            words += ["--start", str(sitting.start)]
        else:
            raise InputError(f"show {FEWEST} corners or crossings first, or let the field be found by itself")
        if state.not_painted:
            words += ["--not-painted", ",".join(state.not_painted)]
        if state.solved:
            words += ["--estimate", ",".join(state.solved)]
        if group[0].name in masked:
            words += ["--mask", str(folder / _mask_name(group[0]))]
        output = folder / (f"field-{number}.json" if number > 1 else "field.json")
        # Otherwise the names of the calibration are used.
        words += [] if sitting.start is not None else ["--camera", CAMERA]
        yield PageStep("detect field", (*map(str, group), *words, "-o", str(output)), output)


def calibrate_step(state: State, observed: Sequence[Path], folder: Path, report: bool) -> PageStep:
    """Return one calibration of all observations."""
    priors = arguments.repeated("--prior", state.priors)
    lengths = ["--estimate", ",".join(state.solved)] if state.solved else []
    page = ["--report", str(folder / "report.html")] if report else []
    output = folder / "calibration.json"
    return PageStep("calibrate", (*map(str, observed), *priors, *lengths, "-o", str(output), *page), output)


def export_steps(state: State, folder: Path) -> Iterator[PageStep]:
    """Yield the export to each format that was chosen."""
    for name in state.exports:
        output = folder / f"{name}{(export_format(name).endings or ('',))[0]}"
        yield PageStep("export", (str(folder / "calibration.json"), "--to", name, "-o", str(output)), output)


# ---- what commands read ---------------------------------------------------------------------------------------------


def write_inputs(state: State, sitting: PageContext, folder: Path, *, auto: bool) -> None:
    """Write clicks and masks as files for the commands."""
    if not auto and len(state.points) >= FEWEST:
        points = {name: (one.x, one.y) for name, one in state.points.items()}
        curves = [(one.curve, one.x, one.y) for one in state.places]
        data = {"format": FORMAT, "version": VERSION, "points": points, "curves": curves}
        write_json(folder / "corners.json", data)
    for path, size in zip(sitting.photographs, sitting.sizes, strict=True):
        regions = [one for one in state.regions if one.photograph == path.name]
        if regions:
            write_bytes(folder / _mask_name(path), _mask(regions, size))


def _mask_name(path: Path) -> str:
    return f"mask-{path.stem}.png"


def _mask(regions: Sequence[Region], size: tuple[int, int]) -> bytes:
    """Return a picture that is black where nothing of the field is."""
    black, white = 0, 255
    picture = np.full(size[::-1], white, np.uint8)
    for one in regions:
        x0, y0, x1, y1 = np.round(one.box).astype(int).tolist()
        picture[max(min(y0, y1), 0) : max(y0, y1, 0) + 1, max(min(x0, x1), 0) : max(x0, x1, 0) + 1] = black
    return encoded(picture, ".png", 100)
