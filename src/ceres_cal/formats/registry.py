"""Tables of all formats, the export of a calibration to one of them, and the import of other programs' files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base import InputError, checked, naming, no_such, read_bytes
from ceres_cal.formats import colmap, detections, kalibr, lookup, mrcal, opencv, paper, ros, ssl_geometry, ssl_settings
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations

_MODULES = (lookup, ssl_geometry, ssl_settings, opencv, ros, kalibr, mrcal, colmap, paper, detections)
_EVERY: list[ExportFormat | ImportFormat] = [form for module in _MODULES for form in module.FORMATS]
EXPORT_FORMATS = {form.name: form for form in _EVERY if isinstance(form, ExportFormat)}
IMPORT_FORMATS = {form.name: form for form in _EVERY if isinstance(form, ImportFormat)}
"""Formats by name; import formats are tried in this order to recognise a file."""


def export_format(name: str) -> ExportFormat:
    """Return the format of a name; InputError where there is none."""
    if name not in EXPORT_FORMATS:
        raise InputError(no_such("export format", name, EXPORT_FORMATS))
    return EXPORT_FORMATS[name]


@checked
def export(
    calibration: Calibration,
    to: str,
    path: str | Path,
    stations: Sequence[str] | None = None,
    max_loss_mm: float | None = None,
    **options: Any,
) -> Export:
    """Write a calibration to a file of a format, or to a folder if the format is a folder.

    Args:
        to: name of the format.
        stations: by default all if the format holds several, else the only one.
        max_loss_mm: refuse an export with a larger error anywhere on the field, on the floor or at robot height.
        options: the format's own.

    Returns:
        The exported content and its errors.

    Raises:
        InputError: no such format, station, option or ending of a file, several stations for a format that holds one, a
            calibration that the format cannot represent, or only with more than `max_loss_mm`, or a file that cannot be
            written.
    """
    exported = prepare_export(calibration, to, path, stations, options)
    exported.require_loss_mm(max_loss_mm)
    exported.save(path)
    return exported


def prepare_export(
    calibration: Calibration, to: str, path: str | Path, stations: Sequence[str] | None, options: Mapping[str, Any]
) -> Export:
    """Make an export without writing it; see `export`."""
    form, path = export_format(to), Path(path)
    names, ending = _stations(calibration, form, stations), _ending(form, path)
    existing = read_bytes(path) if form.edits and path.exists() else None
    return form.export(ExportRequest(calibration, names, ending, existing), **_known_options(form, options))


def read_foreign(path: str | Path, form: str | None = None, **options: Any) -> Calibration | Observations:
    """Read a file of another program.

    Args:
        form: name of the format, by default determined from the file's ending and content.
        options: the format's own.

    Raises:
        InputError: one line that names the file, and what is wrong with it.
    """
    from ceres_cal.observations import Observations

    path = Path(path)
    content = b"" if path.is_dir() else read_bytes(path)
    chosen = _import_format(path, content, form)
    with naming(path):
        made = chosen.read(ImportRequest(path, content), **_known_options(chosen, options))
        if isinstance(made, Observations):
            made.require_inside()
    return made


@checked
def import_calibration(path: str | Path, form: str | None = None, **options: Any) -> Calibration:
    """Read a calibration from a file of another program: see `read_foreign`.

    Raises:
        InputError: it holds observations.
    """
    from ceres_cal.calibration import Calibration

    given = read_foreign(path, form, **options)
    if not isinstance(given, Calibration):
        raise InputError(f"{path}: holds observations, not cameras: calibrate them")
    return given


@checked
def import_observations(path: str | Path, form: str | None = None, **options: Any) -> Observations:
    """Read observations from a file of another program: see `read_foreign`.

    Raises:
        InputError: it holds cameras.
    """
    from ceres_cal.observations import Observations

    given = read_foreign(path, form, **options)
    if not isinstance(given, Observations):
        raise InputError(f"{path}: holds cameras, not observations")
    return given


def _import_format(path: Path, content: bytes, name: str | None) -> ImportFormat:
    known = ", ".join(IMPORT_FORMATS)
    if name is not None:
        if name not in IMPORT_FORMATS:
            raise InputError(no_such("import format", name, IMPORT_FORMATS))
        return IMPORT_FORMATS[name]
    for form in IMPORT_FORMATS.values():
        if (path.name.endswith(form.endings) if form.endings else path.is_dir()) and form.recognises(content):
            return form
    if b'"ceres-cal/' in content[:4096]:
        raise InputError(f"{path}: a file of ceres-cal, not of another program: give it without an import")
    raise InputError(f"{path}: its format is not recognised by ending and content: name one of {known}")


def _stations(calibration: Calibration, form: ExportFormat, names: Sequence[str] | None) -> tuple[str, ...]:
    if names is None and form.most_stations == 1:
        calibration.station()  # raises InputError where there are several
    chosen = tuple(calibration.stations) if names is None else tuple(names)
    for name in chosen:
        calibration.station(name)
    if not form.holds(len(chosen)):
        most = "one station" if form.most_stations == 1 else f"{form.most_stations} stations at most"
        raise InputError(f"a file of format {form.name} holds {most}, not {len(chosen)}: name the stations")
    return chosen


def _ending(form: ExportFormat, path: Path) -> str:
    endings = [ending for ending in form.endings if path.name.endswith(ending)]
    if form.endings and not endings:
        raise InputError(f"{path}: a file of format {form.name} ends in {' or '.join(form.endings)}")
    return max(endings, key=len, default="")


def _known_options(form: ExportFormat | ImportFormat, options: Mapping[str, Any]) -> Mapping[str, Any]:
    for name in options:
        if name not in form.options:
            raise InputError(no_such(f"option of format {form.name}", name, form.options))
    return options
