"""`ceres-cal detect rings`: the paper's concentric rings in a photograph, as observations and as its polynomial."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import parse_length, parse_lengths
from ceres_cal.cli.command import command
from ceres_cal.cli.files import finishing, require_observations_output
from ceres_cal.cli.options import REQUIRED, argument, option
from ceres_cal.cli.photographs import DetectArguments, detected
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.detect.rings import RingsDetection

_MOST_RINGS = 10_000


def _radii(text: str) -> tuple[float, ...]:
    where = f"--radii {text!r}"
    if ":" not in text:
        return parse_lengths(text, where)
    parts = text.split(":")
    if len(parts) != 3:
        raise InputError(f"{where}: write FROM:TO:STEP, such as 0.01:0.36:0.01, or the radii between commas")
    first, last, step = (parse_length(part, where) for part in parts)
    if not (0.0 < first <= last and step > 0.0 and (last - first) / step < _MOST_RINGS):
        raise InputError(f"{where}: FROM must be above 0, TO not below it, and STEP above 0")
    return tuple(first + i * step for i in range(round((last - first) / step) + 1))


@dataclass(frozen=True, kw_only=True)
class RingsArguments(DetectArguments):
    """A photograph of rings, and the rings."""

    image: str = argument("IMAGE", "photograph of the rings, taken about from the front")
    radii: tuple[float, ...] = option(
        "radii in metres of all edges between dark and bright, from the inside out; FROM:TO:STEP for even ones, "
        "such as 0.01:0.36:0.01",
        "M,M,...",
        REQUIRED,
        read=_radii,
    )


@command("detect rings", "edges of concentric rings in a photograph", "rings.png --radii 10mm:360mm:10mm -o rings.json")
def _run(args: RingsArguments) -> Document:
    require_observations_output(args.output, [args.image])
    from ceres_cal.detect.rings import detect_rings

    detection = detected(args.timeout, partial(detect_rings, args.image, args.radii, args.camera, args.station))
    with finishing():
        detection.observations.save(args.output)
    return _document(detection, args)


def _document(detection: RingsDetection, args: RingsArguments) -> Document:
    a1, a2, a3 = detection.polynomial.tolist()
    (x, y), edges, lens = detection.centre.tolist(), len(detection.observations.curves), {"a2": a2 / a1, "a3": a3 / a1}
    lines = [
        f"{detection.rings} of {len(args.radii)} rings around ({x:.1f}, {y:.1f}), "
        f"{edges} edges, blurred by {detection.blur_px:.2f} px",
        "the paper's polynomial r' = a1 r + a2 r^2 + a3 r^3, px, the first ring being as large as it is seen:",
        *(f"    {name} {value!r}" for name, value in (("a1", a1), ("a2", a2), ("a3", a3))),
        f"    with a1 = 1, as a lens has it: a2 {lens['a2']!r}, a3 {lens['a3']!r}; rms {detection.rms_px:.3f} px",
        f"written to {args.output}",
    ]
    data = {
        "image": args.image,
        "output": str(args.output),
        "rings": detection.rings,
        "radii_given": len(args.radii),
        "observations": edges,
        "centre": [x, y],
        "polynomial": {"a1": a1, "a2": a2, "a3": a3},
        "lens": lens,
        "rms_px": detection.rms_px,
        "blur_px": detection.blur_px,
    }
    return Document((Section("", lines, data),))
