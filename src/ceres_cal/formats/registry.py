"""The table of all export formats, and the export of a calibration to one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import read_bytes
from ceres_cal.formats import lookup
from ceres_cal.formats.export_format import Exported, ExportFormat, ExportRequest

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration

EXPORT_FORMATS: dict[str, ExportFormat] = {form.name: form for form in (lookup.FORMAT,)}


def export_format(name: str) -> ExportFormat:
    """The format of a name; InputError where there is none."""
    if name not in EXPORT_FORMATS:
        known = f"choose one of {', '.join(EXPORT_FORMATS)}" if EXPORT_FORMATS else "no format is registered"
        raise InputError(f"there is no export format {name!r}: {known}")
    return EXPORT_FORMATS[name]


def export(
    calibration: Calibration, to: str, path: str | Path, stations: Sequence[str] | None = None, **options: Any
) -> Exported:
    """Write a calibration to a file of a format, or to a folder where the format takes one.

    Args:
        to: name of the format. stations: by default all where the format holds several, else the only one.
        options: the format's own.

    Returns:
        what was written, and what it gets wrong.

    Raises:
        InputError: no such format, station, option or ending of a file, several stations for a format that holds one, a
            calibration that cannot be said in the format, or a file that cannot be written.
    """
    exported = prepare_export(calibration, to, path, stations, options)
    exported.save(path)
    return exported


def prepare_export(
    calibration: Calibration, to: str, path: str | Path, stations: Sequence[str] | None, options: Mapping[str, Any]
) -> Exported:
    """The same, not yet written."""
    form, path = export_format(to), Path(path)
    return form.export(
        ExportRequest(
            calibration,
            _stations(calibration, form, stations),
            _ending(form, path),
            form.options(**_known_options(form, options)),
            read_bytes(path) if form.edits and path.exists() else None,
        )
    )


def _stations(calibration: Calibration, form: ExportFormat, names: Sequence[str] | None) -> tuple[str, ...]:
    if names is None:
        if not form.several_stations:
            calibration.station()  # it complains where there are several
        return tuple(calibration.stations)
    for name in names:
        calibration.station(name)
    if len(names) != 1 and not form.several_stations:
        raise InputError(f"a file of format {form.name} holds one station, not {len(names)}: name one")
    return tuple(names)


def _ending(form: ExportFormat, path: Path) -> str:
    endings = [ending for ending in form.endings if path.name.endswith(ending)]
    if form.endings and not endings:
        raise InputError(f"{path}: a file of format {form.name} ends in {' or '.join(form.endings)}")
    return max(endings, key=len, default="")


def _known_options(form: ExportFormat, options: Mapping[str, Any]) -> Mapping[str, Any]:
    known = [one.name for one in fields(form.options)]
    for name in options:
        if name not in known:
            raise InputError(f"format {form.name} has no option {name!r}: there are {', '.join(known) or 'none'}")
    return options
