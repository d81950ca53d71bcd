"""`ceres-cal export` and, for look-up tables, `export-table`: a calibration in a format that others read."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import add_calibration, add_output, length, parse_length
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.inputs import read_calibration
from ceres_cal.cli.outputs import finishing, require_output, section

if TYPE_CHECKING:
    from ceres_cal.formats import Exported, ExportFormat, ImportFormat

_OPTION = "option "  # before the names of a format's options: theirs may be those of the command's own arguments


def _add_arguments(parser: ArgumentParser) -> None:
    from ceres_cal.formats import EXPORT_FORMATS

    forms = EXPORT_FORMATS.values()
    listed = "; ".join(f"{one.name}: {one.description} ({', '.join(one.endings) or 'a folder'})" for one in forms)
    parser.add_argument("--to", metavar="FORMAT", required=True, help=(listed or "there is none").replace("%", "%%"))
    _add_shared_arguments(parser, forms)


def _add_table_arguments(parser: ArgumentParser) -> None:
    from ceres_cal.formats import export_format

    parser.set_defaults(to="table")
    _add_shared_arguments(parser, [export_format("table")])


def _add_shared_arguments(parser: ArgumentParser, forms: Collection[ExportFormat]) -> None:
    add = parser.add_argument
    add_calibration(parser)
    add_output(parser, "the export; its ending is one of the format's", required=True)
    add(
        "--station",
        metavar="NAME",
        action="append",
        help="which station; may be left out where there is only one, or the format holds all; repeatable",
    )
    add("--max-loss-mm", type=length("mm"), metavar="MM", help="refuse what is wrong by more anywhere on the field")
    add_format_options(parser, forms)


def add_format_options(parser: ArgumentParser, forms: Collection[ExportFormat] | Collection[ImportFormat]) -> None:
    """The options of the formats themselves."""
    for name, helps in _options_of(forms).items():
        parser.add_argument(_flag(name), dest=_OPTION + name, metavar="VALUE", help="; ".join(helps).replace("%", "%%"))


def _options_of(forms: Collection[ExportFormat] | Collection[ImportFormat]) -> dict[str, list[str]]:
    """Every option of the formats, with what it means to each of them."""
    from dataclasses import fields

    every: dict[str, list[str]] = {}
    for form in forms:
        for one in fields(form.options):
            every.setdefault(one.name, []).append(f"{form.name}: {one.metadata.get('help', '')}")
    return every


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _run(args: Namespace) -> Answer:
    from ceres_cal.formats import export_format, prepare_export

    form = export_format(args.to)
    if form.endings:
        require_output(args.output, [args.calibration])
    options = format_options(args, [form])
    exported = prepare_export(read_calibration(args), form.name, args.output, args.station, options)
    exported.require_loss_mm(args.max_loss_mm)
    with finishing():
        exported.save(args.output)
    return Answer(_data(exported, args), lambda: _text(exported, args))


def format_options(args: Namespace, forms: Sequence[ExportFormat] | Sequence[ImportFormat]) -> dict[str, Any]:
    """What was given of the formats' options, of the types that they have."""
    from typing import get_type_hints

    import msgspec

    given = {name.removeprefix(_OPTION): text for name, text in vars(args).items() if name.startswith(_OPTION)}
    types = {name: kind for form in forms for name, kind in get_type_hints(form.options).items()}
    options = {}
    for name, text in given.items():
        if text is None:
            continue
        if name not in types:
            raise InputError(f"{_flag(name)} is no option of format {forms[0].name}")
        try:
            if name.endswith("_mm"):
                text = str(parse_length(text, _flag(name), "mm"))
            options[name] = msgspec.convert(text, types[name], strict=False)
        except msgspec.ValidationError:
            raise InputError(f"{_flag(name)}: {text!r} is not the number or word that it takes") from None
    return options


def _data(exported: Exported, args: Namespace) -> dict[str, Any]:
    return {
        "format": args.to,
        "output": str(args.output),
        **exported.facts,
        "errors": [
            {"station": loss.station, "height_m": height_m, "rms_mm": rms, "worst_mm": worst}
            for loss in exported.losses
            for height_m, (rms, worst) in loss.field_mm.items()
        ],
        "errors_px": [
            {"station": loss.station, "rms_px": loss.image_px[0], "worst_px": loss.image_px[1]}
            for loss in exported.losses
            if loss.image_px is not None
        ],
        "warnings": list(exported.warnings),
    }


def _text(exported: Exported, args: Namespace) -> str:
    return "\n".join([f"{args.to:9} {exported.words}, written to {args.output}", *losses_text(exported)])


def losses_text(exported: Exported) -> list[str]:
    """What is lost, in px and mm, and what else to know."""
    from ceres_cal.formats import loss_words

    lines = [section("error", [text]) for loss in exported.losses for text in loss_words(loss)]
    return lines + [section("warning", [text]) for text in exported.warnings]


COMMANDS = (
    Command(
        "export",
        "a calibration in a format that others read, and what that loses",
        _add_arguments,
        _run,
        (
            "calibration.json --to vision-processor -o geometry.yml --camera-id 0",
            "calibration.json --to opencv -o camera.yml",
            "calibration.json --to table -o table.npz --error-mm 0.05",
        ),
    ),
    Command(
        "export-table",
        "a look-up table from pixels to the field (NPZ)",
        _add_table_arguments,
        _run,
        ("calibration.json -o table.npz",),
    ),
)
