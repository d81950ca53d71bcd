"""Files and messages of other programs: `ceres-cal export`, `export-table`, `import`, `publish`, `listen` and `targets
import`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ceres_cal import formats, scene
from ceres_cal.base import InputError, plural, replace
from ceres_cal.cli.arguments import calibration_argument, length, output_option, parse_length
from ceres_cal.cli.command import REQUIRED, Arguments, argument, command, flag, option, options_of, switch, whole
from ceres_cal.cli.files import read_calibration, require_output, save
from ceres_cal.report.document import Document, Section

# ---- export ---------------------------------------------------------------------------------------------------------


def _listed(forms: Iterable[formats.ExportFormat | formats.ImportFormat]) -> str:
    """List the formats to choose from."""
    return "; ".join(f"{one.name}: {one.description} ({', '.join(one.endings) or 'a folder'})" for one in forms)


@command(
    "export",
    "export a calibration to a format of other programs, and report the error",
    "calibration.json --to vision-processor -o geometry.yml --camera-id 0",
    "calibration.json --to opencv -o camera.yml",
    "calibration.json --to table -o table.npz --error-mm 0.05",
)
def export(
    calibration: Path = calibration_argument(),
    output: Path = output_option("the export; its ending is one of the format's"),
    station: tuple[str, ...] = option(
        "which station; may be left out where there is only one, or the format holds all", "NAME", repeatable=True
    ),
    max_loss_mm: float | None = option("refuse a larger error anywhere on the field", "MM", read=length("mm")),
    to: str = option(
        lambda: _listed(formats.EXPORT_FORMATS.values()), "FORMAT", REQUIRED, elsewhere=("format", "from")
    ),
    options: Mapping[str, str] = options_of(lambda: formats.EXPORT_FORMATS.values()),
) -> Document:
    """Export a calibration to another format."""
    form = formats.export_format(to)
    if form.endings:
        require_output(output, [calibration])
    typed = _typed(options, [form])
    exported = formats.prepare_export(read_calibration(calibration), form.name, output, station or None, typed)
    exported.require_loss_mm(max_loss_mm)
    save(output, exported)
    about = {"format": form.name, "output": str(output), **exported.facts}
    first = Section(form.name, [f"{exported.words}, written to {output}"], about)
    return Document((first, *_losses(exported)))


export_table = replace(
    export,
    name="export-table",
    summary="a look-up table from pixels to the field (NPZ)",
    examples=("calibration.json -o table.npz",),
    preset=("--to", "table"),
)


def _typed(
    given: Mapping[str, str], forms: Sequence[formats.ExportFormat] | Sequence[formats.ImportFormat]
) -> dict[str, Any]:
    """Convert the given options of formats to their types."""
    import msgspec

    types = {name: kind for form in forms for name, (kind, _) in form.options.items()}
    options = {}
    for name, text in given.items():
        if name not in types:
            raise InputError(f"{flag(name)} is not an option of format {forms[0].name}")
        try:
            plain = str(parse_length(text, flag(name), "mm")) if name.endswith("_mm") else text
            options[name] = msgspec.convert(plain, types[name], strict=False)
        except (msgspec.ValidationError, UnicodeEncodeError):  # a word that is not UTF-8 is refused, too
            raise InputError(f"{flag(name)}: {text!r} is not a valid value") from None
    return options


def _losses(exported: formats.Export) -> Iterator[Section]:
    """Yield the errors of an export, in px and mm, and its warnings."""
    every = exported.losses
    errors = [
        {"station": loss.station, "height_m": height_m, "rms_mm": rms, "worst_mm": worst}
        for loss in every
        for height_m, (rms, worst) in loss.field_mm.items()
    ]
    shown = [(loss.station, loss.image_px) for loss in every if loss.image_px is not None]
    errors_px = [{"station": name, "rms_px": rms, "worst_px": worst} for name, (rms, worst) in shown]
    yield Section(data={"errors": errors, "errors_px": errors_px, "warnings": list(exported.warnings)})
    yield from (Section("off", [text]) for loss in every for text in formats.loss_words(loss))
    yield from (Section("warning", [text]) for text in exported.warnings)


# ---- import ---------------------------------------------------------------------------------------------------------


def from_option() -> Any:
    """The option --from FORMAT."""
    return option(
        lambda: f"default: by ending and content. {_listed(formats.IMPORT_FORMATS.values())}",
        "FORMAT",
        flags=("--from",),
        elsewhere=("format", "to"),
    )


def import_options() -> Any:
    """The options of the import formats."""
    return options_of(lambda: formats.IMPORT_FORMATS.values())


def typed_options(given: Mapping[str, str], form: str | None) -> dict[str, Any]:
    """Convert the given options of the named format, or of any."""
    forms = formats.IMPORT_FORMATS.values()
    return _typed(given, [one for one in forms if one.name == form] or list(forms))


@command(
    "import",
    "a calibration, or observations, out of a file of another program",
    "camera.yml -o calibration.json",
    "corners.csv --from csv -o observations.json",
)
def _import(
    file: Path = argument("FILE", "of another program"),
    form: str | None = from_option(),
    output: Path = output_option("the calibration or the observations (.json; observations also .npz)"),
    options: Mapping[str, str] = import_options(),
) -> Document:
    from ceres_cal.observations import Observations

    require_output(output, [file])
    given = formats.read_foreign(file, form, **typed_options(options, form))
    if not isinstance(given, Observations):
        require_output(output, [file], "calibrations are", ".json")
    save(output, given)
    path, place = str(output), f"written to {output}"
    if isinstance(given, Observations):
        sizes = {name: len(getattr(given, name)) for name in ("points", "curves", "views")}
        points, curves = plural(sizes["points"], "point"), plural(sizes["curves"], "curve observation")
        counts = f"{points} and {curves} in {plural(sizes['views'], 'view')}"
        return Document((Section("import", [counts, place], {"output": path, **sizes}),))
    lines = [f"{name}: {camera!r}" for name, camera in given.stations.items()]
    stations = {name: camera.position.tolist() for name, camera in given.stations.items()}
    data = {"output": path, "positions_m": stations, "warnings": list(given.warnings)}
    return Document((Section("import", [*lines, place], data), Section("warning", given.warnings)))


# ---- over the network -----------------------------------------------------------------------------------------------


class GroupArguments(Arguments):
    """Multicast group of the league's messages."""

    address: str = option("multicast group", "IP", "224.5.23.2")
    port: int = option("", "PORT", 10006, read=whole(1, 65535))
    interface: str = option("of the own network card; default: the system's choice", "IP", "0.0.0.0")


def _group(args: GroupArguments) -> formats.Group:
    return formats.Group(args.address, args.port, args.interface)


@command(
    "publish",
    "send a calibration by the league's multicast",
    "calibration.json --camera-id 0",
    "calibration.json --geometry geometry.yml --once",
)
def _publish(
    args: GroupArguments,
    calibration: Path = calibration_argument(),
    station: tuple[str, ...] = option("default: all", "NAME", repeatable=True),
    camera_id: str = option("of the stations; default: the number that each name ends in", "ID,...", ""),
    geometry: Path | None = option("with the field, and other cameras: .pb or geometry.yml", "FILE"),
    once: bool = switch("one packet, not one every 3 s until Ctrl-C"),
    max_loss_mm: float | None = option("refuse a message with a larger error on the field", "MM", read=length("mm")),
) -> Document:
    packet, exported = formats.ssl_packet(read_calibration(calibration), station or None, camera_id, geometry)
    exported.require_loss_mm(max_loss_mm)
    sent = formats.publish(packet, _group(args), 1 if once else None)
    words = f"{exported.words}, {len(packet)} bytes, {plural(sent, 'time')} to {args.address}:{args.port}"
    lost = [
        {"station": loss.station, "field_mm": {str(h): e for h, e in loss.field_mm.items()}} for loss in exported.losses
    ]
    data = {"sent": sent, "bytes": len(packet), "losses": lost}
    return Document((Section("published", [words], data), *_losses(exported)))


@command(
    "listen",
    "the field, or all geometry, out of the league's multicast",
    "-o field.json",
    "-o geometry.yml --seconds 30",
)
def _listen(
    args: GroupArguments,
    output: Path = output_option("the field as a target (.json), or the whole geometry (.pb, .yml)"),
    seconds: float = option("how long to wait", "S", 10.0),
) -> Document:
    require_output(output, [], "a field is", ".json", ".pb", ".yml", ".yaml")
    geometry, field, sender = formats.received_geometry(_group(args), seconds)
    if output.suffix == ".json":
        return _write_target(field, output, sender)
    save(output, formats.geometry_content(geometry, output.suffix))
    ids = [entry["camera_id"] for entry in geometry.get("calib", [])]
    words = f"a field and cameras {ids} from {sender}, written to {output}"
    data = {"output": str(output), "camera_ids": ids, "sender": sender}
    return Document((Section("heard", [words], data),))


# ---- targets --------------------------------------------------------------------------------------------------------


@command("targets import", "a field out of ssl-vision's or vision-processor's files", "geometry.yml -o field.json")
def _targets_import(
    file: Path = argument("FILE", "geometry.yml, a packet (.pb), or robocup-ssl.xml"),
    output: Path = output_option("the target (.json), as `detect field --target` takes it"),
) -> Document:
    require_output(output, [file])
    return _write_target(formats.read_ssl_target(file), output)


def _write_target(target: scene.Target, path: Path, sender: str = "") -> Document:
    save(path, target.spec)
    whence = f" from {sender}" if sender else ""
    points, curves = plural(len(target.points), "point"), plural(len(target.curves), "curve")
    words = f"{target.kind} with {points} and {curves}{whence}, written to {path}"
    data = {"output": str(path), "spec": target.spec, **({"sender": sender} if sender else {})}
    return Document((Section("target", [words], data),))
