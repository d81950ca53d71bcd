"""`ceres-cal export` and, for look-up tables, `export-table`: a calibration in a format that others read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import calibration_argument, length, output_option, parse_length
from ceres_cal.cli.command import REQUIRED, Arguments, command, flag, option, options_of
from ceres_cal.cli.files import read_calibration, require_output, save
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.formats import Exported, ExportFormat, ImportFormat


def _forms() -> Iterable[ExportFormat]:
    from ceres_cal.formats import EXPORT_FORMATS

    return EXPORT_FORMATS.values()


def _table() -> Iterable[ExportFormat]:
    from ceres_cal.formats import export_format

    return [export_format("table")]


def import_forms() -> Mapping[str, ImportFormat]:
    """The formats that are read, by name."""
    from ceres_cal.formats import IMPORT_FORMATS

    return IMPORT_FORMATS


def listed(forms: Iterable[ExportFormat | ImportFormat]) -> str:
    """What there is to choose from."""
    return "; ".join(f"{one.name}: {one.description} ({', '.join(one.endings) or 'a folder'})" for one in forms)


class TableArguments(Arguments):
    """What is written of a calibration, and how much of it may be lost."""

    calibration: Path = calibration_argument()
    output: Path = output_option("the export; its ending is one of the format's")
    station: tuple[str, ...] = option(
        "which station; may be left out where there is only one, or the format holds all", "NAME", repeatable=True
    )
    max_loss_mm: float | None = option("refuse what is wrong by more anywhere on the field", "MM", read=length("mm"))
    options: Mapping[str, str] = options_of(_table)

    @property
    def form(self) -> str:
        """The name of the format."""
        return "table"


class ExportArguments(TableArguments):
    """The same, of a format that is named."""

    to: str = option(lambda: listed(_forms()) or "there is none", "FORMAT", REQUIRED)
    options: Mapping[str, str] = options_of(_forms)

    @property
    def form(self) -> str:
        return self.to


@command(
    "export",
    "a calibration in a format that others read, and what that loses",
    "calibration.json --to vision-processor -o geometry.yml --camera-id 0",
    "calibration.json --to opencv -o camera.yml",
    "calibration.json --to table -o table.npz --error-mm 0.05",
)
def _export(args: ExportArguments) -> Document:
    return _exported(args)


@command("export-table", "a look-up table from pixels to the field (NPZ)", "calibration.json -o table.npz")
def _export_table(args: TableArguments) -> Document:
    return _exported(args)


def _exported(args: TableArguments) -> Document:
    from ceres_cal.formats import export_format, prepare_export

    form = export_format(args.form)
    if form.endings:
        require_output(args.output, [args.calibration])
    options = format_options(args.options, [form])
    exported = prepare_export(read_calibration(args.calibration), form.name, args.output, args.station or None, options)
    exported.require_loss_mm(args.max_loss_mm)
    save(args.output, exported)
    about = {"format": form.name, "output": str(args.output), **exported.facts}
    first = Section(form.name, [f"{exported.words}, written to {args.output}"], about)
    return Document((first, *losses(exported)))


def format_options(given: Mapping[str, str], forms: Sequence[ExportFormat] | Sequence[ImportFormat]) -> dict[str, Any]:
    """What was given of the formats' options, of the types that they have."""
    from typing import get_type_hints

    import msgspec

    types = {name: kind for form in forms for name, kind in get_type_hints(form.options).items()}
    options = {}
    for name, text in given.items():
        if name not in types:
            raise InputError(f"{flag(name)} is no option of format {forms[0].name}")
        try:
            plain = str(parse_length(text, flag(name), "mm")) if name.endswith("_mm") else text
            options[name] = msgspec.convert(plain, types[name], strict=False)
        except (msgspec.ValidationError, UnicodeEncodeError):  # a word that is no UTF-8 is none of those either
            raise InputError(f"{flag(name)}: {text!r} is not the number or word that it takes") from None
    return options


def losses(exported: Exported) -> Iterator[Section]:
    """What is lost, in px and mm, and what else to know."""
    from ceres_cal.formats import loss_words

    every = exported.losses
    errors = [
        {"station": loss.station, "height_m": height_m, "rms_mm": rms, "worst_mm": worst}
        for loss in every
        for height_m, (rms, worst) in loss.field_mm.items()
    ]
    shown = [(loss.station, loss.image_px) for loss in every if loss.image_px is not None]
    errors_px = [{"station": name, "rms_px": rms, "worst_px": worst} for name, (rms, worst) in shown]
    yield Section(data={"errors": errors, "errors_px": errors_px, "warnings": list(exported.warnings)})
    yield from (Section("error", [text]) for loss in every for text in loss_words(loss))
    yield from (Section("warning", [text]) for text in exported.warnings)
