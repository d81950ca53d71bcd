"""`ceres-cal import`, `publish`, `listen` and `targets import`: the files and messages of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import no_such
from ceres_cal.cli.arguments import calibration_argument, length, output_option
from ceres_cal.cli.command import Arguments, argument, command, option, options_of, switch
from ceres_cal.cli.export import format_options, import_forms, listed, losses
from ceres_cal.cli.files import read_calibration, require_ending, require_output, save
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.formats import Group
    from ceres_cal.scene.targets import Target


# ---- import ---------------------------------------------------------------------------------------------------------


class ImportArguments(Arguments):
    """A file of another program."""

    file: Path = argument("FILE", "of another program")
    form: str | None = option(
        lambda: f"default: by ending and content. {listed(import_forms().values())}", "FORMAT", flags=("--from",)
    )
    output: Path = output_option("the calibration or the observations (.json; observations also .npz)")
    options: Mapping[str, str] = options_of(lambda: import_forms().values())


@command(
    "import",
    "a calibration, or observations, out of a file of another program",
    "camera.yml -o calibration.json",
    "corners.csv --from csv -o observations.json",
)
def _import(args: ImportArguments) -> Document:
    from ceres_cal.formats import read_foreign
    from ceres_cal.observations import Observations

    require_output(args.output, [args.file])
    if args.form is not None and args.form not in import_forms():
        raise InputError(no_such("import format", args.form, import_forms()))
    forms = list(import_forms().values()) if args.form is None else [import_forms()[args.form]]
    given = read_foreign(args.file, args.form, **format_options(args.options, forms))
    save(args.output, given)
    path, place = str(args.output), f"written to {args.output}"
    if isinstance(given, Observations):
        sizes = {name: len(getattr(given, name)) for name in ("points", "curves", "views")}
        counts = "{points} points and {curves} curve observations in {views} views".format(**sizes)
        return Document((Section("import", [counts, place], {"output": path, **sizes}),))
    lines = [f"{name}: {camera!r}" for name, camera in given.stations.items()]
    stations = {name: camera.position.tolist() for name, camera in given.stations.items()}
    data = {"output": path, "positions_m": stations, "warnings": list(given.warnings)}
    return Document((Section("import", [*lines, place], data), Section("warning", given.warnings)))


# ---- over the network -----------------------------------------------------------------------------------------------


class GroupArguments(Arguments):
    """Where the league's messages are."""

    address: str = option("multicast group", "IP", "224.5.23.2")
    port: int = option("", "PORT", 10006)
    interface: str = option("of the own network card; default: the system's choice", "IP", "0.0.0.0")


def _group(args: GroupArguments) -> Group:
    from ceres_cal.formats import Group

    return Group(args.address, args.port, args.interface)


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


@command(
    "publish",
    "send a calibration to those who see the field, by the league's multicast",
    "calibration.json --camera-id 0",
    "calibration.json --geometry geometry.yml --once",
)
def _publish(args: PublishArguments) -> Document:
    from ceres_cal.base.files import read_bytes
    from ceres_cal.formats import publish, ssl_packet

    before = None if args.geometry is None else read_bytes(args.geometry)
    packet, exported = ssl_packet(read_calibration(args.calibration), args.station or None, args.camera_id, before)
    exported.require_loss_mm(args.max_loss_mm)
    sent = publish(packet, _group(args), 1 if args.once else None)
    words = f"{exported.words}, {len(packet)} bytes, {sent} times to {args.address}:{args.port}"
    lost = [
        {"station": loss.station, "field_mm": {str(h): e for h, e in loss.field_mm.items()}} for loss in exported.losses
    ]
    data = {"sent": sent, "bytes": len(packet), "losses": lost}
    return Document((Section("published", [words], data), *losses(exported)))


class ListenArguments(GroupArguments):
    """What is written, and how long to wait for it."""

    output: Path = output_option("the field as a target (.json), or the whole geometry (.pb, .yml)")
    seconds: float = option("how long to wait", "S", 10.0)


@command(
    "listen",
    "the field, or all geometry, out of the league's multicast",
    "-o field.json",
    "-o geometry.yml --seconds 30",
)
def _listen(args: ListenArguments) -> Document:
    from ceres_cal.formats import geometry_content, received_geometry

    require_output(args.output, [])
    require_ending(args.output, "a field is", ".json", ".pb", ".yml", ".yaml")
    heard = received_geometry(_group(args), args.seconds)
    if args.output.suffix == ".json":
        return _write_target(heard.field, args.output, heard.sender)
    save(args.output, geometry_content(heard.geometry, args.output.suffix))
    ids = [entry["camera_id"] for entry in heard.geometry.get("calib", [])]
    words = f"a field and cameras {ids} from {heard.sender}, written to {args.output}"
    data = {"output": str(args.output), "camera_ids": ids, "sender": heard.sender}
    return Document((Section("heard", [words], data),))


# ---- targets --------------------------------------------------------------------------------------------------------


class TargetsImportArguments(Arguments):
    """A file with a field in it."""

    file: Path = argument("FILE", "geometry.yml, a packet (.pb), or robocup-ssl.xml")
    output: Path = output_option("the target (.json), as `detect field --target` takes it")


@command("targets import", "a field out of ssl-vision's or vision-processor's files", "geometry.yml -o field.json")
def _targets_import(args: TargetsImportArguments) -> Document:
    from ceres_cal.formats import read_ssl_target

    require_output(args.output, [args.file])
    return _write_target(read_ssl_target(args.file), args.output)


def _write_target(target: Target, path: Path, sender: str = "") -> Document:
    save(path, target.spec)
    whence = f" from {sender}" if sender else ""
    counts = f"{len(target.points)} points and {len(target.curves)} curves"
    words = f"{target.kind} with {counts}{whence}, written to {path}"
    data = {"output": str(path), "spec": target.spec, **({"sender": sender} if sender else {})}
    return Document((Section("target", [words], data),))
