"""Definition of formats: an export makes files from a calibration and states their errors; an import reads other
programs' files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from ceres_cal import scene
from ceres_cal.base import Frozen, InputError, field, make_folder, short, write_bytes

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations


class ExportLoss(Frozen, eq=True):
    """Errors of a file for one station, compared with the calibration that it was made from; 0 where it is exact.

    Attributes:
        field_mm: height_m -> root mean square and largest error over the field, mm.
        image_px: root mean square and largest error over the observed image, px; None where the file does not project.
    """

    station: str
    field_mm: Mapping[float, tuple[float, float]]
    image_px: tuple[float, float] | None = None


class Export(Frozen):
    """A calibration in a format.

    Attributes:
        content: content of the file, or by name that of the files in a folder.
        losses: one for each station.
        words: description for users. facts: the same for scripts, in the form of JSON.
        warnings: one line for each thing that readers of the file should know.
    """

    content: bytes | Mapping[str, bytes]
    losses: tuple[ExportLoss, ...]
    words: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def require_loss_mm(self, most: float | None) -> None:
        """Raise InputError where the error of a station exceeds `most` mm anywhere on the field."""
        for loss in self.losses if most is not None else ():
            worst = max((worst for _, worst in loss.field_mm.values()), default=float("inf"))
            if not worst <= most:  # type: ignore[operator]
                raise InputError(
                    f"station {loss.station!r}: the export would be off by {short(worst, 3)} mm on the field, more "
                    f"than {most:g} mm: calibrate with a lens that the format supports, or allow a larger error"
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


class ExportRequest(Frozen):
    """A request to export stations of a calibration.

    Attributes:
        stations: names; one or, where the format holds several, any number.
        ending: ending of the requested file, one of the format's.
        existing: previous content of that file, only for formats that edit it; None where there is none.
    """

    calibration: Calibration
    stations: tuple[str, ...]
    ending: str
    existing: bytes | None = None


class ExportFormat(Frozen):
    """A format for export.

    Attributes:
        name: by which users choose it. description: one line.
        endings: possible endings of its file, the usual one first; empty if it is a folder of files.
        export: makes it; raises InputError where the format cannot represent the calibration. Its options are its
            keyword parameters: each Annotated[type, help], with a default; on the command line --error-mm for error_mm.
        most_stations: largest number of stations in a file, None for any. edits: whether an existing file is edited.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    export: Callable[..., Export]
    most_stations: int | None = 1
    edits: bool = False

    def holds(self, stations: int) -> bool:
        """Whether a file can hold so many stations."""
        return self.most_stations is None or stations <= self.most_stations

    @property
    def options(self) -> dict[str, tuple[Any, str]]:
        """Type and help of each option, by name."""
        return _options(self.export)


def _options(work: Callable[..., Any]) -> dict[str, tuple[Any, str]]:
    names = getattr(work, "__kwdefaults__", None)
    hints = get_type_hints(work, include_extras=True) if names else {}
    return {name: get_args(hints[name]) for name in names or ()}


# ---- reading --------------------------------------------------------------------------------------------------------


class ImportRequest(Frozen):
    """A file or folder to read.

    Attributes:
        path: of the file or folder. content: of the file; empty for a folder.
    """

    path: Path
    content: bytes

    @property
    def text(self) -> str:
        """The content as text."""
        return self.content.decode("utf-8-sig", errors="replace")


class ImportFormat(Frozen):
    """A format for import.

    Attributes:
        name: by which users choose it; the same as that of the export format, if there is one. description: one line.
        endings: possible endings of its file. recognises: whether the content of a file with this ending is in the
            format.
        read: returns what it holds; raises InputError, whose text need not name the file. Its options are like those of
            an `ExportFormat`.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    recognises: Callable[[bytes], bool]
    read: Callable[..., Calibration | Observations]

    @property
    def options(self) -> dict[str, tuple[Any, str]]:
        """Type and help of each option, by name."""
        return _options(self.read)


def calibration_of(
    source: str,
    cameras: Mapping[str, scene.Camera | scene.ForeignCamera],
    targets: Mapping[str, scene.Target] | None = None,
    warnings: Sequence[str] = (),
) -> Calibration:
    """Make a calibration of unknown accuracy from the cameras of a file, by name.

    A camera without a pose defines the world, like a camera that saw only boards.

    Args:
        source: description of what was read. cameras: this package's or other programs' cameras.
        targets: targets that the file describes. warnings: one line for each thing to know.
    """
    from ceres_cal.calibration import Calibration, Fit
    from ceres_cal.problem import EXACT, Estimate, Options, Station

    ours, told = dict[str, scene.Camera](), [*warnings]
    for name, given in cameras.items():
        if isinstance(given, scene.Camera):
            ours[name] = given
            continue
        ours[name], (rms, worst) = given.camera()
        if worst > 0.0:
            what = f"its {given.model} model is approximated by the nearest {ours[name].lens.kind} lens"
            told.append(f"camera {name!r}: {what}, off by {short(rms)} px rms and {short(worst)} px at most")
        if given.cam_from_world is None:
            told.append(f"camera {name!r}: the file has no pose over a field, so the camera defines the world")
    stations = {name: Station(name, camera.cam_from_world) for name, camera in ours.items()}
    bare = {name: camera.at(type(camera.cam_from_world).identity()) for name, camera in ours.items()}
    lenses = {name: camera.lens for name, camera in ours.items()}
    each = {name: Options(lens=one.kind, powers=one.powers, terms=one.terms) for name, one in lenses.items()}
    return Calibration(
        Estimate(bare, stations, {}, EXACT),
        dict(targets or {}),
        Fit(0, 0, 0.0, 0.0, 1.0, 1.0, 0),
        (),
        f"read from {source}",
        True,
        0,
        (),
        dict.fromkeys(ours, "file"),
        tuple(told),
        Options(usual_camera=False).with_lenses(each),
        "",
    )
