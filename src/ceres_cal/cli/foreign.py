"""`ceres-cal import`, `publish`, `listen` and `targets import`: the files and messages of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import calibration_argument, length, output_option
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.export import format_options, listed, losses_text
from ceres_cal.cli.inputs import read_calibration
from ceres_cal.cli.options import Arguments, argument, option, options_of, switch
from ceres_cal.cli.outputs import finishing, require_output, section

if TYPE_CHECKING:
    from ceres_cal.formats import Group, ImportFormat
    from ceres_cal.scene.targets import Target


# ---- import ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ImportArguments(Arguments):
    """A file of another program."""

    file: Path = argument("FILE", "of another program")
    form: str | None = option(
        lambda: f"default: by ending and content. {listed(_forms().values())}", "FORMAT", flags=("--from",)
    )
    output: Path = output_option("the calibration or the observations (.json; observations also .npz)")
    options: Mapping[str, str] = options_of(lambda: _forms().values())


def _forms() -> Mapping[str, ImportFormat]:
    from ceres_cal.formats import IMPORT_FORMATS

    return IMPORT_FORMATS


def _import(args: ImportArguments) -> Answer:
    from ceres_cal.formats import read_foreign
    from ceres_cal.observations import Observations

    require_output(args.output, [args.file])
    if args.form is not None and args.form not in _forms():
        raise InputError(f"there is no format {args.form!r} to read: choose one of {', '.join(_forms())}")
    forms = list(_forms().values()) if args.form is None else [_forms()[args.form]]
    given = read_foreign(args.file, args.form, **format_options(args.options, forms))
    with finishing():
        given.save(args.output)
    if isinstance(given, Observations):
        counts = f"{len(given.points)} points and {len(given.curves)} curve observations in {len(given.views)} views"
        sizes = {"points": len(given.points), "curves": len(given.curves), "views": len(given.views)}
        return Answer(
            {"output": str(args.output), **sizes}, lambda: section("import", [counts, f"written to {args.output}"])
        )
    lines = [f"{name}: {camera!r}" for name, camera in given.stations.items()]
    text = [section("import", [*lines, f"written to {args.output}"]), section("warning", given.warnings)]
    stations = {name: camera.position.tolist() for name, camera in given.stations.items()}
    data = {"output": str(args.output), "positions_m": stations, "warnings": list(given.warnings)}
    return Answer(data, lambda: "\n".join(part for part in text if part))


# ---- over the network -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class GroupArguments(Arguments):
    """Where the league's messages are."""

    address: str = option("multicast group", "IP", "224.5.23.2")
    port: int = option("", "PORT", 10006)
    interface: str = option("of the own network card; default: the system's choice", "IP", "0.0.0.0")


def _group(args: GroupArguments) -> Group:
    from ceres_cal.formats import Group

    return Group(args.address, args.port, args.interface)


@dataclass(frozen=True, kw_only=True)
class PublishArguments(GroupArguments):
    """What is sent, and how often."""

    calibration: Path = calibration_argument()
    station: tuple[str, ...] = option("default: all", "NAME", repeatable=True)
    camera_id: str = option("of the stations; default: the number that each name ends in", "ID,...", "")
    geometry: Path | None = option("with the field, and other cameras: .pb or geometry.yml", "FILE")
    once: bool = switch("one packet, not one every 3 s until Ctrl-C")
    max_loss_mm: float | None = option(
        "refuse what the message would get wrong by more on the field", "MM", read=length("mm")
    )


def _publish(args: PublishArguments) -> Answer:
    from ceres_cal.base.files import read_bytes
    from ceres_cal.formats import publish, ssl_packet

    before = None if args.geometry is None else read_bytes(args.geometry)
    packet, exported = ssl_packet(read_calibration(args.calibration), args.station or None, args.camera_id, before)
    exported.require_loss_mm(args.max_loss_mm)
    sent = publish(packet, _group(args), 1 if args.once else None)
    words = f"{exported.words}, {len(packet)} bytes, {sent} times to {args.address}:{args.port}"
    losses = [
        {"station": loss.station, "field_mm": {str(h): e for h, e in loss.field_mm.items()}} for loss in exported.losses
    ]
    data = {"sent": sent, "bytes": len(packet), "losses": losses, "warnings": list(exported.warnings)}
    return Answer(data, lambda: "\n".join([section("published", [words]), *losses_text(exported)]))


@dataclass(frozen=True, kw_only=True)
class ListenArguments(GroupArguments):
    """What is written, and how long to wait for it."""

    output: Path = output_option("the field as a target (.json), or the whole geometry (.pb, .yml)")
    seconds: float = option("how long to wait", "S", 10.0)


def _listen(args: ListenArguments) -> Answer:
    from ceres_cal.formats import geometry_content, received_geometry, ssl_target

    require_output(args.output, [])
    if args.output.suffix not in (".json", ".pb", ".yml", ".yaml"):
        raise InputError(f"{args.output}: a field is written as .json, .pb or .yml: give one of these endings")
    geometry = received_geometry(_group(args), args.seconds)
    if args.output.suffix == ".json":
        return _write_target(ssl_target(geometry), args.output)
    from ceres_cal.base.files import write_bytes

    with finishing():
        write_bytes(args.output, geometry_content(geometry, args.output.suffix))
    ids = [entry["camera_id"] for entry in geometry.get("calib", [])]
    words = f"a field and cameras {ids}, written to {args.output}"
    return Answer({"output": str(args.output), "camera_ids": ids}, lambda: section("heard", [words]))


# ---- targets --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TargetsImportArguments(Arguments):
    """A file with a field in it."""

    file: Path = argument("FILE", "geometry.yml, a packet (.pb), or robocup-ssl.xml")
    output: Path = output_option("the target (.json), as `detect field --target` takes it")


def _targets_import(args: TargetsImportArguments) -> Answer:
    from ceres_cal.formats import read_ssl_target

    require_output(args.output, [args.file])
    return _write_target(read_ssl_target(args.file), args.output)


def _write_target(target: Target, path: Path) -> Answer:
    from ceres_cal.base.files import write_json

    with finishing():
        write_json(path, target.spec)
    words = f"{target.kind} with {len(target.points)} points and {len(target.curves)} curves, written to {path}"
    return Answer({"output": str(path), "spec": target.spec}, lambda: section("target", [words]))


COMMANDS = (
    Command(
        "import",
        "a calibration, or observations, out of a file of another program",
        ImportArguments,
        _import,
        ("camera.yml -o calibration.json", "corners.csv --from csv -o observations.json"),
    ),
    Command(
        "publish",
        "send a calibration to those who see the field, by the league's multicast",
        PublishArguments,
        _publish,
        ("calibration.json --camera-id 0", "calibration.json --geometry geometry.yml --once"),
    ),
    Command(
        "listen",
        "the field, or all geometry, out of the league's multicast",
        ListenArguments,
        _listen,
        ("-o field.json", "-o geometry.yml --seconds 30"),
    ),
    Command(
        "targets import",
        "a field out of ssl-vision's or vision-processor's files",
        TargetsImportArguments,
        _targets_import,
        ("geometry.yml -o field.json",),
    ),
)
