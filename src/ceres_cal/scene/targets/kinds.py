"""The table of the kinds of targets, and the target that a file describes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ceres_cal.base import InputError, LazyTable, did_you_mean, naming
from ceres_cal.scene.targets.painted_fields import templates
from ceres_cal.scene.targets.target import Target, TargetKind, require_size

_MODULES = {
    "tape-grid": "grids",
    "checkerboard": "grids",
    "circle-grid": "grids",
    "april-grid": "grids",
    "markers": "marker_targets",
    "rings": "ring_sheets",
    "custom": "custom_targets",
}
TARGET_KINDS: LazyTable[TargetKind] = LazyTable(
    "ceres_cal.scene.targets",
    {**{name: template.as_kind() for name, template in templates().items()}, **_MODULES},
    TargetKind,
)


def target_from_spec(spec: Any, where: str) -> Target:
    """The target that a file describes.

    Args:
        spec: `{"kind": ..., ...}`.
        where: how to name the place in messages, such as 'obs.json: target "field"'.

    Raises:
        InputError: unknown kind, or a description that does not fit its kind.
    """
    kind = spec.get("kind") if isinstance(spec, dict) else None
    if not isinstance(kind, str) or kind not in TARGET_KINDS:
        missing = '; its description has no "kind"' if kind is None else ""
        choices = did_you_mean(kind, TARGET_KINDS) or f": choose one of {', '.join(TARGET_KINDS)}"
        raise InputError(f"{where}: unknown kind {kind!r}{choices}{missing}")
    with naming(where):
        return TARGET_KINDS[kind].from_spec(spec, where)


def targets_from_specs(specs: Mapping[str, Any], where: str = "") -> dict[str, Target]:
    """The targets that a file describes, by name; InputError as `target_from_spec`, or where they are too large."""
    targets: dict[str, Target] = {}
    for name, spec in specs.items():
        targets[name] = target_from_spec(spec, f"{where}target {name!r}")
        features = sum(len(target.points) + len(target.curves) for target in targets.values())
        require_size(features, f"{where}targets up to {name!r}")
    return targets


def target_named(name: str) -> Target | None:
    """One of `targets_by_name`, without making the others; None where there is none of the name."""
    every = (kind.examples() for kind in TARGET_KINDS.values() if name != kind.name)
    return next((examples[name] for examples in every if name in examples), None)


def targets_by_name() -> dict[str, Target]:
    """The targets of any kind that exist in the world, such as ssl-a."""
    every = ((kind, *example) for kind in TARGET_KINDS.values() for example in kind.examples().items())
    return {name: target for kind, name, target in every if name != kind.name}
