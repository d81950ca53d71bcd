"""ssl-vision's settings (VarTypes XML): the cameras' values in an existing file are replaced, everything else is kept.

src RoboCup-SSL/ssl-vision src/shared/vartypes, src/shared/util/camera_parameters. The file is robocup-ssl.xml beside
settings.xml. ssl-vision reads it at its start and overwrites it at its end: edit it while ssl-vision is closed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape

from msgspec import Struct

from ceres_cal.base import InputError, finite, replace
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import field_box
from ceres_cal.formats.opencv import ImageSize
from ceres_cal.formats.ssl_cameras import NAMES, CameraIds, to_cameras, to_entries
from ceres_cal.formats.ssl_fields import target_of
from ceres_cal.scene import LARGEST, Target

_CAMERA, _PARAMETERS, _FIELD = "Camera Calibrator", "Camera Parameters", "Field Configuration"
_INDEX, _OPENCV = "camera index", "use openCV camera model"
_XML_NAMES = {name: name.replace("_", " ") if name[0] not in "qt" else name for name in NAMES}
_SIZES = {  # name in the message: name in the settings
    "field_length": "Field Length",
    "field_width": "Field Width",
    "goal_width": "Goal Width",
    "goal_depth": "Goal Depth",
    "goal_height": "Goal Height",
    "boundary_width": "Boundary Width Touch Line",
    "line_thickness": "Line Thickness",
    "penalty_area_depth": "Penalty Area Depth",
    "penalty_area_width": "Penalty Area Width",
    "goal_center_to_penalty_mark": "Goal Line to Penalty Mark",
    "center_circle_radius": "Center Circle Radius",
}


class _Var(Struct, frozen=True):
    """One value: the path of names to it, its text, and the range of its text's bytes in the file.

    Attributes:
        owner: the number of the list that holds it.
    """

    path: tuple[str, ...]
    owner: int
    text: str
    start: int
    end: int


def values_in(content: bytes) -> list[_Var]:
    """Return every value of a settings file.

    Raises:
        InputError: it is no XML of VarTypes.
    """
    parser, found = expat.ParserCreate(), []
    open_tags: list[tuple[str, int, int]] = []  # name, number, first byte of the content
    count, root = 0, ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count, root
        root = root or tag
        count += 1
        open_tags.append((attributes.get("name", ""), count, content.index(b">", parser.CurrentByteIndex) + 1))

    def end(tag: str) -> None:
        name, _, first = open_tags.pop()
        last = max(parser.CurrentByteIndex, first)
        inside = content[first:last]
        if tag == "Var" and open_tags and b"<" not in inside:
            path = (*(one[0] for one in open_tags[1:]), name)
            owner = open_tags[-1][1]
            found.append(_Var(path, owner, inside.decode("utf-8", errors="replace").strip(), first, last))

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError) as error:
        raise InputError(f"not valid XML (cut short?): {error}") from None
    if root != "VarXML":
        raise InputError(f"not a settings file of ssl-vision: it begins with <{root}>, not <VarXML>")
    return found


def _cameras(values: list[_Var]) -> dict[int, dict[str, _Var]]:
    """Return camera index -> the values of its Camera Parameters by name, and those beside them."""
    groups = _by_list(one for one in values if _PARAMETERS in one.path and one.path[-2] == _PARAMETERS)
    owners = sorted(groups)
    if not owners:
        raise InputError(
            "it holds no camera: ssl-vision keeps its cameras in robocup-ssl.xml, beside settings.xml: name that file"
        )
    cameras: dict[int, dict[str, _Var]] = {}
    for place, owner in enumerate(owners):
        first = min(one.start for one in groups[owner].values())
        following = [min(one.start for one in groups[other].values()) for other in owners if other > owner]
        beside = _beside(values, first, min(following, default=1 << 62))
        index = beside.get(_INDEX)
        number = place if index is None else int(_number(index))
        cameras[number] = {**beside, **groups[owner]}
    return cameras


def _by_list(values: Iterable[_Var]) -> dict[int, dict[str, _Var]]:
    """Return number of a list -> the values in it by name."""
    groups: dict[int, dict[str, _Var]] = {}
    for one in values:
        groups.setdefault(one.owner, {})[one.path[-1]] = one
    return groups


def _beside(values: list[_Var], first: int, last: int) -> dict[str, _Var]:
    """Return index and image size of the calibrator whose parameters begin at byte `first`, before the next one's."""
    wanted = (_INDEX, "Image width", "Image height")
    return {one.path[-1]: one for one in values if one.path[-1] in wanted and first <= one.start < last}


def _number(one: _Var) -> float:
    number = one.text.replace(",", ".")  # decimal comma of some locales
    return finite(number, InputError(f"{one.path[-1]!r} is not a number, but {one.text!r}"), LARGEST)


# ---- writing --------------------------------------------------------------------------------------------------------


def _export(request: ExportRequest, *, camera_id: CameraIds = "") -> Export:
    if request.existing is None:
        raise InputError("ssl-vision's settings are edited in place: name its robocup-ssl.xml (or a copy), with "
                         "ssl-vision closed")  # fmt: skip
    values = values_in(request.existing)
    there, box = _cameras(values), field_box(request.calibration.targets)
    box = box or field_box({"field": settings_target(values)})
    entries, exported = to_entries(request, camera_id, box)
    changes: list[tuple[_Var, str]] = []
    for number, entry in entries.items():
        if number not in there:
            raise InputError(f"it has no camera {number}, only {', '.join(map(str, sorted(there)))}: see camera_id")
        changes += _changes(number, entry, there[number])
    content = request.existing
    for one, text in sorted(changes, key=lambda change: -change[0].start):
        content = content[: one.start] + escape(text).encode() + content[one.end :]
    closed = "ssl-vision reads this file at its start and overwrites it at its end: it must be closed meanwhile"
    words, warnings = f"{exported.words} in ssl-vision's settings", (*exported.warnings, closed)
    return replace(exported, content=content, words=words, warnings=warnings)


def _changes(number: int, entry: Mapping[str, Any], there: Mapping[str, _Var]) -> Iterator[tuple[_Var, str]]:
    most_tz_mm, distortion = 6500.0, (-1.0, 2.0)  # ssl-vision clamps to these when it reads
    if not 0.0 <= entry["tz"] <= most_tz_mm:
        raise InputError(
            f"camera {number}: its tz {entry['tz']:.0f} mm is not between 0 and {most_tz_mm:.0f}, the range of "
            "ssl-vision, which cannot load this camera"
        )
    if not distortion[0] <= entry["distortion"] <= distortion[1]:
        raise InputError(f"camera {number}: ssl-vision clamps its distortion {entry['distortion']:.3g} to [-1, 2]")
    for name, label in _XML_NAMES.items():
        if label not in there:
            raise InputError(f"camera {number} has no {label!r}: let ssl-vision write the file once")
        yield there[label], f"{entry[name]:.9f}"
    if _OPENCV in there:
        yield there[_OPENCV], "false"


# ---- reading --------------------------------------------------------------------------------------------------------


def _read(request: ImportRequest, *, image_size: ImageSize = "") -> Any:
    values = values_in(request.content)
    every = sorted(_cameras(values).items())
    cameras, warnings = to_cameras((_entry(*one) for one in every), image_size)
    for number, there in every:
        if _OPENCV in there and there[_OPENCV].text == "true":
            warnings.append(
                f"camera 'camera{number}': ssl-vision's OpenCV mode is on, which ignores all distortion when it "
                "locates: the numbers of its own model were read instead"
            )
    return calibration_of("ssl-vision's settings", cameras, {"field": settings_target(values)}, warnings)


def _entry(number: int, there: Mapping[str, _Var]) -> dict[str, Any]:
    """Return the values in the form of SSL_GeometryCameraCalibration."""
    numbers = {name: _number(there[label]) for name, label in _XML_NAMES.items() if label in there}
    sizes = [_number(there[label]) if label in there else 0.0 for label in ("Image width", "Image height")]
    return {"camera_id": number, **numbers, "pixel_image_width": sizes[0], "pixel_image_height": sizes[1]}


def settings_target(values: list[_Var]) -> Target:
    """Return the field of a settings file; InputError where it has none."""
    inside = [one for one in values if _FIELD in one.path]
    if not inside:
        raise InputError("it holds no field: ssl-vision keeps it in robocup-ssl.xml, beside settings.xml")
    by_name = {one.path[-1]: one for one in inside if one.path[-2] == _FIELD}
    sizes = {name: _number(by_name[label]) for name, label in _SIZES.items() if label in by_name}
    return target_of(
        {**sizes, "field_lines": _shapes(inside, "Field Lines"), "field_arcs": _shapes(inside, "Field Arcs")}
    )


def _shapes(inside: list[_Var], of: str) -> list[dict[str, Any]]:
    """Return lines or arcs in the form of the message."""
    return [_shape(group) for group in _by_list(one for one in inside if of in one.path[:-1]).values()]


def _shape(group: Mapping[str, _Var]) -> dict[str, Any]:
    def place(name: str) -> dict[str, float]:
        return {axis: _number(group[f"{name}.{axis}"]) for axis in "xy"}

    try:
        shape: dict[str, Any] = {"name": group["Name"].text, "thickness": _number(group["Line thickness"])}
        if "Radius" not in group:
            return {**shape, "p1": place("P1"), "p2": place("P2")}
        ends = {"a1": _number(group["Start angle"]), "a2": _number(group["End angle"])}
        return {**shape, "center": place("Center"), "radius": _number(group["Radius"]), **ends}
    except KeyError as missing:
        raise InputError(f"a line or arc of the field lacks {missing}") from None


_NAME, _FILE, _ENDINGS = "ssl-vision-xml", "ssl-vision's robocup-ssl.xml", (".xml",)
_WRITTEN = f"{_FILE}, edited in place"
FORMATS = (
    ExportFormat(_NAME, _WRITTEN, _ENDINGS, _export, most_stations=None, edits=True),
    ImportFormat(_NAME, _FILE, _ENDINGS, lambda content: b"<VarXML" in content, _read),
)
