"""What somebody showed and chose on the page, as frozen data: it is kept, undone, sent and read back whole."""

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
_MOST = 500  # of anything that somebody shows by hand
FEW: Meta = Meta(max_length=_MOST)

Name = Annotated[str, Meta(max_length=200)]
Text = Annotated[str, Meta(max_length=4000)]
Pixel = Annotated[float, Meta(ge=-_MOST_PX, le=_MOST_PX)]
Sigma = Annotated[float, Meta(ge=0.1, le=100.0)]
Length = Annotated[float, Meta(gt=0.0, le=10_000.0)]


class Click(Struct, frozen=True, forbid_unknown_fields=True):
    """A pixel that somebody showed, and how well a hand hits it, px."""

    x: Pixel
    y: Pixel
    sigma: Sigma


class Place(Struct, frozen=True, forbid_unknown_fields=True):
    """A pixel that lies somewhere on a named curve."""

    curve: Name
    x: Pixel
    y: Pixel
    sigma: Sigma


class Region(Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle x0, y0, x1, y1 px of one photograph, by its name, that shows nothing of the field."""

    photograph: Name
    box: tuple[Pixel, Pixel, Pixel, Pixel]


class State(Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that one can undo.

    Attributes:
        target: the field, as `--target` takes it; "" where there is none.
        points: named corners and crossings. places: of lines and arcs.
        not_painted: names of curves that this field does not have. regions: what is left out of photographs.
        facing: as `--facing` takes it. lengths: dimensions that are not the target's own, m. solved: those that the
            photographs are to tell.
        board: as `run --board` takes it. priors, exports: as `--prior` and `--to` take them.
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
    """What does not change while the page is open.

    Attributes:
        photographs: those that were named, and their sizes. folder: where results go.
        target: the field that was named; no other file is read for one.
        start, other: calibrations that were named: the field is looked for from the first.
    """

    photographs: tuple[Path, ...]
    sizes: tuple[tuple[int, int], ...]
    folder: Path
    target: str = ""
    start: Path | None = None
    other: Path | None = None


class CommandResults(Struct, frozen=True):
    """What the commands made of a state.

    Attributes:
        typed: the commands. observed: files of observations by their names. boards: the photographs that show one.
    """

    typed: tuple[str, ...]
    observed: Mapping[str, bytes]
    calibration: Path
    boards: tuple[Path, ...] = ()


class Change(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="change"):
    """The state as it is to be; `revision`: of the one that it was made from."""

    state: State
    revision: int


class Drag(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="drag"):
    """A point or a place of a curve is where the pointer is.

    Attributes:
        number: which place of the state it is; None: a new one. last: whether it was let go there.
    """

    what: str
    name: Name
    x: Pixel
    y: Pixel
    sigma: Sigma
    number: Annotated[int, Meta(ge=0, le=_MOST)] | None = None
    last: bool = False

    def of(self, state: State, target: Target) -> State:
        """The state with it; InputError where the target has nothing of that name."""
        known = target.point_index if self.what == "point" else target.curve_index
        if self.what not in ("point", "place") or self.name not in known:
            raise InputError(f"{self.what} {self.name!r} is not one of the target's: see `ceres-cal targets`")
        if self.what == "point":
            points = {**state.points, self.name: Click(self.x, self.y, self.sigma)}
            return msgspec.structs.replace(state, points=points)
        places, here = list(state.places), Place(self.name, self.x, self.y, self.sigma)
        if self.number is None or self.number >= len(places):
            places.append(here)
        else:
            places[self.number] = here
        return msgspec.structs.replace(state, places=tuple(places))


class ButtonPress(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="now"):
    """A button: what is to be done with the state as it is."""

    what: str
    photograph: Annotated[int, Meta(ge=0, le=10_000)] = 0


Message = Change | Drag | ButtonPress
_MESSAGES = msgspec.json.Decoder(Message)


def read_message(content: str | bytes) -> Message:
    """A message of the page's; InputError for anything else."""
    try:
        message: Message = _MESSAGES.decode(content)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"the message is none of the page's: {error}") from None
    return message


def target_words(state: State, target: Target) -> str:
    """The target as `--target` takes it, with the dimensions that were changed."""
    if not state.lengths:
        return state.target
    return " ".join(json_text({**target.spec, **state.lengths}).split())


# ---- kept in a file -------------------------------------------------------------------------------------------------


def load_state(path: Path) -> State:
    """What was kept of an earlier sitting.

    Raises:
        InputError: one line that names the file.
    """
    return convert(body_of(read_json(path, FORMAT, VERSION), str(path), FORMAT, VERSION), State, str(path))


def save_state(path: Path, state: State) -> None:
    """Keep it; InputError where the file cannot be written."""
    data: dict[str, Any] = msgspec.to_builtins(state)
    write_json(path, {"format": FORMAT, "version": VERSION, **data})
