"""`ceres-cal audit`: may the calibration of another program be trusted? exit code 0 yes, 1 no."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.cli.command import REQUIRED, Arguments, argument, command, option, options_of
from ceres_cal.cli.export import format_options, import_forms
from ceres_cal.cli.files import read_observations
from ceres_cal.report.document import Document, Section, wrapped

if TYPE_CHECKING:
    from ceres_cal.moves.agreement import Agreement


class AuditArguments(Arguments):
    """A calibration, and what is held against it."""

    file: Path = argument("FILE", "a calibration of ours or of another program")
    form: str | None = option(lambda: f"default: by content; {', '.join(import_forms())}", "FORMAT", flags=("--from",))
    observations: tuple[str, ...] = option("of its stations", "FILE", REQUIRED, repeatable=True)
    options: Mapping[str, str] = options_of(lambda: import_forms().values())


@command(
    "audit",
    "may another program's calibration be trusted? exit code 0 yes, 1 no",
    "opencv.yml --observations field.json",
    "geometry.yml --observations field.json --observations more.json",
)
def _run(args: AuditArguments) -> Document:
    from ceres_cal.calibration import Calibration
    from ceres_cal.formats import import_calibration
    from ceres_cal.moves.audits import audit

    if args.form is None and args.file.suffix == ".json" and _is_ours(args.file):
        given = Calibration.load(args.file)
    else:
        given = import_calibration(args.file, args.form, **format_options(args.options, list(import_forms().values())))
    stations = audit(given, read_observations(args.observations))
    return Document(
        (
            Section(
                "audit",
                ["yes" if stations.holds else "no"],
                {"trusted": stations.holds, "warnings": list(given.warnings)},
            ),
            *map(_station, stations.values()),
            *(Section("warning", wrapped(text)) for text in given.warnings),
        ),
        stations.exit_code,
    )


def _is_ours(path: Path) -> bool:
    from ceres_cal.base.files import read_bytes

    return b"ceres-cal/calibration" in read_bytes(path)[:4096]


def _station(one: Agreement) -> Section:
    from ceres_cal.moves.audits import excess_px

    assert one.solution is not None and one.change is not None
    camera, maps = one.solution.station(), one.change.maps
    off_px, noise_px = excess_px(one)
    known_mm = {} if one.solution.posterior is None else {over.height_m: over.known_mm for over in maps}
    known = ", ".join(f"{sd:.2g} mm at {1e3 * h:.0f} mm" for h, sd in known_mm.items())
    ours = f"ours: {camera!r}" + (f", known to {known}" if known else "")
    off = f"its picture is off by {off_px:.3f} px rms beyond the noise of {noise_px:.3f} px"
    data: dict[str, Any] = {"trusted": one.holds, "cause": one.cause, "words": one.words}
    data |= {"off_px": off_px, "noise_px": noise_px, "posed": not one.pose_free}
    data["off_mm"] = [{"height_m": over.height_m, "rms_mm": over.rms_mm, "worst_mm": over.most_mm} for over in maps]
    data["known_mm"] = [{"height_m": h, "sd_mm": sd} for h, sd in known_mm.items()]
    data["ours"] = {"phi_px": camera.phi, "lens": camera.lens.kind, "rms_px": one.solution.rms_px}
    return Section("station", wrapped(f"{one.name} {one.words}", off, ours), {"stations": {one.name: data}})
