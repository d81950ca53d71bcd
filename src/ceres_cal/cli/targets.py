"""`ceres-cal targets`: the kinds of targets and the names of their features."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import Answer, Command

if TYPE_CHECKING:
    from ceres_cal.scene.targets import Curve, Target


@dataclass(frozen=True)
class Kind:
    """A kind of target, for people: what it is, its parameters, how its features are named, and examples by name."""

    what: str
    parameters: str
    features: str
    examples: Callable[[], dict[str, Target]]


def _ssl_fields() -> dict[str, Target]:
    from ceres_cal.scene.targets import ssl_field

    return {"ssl-a": ssl_field("A"), "ssl-b": ssl_field("B")}


def _checkerboard() -> dict[str, Target]:
    from ceres_cal.scene.targets import checkerboard

    return {"checkerboard": checkerboard(9, 6, 0.025)}


def _rings() -> dict[str, Target]:
    from ceres_cal.scene.targets import rings

    return {"rings": rings((0.05, 0.1, 0.15))}


def _custom() -> dict[str, Target]:
    from ceres_cal.scene.targets import Arc, Segment, custom

    curves: dict[str, Curve] = {
        "edge": Segment((0, 0, 0), (4, 0, 0), 0.01),
        "circle": Arc((0, 0, 0), 0.5, width_m=0.01),
    }
    return {"custom": custom({"pole_top": (1.0, 2.0, 1.0)}, curves)}


KINDS = {
    "ssl-field": Kind(
        "a field of the RoboCup small-size league: x along its length, the centre mark at 0, 0",
        "division (A or B), or field_length_m, field_width_m, goal_width_m, penalty_area_depth_m, "
        "penalty_area_width_m, goal_center_to_penalty_mark_m, center_circle_radius_m, line_thickness_m; a dimension "
        "beside a division replaces the division's",
        "lines and circle as in the league's geometry message, points after the lines that meet there",
        _ssl_fields,
    ),
    "checkerboard": Kind(
        "the inner corners of a checkerboard",
        "columns and rows (inner corners), square_m",
        'points "c,r" at (c, r, 0) squares, c from 0 to columns - 1, r from 0 to rows - 1',
        _checkerboard,
    ),
    "rings": Kind(
        "concentric circles",
        "radii_m, from the inside out",
        'curves "ring_1", "ring_2", ... from the inside out, point "centre"',
        _rings,
    ),
    "custom": Kind(
        "anything flat or not, given in full",
        "points (name: x, y, z), segments (from, to, width_m), arcs (centre, radius_m, from_rad, to_rad, width_m)",
        "as named there",
        _custom,
    ),
}


def _add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "target",
        nargs="?",
        metavar="TARGET",
        help="list the features of a kind (ssl-field, checkerboard, rings, custom), of ssl-a or ssl-b, or of the "
        "targets in a file of observations; without it the kinds are listed",
    )


def _run(args: Namespace) -> Answer:
    if args.target is None:
        return Answer({"kinds": {name: _kind_data(kind) for name, kind in KINDS.items()}}, _kinds_text)
    targets = _targets(args.target)
    return Answer(
        {"targets": {name: _target_data(target) for name, target in targets.items()}},
        lambda: "\n\n".join(_target_text(name, target) for name, target in targets.items()),
    )


COMMANDS = (Command("targets", "the kinds of targets and the names of their features", _add_arguments, _run),)


def _targets(wanted: str) -> dict[str, Target]:
    """The targets of a kind, a name or a file."""
    if wanted in KINDS:
        return KINDS[wanted].examples()
    examples = {name: target for kind in KINDS.values() for name, target in kind.examples().items()}
    if wanted in examples:
        return {wanted: examples[wanted]}
    if wanted.endswith((".json", ".npz")) or Path(wanted).exists():
        return _targets_in(Path(wanted))
    names = dict.fromkeys((*KINDS, *examples))
    raise InputError(f"there is no target {wanted!r}: choose one of {', '.join(names)}, or name a file of observations")


def _targets_in(path: Path) -> dict[str, Target]:
    """The targets of a file of observations, even where its observations are at fault."""
    from ceres_cal.base.files import read_json
    from ceres_cal.observations import FORMAT, VERSION, Observations
    from ceres_cal.scene.targets import target_from_spec

    if path.suffix == ".npz":
        return dict(Observations.load(path).targets)
    specs = read_json(path, FORMAT, VERSION).get("targets")
    if not isinstance(specs, dict) or not specs:
        raise InputError(f"{path}: it holds no targets")
    return {name: target_from_spec(spec, f"{path}: target {name!r}") for name, spec in specs.items()}


# ---- for people -----------------------------------------------------------------------------------------------------


def _kinds_text() -> str:
    import json

    blocks = []
    for name, kind in KINDS.items():
        lines = [f"{name}: {kind.what}", _item("parameters", kind.parameters), _item("features", kind.features)]
        for example, target in kind.examples().items():
            lines.append(_item("example", json.dumps(target.spec)))
            lines.append(_item("", f"`ceres-cal targets {example}` lists its features"))
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _item(title: str, text: str) -> str:
    import textwrap

    return textwrap.fill(text, 100, initial_indent=f"  {title:12}", subsequent_indent=" " * 14, break_on_hyphens=False)


def _target_text(name: str, target: Target) -> str:
    import json

    spec = target.spec if target.kind != "custom" else {"kind": "custom"}  # the rest of it follows
    lines = [f"{name} {json.dumps(spec)}"]
    width = max(map(len, (*target.points, *target.curves)))
    if target.points:
        lines.append(f"points ({len(target.points)}): x, y, z in m")
        lines += [f"  {feature:{width}}  {_place(place)}" for feature, place in target.points.items()]
    if target.curves:
        lines.append(f"curves ({len(target.curves)})")
        lines += [f"  {feature:{width}}  {_curve_text(curve)}" for feature, curve in target.curves.items()]
    return "\n".join(lines)


def _place(place: tuple[float, float, float]) -> str:
    return "  ".join(f"{number:8.4f}" for number in place)


def _curve_text(curve: Curve) -> str:
    from ceres_cal.scene.targets import Segment

    if isinstance(curve, Segment):
        shape = f"segment  from {_place(curve.start)}  to {_place(curve.end)}"
    else:
        span = f"from {curve.from_rad:g} to {curve.to_rad:g} rad"
        shape = f"arc      around {_place(curve.centre)}, radius {curve.radius_m:g}, {span}"
    return f"{shape}, width {curve.width_m:g}"


# ---- for scripts ----------------------------------------------------------------------------------------------------


def _kind_data(kind: Kind) -> dict[str, Any]:
    examples = {name: target.spec for name, target in kind.examples().items()}
    return {"what": kind.what, "parameters": kind.parameters, "features": kind.features, "examples": examples}


def _target_data(target: Target) -> dict[str, Any]:
    """Its description, and all its features as a custom target's file has them."""
    from ceres_cal.scene.targets import custom

    features = {**custom(target.points, target.curves).spec}
    del features["kind"]
    return {"spec": target.spec, **features}
