"""State of the page: what the user showed and chose, as frozen data that are saved, undone, sent and loaded whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from ceres_cal.base import InputError, body_of, convert, json_text, read_json, write_json
from ceres_cal.scene.targets import Target

FORMAT, VERSION = "ceres-cal/page", 1
_MOST_PX = 1e6
_MOST = 500  # largest number of items of each kind that a user may show
FEW: Meta = Meta(max_length=_MOST)

Name = Annotated[str, Meta(max_length=200)]
Text = Annotated[str, Meta(max_length=4000)]
Pixel = Annotated[float, Meta(ge=-_MOST_PX, le=_MOST_PX)]
Sigma = Annotated[float, Meta(ge=0.1, le=100.0)]
Length = Annotated[float, Meta(gt=0.0, le=10_000.0)]


class Click(Struct, frozen=True, forbid_unknown_fields=True):
    """A pixel that the user showed, and its standard deviation, px."""

    x: Pixel
    y: Pixel
    sigma: Sigma


class Place(Struct, frozen=True, forbid_unknown_fields=True):
    """A pixel that lies somewhere on a named curve, and its standard deviation, px."""

    curve: Name
    x: Pixel
    y: Pixel
    sigma: Sigma


class Region(Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle x0, y0, x1, y1 px of one photograph, given by name, that shows nothing of the field."""

    photograph: Name
    box: tuple[Pixel, Pixel, Pixel, Pixel]


class State(Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that can be undone.

    Attributes:
        target: the field, as for `--target`; "" where there is none.
        points: named corners and crossings. places: places on lines and arcs.
        not_painted: names of curves that this field does not have. regions: parts of photographs that are left out.
        facing: as for `--facing`. lengths: dimensions that differ from the target's own, m.
        solved: dimensions that are estimated from the photographs.
        board: as for `run --board`. priors, exports: as for `--prior` and `--to`.
    """

    target: Text = ""
    points: Annotated[dict[Name, Click], FEW] = {}
    places: Annotated[tuple[Place, ...], FEW] = ()
    not_painted: Annotated[tuple[Name, ...], FEW] = ()
    regions: Annotated[tuple[Region, ...], FEW] = ()
    facing: Name = ""
    lengths: Annotated[dict[Name, Length], FEW] = {}
    solved: Annotated[tuple[Name, ...], FEW] = ()
    board: Name = ""
    priors: Annotated[tuple[Name, ...], FEW] = ()
    exports: Annotated[tuple[Name, ...], FEW] = ()


class PageContext(Struct, frozen=True):
    """The inputs of the page that do not change while it is open.

    Attributes:
        photographs: those named. sizes: their (width, height) px. folder: for results.
        target: the named field; no other file is read for one.
        start, other: named calibrations; the search for the field starts from the first.
    """

    photographs: tuple[Path, ...]
    sizes: tuple[tuple[int, int], ...]
    folder: Path
    target: str = ""
    start: Path | None = None
    other: Path | None = None


class CommandResults(Struct, frozen=True):
    """Results of the commands for a state.

    Attributes:
        typed: the commands. observed: files of observations by name. calibration: its file.
        boards: the photographs that show a board.
    """

    typed: tuple[str, ...]
    observed: Mapping[str, bytes]
    calibration: Path
    boards: tuple[Path, ...] = ()


class Change(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="change"):
    """A new state; `revision` is that of the state it was made from."""

    state: State
    revision: int


class Drag(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="drag"):
    """A point, or a place of a curve, is at the pointer.

    Attributes:
        number: index of the place in the state; None for a new one. last: whether it was released there.
    """

    what: str
    name: Name
    x: Pixel
    y: Pixel
    sigma: Sigma
    number: Annotated[int, Meta(ge=0, le=_MOST)] | None = None
    last: bool = False

    def of(self, state: State, target: Target) -> State:
        """Return the state with the drag applied; InputError where the target has nothing of that name."""
        known = target.point_index if self.what == "point" else target.curve_index
        if self.what not in ("point", "place") or self.name not in known:
            raise InputError(f"{self.what} {self.name!r} is not one of the target's: see `ceres-cal targets`")
        if self.what == "point":
            points = {**state.points, self.name: Click(self.x, self.y, self.sigma)}
            return msgspec.structs.replace(state, points=points)
        at = len(state.places) if self.number is None else self.number
        here = Place(self.name, self.x, self.y, self.sigma)
        return msgspec.structs.replace(state, places=(*state.places[:at], here, *state.places[at + 1 :]))


class ButtonPress(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="now"):
    """A button: what to do with the present state."""

    what: str
    photograph: Annotated[int, Meta(ge=0, le=10_000)] = 0


Message = Change | Drag | ButtonPress
_MESSAGES = msgspec.json.Decoder(Message)


def read_message(content: str | bytes) -> Message:
    """Decode a message of the page; InputError for anything else."""
    try:
        message: Message = _MESSAGES.decode(content)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"the message is none of the page's: {error}") from None
    return message


def target_words(state: State, target: Target) -> str:
    """Return the target as for `--target`, with the changed dimensions."""
    if not state.lengths:
        return state.target
    return " ".join(json_text({**target.spec, **state.lengths}).split())


# ---- kept in a file -------------------------------------------------------------------------------------------------


def load_state(path: Path) -> State:
    """Load the state of an earlier session.

    Raises:
        InputError: one line that names the file.
    """
    return convert(body_of(read_json(path, FORMAT, VERSION), str(path), FORMAT, VERSION), State, str(path))


def save_state(path: Path, state: State) -> None:
    """Save the state; InputError where the file cannot be written."""
    data: dict[str, Any] = msgspec.to_builtins(state)
    write_json(path, {"format": FORMAT, "version": VERSION, **data})
