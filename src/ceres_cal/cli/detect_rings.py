"""`ceres-cal detect rings`: the paper's concentric rings in a photograph, as observations and as its polynomial."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import Detecting, parse_length, parse_lengths
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.detection import detected
from ceres_cal.cli.options import REQUIRED, argument, option
from ceres_cal.cli.outputs import finishing, require_observations_output

if TYPE_CHECKING:
    from ceres_cal.detect.rings import RingsDetection

_MOST_RINGS = 10_000


@dataclass(frozen=True, kw_only=True)
class RingsArguments(Detecting):
    """A photograph of rings, and the rings."""

    image: str = argument("IMAGE", "photograph of the rings, taken about from the front")
    radii: str = option(
        "radii in metres of all edges between dark and bright, from the inside out; FROM:TO:STEP for even ones, "
        "such as 0.01:0.36:0.01",
        "M,M,...",
        REQUIRED,
    )


def _run(args: RingsArguments) -> Answer:
    require_observations_output(args.output, [args.image])
    radii = _radii(args.radii)
    from ceres_cal.detect.rings import detect_rings

    detection = detected(args.timeout, partial(detect_rings, args.image, radii, args.camera, args.station))
    with finishing():
        detection.observations.save(args.output)
    data = _data(detection, args, len(radii))
    return Answer(data, lambda: _text(data))


COMMANDS = (
    Command(
        "detect rings",
        "edges of concentric rings in a photograph",
        RingsArguments,
        _run,
        ("rings.png --radii 10mm:360mm:10mm -o rings.json",),
    ),
)


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


def _data(detection: RingsDetection, args: RingsArguments, given: int) -> dict[str, Any]:
    a1, a2, a3 = detection.polynomial.tolist()
    return {
        "image": args.image,
        "output": str(args.output),
        "rings": detection.rings,
        "radii_given": given,
        "observations": len(detection.observations.curves),
        "centre": detection.centre.tolist(),
        "polynomial": {"a1": a1, "a2": a2, "a3": a3},
        "lens": {"a2": a2 / a1, "a3": a3 / a1},
        "rms_px": detection.rms_px,
        "blur_px": detection.blur_px,
    }


def _text(data: dict[str, Any]) -> str:
    x, y = data["centre"]
    return "\n".join(
        [
            f"{data['rings']} of {data['radii_given']} rings around ({x:.1f}, {y:.1f}), "
            f"{data['observations']} edges, blurred by {data['blur_px']:.2f} px",
            "the paper's polynomial r' = a1 r + a2 r^2 + a3 r^3, px, the first ring being as large as it is seen:",
            *(f"    {name} {value!r}" for name, value in data["polynomial"].items()),
            f"    with a1 = 1, as a lens has it: a2 {data['lens']['a2']!r}, a3 {data['lens']['a3']!r}; "
            f"rms {data['rms_px']:.3f} px",
            f"written to {data['output']}",
        ]
    )
