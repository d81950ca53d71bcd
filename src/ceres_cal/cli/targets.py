"""`ceres-cal targets`: the kinds of targets and the names of their features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ceres_cal import base, observations, report, scene
from ceres_cal.base import InputError
from ceres_cal.cli.arguments import output_option
from ceres_cal.cli.command import argument, command, option
from ceres_cal.cli.files import require_file_of_targets, require_output, save, spelled_target
from ceres_cal.report.document import Document, Section


def _help() -> str:
    return (
        f"list the features of a kind ({', '.join(scene.TARGET_KINDS)}), of {' or '.join(scene.targets_by_name())}, of "
        "one that is spelled out as in files ('{\"kind\": ...}'), or of the targets in a file of observations; without "
        "it the kinds are listed"
    )


@command(
    "targets",
    "the kinds of targets and the names of their features",
    "",
    "vss-3 --picture vss-3.svg",
    "observations.json",
)
def _run(
    target: str | None = argument("TARGET", _help, None),
    picture: Path | None = option("draw the target there, with the names of its lines", "SVG"),
) -> Document:
    require_output(picture, [], "pictures are", ".svg")
    if target is None:
        if picture is not None:
            raise InputError("--picture draws one target: name it, such as vss-3")
        kinds = {name: _kind_data(kind) for name, kind in scene.TARGET_KINDS.items()}
        return Document((Section("", _kinds_text().splitlines(), {"kinds": kinds}),))
    targets = _targets(target)
    if picture is not None:
        name, drawn = _only(targets, target, "--picture draws one of them")
        save(picture, report.target_svg(drawn, name).encode())
    data = {"targets": {name: _target_data(target) for name, target in targets.items()}}
    text = "\n\n".join(_target_text(name, target) for name, target in targets.items())
    return Document((Section("", text.splitlines(), data),))


def _only(targets: dict[str, scene.Target], wanted: str, what_to_do: str) -> tuple[str, scene.Target]:
    if len(targets) > 1:
        raise InputError(f"{wanted}: it has several targets: {', '.join(targets)}: {what_to_do}")
    return next(iter(targets.items()))


@command(
    "targets print",
    "a board as a PDF to print to scale, with a ruler on it",
    "9x6x25mm -o board.pdf",
    '\'{"kind": "rings", "radii_m": [0.05, 0.1]}\' -o rings.pdf',
)
def _print(
    target: str = argument("BOARD", 'such as 9x6x25mm, as `ceres-cal targets` has it, or {"kind": ...} as in files'),
    output: Path = output_option("the sheet (.pdf)"),
) -> Document:
    require_output(output, [], "sheets are", ".pdf")
    import json

    _, board = _only(_targets(target), target, "give the description of one")
    save(output, report.sheet_pdf(board, json.dumps(board.spec)))
    return Document((Section("written", [str(output)], {"output": str(output), "spec": board.spec}),))


def _targets(wanted: str) -> dict[str, scene.Target]:
    if wanted in scene.TARGET_KINDS:
        return scene.TARGET_KINDS[wanted].examples()
    if (spelled := spelled_target(wanted, "TARGET")) is not None:
        return {spelled.kind: spelled}
    by_name = scene.targets_by_name()
    if wanted in by_name:
        return {wanted: by_name[wanted]}
    return _targets_in(require_file_of_targets(wanted, (*scene.TARGET_KINDS, *by_name)))


def _targets_in(path: Path) -> dict[str, scene.Target]:
    """Return the targets of a file of observations, even if its observations are invalid."""
    from ceres_cal.observations import Observations

    if path.suffix == ".npz":
        return dict(Observations.load(path).targets)
    specs = base.read_json(path, observations.FORMAT, observations.VERSION).get("targets")
    if not isinstance(specs, dict) or not specs:
        raise InputError(f"{path}: it holds no targets")
    return scene.targets_from_specs(specs, f"{path}: ")


# ---- for people -----------------------------------------------------------------------------------------------------


def _kinds_text() -> str:
    import json

    blocks = []
    for name, kind in scene.TARGET_KINDS.items():
        lines = [f"{name}: {kind.what}", _item("parameters", kind.parameters), _item("features", kind.features)]
        for example, target in kind.examples().items():
            lines.append(_item("example", json.dumps(target.spec)))
            lines.append(_item("", f"`ceres-cal targets {example}` lists its features"))
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


_FEATURES = ("points", "segments", "arcs")


def _item(title: str, text: str) -> str:
    import textwrap

    return textwrap.fill(text, 100, initial_indent=f"  {title:12}", subsequent_indent=" " * 14, break_on_hyphens=False)


def _target_text(name: str, target: scene.Target) -> str:
    import json

    spec = {key: value for key, value in target.spec.items() if key not in _FEATURES}  # listed below
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


def _curve_text(curve: scene.Curve) -> str:
    if isinstance(curve, scene.Segment):
        shape = f"segment  from {_place(curve.start)}  to {_place(curve.end)}"
    else:
        span = f"from {curve.from_rad:g} to {curve.to_rad:g} rad"
        shape = f"arc      around {_place(curve.centre)}, radius {curve.radius_m:g}, {span}"
    return f"{shape}, width {curve.width_m:g}"


# ---- for scripts ----------------------------------------------------------------------------------------------------


def _kind_data(kind: scene.TargetKind) -> dict[str, Any]:
    examples = {name: target.spec for name, target in kind.examples().items()}
    return {"what": kind.what, "parameters": kind.parameters, "features": kind.features, "examples": examples}


def _target_data(target: scene.Target) -> dict[str, Any]:
    """Return a target's description, and all its features in the form of a custom target's file."""
    features = {**scene.custom(target.points, target.curves).spec}
    del features["kind"]
    return {"spec": target.spec, **features}
