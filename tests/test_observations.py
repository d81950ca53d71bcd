"""Observations: exact round trips through both kinds of file, and one line for every possible error in one."""

import copy
import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.errors import InputError
from ceres_cal.observations import Curves, Observations, Points, Prior, View, combine
from ceres_cal.scene.targets import Segment, checkerboard, custom, rings, ssl_field

quick = settings(deadline=None, max_examples=40)

Document = dict[str, Any]


def document() -> Document:
    """The file of docs/files.md, with the names that the targets have."""
    return {
        "format": "ceres-cal/observations",
        "version": 1,
        "targets": {
            "field": {"kind": "ssl-field", "division": "B"},
            "board": {"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.025},
        },
        "cameras": {"overhead": {"image_size": [1280, 960]}},
        "views": [
            {
                "frame": "0001",
                "camera": "overhead",
                "station": "overhead",
                "target": "field",
                "points": {"features": ["BottomLeftCorner"], "pixels": [[102.4, 800.1]], "sigma_px": 0.3},
                "curves": {
                    "features": ["BottomTouchLine", "BottomTouchLine"],
                    "pixels": [[130.0, 799.2], [140.0, 798.9]],
                    "sigma_px": 0.3,
                },
            },
            {
                "frame": "0002",
                "camera": "overhead",
                "station": "overhead",
                "target": "board",
                "placement": "0002",
                "points": {"features": ["0,0", "1,0"], "pixels": [[400.2, 300.1], [431.0, 300.9]]},
            },
        ],
        "priors": [{"station": "overhead", "height_m": 4.02, "sigma_m": 0.01}],
    }


def written(folder: Path, content: Document | bytes | str, name: str = "obs.json") -> Path:
    path = folder / name
    text = json.dumps(content) if isinstance(content, dict) else content
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def assert_refused(path: Path, *parts: str) -> None:
    """Loading fails with one line that names the file once, at its beginning, and contains all parts."""
    with pytest.raises(InputError) as raised:
        Observations.load(path)
    text = str(raised.value)
    assert text.startswith(f"{path}: ") and text.count(str(path)) == 1 and "\n" not in text
    for part in parts:
        assert part in text


def assert_same(one: Observations, other: Observations) -> None:
    """Equal to the last bit."""
    assert list(one.targets) == list(other.targets) and one.targets == other.targets
    assert list(one.cameras.items()) == list(other.cameras.items())
    assert one.views == other.views and one.priors == other.priors
    for mine, theirs in ((one.points, other.points), (one.curves, other.curves)):
        for name, column in vars(mine).items():
            assert column.dtype == getattr(theirs, name).dtype and column.shape == getattr(theirs, name).shape
            assert column.tobytes() == getattr(theirs, name).tobytes()
    assert one.digest == other.digest


# ---- round trips ----------------------------------------------------------------------------------------------------

TARGETS = {
    "field": ssl_field("B", line_thickness_m=0.012),
    "board": checkerboard(3, 2, 0.025),
    "circles": rings([0.01, 0.02]),
    'a "thing"\n': custom({"é": (0.1, 1 / 3, 0.0)}, {"": Segment((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.01)}),
}
finite = st.floats(allow_nan=False, allow_infinity=False)
sigmas = st.floats(1e-12, 1e12)
sigmas_px = st.floats(1e-3, 10.0)  # with ratios that measured pixels may have


@st.composite
def observation_sets(draw: st.DrawFn) -> Observations:
    cameras = draw(st.lists(st.text(max_size=4), min_size=1, max_size=2, unique=True))
    sizes = draw(st.tuples(st.integers(1, 9999), st.integers(1, 9999)))
    views: list[View] = []
    rows: dict[str, list[tuple[Any, ...]]] = {"point": [], "curve": []}
    for camera in cameras:
        for number in range(draw(st.integers(1, 3))):
            target = draw(st.sampled_from(sorted(TARGETS)))
            placement = draw(st.none() | st.just(f"{target} {number}"))
            views.append(View(draw(st.text(max_size=4)), camera, f"{camera} {number}", target, placement))
            for kind, names in (("point", TARGETS[target].point_names), ("curve", TARGETS[target].curve_names)):
                least = 1 if number == 0 and kind == "point" else 0
                for _ in range(draw(st.integers(least, 3)) if names else 0):
                    feature = draw(st.integers(0, len(names) - 1))
                    x, y = (draw(st.floats(-1.5, end)) for end in sizes)
                    rows[kind].append((len(views) - 1, feature, x, y, draw(sigmas_px), draw(st.integers(-1, 1))))
    columns: dict[str, dict[str, Any]] = {
        kind: {
            "view": [row[0] for row in rows[kind]],
            "feature": [row[1] for row in rows[kind]],
            "pixels": np.reshape([row[2:4] for row in rows[kind]], (-1, 2)),
            "sigma_px": [row[4] for row in rows[kind]],
        }
        for kind in rows
    }
    columns["curve"]["side"] = [row[5] for row in rows["curve"]]
    priors = [
        Prior("camera", camera, "principal_point", (draw(finite), draw(finite)), (1.0, draw(sigmas)))
        for camera in cameras
    ]
    priors += [Prior("station", views[0].station, "height_m", (draw(finite),), (draw(sigmas),))]
    return Observations(
        TARGETS,
        dict.fromkeys(cameras, sizes),
        tuple(views),
        Points(**columns["point"]),
        Curves(**columns["curve"]),
        tuple(priors),
    )


@quick
@given(observation_sets())
def test_files_come_back_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, observations: Observations) -> None:
    folder = tmp_path_factory.mktemp("observations")
    for name in ("obs.json", "obs.npz"):
        observations.save(folder / name)
        assert_same(Observations.load(folder / name), observations)
    again = Observations.load(folder / "obs.npz")
    again.save(folder / "again.json")
    assert (folder / "again.json").read_bytes() == (folder / "obs.json").read_bytes()


def test_the_designs_file(tmp_path: Path) -> None:
    observations = Observations.load(written(tmp_path, document()))
    assert observations.cameras == {"overhead": (1280, 960)}
    assert observations.views == (
        View("0001", "overhead", "overhead", "field"),
        View("0002", "overhead", "overhead", "board", "0002"),
    )
    assert observations.stations == {"overhead": "overhead"} and observations.placements == ("0002",)
    assert observations.points.view.tolist() == [0, 1, 1]
    assert observations.points.pixels.tolist() == [[102.4, 800.1], [400.2, 300.1], [431.0, 300.9]]
    assert observations.points.sigma_px.tolist() == [0.3, 1.0, 1.0]  # 1 where none is stated
    assert [observations.feature_name("point", row) for row in range(3)] == ["BottomLeftCorner", "0,0", "1,0"]
    assert [observations.feature_name("curve", row) for row in range(2)] == ["BottomTouchLine"] * 2
    assert observations.curves.side.tolist() == [0, 0]
    assert observations.priors == (Prior("station", "overhead", "height_m", (4.02,), (0.01,)),)


def test_what_a_file_may_leave_out_or_spell_out(tmp_path: Path) -> None:
    short, long = document(), document()
    for view in short["views"]:
        del view["station"]
    short["views"][0]["points"]["pixels"] = [[102, 800]]  # whole numbers are numbers
    del short["priors"]
    long["views"][0]["points"] |= {"pixels": [[102.0, 800.0]], "sigma_px": [0.3]}
    long["views"][0]["curves"] |= {"sigma_px": [0.3, 0.3], "side": ["centre", "centre"]}
    long |= {"priors": [], "units": "metres, radians, pixels", "pixel_origin": "centre of the top-left pixel"}
    assert_same(Observations.load(written(tmp_path, short)), Observations.load(written(tmp_path, long)))
    long["views"][0]["curves"]["side"] = "left"
    assert Observations.load(written(tmp_path, long)).curves.side.tolist() == [1, 1]
    long["views"][0]["curves"]["side"] = ["right", "centre"]
    assert Observations.load(written(tmp_path, long)).curves.side.tolist() == [-1, 0]


def test_a_file_from_an_editor_with_a_byte_order_mark(tmp_path: Path) -> None:
    plain = Observations.load(written(tmp_path, document()))
    assert_same(Observations.load(written(tmp_path, b"\xef\xbb\xbf" + json.dumps(document()).encode())), plain)


def test_written_json_is_for_people_too(tmp_path: Path) -> None:
    path = written(tmp_path, document())
    Observations.load(path).save(path)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert sum('"frame"' in line for line in lines) == 2  # one line a view
    assert '"units": "metres, radians, pixels"' in "".join(lines) and "top-left" in "".join(lines)


def test_digest_tells_contents_apart(tmp_path: Path) -> None:
    base = Observations.load(written(tmp_path, document()))
    digests = {base.digest}
    changes: list[Callable[[Document], object]] = [
        lambda d: d["views"][0]["points"]["pixels"][0].__setitem__(0, np.nextafter(102.4, 0.0)),
        lambda d: d["views"][0]["points"].update(sigma_px=0.4),
        lambda d: d["views"][0]["points"].update(features=["BottomRightCorner"]),
        lambda d: d["views"][0]["curves"].update(side="left"),
        lambda d: d["views"][0].update(frame="0003"),
        lambda d: d["views"][1].update(placement="0003"),
        lambda d: d["targets"]["board"].update(square_m=0.026),
        lambda d: d["cameras"]["overhead"].update(image_size=[1280, 961]),
        lambda d: d["priors"][0].update(sigma_m=0.02),
    ]
    for change in changes:
        changed = document()
        change(changed)
        digests.add(Observations.load(written(tmp_path, changed)).digest)
    assert len(digests) == 1 + len(changes)
    # The same columns have another meaning if a target lists its features in another order.
    orders = [{"a": [0, 0, 0], "b": [1, 0, 0]}, {"b": [1, 0, 0], "a": [0, 0, 0]}]
    for order in orders:
        changed = document()
        changed["targets"]["field"] = {"kind": "custom", "points": order}
        changed["views"][0] = {"frame": "1", "camera": "overhead", "target": "field"}
        changed["views"][0]["points"] = {"features": [next(iter(order))], "pixels": [[1, 2]]}
        digests.add(Observations.load(written(tmp_path, changed)).digest)
    assert len(digests) == 3 + len(changes)


def test_columns_are_owned_and_frozen() -> None:
    pixels = np.array([[1.0, 2.0]])
    points = Points(np.array([0], np.int64), [0], pixels, [1])  # type: ignore[arg-type]
    pixels[0, 0] = 7.0  # the caller's array is not shared
    assert points.pixels.tolist() == [[1.0, 2.0]] and len(points) == 1
    assert [column.dtype for column in vars(points).values()] == [np.int32, np.int32, np.float64, np.float64]
    with pytest.raises(ValueError, match="read-only"):
        points.pixels[0, 0] = 7.0


# ---- combine --------------------------------------------------------------------------------------------------------


def test_combine_puts_views_one_after_the_other(tmp_path: Path) -> None:
    first = Observations.load(written(tmp_path, document()))
    other = document()
    other["cameras"] = {"side": {"image_size": [1600, 1200]}}
    for view in other["views"]:
        view |= {"camera": "side", "station": "side"}
    other["priors"].append({"camera": "side", "phi": 700.0, "sigma": 5.0})
    other["priors"][0]["station"] = "side"
    second = Observations.load(written(tmp_path, other))
    both = combine([first, second, first])
    assert both.views == first.views + second.views + first.views
    assert both.points.view.tolist() == [0, 1, 1, 2, 3, 3, 4, 5, 5]
    assert both.curves.view.tolist() == [0, 0, 2, 2, 4, 4]
    assert both.points.view.dtype == np.int32
    assert np.array_equal(both.points.pixels, np.tile(first.points.pixels, (3, 1)))
    assert both.cameras == {"overhead": (1280, 960), "side": (1600, 1200)}
    assert both.priors == (*first.priors, *second.priors)  # each once
    assert combine([first]) is first
    alone = both.of_station("side")
    assert alone.views == second.views and alone.cameras == second.cameras and not alone.priors
    assert alone.points.view.tolist() == second.points.view.tolist()
    assert np.array_equal(alone.curves.pixels, second.curves.pixels)


def test_a_part_keeps_its_views(tmp_path: Path) -> None:
    whole = Observations.load(written(tmp_path, document()))
    points, curves = np.arange(len(whole.points)) > 0, np.arange(len(whole.curves)) > 0
    part = whole.part(points, curves)
    assert part.views == whole.views and part.priors == whole.priors
    assert np.array_equal(part.points.pixels, whole.points.pixels[1:])
    assert np.array_equal(part.curves.side, whole.curves.side[1:])


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"cameras": {"overhead": {"image_size": [1600, 1200]}}},
            r"camera 'overhead' has image sizes \(1280, 960\) and",
        ),
        (
            {"targets": {"field": {"kind": "ssl-field", "division": "A"}, "board": document()["targets"]["board"]}},
            "target 'field'",
        ),
    ],
)
def test_combine_refuses_one_name_for_two_things(tmp_path: Path, change: Document, message: str) -> None:
    first = Observations.load(written(tmp_path, document()))
    second = Observations.load(written(tmp_path, document() | change))
    with pytest.raises(InputError, match=message):
        combine([first, second])


# ---- what can be wrong in a file ------------------------------------------------------------------------------------

VIEW_0, VIEW_1 = "view 0 (frame '0001')", "view 1 (frame '0002')"
TWO_CAMERAS = {"overhead": {"image_size": [1280, 960]}, "side": {"image_size": [640, 480]}}


def at(*place: str | int | slice, value: Any) -> Callable[[Document], object]:
    """A change of the document that sets the value at a place."""

    def change(data: Document) -> None:
        inner: Any = data
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = value

    return change


POINTS_0, CURVES_0 = ("views", 0, "points"), ("views", 0, "curves")
BAD_DOCUMENTS: list[tuple[Callable[[Document], object], tuple[str, ...]]] = [
    # names
    (
        at(*POINTS_0, "features", 0, value="corner"),
        (VIEW_0, "target 'field' has no point 'corner'", "ceres-cal targets"),
    ),
    (at(*POINTS_0, "features", 0, value="a\nb"), (VIEW_0, r"has no point 'a\nb'")),
    (at(*POINTS_0, "features", 0, value="BottomTouchLine"), (VIEW_0, "has no point 'BottomTouchLine'")),
    (
        at(*CURVES_0, "features", 1, value="CenterMark"),
        (VIEW_0, "target 'field' has no curve 'CenterMark'"),
    ),
    (
        at("views", 1, "target", value="plate"),
        (VIEW_1, "there is no target 'plate': choose one of field, board"),
    ),
    (at("views", 1, "camera", value="side"), (VIEW_1, "there is no camera 'side': choose one of overhead")),
    (at("cameras", value=TWO_CAMERAS), ("camera 'side' has no observation",)),
    (at("targets", "field", "kind", value="ssl"), ("target 'field': unknown kind 'ssl'",)),
    (at("targets", "board", "rows", value=1), ("target 'board': ", "at least 2")),
    # headers
    (at("version", value=2), ("version 2 is not known here, only 1: update ceres-cal",)),
    (at("version", value="1"), ("version '1' is not known here",)),
    (
        at("format", value="ceres-cal/calibration"),
        ("it holds a calibration, where observations must be given",),
    ),
    # numbers
    (at(*POINTS_0, "pixels", 0, value=[np.nan, 1.0]), (VIEW_0, "point 'BottomLeftCorner': its pixel is not finite")),
    (at("views", 1, "points", "pixels", 1, value=[1.0, np.inf]), (VIEW_1, "point '1,0': its pixel is not finite")),
    (at(*CURVES_0, "pixels", 1, value=[-np.inf, 1.0]), (VIEW_0, "curve 'BottomTouchLine': its pixel is not finite")),
    (
        at(*POINTS_0, "pixels", 0, value=[None, 1.0]),
        ("Expected a number, got nothing, in views[0].points.pixels[0][0]",),
    ),
    (
        at(*POINTS_0, "pixels", 0, value=["1", 1.0]),
        ("Expected a number, got a text, in views[0].points.pixels[0][0]",),
    ),
    (
        at(*POINTS_0, "pixels", 0, value=[1.0, 2.0, 3.0]),
        ("Expected a list of length 2", "views[0].points.pixels[0]"),
    ),
    (
        at(*POINTS_0, "sigma_px", value=0.0),
        (VIEW_0, "point 'BottomLeftCorner': its sigma_px must be positive and finite"),
    ),
    (at(*CURVES_0, "sigma_px", value=[0.3, -0.3]), (VIEW_0, "curve 'BottomTouchLine': its sigma_px must be positive")),
    (
        at(*CURVES_0, "sigma_px", value=[np.nan, 0.3]),
        (VIEW_0, "curve 'BottomTouchLine': its sigma_px must be positive"),
    ),
    (at("cameras", "overhead", "image_size", value=[0, 960]), ("camera 'overhead': image_size must be two positive",)),
    (at("cameras", "overhead", "image_size", value=[960]), ("Expected a list of length 2",)),
    # lengths
    (at(*POINTS_0, "pixels", value=[]), (VIEW_0, "1 point features but 0 pixels")),
    (at(*CURVES_0, "sigma_px", value=[0.3]), (VIEW_0, "2 curve features but 1 numbers in sigma_px")),
    (at(*CURVES_0, "side", value=["left"]), (VIEW_0, "2 curve features but 1 sides")),
    (at(*CURVES_0, "side", value="inner"), (VIEW_0, "side 'inner' is unknown: centre, left, right")),
    # keys
    (at("camera", value={}), ("there is no field 'camera'",)),
    (at("views", 0, "lines", value={}), ("there is no field 'lines' in views[0]",)),
    (at(*POINTS_0, "sigma", value=0.3), ("there is no field 'sigma' in views[0].points",)),
    (at(*POINTS_0, "side", value="left"), ("there is no field 'side'",)),
    (lambda d: d["views"][1].pop("frame"), ("'frame' is missing",)),
    (at("views", 0, "frame", value=1), ("Expected a text, got a whole number, in views[0].frame",)),
    # stations and placements
    (
        lambda d: (d.update(cameras=TWO_CAMERAS), d["views"][1].update(camera="side")),
        (VIEW_1, "station 'overhead' belongs to camera 'overhead' already"),
    ),
    (at("views", 0, "placement", value="0002"), (VIEW_1, "placement '0002' holds target 'field' already")),
    # priors
    (
        at("priors", 0, "station", value="side"),
        ("a prior: there is no station 'side': choose one of overhead",),
    ),
    (at("priors", 0, "camera", value="overhead"), ('prior 0: a prior names one "camera" or one "station"',)),
    (
        at("priors", 0, value={"station": "overhead", "height_m": 4.0}),
        ('prior 0: a prior of a station has one quantity and "sigma_m"',),
    ),
    (at("priors", 0, "phi", value=3.0), ('prior 0: a prior of a station has one quantity and "sigma_m"',)),
    (
        at("priors", 0, value={"station": "overhead", "phi": 4.0, "sigma_m": 1.0}),
        ("prior 0: a station's prior is on height_m or position_m, not 'phi'",),
    ),
    (at("priors", 0, "height_m", value="4"), ("prior 0: height_m must be a number, such as 4.6, not '4'",)),
    (
        at("priors", 0, "height_m", value=np.nan),
        ("prior on 'height_m' of 'overhead': finite numbers and a sigma above 0",),
    ),
    (at("priors", 0, "sigma_m", value=0.0), ("prior on 'height_m' of 'overhead': finite numbers and a sigma above 0",)),
    (at("priors", 0, "sigma_m", value=[0.1, 0.1]), ("prior 0: sigma_m: 1 numbers are needed, not 2",)),
    (
        at("priors", 0, value={"station": "overhead", "position_m": [1.0, 2.0], "sigma_m": 1.0}),
        ("prior 0: position_m: 3 numbers are needed, not 2",),
    ),
]


@pytest.mark.parametrize("change, parts", BAD_DOCUMENTS)
def test_a_bad_document_gets_one_line(
    tmp_path: Path, change: Callable[[Document], object], parts: tuple[str, ...]
) -> None:
    data = document()
    change(data)
    assert_refused(written(tmp_path, data), *parts)


def test_a_view_without_observations_is_none_of_its_camera(tmp_path: Path) -> None:
    data = document()
    data["cameras"] = copy.deepcopy(TWO_CAMERAS)
    data["views"].append(
        {"frame": "0003", "camera": "side", "target": "field", "points": {"features": [], "pixels": []}}
    )
    assert_refused(written(tmp_path, data), "camera 'side' has no observation: add views of it or remove the camera")


def test_numbers_too_large_for_a_float(tmp_path: Path) -> None:
    text = json.dumps(document()).replace("102.4", "1e999")
    assert_refused(written(tmp_path, text), VIEW_0, "point 'BottomLeftCorner': its pixel is not finite")


def test_a_file_whose_name_begins_the_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    data = document()
    data["views"][0]["camera"] = "side"
    written(tmp_path, data, "view")
    with pytest.raises(InputError, match=r"^view: view 0 \(frame '0001'\): there is no camera"):
        Observations.load("view")


def test_json_cut_short_anywhere(tmp_path: Path) -> None:
    whole = json.dumps(document()).encode()
    for end in range(0, len(whole), 7):
        assert_refused(written(tmp_path, whole[:end]), "not valid JSON (cut short?)")


@pytest.mark.parametrize(
    "content",
    [b"\x89PNG\r\n\x1a\n\0\0\0", b"x,y\n1,2\n", b'{"views": "\xff"}', b'{"targets": ' + b"[" * 100_000],
    ids=str,
)
def test_what_is_not_json(tmp_path: Path, content: bytes) -> None:
    assert_refused(written(tmp_path, content), "not valid JSON")


def test_a_missing_file(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none.json", "no such file")


# ---- what can be wrong in an NPZ file -------------------------------------------------------------------------------


@pytest.fixture
def arrays(tmp_path: Path) -> dict[str, Any]:
    """The columns of the design's file."""
    path = tmp_path / "good.npz"
    Observations.load(written(tmp_path, document())).save(path)
    with np.load(path) as archive:
        return dict(archive)


def saved(folder: Path, arrays: dict[str, Any]) -> Path:
    np.savez(folder / "obs.npz", **arrays)
    return folder / "obs.npz"


def header_with(change: Callable[[Document], object]) -> Callable[[dict[str, Any]], object]:
    """A change of the header among the arrays."""

    def changed(arrays: dict[str, Any]) -> None:
        data = json.loads(arrays["header"].tobytes())
        change(data)
        arrays["header"] = np.frombuffer(json.dumps(data).encode(), np.uint8)

    return changed


BAD_ARRAYS: list[tuple[Callable[[dict[str, Any]], object], tuple[str, ...]]] = [
    (at("points_pixels", 1, 0, value=np.nan), (VIEW_1, "point '0,0': its pixel is not finite")),
    (at("curves_pixels", 1, 1, value=np.inf), (VIEW_0, "curve 'BottomTouchLine': its pixel is not finite")),
    (at("points_sigma_px", 0, value=-1.0), (VIEW_0, "point 'BottomLeftCorner': its sigma_px must be positive")),
    (at("curves_side", 1, value=2), (VIEW_0, "curve 'BottomTouchLine': its side must be 0, 1 or -1")),
    (at("curves_side", 1, value=-128), (VIEW_0, "curve 'BottomTouchLine': its side must be 0, 1 or -1")),
    (at("points_feature", 2, value=54), (VIEW_1, "point feature number 54 is unknown in target 'board', which has 54")),
    (at("curves_feature", 0, value=-1), (VIEW_0, "curve feature number -1 is unknown in target 'field', which has 13")),
    (at("points_view", 2, value=2), ("a point observation names view 2, but there are 2",)),
    (at("points_view", 0, value=-1), ("a point observation names view -1, but there are 2",)),
    (at("points_view", slice(None), value=[1, 0, 0]), ("the point observations are not in the order of their views",)),
    (
        lambda a: a.update(points_pixels=a["points_pixels"][:2]),
        ("column points_pixels has a shape, (2, 2), that does not fit others",),
    ),
    (
        lambda a: a.update(curves_side=a["curves_side"][:1]),
        ("curves_side has a shape, (1,), that does not",),
    ),
    (lambda a: a.pop("points_sigma_px"), ("column points_sigma_px is missing",)),
    (
        lambda a: a.update(points_view=a["points_view"] * 1.0),
        ("points_view must be int32 in 1 dimensions, not float64 in 1",),
    ),
    (lambda a: a.update(points_pixels=a["points_pixels"].ravel()), ("points_pixels must be float64 in 2 dimensions",)),
    (lambda a: a.update(curves_sigma=a["curves_sigma_px"]), ("unknown column 'curves_sigma'",)),
    (lambda a: a.pop("header"), ("column header is missing: is this another kind of file?",)),
    (lambda a: a.update(header=np.array("text")), ("column header must be uint8 in 1 dimensions, not <U4",)),
    (lambda a: a.update(header=a["header"][:50]), ("not valid JSON (cut short?)",)),
    (lambda a: a.update(header=np.array(["an", {"object": 1}], object)), ("it holds pickled objects",)),
    (lambda a: a.update(points_pixels=a["points_pixels"].astype(object)), ("it holds pickled objects",)),
    (header_with(at("version", value=7)), ("version 7 is not known here, only 1",)),
    (header_with(at("views", 0, "camera", value="side")), (VIEW_0, "there is no camera 'side'")),
    (header_with(at("views", 0, "target", value="plate")), (VIEW_0, "there is no target 'plate'")),
    (header_with(at("cameras", value=TWO_CAMERAS)), ("camera 'side' has no observation",)),
    (header_with(at("lines", value={})), ("there is no field 'lines'",)),
]


@pytest.mark.parametrize("change, parts", BAD_ARRAYS)
def test_bad_arrays_get_one_line(
    tmp_path: Path, arrays: dict[str, Any], change: Callable[[dict[str, Any]], object], parts: tuple[str, ...]
) -> None:
    change(arrays)
    assert_refused(saved(tmp_path, arrays), *parts)


def test_npz_cut_short_anywhere(tmp_path: Path, arrays: dict[str, Any]) -> None:
    whole = saved(tmp_path, arrays).read_bytes()
    for end in range(0, len(whole), 61):
        assert_refused(written(tmp_path, whole[:end], "obs.npz"), "cut short or not an NPZ file")


def message_of(path: Path) -> str | None:
    """The message of the InputError on loading, if it is raised; no other error may be."""
    try:
        Observations.load(path)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.parametrize("compressed", [False, True])
def test_npz_with_a_byte_changed(tmp_path: Path, arrays: dict[str, Any], compressed: bool) -> None:
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)
    whole, rng, refused = stream.getvalue(), np.random.default_rng(0), 0
    for place in rng.integers(0, len(whole), 150):
        content = bytearray(whole)
        content[place] ^= int(rng.integers(1, 256))
        path = written(tmp_path, bytes(content), "obs.npz")
        if text := message_of(path):
            refused += 1
            assert text.startswith(f"{path}: ") and "\n" not in text
    assert refused > 75  # the others are unused fields of the archive, such as dates


def test_other_files_under_its_name(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    for content in (b"", stream.getvalue(), pickle.dumps({"a": 1}), json.dumps(document()).encode()):
        assert_refused(written(tmp_path, content, "obs.npz"), "cut short or not an NPZ file")
    with zipfile.ZipFile(tmp_path / "obs.npz", "w") as archive:
        archive.writestr("notes.txt", "no arrays")
    assert_refused(tmp_path / "obs.npz", "unknown column 'notes.txt'")


# ---- writing --------------------------------------------------------------------------------------------------------


def test_other_endings_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    observations = Observations.load(written(tmp_path, document()))
    with pytest.raises(InputError, match=r"obs.csv: observations are written as .json or .npz"):
        observations.save(tmp_path / "obs.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["obs.json"]


@pytest.mark.parametrize("name", ["obs.json", "obs.npz"])
def test_a_crash_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    observations = Observations.load(written(tmp_path, document()))
    path = written(tmp_path, b"old", name)

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        observations.save(path)
    assert path.read_bytes() == b"old"
    assert not list(tmp_path.glob("*.part")) and not list(tmp_path.glob(".*"))


def test_a_slash_is_in_names_of_cameras_but_not_of_targets() -> None:
    """ROS names the cameras of a pair "narrow_stereo/left". A target with one ended `--estimate` as a KeyError."""
    one, other = (View("one/f", "pair/left", "one/s", name, None) for name in ("field", "a/b"))
    seen = Points(np.zeros(1, np.int32), np.zeros(1, np.int32), np.full((1, 2), 9.0), np.ones(1))
    nothing = Curves(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)), np.ones(0), np.zeros(0, np.int8))
    sizes = {"pair/left": (640, 480)}
    assert Observations({"field": ssl_field("B")}, sizes, (one,), seen, nothing).noise_names == ("pair/left/field",)
    with pytest.raises(InputError, match=r"^target 'a/b': '/' separates a target from its features"):
        Observations({"a/b": ssl_field("B")}, sizes, (other,), seen, nothing)


def test_each_camera_and_target_has_a_noise_of_its_own() -> None:
    """The noise of target "b" of camera "a" and that of a camera "a/b" had one name."""
    pairs = [("a", "b"), ("a", "field"), ("a/b", "field"), ("c", "field")]
    views = tuple(View("f", camera, camera, target, None) for camera, target in pairs)
    number = np.arange(4, dtype=np.int32)
    seen = Points(number, np.zeros(4, np.int32), np.full((4, 2), 9.0), np.ones(4))
    nothing = Curves(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)), np.ones(0), np.zeros(0, np.int8))
    targets = {"field": ssl_field("B"), "b": ssl_field("A")}
    observations = Observations(targets, dict.fromkeys(("a", "a/b", "c"), (640, 480)), views, seen, nothing)
    assert observations.noise_names == ("a/b", "a/field", "a/b/field", "c")
    noise = dict(zip(observations.noise_names, (2.0, 3.0, 5.0, 7.0), strict=True))
    assert observations.at_noise(noise).points.sigma_px.tolist() == [2.0, 3.0, 5.0, 7.0]


@pytest.mark.parametrize("what", ["camera", "station", "frame"])
def test_a_name_that_no_file_can_hold(what: str) -> None:
    """Bytes of a command line that are not UTF-8."""
    names = {"camera": "c", "station": "s", "frame": "f", what: "ove\udce9head"}
    view = View(names["frame"], names["camera"], names["station"], "field", None)
    seen = Points(np.zeros(1, np.int32), np.zeros(1, np.int32), np.full((1, 2), 9.0), np.ones(1))
    nothing = Curves(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)), np.ones(0), np.zeros(0, np.int8))
    with pytest.raises(InputError, match=rf"^{what} 'ove\\udce9head': a name must be UTF-8: give another one$"):
        Observations({"field": ssl_field("B")}, {names["camera"]: (640, 480)}, (view,), seen, nothing)


@pytest.mark.parametrize(
    "unit, origin_m, said",
    [
        (1.0, 0.0, ""),
        (1.0, 9e4, ""),  # a surveyor's local grid: it was reported to be in millimetres, and not trusted
        (
            1.0,
            5.8e6,
            "target 'target' lies 5800 km from its coordinate origin, which loses precision: use an ",
        ),
        (1e2, 0.0, "target 'target' is 1803 m large: are its numbers metres, not cm or mm?"),
        (1e3, 0.0, "target 'target' is 18028 m large: are its numbers metres, not cm or mm?"),
    ],
)
def test_sizes_that_are_odd(unit: float, origin_m: float, said: str) -> None:
    places = np.array([[0.0, 0.0], [15.0, 0.0], [15.0, 10.0], [0.0, 10.0]]) * unit + [origin_m, 0.0]
    warnings = Observations.from_points(np.full((4, 2), 9.0) + np.eye(4, 2), places, (640, 480)).warnings
    assert [one[: len(said)] for one in warnings] == [said] * bool(said)
