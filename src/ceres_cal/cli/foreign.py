"""`ceres-cal import`, `publish`, `listen` and `targets import`: the files and messages of other programs."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import add_calibration, add_output, length
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.export import add_format_options, format_options, losses_text
from ceres_cal.cli.inputs import read_calibration
from ceres_cal.cli.outputs import finishing, require_output, section

if TYPE_CHECKING:
    from ceres_cal.formats import Group
    from ceres_cal.scene.targets import Target


# ---- import ---------------------------------------------------------------------------------------------------------


def _add_import(parser: ArgumentParser) -> None:
    from ceres_cal.formats import IMPORT_FORMATS

    forms = IMPORT_FORMATS.values()
    listed = "; ".join(f"{one.name}: {one.description} ({', '.join(one.endings) or 'a folder'})" for one in forms)
    parser.add_argument("file", metavar="FILE", type=Path, help="of another program")
    parser.add_argument("--from", dest="form", metavar="FORMAT", help=f"default: by ending and content. {listed}")
    add_output(parser, "the calibration or the observations (.json; observations also .npz)", required=True)
    add_format_options(parser, forms)


def _import(args: Namespace) -> Answer:
    from ceres_cal.formats import IMPORT_FORMATS, read_foreign
    from ceres_cal.observations import Observations

    require_output(args.output, [args.file])
    if args.form is not None and args.form not in IMPORT_FORMATS:
        raise InputError(f"there is no format {args.form!r} to read: choose one of {', '.join(IMPORT_FORMATS)}")
    forms = list(IMPORT_FORMATS.values()) if args.form is None else [IMPORT_FORMATS[args.form]]
    given = read_foreign(args.file, args.form, **format_options(args, forms))
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


def _add_group(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("--address", default="224.5.23.2", metavar="IP", help="multicast group; default: 224.5.23.2")
    add("--port", type=int, default=10006, metavar="PORT", help="default: 10006")
    add("--interface", default="0.0.0.0", metavar="IP", help="of the own network card; default: the system's choice")


def _group(args: Namespace) -> Group:
    from ceres_cal.formats import Group

    return Group(args.address, args.port, args.interface)


def _add_publish(parser: ArgumentParser) -> None:
    add_calibration(parser)
    add = parser.add_argument
    add("--station", metavar="NAME", action="append", help="default: all; repeatable")
    add("--camera-id", default="", metavar="ID,...", help="of the stations; default: the number that each name ends in")
    add("--geometry", metavar="FILE", type=Path, help="with the field, and other cameras: .pb or geometry.yml")
    add("--once", action="store_true", help="one packet, not one every 3 s until Ctrl-C")
    add(
        "--max-loss-mm",
        type=length("mm"),
        metavar="MM",
        help="refuse what the message would get wrong by more on the field",
    )
    _add_group(parser)


def _publish(args: Namespace) -> Answer:
    from ceres_cal.base.files import read_bytes
    from ceres_cal.formats import publish, ssl_packet

    before = None if args.geometry is None else read_bytes(args.geometry)
    packet, exported = ssl_packet(read_calibration(args), args.station, args.camera_id, before)
    exported.require_loss_mm(args.max_loss_mm)
    sent = publish(packet, _group(args), 1 if args.once else None)
    words = f"{exported.words}, {len(packet)} bytes, {sent} times to {args.address}:{args.port}"
    losses = [
        {"station": loss.station, "field_mm": {str(h): e for h, e in loss.field_mm.items()}} for loss in exported.losses
    ]
    data = {"sent": sent, "bytes": len(packet), "losses": losses, "warnings": list(exported.warnings)}
    return Answer(data, lambda: "\n".join([section("published", [words]), *losses_text(exported)]))


def _add_listen(parser: ArgumentParser) -> None:
    add_output(parser, "the field as a target (.json), or the whole geometry (.pb, .yml)", required=True)
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="how long to wait; default: 10")
    _add_group(parser)


def _listen(args: Namespace) -> Answer:
    from ceres_cal.formats import geometry_content, received_geometry

    require_output(args.output, [])
    if args.output.suffix not in (".json", ".pb", ".yml", ".yaml"):
        raise InputError(f"{args.output}: a field is written as .json, .pb or .yml: give one of these endings")
    heard = received_geometry(_group(args), args.seconds)
    if args.output.suffix == ".json":
        return _write_target(heard.field, args.output, heard.sender)
    from ceres_cal.base.files import write_bytes

    with finishing():
        write_bytes(args.output, geometry_content(heard.geometry, args.output.suffix))
    ids = [entry["camera_id"] for entry in heard.geometry.get("calib", [])]
    words = f"a field and cameras {ids} from {heard.sender}, written to {args.output}"
    data = {"output": str(args.output), "camera_ids": ids, "sender": heard.sender}
    return Answer(data, lambda: section("heard", [words]))


# ---- targets --------------------------------------------------------------------------------------------------------


def _add_targets_import(parser: ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="geometry.yml, a packet (.pb), or robocup-ssl.xml")
    add_output(parser, "the target (.json), as `detect field --target` takes it", required=True)


def _targets_import(args: Namespace) -> Answer:
    from ceres_cal.formats import read_ssl_target

    require_output(args.output, [args.file])
    return _write_target(read_ssl_target(args.file), args.output)


def _write_target(target: Target, path: Path, sender: str = "") -> Answer:
    from ceres_cal.base.files import write_json

    with finishing():
        write_json(path, target.spec)
    whence = f" from {sender}" if sender else ""
    counts = f"{len(target.points)} points and {len(target.curves)} curves"
    words = f"{target.kind} with {counts}{whence}, written to {path}"
    data = {"output": str(path), "spec": target.spec, **({"sender": sender} if sender else {})}
    return Answer(data, lambda: section("target", [words]))


COMMANDS = (
    Command(
        "import",
        "a calibration, or observations, out of a file of another program",
        _add_import,
        _import,
        ("camera.yml -o calibration.json", "corners.csv --from csv -o observations.json"),
    ),
    Command(
        "publish",
        "send a calibration to those who see the field, by the league's multicast",
        _add_publish,
        _publish,
        ("calibration.json --camera-id 0", "calibration.json --geometry geometry.yml --once"),
    ),
    Command(
        "listen",
        "the field, or all geometry, out of the league's multicast",
        _add_listen,
        _listen,
        ("-o field.json", "-o geometry.yml --seconds 30"),
    ),
    Command(
        "targets import",
        "a field out of ssl-vision's or vision-processor's files",
        _add_targets_import,
        _targets_import,
        ("geometry.yml -o field.json",),
    ),
)
