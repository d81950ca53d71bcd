"""What an export format is: it makes files of a calibration, and says what they get wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import make_folder, write_bytes

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration


@dataclass(frozen=True)
class ExportLoss:
    """What a file gets wrong about one station, against the calibration that it was made from: 0 where it is exact.

    Attributes:
        field_mm: height_m -> root mean square and largest error over the field, mm.
        image_px: the same over the observed image, px; None where the file does not project.
    """

    station: str
    field_mm: Mapping[float, tuple[float, float]]
    image_px: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Exported:
    """A calibration in a format.

    Attributes:
        content: of the file, or by name of the files in a folder.
        losses: one for each station.
        words: what it is, for people. facts: the same for scripts, as JSON has them.
        warnings: what to know of those who will read it, a line each.
    """

    content: bytes | Mapping[str, bytes]
    losses: tuple[ExportLoss, ...]
    words: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def with_content(self, content: bytes | Mapping[str, bytes]) -> Exported:
        """The same with this content."""
        return replace(self, content=content)

    def require_loss_mm(self, most: float | None) -> None:
        """Raise InputError where a station is wrong by more than so many mm anywhere on the field."""
        for loss in self.losses if most is not None else ():
            worst = max((worst for _, worst in loss.field_mm.values()), default=float("inf"))
            if not worst <= most:  # type: ignore[operator]
                raise InputError(
                    f"station {loss.station!r}: the format would be wrong by {worst:.3g} mm on the field, more than "
                    f"{most:g}: calibrate with a lens that it holds, or allow for more"
                )

    def save(self, path: str | Path) -> None:
        """Write the file, or the folder with its files.

        Raises:
            InputError: it cannot be written.
        """
        if isinstance(self.content, bytes):
            write_bytes(path, self.content)
            return
        folder = make_folder(path)
        for name, content in self.content.items():
            write_bytes(folder / name, content)


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """What is to be exported.

    Attributes:
        stations: names, one or, where the format holds several, any number.
        ending: of the file that is asked for, one of the format's.
        options: an instance of the format's options.
        existing: content of the file of that name before; only for formats that edit it, None where there is none.
    """

    calibration: Calibration
    stations: tuple[str, ...]
    ending: str
    options: Any
    existing: bytes | None = None


@dataclass(frozen=True)
class NoOptions:
    """Of a format that leaves nothing to choose."""


@dataclass(frozen=True)
class ExportFormat:
    """A format.

    Attributes:
        name: as it is asked for. description: one line.
        endings: that its file may have, the usual one first; none where it is a folder of files.
        export: makes it; raises InputError where the calibration cannot be said in the format.
        options: frozen dataclass of numbers and texts, each with a default and metadata {"help": ...}: on the command
            line --error-mm for error_mm.
        several_stations: whether a file holds any number of stations. edits: whether an existing file is edited.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    export: Callable[[ExportRequest], Exported]
    options: type[Any] = NoOptions
    several_stations: bool = False
    edits: bool = False
