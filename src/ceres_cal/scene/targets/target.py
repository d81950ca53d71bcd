"""Targets: rigid things of known geometry with named points and named curves; and what a kind of target is.

Also the appearance of a printed target (its sheet of paper, and what is on it), the table of the kinds, and the target
that a file describes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
from msgspec import Struct

from ceres_cal.base import Array, Frozen, LazyTable, Mask, cached_property, convert, did_you_mean, field, median
from ceres_cal.base.errors import InputError, naming
from ceres_cal.base.words import plural
from ceres_cal.scene.curves import Arc, Curve, aliases, along_curve, along_track


class Shape(Struct, frozen=True):
    """A square, by its corner with the least x and y and its side, m, or a disc, by its centre and radius.

    A light shape lies on a dark one.
    """

    place_m: tuple[float, float]
    size_m: float
    is_round: bool = False
    is_dark: bool = True


class Paper(Struct, frozen=True, eq=False):
    """The rectangular sheet that a target is printed on.

    Attributes:
        low_m, high_m: (x, y) of two opposite corners of the sheet.
        shapes: yields what is printed, in this order, on white.
    """

    low_m: tuple[float, float]
    high_m: tuple[float, float]
    shapes: Callable[[], Iterator[Shape]]


MOST_FEATURES = 100_000
"""Largest number of points and curves of all targets of a file: ten boards of 100 x 100 corners."""


WARP = ("bow.x", "bow.y", "twist", "wave.x", "wave.y")
"""Components of a board's warp: see `Target.bends`."""
STRETCH = ("stretch.x", "stretch.y")
"""Stretch of a board along its columns and along its rows, as by printers: see `Target.bends`."""
LARGEST_M = 1e7
"""Upper limit of a target's numbers, more than the Earth's radius. Products of four such numbers keep their meaning."""


HANDY_M = 50.0  # from its origin: largest reach of a target that somebody holds before a camera
PAINT_WANDERS = 0.2
"""Share of `Target.usual_aside_m` by which lines wander about their drawing: tape by 3 to 8 mm on 9 m."""


def require_places(kind: str, points: Mapping[str, Sequence[float]], curves: Mapping[str, Curve]) -> None:
    """Raise InputError where a point or a curve of a target has impossible numbers."""
    once_round = 2.0 * np.pi * (1.0 + 1e-6)  # people round
    for name, place in points.items():
        if not np.all(np.abs(place) < LARGEST_M):
            raise InputError(f"{kind}: point {name!r} must have three finite numbers of metres, not {place}")
    for name, curve in curves.items():
        numbers = np.hstack(msgspec.structs.astuple(curve))
        if not np.all(np.abs(numbers) < LARGEST_M) or curve.length_m <= 0.0 or curve.width_m < 0.0:
            raise InputError(f"{kind}: curve {name!r} needs finite numbers, a length and a width_m from 0 on")
        if isinstance(curve, Arc) and not curve.radius_m > 0.5 * curve.width_m:
            raise InputError(f"{kind}: arc {name!r} must have a radius of more than half its width")
        if isinstance(curve, Arc) and curve.to_rad - curve.from_rad > once_round:
            raise InputError(f"{kind}: arc {name!r} goes more than once round: its to_rad is too large")


def require_size(features: float, what: str) -> None:
    """Raise InputError where a target, or all of a file, would have more than MOST_FEATURES."""
    if not features <= MOST_FEATURES:
        raise InputError(f"{what}: at most {MOST_FEATURES} points and curves, not {features:.0f}: split it")


class Grid(Struct, frozen=True):
    """Points at even distances in columns (along x) and rows (along y), listed row by row.

    Attributes:
        checkered: whether they are the corners of a checkerboard's squares, which `detect.boards` finds.
    """

    columns: int
    rows: int
    spacing_m: float
    checkered: bool = False


class Target(Frozen):
    """A rigid thing of known geometry, in its own frame, in metres; a field's frame is the world.

    Attributes:
        spec: its description in a file, `{"kind": ..., ...}`; two targets are equal if their specs are, whether they
            move or not, and if their features come in the same order (observations number them).
        points: name -> (x, y, z) m.
        curves: name -> Segment or Arc.
        movable: whether somebody places it; what is not movable is the world.
        bows: whether it is a board that may be bent or stretched: then a tolerance may have a warp.
        grid: arrangement of its points in columns and rows; None where there is none.
        paper: the sheet that it is printed on; None for what is painted on the floor.
        mistaken_for: description in words -> spec of another target, most of whose features have the same names.
        dimensions: the lengths, m, that its spec gives or implies, by their names there; another value in the spec
            moves features.
        optional: groups of curve names, each of which a field may lack as a whole without being another one.
        tolerance_m: offset of its lines from their nominal position, where it states one; None: the usual one for its
            size.
    """

    spec: Mapping[str, Any]
    points: Mapping[str, tuple[float, float, float]]
    curves: Mapping[str, Curve]
    movable: bool = False
    bows: bool = False
    grid: Grid | None = None
    paper: Paper | None = None
    mistaken_for: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    dimensions: Mapping[str, float] = field(default_factory=dict)
    optional: tuple[tuple[str, ...], ...] = ()
    tolerance_m: float | None = None

    def __post_init__(self) -> None:
        require_places(self.kind, self.points, self.curves)
        if self.movable and self.reach_m > HANDY_M:  # only boards fit in any unit
            raise InputError(
                f"{self.kind}: it reaches {self.reach_m:.0f} m from its origin, too far for a board that is held up: "
                "give its dimensions in metres, or with their unit, such as 25mm"
            )

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Target)
            and {**self.spec, "movable": None} == {**other.spec, "movable": None}
            and self.point_names == other.point_names
            and self.curve_names == other.curve_names
        )

    __hash__: ClassVar[None] = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Target({self.kind}, {plural(len(self.points), 'point')}, {plural(len(self.curves), 'curve')})"

    @property
    def kind(self) -> str:
        return str(self.spec["kind"])

    @cached_property
    def point_names(self) -> tuple[str, ...]:
        return tuple(self.points)

    @cached_property
    def point_index(self) -> Mapping[str, int]:
        """The number of each point, by its name and by the names of a crossing at its place: see `crossings`."""
        index = {name: number for number, name in enumerate(self.points)}
        return index | {alias: index[name] for alias, name in aliases(self.points, self.curves).items()}

    @cached_property
    def curve_names(self) -> tuple[str, ...]:
        return tuple(self.curves)

    @cached_property
    def curve_index(self) -> Mapping[str, int]:
        """The number of each curve, by its name."""
        return {name: number for number, name in enumerate(self.curves)}

    @cached_property
    def point_array(self) -> Array:
        """(P, 3) m, in the order of `point_names`."""
        return np.array(list(self.points.values()), dtype=float).reshape(-1, 3)

    @cached_property
    def tracks(self) -> Array:
        """(3, C, 3, 3) track of each curve for side 0, +1 and -1; the side itself is the index."""
        return np.array(
            [[curve.track(side) for curve in self.curves.values()] for side in (0, 1, -1)], dtype=float
        ).reshape(3, -1, 3, 3)

    @cached_property
    def is_arc(self) -> Mask:
        """(C,) whether each curve is an arc."""
        return np.array([isinstance(curve, Arc) for curve in self.curves.values()], dtype=bool)

    @cached_property
    def evenly(self) -> tuple[Array, Array]:
        """(C, 241) parameters evenly along each curve, from end to end, and (C, 241, 3) m their places."""
        low, high = np.array([curve.parameter_range for curve in self.curves.values()]).reshape(-1, 2).T
        s = np.ascontiguousarray(np.linspace(low, high, 241, axis=1))
        return s, along_track(self.tracks[0][:, None], self.is_arc[:, None], s)

    @cached_property
    def places(self) -> Array:
        """(P, 3) m: its points, and the beginnings of its curves."""
        return np.concatenate([self.point_array, self.tracks[0, :, 0] + self.tracks[0, :, 1]])

    @cached_property
    def bends(self) -> Array:
        """(P, W + 3) deformations of a board, with x and y from -1 to 1 between its edges: 1 - x^2, 1 - y^2, x y, the
        odd terms along a side, x (1 - x^2) and y (1 - y^2), scaled to a maximum of 1, and 1 for a height; then its
        places along x and y from the middle, over its longer side. They are 0 where it does not bow.
        """
        if not self.bows or not self.points:
            return np.zeros((len(self.points), len(WARP) + 1 + len(STRETCH)))
        flat = self.point_array[:, :2]
        half = 0.5 * np.ptp(flat, axis=0)
        from_middle = flat - flat.min(axis=0) - half
        across = from_middle / half
        bows = 1.0 - across**2
        waves = 1.5 * np.sqrt(3.0) * across * bows
        stretches = 0.5 * from_middle / np.max(half)
        return np.column_stack([bows, across[:, 0] * across[:, 1], waves, np.ones(len(flat)), stretches])

    @property
    def reach_m(self) -> float:
        """Distance from its origin to the farthest of `places`, m."""
        return float(np.max(np.linalg.norm(self.places, axis=1), initial=0.0))

    @property
    def painted(self) -> tuple[str, ...]:
        """Names of the curves that photographs show: those with a width."""
        return tuple(name for name, curve in self.curves.items() if curve.width_m > 0.0)

    @property
    def usual_aside_m(self) -> float:
        """Offset of a curve that is off its nominal position, m: as stated, or usual for its size; 0 without paint."""
        aside = 4.2  # factor on the geometric mean of the line's width and a thousandth of the field's length
        widths = [self.curves[name].width_m for name in self.painted]
        if self.tolerance_m or not widths:
            return self.tolerance_m or 0.0
        return aside * float(np.sqrt(median(np.array(widths)) * 1e-3 * np.max(np.ptp(self.box, axis=0))))

    @cached_property
    def box(self) -> Array:
        """(2, 2) m, the lowest and the highest x and y of its points and curves."""
        reach = [along_curve(curve, _farthest(curve))[:, :2] for curve in self.curves.values()]
        every = np.concatenate([self.point_array[:, :2], *reach])
        return np.array([every.min(axis=0), every.max(axis=0)])


def _farthest(curve: Curve) -> Array:
    """Return the parameters of a curve's ends, and of the places where an arc is parallel to x or y."""
    low, high = curve.parameter_range
    turns = 0.5 * np.pi * np.arange(np.ceil(low / (0.5 * np.pi)), high / (0.5 * np.pi))
    return np.array([low, *(turns if isinstance(curve, Arc) else ()), high])


def from_arguments(kind: str, make: Callable[..., Target]) -> Callable[[dict[str, Any], str], Target]:
    """Return `TargetKind.from_spec` of a kind whose spec has the arguments of the function that makes its targets."""

    @cache
    def form() -> type[msgspec.Struct]:
        arguments = signature(make, eval_str=True).parameters.values()
        given = [
            (one.name, one.annotation) if one.default is one.empty else (one.name, one.annotation, one.default)
            for one in arguments
        ]
        return msgspec.defstruct(kind, [("kind", str), *given], forbid_unknown_fields=True)

    def from_spec(spec: dict[str, Any], where: str) -> Target:
        given = msgspec.structs.asdict(convert(spec, form(), where))
        del given["kind"]
        return make(**given)

    return from_spec


class TargetKind(Struct, frozen=True):
    """A kind of target: all that the package knows of it.

    Attributes:
        name: in files. what, parameters, features: texts for people: what it is, what a file gives, how its features
            are named.
        examples: returns targets by name. A target with another name than its kind's exists in the world, such as
            ssl-a, and can be used by that name.
        from_spec: makes the target that a file describes; the text names the place in messages. Raises InputError.
    """

    name: str
    what: str
    parameters: str
    features: str
    examples: Callable[[], dict[str, Target]]
    from_spec: Callable[[dict[str, Any], str], Target]


_FIELDS = sorted(Path(__file__).parent.glob("fields/*.json"), key=lambda path: (path.stem != "ssl-field", path))
FIELDS = {path.stem: path for path in _FIELDS}
"""Files of painted fields, by the kinds that they describe; the small-size league's first."""
_MODULES = {
    **dict.fromkeys(FIELDS, "painted_fields"),
    **dict.fromkeys(("tape-grid", "checkerboard", "circle-grid", "april-grid"), "grids"),
    "charuco": "charuco_boards",
    "markers": "marker_targets",
    "rings": "ring_sheets",
    "custom": "custom_targets",
}
TARGET_KINDS: LazyTable[TargetKind] = LazyTable("ceres_cal.scene.targets", _MODULES, TargetKind)


def target_from_spec(spec: Any, where: str) -> Target:
    """Return the target that a file describes.

    Args:
        spec: `{"kind": ..., ...}`.
        where: name of the place in messages, such as 'obs.json: target "field"'.

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
    """Return the targets of a file, by name; raises InputError as `target_from_spec`, or where they are too large."""
    targets: dict[str, Target] = {}
    for name, spec in specs.items():
        targets[name] = target_from_spec(spec, f"{where}target {name!r}")
        features = sum(len(target.points) + len(target.curves) for target in targets.values())
        require_size(features, f"{where}targets up to {name!r}")
    return targets


def still(targets: Mapping[str, Target]) -> dict[str, Target]:
    """Return the targets that lie in the world, as a field does."""
    return {name: target for name, target in targets.items() if not target.movable}


def require_features(target: Target, points: Iterable[str] = (), curves: Iterable[str] = ()) -> None:
    """Raise InputError where a target has no such point or curve."""
    for kind, names, known in (("point", points, target.point_index), ("curve", curves, target.curve_index)):
        for name in names:
            if name not in known:
                meant = did_you_mean(name, known) or ":"
                raise InputError(
                    f"{kind} {name!r} is not one of the target's{meant} `ceres-cal targets` lists the names"
                )


def target_named(name: str) -> Target | None:
    """Return one of `targets_by_name`, without making the others; None where there is none with that name."""
    every = (kind.examples() for kind in TARGET_KINDS.values() if name != kind.name)
    return next((examples[name] for examples in every if name in examples), None)


def targets_by_name() -> dict[str, Target]:
    """Return the targets of any kind that exist in the world, such as ssl-a."""
    every = ((kind, *example) for kind in TARGET_KINDS.values() for example in kind.examples().items())
    return {name: target for kind, name, target in every if name != kind.name}


def others_of_kind(target: Target) -> dict[str, Target]:
    """Return the other existing targets of a target's kind, such as the field of the other division."""
    kind = TARGET_KINDS[target.spec["kind"]]
    return {name: one for name, one in kind.examples().items() if name != kind.name and one.spec != target.spec}
