"""Fields and courts from data files: `fields/*.json`, each made from published rules, which the file names.

A file gives dimensions (m) by name, parts that may be painted or not, and curves and points by expressions of these.
"(Left|Right)GoalLine" is two curves: the first as written, the second with x mirrored; "[Top|Bottom]TouchLine" is the
same in y. Where the rules measure to an edge of a line, the file's `lengths` convert that to the line's centre.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from functools import cache, lru_cache, partial
from itertools import product
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base import IN_A_METRE, InputError, checked, convert, did_you_mean, no_such
from ceres_cal.scene.curves import Arc, Curve, Segment, with_crossings
from ceres_cal.scene.targets.target import FIELDS, LARGEST_M, Target, TargetKind

_FUNCTIONS = {name: getattr(math, name) for name in ("acos", "asin", "atan2", "pi", "sqrt")} | {"max": max}
TOLERANCE = "tolerance_m"  # offset of a field's lines from their nominal position: of every kind, but no dimension
_X, _Y = re.compile(r"\((\w*)\|(\w*)\)"), re.compile(r"\[(\w*)\|(\w*)\]")

Expression = str | float
"""A number, or Python's arithmetic on a file's dimensions, parts and lengths."""
_Names = dict[str, Any]


class _Variants(msgspec.Struct, forbid_unknown_fields=True):
    """The variants of a spec: `key` selects one, `words` describes it, and `names` are those of existing targets."""

    key: str
    words: str
    names: dict[str, str]


class _SegmentSpec(msgspec.Struct, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}):
    start: tuple[Expression, Expression]
    end: tuple[Expression, Expression]
    width_m: Expression = "line_thickness_m"
    parts: tuple[str, ...] = ()

    def curve(self, names: _Names, mirror: tuple[int, int]) -> Curve:
        start, end = (_place(place, names, mirror) for place in (self.start, self.end))
        return Segment(start, end, _value(self.width_m, names))


class _ArcSpec(msgspec.Struct, forbid_unknown_fields=True):
    centre: tuple[Expression, Expression]
    radius_m: Expression
    from_rad: Expression = 0.0
    to_rad: Expression = "2 * pi"
    width_m: Expression = "line_thickness_m"
    parts: tuple[str, ...] = ()

    def curve(self, names: _Names, mirror: tuple[int, int]) -> Curve:
        low, high = _value(self.from_rad, names), _value(self.to_rad, names)
        if mirror[0] < 0:
            low, high = math.pi - high, math.pi - low
        if mirror[1] < 0:
            low, high = -high, -low
        turns = 2.0 * math.pi * math.floor((low + math.pi) / (2.0 * math.pi))  # begin within -pi and pi
        radius, width = _value(self.radius_m, names), _value(self.width_m, names)
        return Arc(_place(self.centre, names, mirror), radius, low - turns, high - turns, width)


class _Point(msgspec.Struct, forbid_unknown_fields=True):
    at: tuple[Expression, Expression]
    parts: tuple[str, ...] = ()


class Template(msgspec.Struct, forbid_unknown_fields=True):
    """A field or court as its data file describes it.

    Attributes:
        source: the rules: document, edition, clause, and which of them are from memory. measured: to which edges.
        dimensions, parts: name -> value, or the value of each variant. lengths: name -> expression, in order.
        optional: parts that a field may lack without being another one. tolerance_m: offset of its lines from their
            nominal position, where that is not the usual one for its size.
    """

    kind: str
    what: str
    features: str
    source: tuple[str, ...]
    measured: str
    dimensions: dict[str, float | dict[str, float]]
    segments: dict[str, _SegmentSpec]
    variants: _Variants | None = None
    parts: dict[str, bool | dict[str, bool]] = {}
    optional: tuple[str, ...] = ()
    tolerance_m: float | None = None
    lengths: dict[str, Expression] = {}
    arcs: dict[str, _ArcSpec] = {}
    points: dict[str, _Point] = {}

    @property
    def choices(self) -> tuple[str, ...]:
        """The variants."""
        return () if self.variants is None else tuple(dict.fromkeys(self.variants.names.values()))

    def target(self, variant: str | None, given: Mapping[str, float | bool]) -> Target:
        """Return the field of a variant, with what is given in place of the variant's values.

        Raises:
            InputError: an unknown variant, dimension or part, a dimension that is missing or not positive, or
                dimensions that make no field.
        """
        self._require_known(variant, given)
        parts = {name: bool(given.get(name, _of(value, variant))) for name, value in self.parts.items()}
        dimensions = self._dimensions(variant, given)
        names: _Names = {**_FUNCTIONS, **dimensions, **parts}
        try:
            for name, expression in self.lengths.items():
                names[name] = _value(expression, names)
            shapes = list(_painted({**self.segments, **self.arcs}, parts))
            curves = {name: shape.curve(names, mirror) for name, mirror, shape in shapes}
            points = {name: _place(one.at, names, mirror) for name, mirror, one in _painted(self.points, parts)}
        except (ValueError, ZeroDivisionError, OverflowError):
            raise InputError(f"{self.kind}: there is no field of these dimensions: its lines do not meet") from None
        chosen = {self.variants.key: variant} if self.variants and variant else {}
        spec = {"kind": self.kind, **chosen, **given}
        switched = {name: bool(value) for name, value in given.items() if name in self.parts}
        return Target(
            spec,
            with_crossings(points, curves),
            curves,
            mistaken_for=self._others(variant, switched),
            dimensions=dimensions,
            optional=tuple(
                tuple(name for name, _, shape in shapes if part in shape.parts) for part in self.optional if parts[part]
            ),
            tolerance_m=given.get(TOLERANCE, self.tolerance_m),
        )

    def _require_known(self, variant: str | None, given: Mapping[str, float | bool]) -> None:
        if variant is not None and variant not in self.choices:
            key = self.variants.key if self.variants else "variant"
            raise InputError(f"{self.kind}: unknown {key} {variant!r}: {self._choice}")
        for name, value in given.items():
            if name not in (*self.dimensions, *self.parts, TOLERANCE):
                switched = f"; its parts are {', '.join(self.parts)}" if self.parts else ""
                known = f": the dimensions, in metres, are {', '.join(self.dimensions)}{switched}"
                near = did_you_mean(name, (*self.dimensions, *self.parts))
                raise InputError(f"{self.kind}: unknown dimension {name!r}{near or known}")
            if isinstance(value, bool) != (name in self.parts):
                wanted = "true or false" if name in self.parts else "a length in metres"
                raise InputError(f"{self.kind}: {name} must be {wanted}, not {value}")

    @property
    def _choice(self) -> str:
        return f"{' or '.join(self.choices)}, or give every dimension"

    def _dimensions(self, variant: str | None, given: Mapping[str, float | bool]) -> dict[str, float]:
        values = self.dimensions | ({TOLERANCE: given[TOLERANCE]} if TOLERANCE in given else {})
        every = {name: given.get(name, _of(value, variant)) for name, value in values.items()}
        if missing := [name for name, value in every.items() if value is None]:
            key = self.variants.key if self.variants else "variant"
            raise InputError(f"{self.kind}: {missing[0]} is missing: name a {key} or give every dimension")
        for name, value in every.items():
            if not 0.0 < value < LARGEST_M:
                raise InputError(f"{self.kind}: {name} must be a positive number of metres, not {value}")
        self._require_metres({name: float(value) for name, value in given.items() if name in self.dimensions})
        return {name: float(every[name]) for name in self.dimensions}

    def _require_metres(self, given: Mapping[str, float]) -> None:
        """Raise InputError where most of two or more dimensions are known ones in another unit, to 2 %, or where all
        are far too large: in inches a field is 39 times as large.
        """
        least = np.inf
        for variant, (unit, many) in product(self.choices or (None,), IN_A_METRE.items()):
            ratios = np.array([value / _of(self.dimensions[name], variant) for name, value in given.items()])
            same = np.mean(np.abs(ratios / many - 1.0) < 0.02) if len(ratios) > 1 else 0.0
            if unit != "m" and same > 0.5:
                raise InputError(f"{self.kind}: its dimensions are in {unit}, it seems: give them in metres")
            least = float(np.min(ratios, initial=least))
        if given and least > 25.0:
            raise InputError(f"{self.kind}: its dimensions are over {least:.0f} times the usual: give them in metres")

    def _others(self, variant: str | None, parts: Mapping[str, bool]) -> dict[str, Mapping[str, Any]]:
        """Return the specs of targets for which it may be mistaken, by their names in words."""
        if self.variants is None:
            return {}
        others = [other for other in self.choices if variant not in (None, other)]
        return {
            self.variants.words.format(other): {"kind": self.kind, self.variants.key: other, **parts}
            for other in others
        }

    def from_spec(self, spec: dict[str, Any], where: str) -> Target:
        """Return the target that a file describes; raises InputError as `target`."""
        data = {name: value for name, value in spec.items() if name != "kind"}
        variant = None
        if self.variants is not None:
            key = self.variants.key
            variant = convert(data.pop(key, None), str | None, f"{where}.{key}")  # type: ignore[arg-type]
        known = {**dict.fromkeys((*self.dimensions, TOLERANCE), float), **dict.fromkeys(self.parts, bool)}
        given = {  # an unknown one is refused by its name, whatever its value
            name: convert(value, known[name], f"{where}: {name}") if name in known else 0.0
            for name, value in data.items()
        }
        return _made(self.kind, variant, tuple(given.items()))

    def examples(self) -> dict[str, Target]:
        """Return the targets that exist, by name."""
        if self.variants is None:
            return {self.kind.rpartition("-")[0]: _made(self.kind, None, ())}
        return {name: _made(self.kind, variant, ()) for name, variant in self.variants.names.items()}

    def as_kind(self) -> TargetKind:
        """Return its entry in the table of kinds."""
        dimensions = ", ".join(self.dimensions)
        given = f"{dimensions}, each replacing that of the rules"
        if self.variants is not None:
            key = self.variants.key
            given = (
                f"{key} ({' or '.join(self.choices)}), or {dimensions}; a dimension beside a {key} replaces the {key}'s"
            )
        if self.parts:
            given += f"; true or false: {', '.join(self.parts)}"
        given += f"; {TOLERANCE}: how far lines may be off; default: usual for the field's size"
        what = f"{self.what}: x along its length, the middle at 0, 0; measured {self.measured}"
        return TargetKind(self.kind, what, given, self.features, self.examples, self.from_spec)


@checked
def painted_field(kind: str, variant: str | None = None, **given: float | bool) -> Target:
    """Return a field or court by its rules, such as `painted_field("vss-field", "3v3", center_circle=False)`.

    Args:
        kind: ssl-field, vss-field, spl-field, humanoid-field, football-field, basketball-court or tennis-court:
            `ceres-cal targets` lists them, with their variants, dimensions and parts.
        variant: such as the division, where the rules have several; without it every dimension that depends on it must
            be given.
        given: dimensions in metres that replace the rules', and parts that are painted (True) or not (False).

    Raises:
        InputError: unknown kind, variant, dimension or part, a dimension that is missing or not positive, or dimensions
            that make no field.
    """
    if kind not in templates():
        raise InputError(no_such("field", kind, templates()))
    plain = {name: value if isinstance(value, bool) else float(value) for name, value in given.items()}
    return _made(kind, variant, tuple(plain.items()))


@checked
def ssl_field(division: str | None = None, **given: float | bool) -> Target:
    """Return a field of the RoboCup small-size league: its lines, circle, corners and crossings by the league's names.

    Lines are named as in the league's geometry message (and lie where ssl-vision puts them); the message names no
    points, so those are named after the lines that meet there. All distances are between line centres (league rules,
    "distances between lines are measured from their centers").

    Args:
        division: "A" or "B"; without it every dimension must be given.
        given: field_length_m, field_width_m, goal_width_m, penalty_area_depth_m, penalty_area_width_m,
            goal_center_to_penalty_mark_m, center_circle_radius_m, line_thickness_m; what is given replaces the
            division's value. center_circle=False, center_line=False: not painted.

    Raises:
        InputError: unknown division, dimension or part, a missing or a non-positive dimension.
    """
    return painted_field("ssl-field", division, **given)


@cache
def templates() -> dict[str, Template]:
    """Return kind -> its template; that of the small-size league first."""
    return {kind: msgspec.json.decode(path.read_bytes(), type=Template) for kind, path in FIELDS.items()}


@lru_cache(maxsize=256)  # the same targets are needed repeatedly: what a dimension moves, in every photograph
def _made(kind: str, variant: str | None, given: tuple[tuple[str, float | bool], ...]) -> Target:
    return templates()[kind].target(variant, dict(given))


# ---- expressions and mirrors ----------------------------------------------------------------------------------------


def _of(value: Any, variant: str | None) -> Any:
    return value.get(variant) if isinstance(value, dict) else value


@cache
def _compiled(expression: str) -> Any:
    return compile(expression, "<field>", "eval")


def _value(expression: Expression, names: _Names) -> float:
    """Return the value of an expression in one of the package's own files."""
    if not isinstance(expression, str):
        return float(expression)
    return float(eval(_compiled(expression), {"__builtins__": {}}, names))


def _place(at: tuple[Expression, Expression], names: _Names, mirror: tuple[int, int]) -> tuple[float, float, float]:
    x, y = (sign * _value(one, names) for sign, one in zip(mirror, at, strict=True))
    return x + 0.0, y + 0.0, 0.0  # no -0


def _painted(every: Mapping[str, Any], parts: Mapping[str, bool]) -> Iterator[tuple[str, tuple[int, int], Any]]:
    """Yield name, signs of x and y, and shape of everything that is painted."""
    for pattern, shape in every.items():
        if not all(parts[part] for part in shape.parts):
            continue
        ways = ((1, -1) if _Y.search(pattern) else (1,)), ((1, -1) if _X.search(pattern) else (1,))
        for sign_y, sign_x in product(*ways):
            name = _X.sub(partial(_chosen, sign_x), _Y.sub(partial(_chosen, sign_y), pattern))
            yield name, (sign_x, sign_y), shape


def _chosen(sign: int, found: re.Match[str]) -> str:
    return found[1] if sign > 0 else found[2]


KINDS = tuple(template.as_kind() for template in templates().values())
