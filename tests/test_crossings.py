"""Crossings of a target's curves: their places, their names, and that they are points like others."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal import InputError, Observations, custom, ssl_field
from ceres_cal.detect.photographs.by_hand import Clicks, starts_from_clicks
from ceres_cal.scene.curves import Arc, Curve, Segment, crossings, distance_to_curve

number = st.floats(-3.0, 3.0, allow_nan=False)
places = st.tuples(number, number, st.just(0.0))
segments = st.builds(Segment, places, places, st.just(0.02)).filter(lambda one: one.length_m > 0.1)
arcs = st.builds(
    lambda centre, radius, begin, span: Arc(centre, radius, begin, begin + span, 0.02),
    *(places, st.floats(0.2, 3.0), st.floats(-3.0, 3.0), st.floats(0.1, 6.28)),
)


@given(st.lists(segments | arcs, min_size=2, max_size=5))
@settings(max_examples=60)
def test_every_crossing_lies_on_both_curves(shapes: list[Curve]) -> None:
    curves = {f"c{n}": curve for n, curve in enumerate(shapes)}
    for name, place in crossings(curves).items():
        for one in name.partition("#")[0].split("*"):
            assert distance_to_curve(curves[one], np.array([place]))[0] < 0.01 + 1e-5  # half a width past an end


def test_what_is_sampled_to_meet_has_a_crossing() -> None:
    """Compared with sampling: a sign change of one curve's distance along the other, away from ends and tangents."""
    circle, line = Arc((0.2, 0.1, 0.0), 1.0, -2.0, 1.0), Segment((-2.0, -0.4, 0.0), (2.0, 0.6, 0.0))
    along = np.linspace(0.0, 1.0, 200001)
    there = np.column_stack([np.interp(along, [0, 1], [-2, 2]), np.interp(along, [0, 1], [-0.4, 0.6])])
    off = np.linalg.norm(there - (0.2, 0.1), axis=1) - 1.0
    hits = there[:-1][np.sign(off[1:]) != np.sign(off[:-1])]
    angles = np.arctan2(hits[:, 1] - 0.1, hits[:, 0] - 0.2)
    hits = hits[np.mod(angles + 2.0, 2.0 * np.pi) < 3.0]
    found = np.array(list(crossings({"circle": circle, "line": line}).values()))
    assert found[:, :2] == pytest.approx(hits, abs=1e-4)


def test_names() -> None:
    line, low = Segment((-2, 0, 0), (2, 0, 0), 0.01), Segment((-2, -1, 0), (2, -1, 0), 0.01)
    up, circle = Segment((0, -1, 0), (0, 2, 0), 0.01), Arc((0, 0, 0), 0.5, width_m=0.01)
    target = custom({"middle": (0.0, 0.0, 0.0)}, {"line": line, "low": low, "up": up, "circle": circle})
    assert target.point_names == (
        *("middle", "line*circle#1", "line*circle#2", "low*up"),
        *("up*circle#1", "up*circle#2"),
    )
    assert target.points["line*circle#1"] == pytest.approx((-0.5, 0, 0))  # along the line
    assert target.points["up*circle#1"] == pytest.approx((0, -0.5, 0))
    assert target.point_index["line*up"] == target.point_index["up*line"] == target.point_index["middle"]
    assert target.point_index["circle*up#2"] == target.point_index["up*circle#2"]
    assert not crossings({"a": line, "b": Segment((0, -1, 1.0), (0, 1, 1.0))})  # one above the other
    assert not crossings({"a": line, "b": Arc((0, 1, 0), 1.0)})  # they touch


def test_a_target_without_points_is_clicked_and_observed(tmp_path: Path) -> None:
    square = [(0.0, 0.0), (3.0, 0.0), (3.0, 2.0), (0.0, 2.0)]
    sides: dict[str, Curve] = {
        name: Segment((*square[n], 0.0), (*square[(n + 1) % 4], 0.0), 0.02) for n, name in enumerate("abcd")
    }
    target = custom({}, sides)
    clicks = {"a*b": (500.0, 400.0), "c*b": (500.0, 100.0), "c*d": (50.0, 100.0), "d*a": (50.0, 400.0)}
    cameras, _ = starts_from_clicks(Clicks(clicks), target, (640, 480))
    assert cameras[0].project([[3.0, 0.0, 0.0]])[0] == pytest.approx((500.0, 400.0), abs=1.0)
    with pytest.raises(InputError, match=r"point 'a\*c' is not one of the target's"):
        starts_from_clicks(Clicks({**clicks, "a*c": (0.0, 0.0)}), target, (640, 480))
    view = {"frame": "1", "camera": "c", "station": "c", "target": "field"}
    file = {
        **{"format": "ceres-cal/observations", "version": 1, "units": "metres, radians, pixels"},
        **{"pixel_origin": "centre of the top-left pixel", "targets": {"field": target.spec}},
        **{"cameras": {"c": {"image_size": [640, 480]}}},
        "views": [{**view, "points": {"features": ["b*a", "d*c"], "pixels": [[500, 400], [50, 100]]}}],
    }
    (tmp_path / "o.json").write_text(json.dumps(file))
    observations = Observations.load(tmp_path / "o.json")
    assert [observations.feature_name("point", row) for row in (0, 1)] == ["a*b", "c*d"]


def test_the_league_s_field_keeps_its_points() -> None:
    field = ssl_field("B")
    assert len(field.points) == 25 and not any("*" in name for name in field.points)
    assert field.point_index["HalfwayLine*TopTouchLine"] == field.point_index["TopHalfwayCrossing"]
    assert field.point_index["CenterCircle*CenterLine#1"] == field.point_index["LeftCircleCrossing"]
