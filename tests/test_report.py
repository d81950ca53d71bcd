"""The report: a self-contained page with the verdict first, which is displayed correctly in a real browser."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from chromium import Browser, browser
from scenery import field_scene, overhead_pose
from scenes import RADIAL, SCENES, camera
from thorough import partly

from ceres_cal import Calibration, Observations, Options, Pose, Prior, calibrate, write_report
from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.base.transforms import euler_from_rotation, rotation_exp
from ceres_cal.base.words import HEIGHTS_M, at_precision, short
from ceres_cal.cli import main
from ceres_cal.diagnostics import diagnose
from ceres_cal.effects.columns import EffectColumns, ScoreTest
from ceres_cal.effects.table.camera import motion_columns
from ceres_cal.observations import NO_POINTS
from ceres_cal.problem.quantities import camera_moved
from ceres_cal.report import make_report, quality
from ceres_cal.report.document import Document
from ceres_cal.report.grounds import CARE_MM, GOOD_MM, judge_quality, level_of, noise_ratio, reaches, worst
from ceres_cal.report.maps import levels_of
from ceres_cal.report.quality import Material, quality_of
from ceres_cal.report.residual_pictures import significant_means
from ceres_cal.report.scale import COLORS, MM, PX
from ceres_cal.report.solve_pictures import ideal_radii
from ceres_cal.report.summary import calibration_sections, verdict_chapter
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, built_in_scene, simulate

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data" / "ssl_field" / "observations.json"
HOSTILE = '<script>alert("x")</script>&\'$a_b$'
PICTURES = (
    "vectors-0", "radius-0", "lens-0", "frames", "outliers", "map-0-0", "image-0", "map-0-1", "correlation",
    "convergence", "closed-form", "support-0",
)  # fmt: skip


class Outline(HTMLParser):
    """Elements, attributes and texts of a page."""

    VOID = frozenset({"meta", "link", "br", "path", "use", "rect", "image"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@cache
def sample() -> tuple[Calibration, Observations]:
    observations = Observations.load(SAMPLE)
    return calibrate(observations, RADIAL), observations


@cache
def sample_page() -> str:
    return make_report(*sample())


def tilted(degrees: float) -> tuple[Calibration, Observations]:
    """A field from 5.2 m by a camera tilted by this angle."""
    stations = {"overhead": Station("overhead", overhead_pose(0.2, 0.1, 5.2, tilt_x_deg=degrees))}
    scene = field_scene(ssl_field("B"), {"overhead": camera("radial-2-3")}, stations, points=(), spacing_m=0.25)
    observations = simulate(scene, Disturbance(0.3, 0.3), seed=2).observations
    return calibrate(observations, RADIAL), observations


@cache
def frontal_page() -> str:
    return make_report(*tilted(0.5))


def headline(page: str) -> str:
    found = re.search(r'<section id="verdict" class="(\w+)"><h2>(.*?)</h2>', page)
    assert found is not None
    return f"{found[1]}: {found[2]}"


# ---- the page -------------------------------------------------------------------------------------------------------


def test_the_page_needs_nothing_from_elsewhere() -> None:
    page = sample_page()
    assert len(page.encode()) < 1_000_000  # 0.74 MB measured
    outline = Outline(page)
    for tag, attributes in outline.elements:
        for name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster"):
            assert re.match(r"#|data:", attributes.get(name, "#")), (tag, attributes)
    assert not re.search(r"url\((?!#)|@import|https?://", page)
    assert {"iframe", "object", "base", "form"}.isdisjoint(tag for tag, _ in outline.elements)
    assert [attributes for tag, attributes in outline.elements if tag == "script"] == [{}]  # its own, and inline


def test_every_reference_in_the_page_leads_to_one_place() -> None:
    page = sample_page()
    ids = re.findall(r' id="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page)) and all(
        a or b in ids for a, b in re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page)
    )


def test_verdict_first_then_findings_numbers_pictures() -> None:
    sections = re.findall(r'<section id="(\w+)"', sample_page())
    assert sections == ["verdict", "support", "findings", "numbers", "residuals", "maps", "solve"]
    assert headline(sample_page()).startswith("good: This calibration can be trusted: to 1.")


def test_every_picture_has_its_sentence_and_its_table() -> None:
    figures = re.findall(r"<figure.*?</figure>", sample_page(), flags=re.S)
    names = [re.search(r'id="([^"]+)"', figure)[1] for figure in figures]  # type: ignore[index]
    assert sorted(names) == sorted(PICTURES)
    for name, figure in zip(names, figures, strict=True):
        reading = re.search(r"<figcaption>(.*?)</figcaption>", figure)
        assert reading is not None and len(reading[1]) > 60, name
        assert figure.count("<svg") == (2 if name.startswith(("vectors", "support")) else 1)
        table = re.search(r"<details><summary>.*?</summary>.*<tbody>(.*?)</tbody>", figure, flags=re.S)
        assert table is not None and table[1].count("<tr>") >= 4, name


def test_numbers_are_the_calibrations_own() -> None:
    calibration, _ = sample()
    page = sample_page()
    lens = calibration.cameras["overhead"].lens
    for name, value in lens.coefficients.items():
        sd = calibration.uncertainty.verdict("camera", "overhead", name).sd
        assert f">{at_precision(value, sd)}</td>" in page, name
    found = calibration.uncertainty.verdict("camera", "overhead", "phi")
    assert f">{found.value:.1f} px</td>" in page and f">{short(found.sd)} px</td>" in page
    assert calibration.digest[:16] in page
    floor = calibration.uncertainty.map_sd_mm(height_m=0.0)
    shown = re.search(r'On the floor</p><p class="value">± ([\d.]+)', page)
    assert shown is not None and float(shown[1]) == float(short(floor.mean_mm))


def test_names_from_files_do_no_harm() -> None:
    scene, disturbance = built_in_scene("ssl-field")
    plain = simulate(scene, disturbance, seed=1).observations
    views = tuple(
        replace(
            view,
            frame=f"{HOSTILE}{number}",
            station=HOSTILE,
            camera=HOSTILE,
            placement=f"{HOSTILE}{number}" if view.placement else None,
        )
        for number, view in enumerate(plain.views)
    )
    observations = replace(plain, views=views, cameras={HOSTILE: plain.cameras["overhead"]})
    page = make_report(calibrate(observations, RADIAL), observations)
    outline = Outline(page)
    assert [tag for tag, _ in outline.elements].count("script") == 1 == page.count("<script")  # the page's own
    assert any(HOSTILE in text for text in "".join(outline.text).split("\n"))
    assert "alert(&quot;x&quot;)" in page and 'alert("x")' not in re.sub(r"<text.*?</text>", "", page, flags=re.S)


@pytest.mark.usefixtures("words_alone")
def test_a_report_of_other_observations_says_so(tmp_path: Path) -> None:
    calibration, observations = sample()
    scene, disturbance = built_in_scene("ssl-field")
    other = simulate(scene, disturbance, seed=9).observations
    with pytest.raises(InputError, match="not the observations that the calibration was made from"):
        make_report(calibration, other)
    page = make_report(calibration, other, diagnose(calibration, other, new_data=True))
    assert "These are new data" in page and "No closed form to compare with" in page
    write_report(tmp_path / "page.html", calibration, observations)
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == make_report(calibration, observations)


# ---- verdicts -------------------------------------------------------------------------------------------------------


def test_a_frontal_view_is_trusted_on_the_floor_alone() -> None:
    page = frontal_page()
    assert headline(page).startswith("care: Usable on the floor only, to ")
    assert headline(page).endswith("places at robot height (150\N{NO-BREAK SPACE}mm) are not known.")
    assert "only their ratio is known" in page and "the observations do not determine how far off" in page.lower()
    assert "nan" not in re.sub(r"<svg.*?</svg>|<style.*?</style>", "", page, flags=re.S).lower().split()


@pytest.mark.usefixtures("words_alone")
def test_a_wrong_model_is_never_simply_trusted() -> None:
    observations = sample()[1]
    calibration = calibrate(observations, Options(powers=(3,)))
    page = make_report(calibration, observations)
    promised = re.fullmatch(
        r"care: Usable with limits: to ([\d.]+)\smm on the floor and to ([\d.]+)\smm at robot height .*", headline(page)
    )
    assert promised is not None
    camera = built_in_scene("ssl-field")[0].camera_at("overhead")
    for height_m, stated_mm in zip(HEIGHTS_M, map(float, promised.groups()), strict=True):  # 7.7 and 8.7
        known = calibration.uncertainty.map_sd_mm(height_m=height_m)
        places = known.places[np.isfinite(known.sd_mm.ravel())]
        pixels = camera.project(np.column_stack([places, np.full(len(places), height_m)]))
        off_mm = 1e3 * np.linalg.norm(calibration.station().locate(pixels, height_m) - places, axis=1)
        assert 0.5 * stated_mm < np.quantile(off_mm, 0.95) < stated_mm  # 5.9 and 6.0
    assert "The accuracy in the first line includes this" in page
    cards = re.findall(r'<article class="card (\w+)"><h3>(.*?)</h3>', page)
    assert cards[0][0] == "no" and "residuals vary with the radius" in cards[0][1]


def test_no_accuracy_is_stated_where_the_noise_is_three_times_the_stated_one() -> None:
    observations = sample()[1]
    points, curves = observations.points, observations.curves
    stated = replace(
        observations,
        points=replace(points, sigma_px=points.sigma_px / 3.5),
        curves=replace(curves, sigma_px=curves.sigma_px / 3.5),
    )
    judged = judge_quality(quality_of(calibrate(stated, RADIAL), stated))
    assert judged.level == "care"
    assert judged.headline == "Usable with limits, without a stated accuracy: the noise is 3.5 times the stated sigma."


@pytest.mark.parametrize("noise_px, ratio", [(0.5, 0.0), (2.5, 5.0)])
def test_noise_of_curves_as_paint_wanders_is_no_doubt(noise_px: float, ratio: float) -> None:
    """2.5 mm, and 13 mm."""
    station = Station("c", overhead_pose(0.0, 0.0, 4.2, 12.0, 8.0, 0.0))
    scene = field_scene(ssl_field("B"), {"c": camera("brown")}, {"s": station}, spacing_m=0.25)
    observations = simulate(scene, Disturbance(0.1, noise_px), 1).observations
    curves = replace(observations.curves, sigma_px=np.full(len(observations.curves), noise_px / 5.0))
    stated = replace(observations, points=NO_POINTS, curves=curves)
    assert noise_ratio(quality_of(calibrate(stated, Options(lens="brown")), stated)) == pytest.approx(ratio, rel=0.15)


def test_very_many_observations_are_diagnosed_by_a_sample() -> None:
    calibration, observations = sample()
    assert quality_of(calibration, observations).diagnosis is not None
    views = [replace(view, frame=f"{view.frame} {n}") for n in range(4) for view in observations.views]
    rng, count = np.random.default_rng(0), len(observations.views)
    copies = [
        type(column)(
            **{name: np.concatenate([values] * 4) for name, values in vars(column).items()}
            | {"view": np.concatenate([column.view + n * count for n in range(4)])}
            | {"pixels": np.concatenate([column.pixels] * 4) + rng.normal(0.0, 1e-3, (4 * len(column), 2))}
        )
        for column in (observations.points, observations.curves)
    ]
    many = Observations(observations.targets, observations.cameras, tuple(views), *copies)  # type: ignore[arg-type]
    few = quality_of(calibration, many).diagnosis
    assert few is not None and few.new_data and 1000 < len(few.table) <= 5_500 < 4 * 2271


def test_findings_name_a_command_that_can_be_run() -> None:
    """`diagnose` takes files of observations, and `refit new.jpg` writes none."""
    quality = quality_of(*sample())
    for is_observed_now, where in ((False, "`ceres-cal diagnose`"), (True, r"the report \(--report PAGE\)")):
        sections = calibration_sections(quality, ["new"], is_observed_now=is_observed_now)
        assert re.search(rf"\d findings?: {where} says what to do", Document(tuple(sections)).text())


def test_a_fault_that_moves_places_by_little_is_counted() -> None:
    """A fault with an effect smaller than the standard deviations increases the promised errors."""
    calibration, observations = sample()
    sound = quality_of(calibration, observations)
    assert sound.diagnosis is not None and sound.uncertainty is not None
    key = next(key for key in sound.uncertainty.posterior.keys if key.quantity == "x")
    sd = sound.uncertainty.posterior.sd_of(*key[:3])
    fault = replace(sound.diagnosis.findings[0], wrong="model", effect_mm=1.0)
    step = sound.diagnosis.step
    shifts = motion_columns(step.case)[:, 3:]
    share, along_x = np.abs(shifts) / np.linalg.norm(shifts, axis=1, keepdims=True), shifts[:, :1]
    # Of a frame that shows lines along x alone it was said that it is shifted by 1e16 mm along x.
    assert np.any(share == 0.0) and np.all((share == 0.0) | (share > 1e-9))
    shifted = EffectColumns(along_x, np.zeros(len(along_x), dtype=np.int64), ("overhead",), kind="moved in")
    cause = ScoreTest(shifted, 0, 0.0, 1, 0.0, np.ones(1), np.ones(1))
    for sigmas, level in ((0.05, "good"), (30.0, "no")):
        moved = replace(step, causes=((cause, np.array([sigmas * sd])),))
        assert abs(moved.moves[key]) == pytest.approx(sigmas * sd, rel=1e-6)
        judged = replace(sound, diagnosis=replace(sound.diagnosis, findings=(fault,), step=moved))
        assert judge_quality(judged).level == level
        before, after = reaches(sound)[0].radius_mm, reaches(judged)[0].radius_mm
        assert after >= np.hypot(before, 2.0) and (after > before + 1.0 if sigmas > 1.0 else after < before + 2.0)


@pytest.mark.usefixtures("words_alone")
def test_boards_alone_tell_no_places() -> None:
    scene, disturbance = built_in_scene("boards")
    observations = simulate(scene, disturbance, seed=1).observations
    page = make_report(calibrate(observations, RADIAL), observations)
    assert headline(page) == (
        "good: The intrinsics can be trusted, to 1.9 px in the observed part of the image. No station sees a field, "
        "so places in the world are not known."
    )
    assert '<figure id="map' not in page and "defines the world" in page


@pytest.mark.usefixtures("words_alone")
def test_the_closed_form_alone_is_not_to_be_used() -> None:
    observations = sample()[1]
    page = make_report(calibrate(observations, Options(lens="radial", closed_form_only=True)), observations)
    assert headline(page).startswith("no: Not to be used: this is the closed form of the paper")


def test_a_solve_that_did_not_come_to_rest_is_not_trusted() -> None:
    calibration, observations = sample()
    material = Material(replace(calibration, converged=False), observations, diagnose(calibration, observations))
    chapter = verdict_chapter(material)
    assert chapter.level == "no" and chapter.title.startswith("Do not trust this calibration")


def test_a_diagnosis_that_fails_lowers_the_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SolutionError("nothing came out")

    calibration, observations = sample()
    monkeypatch.setattr(quality, "diagnose", fails)
    judged = judge_quality(quality_of(calibration, observations))
    assert judged.level == "care" and "can be trusted" not in judged.headline
    assert judged.headline == "Usable with limits, without a stated accuracy: its residuals could not be judged."
    assert "Its residuals could not be judged. So it is not known whether the model is right: nothing came out." in [
        words for level, words in judged.reasons if level == "care"
    ]


@pytest.mark.parametrize(
    "radius, level", [(0.3, "good"), (10.0, "good"), (10.1, "care"), (50.1, "no"), (np.inf, "no"), (np.nan, "no")]
)
def test_levels(radius: float, level: str) -> None:
    assert level_of(radius) == level
    assert worst("good", level) == level


@pytest.mark.parametrize(
    "turned_deg, found", [(0.0, "good: This"), (0.05, "care: Usable with limits"), (0.5, "no: It does not hold")]
)
@pytest.mark.usefixtures("words_alone")
def test_new_data_tell_a_camera_that_was_bumped(turned_deg: float, found: str) -> None:
    calibration, _ = sample()
    scene, disturbance = built_in_scene("ssl-field")
    there = scene.stations["overhead"]
    turn = rotation_exp(np.array([np.radians(turned_deg), 0.0, 0.0]))
    pose = Pose.looking(there.cam_from_world.position, turn @ there.cam_from_world.rotation)
    bumped = replace(scene, stations={"overhead": replace(there, cam_from_world=pose)})
    observations = simulate(bumped, disturbance, seed=7).observations
    page = make_report(calibration, observations, diagnose(calibration, observations, new_data=True))
    assert headline(page).startswith(found)
    assert ("would move them by" in page) == (turned_deg > 0.0)


# ---- what is drawn --------------------------------------------------------------------------------------------------


def test_means_of_regions_tell_a_shift_from_noise() -> None:
    calibration, observations = sample()
    table = diagnose(calibration, observations).table
    rows, size = np.flatnonzero(table.inlier), calibration.cameras["overhead"].image_size
    assert len(significant_means(table, rows, size)[0]) <= 1
    left = table.pixel[:, 0] < 640.0
    shift = np.array([0.8, -0.6])
    across = table.residual_px / np.linalg.norm(table.residual_px, axis=1, keepdims=True)
    along = np.where(table.is_curve[:, None], across * np.sum(across * shift, axis=1, keepdims=True), shift)
    moved = replace(table, residual_px=table.residual_px + left[:, None] * along)
    places, vectors, regions = significant_means(moved, rows, size)
    assert len(places) > 15 and np.all(places[:, 0] < 680.0) and regions > 60
    assert np.mean(vectors, axis=0) == pytest.approx(shift, abs=0.15)  # 0.05 measured


def test_the_distortion_curve_is_the_papers_polynomial() -> None:
    seen = camera("radial-2-3")
    r = np.array([0.0, 100.0, 450.0])
    assert isinstance(seen.lens, Radial)
    assert ideal_radii(seen, r) == pytest.approx(seen.lens.ideal_radius(r), rel=1e-12)
    wide = replace(camera("kannala-brandt"), phi=250.0)
    assert np.isnan(ideal_radii(wide, np.array([700.0]))[0])


@pytest.mark.parametrize("low, high", [(0.13, 0.52), (1.0, 1.0), (0.9, 70.0), (3e-4, 5e-4)])
def test_colours_of_maps_cover_what_there_is(low: float, high: float) -> None:
    found = sample()[0].uncertainty.map_sd_mm(height_m=0.0)
    values = np.full(found.sd_mm.shape, low)
    values[0, 0], values[1, 1], values[2, 2] = high, np.inf, np.nan
    levels = levels_of(values)
    assert levels[0] <= low and levels[-1] >= high and 3 <= len(levels) <= 20
    assert np.all(np.diff(levels) > 0.0)


@pytest.mark.parametrize(
    "value, sd, text",
    [
        (868.9123, 1.42, "868.9"),
        (868.9123, 130.0, "869"),
        (4.02221, 0.0067, "4.0222"),
        (-4.961983740740919e-05, 2.2e-06, "-4.96e-05"),
        (-0.21344123, 3.1e-05, "-0.213441"),
        (1e-9, 2.2e-06, "0.0e+00"),
        (0.0004, 0.012, "0.000"),
        (868.9123, np.inf, "868.9123"),
        (-4.961983740740919e-05, np.inf, "-4.962e-05"),
    ],
)
def test_values_have_the_places_that_they_deserve(value: float, sd: float, text: str) -> None:
    assert at_precision(value, sd) == text


@pytest.mark.parametrize("value, text", [(0.2149, "0.21"), (99.4, "99"), (130.4, "130"), (np.inf, "unknown")])
def test_short_numbers(value: float, text: str) -> None:
    assert short(value) == text


def test_angles_have_the_sd_of_the_turns_that_make_them() -> None:
    calibration, _ = sample()
    pose = calibration.stations["overhead"].cam_from_world.rotation
    posterior = calibration.posterior
    assert posterior is not None
    at = [posterior.column("station", "overhead", f"turn_{axis}") for axis in "xyz"]
    turns = np.random.default_rng(0).multivariate_normal(np.zeros(3), posterior.covariance[np.ix_(at, at)], 4000)
    alpha, beta, gamma = np.degrees([euler_from_rotation(rotation_exp(turn) @ pose) for turn in turns]).std(axis=0)
    page = sample_page()
    for name, sd in (("alpha", alpha), ("beta", beta), ("gamma", gamma)):
        row = re.search(rf">{name}, the paper.*?</tr>", page)
        assert row is not None
        value, shown = re.findall(r'data-head="(?:value|± sd)">(-?[\d.]+)°', row[0])
        assert float(shown) == pytest.approx(sd, rel=0.06), name  # 0.03: two digits
        assert len(value.partition(".")[2]) == len(shown.partition(".")[2]), name  # and no more of the angle


def test_the_colours_say_the_same_in_every_report() -> None:
    good, bad = sample_page(), frontal_page()
    borders = [f"{border:g}" for border in MM.borders]
    for page in (good, bad):
        drawn = re.search(r'<figure id="map-0-0".*?(<svg.*?</svg>)', page, flags=re.S)
        assert drawn is not None
        texts = re.findall(r"<text[^>]*>([^<]+)</text>", drawn[1])
        assert texts[texts.index("95 % within, mm") - len(borders) : texts.index("95 % within, mm")] == borders
    assert {GOOD_MM, CARE_MM} < set(MM.borders) and len(COLORS) == len(MM.borders) + 1 == len(PX.borders) + 1
    lightness = [sum(w * int(color[i : i + 2], 16) for w, i in ((0.3, 1), (0.6, 3), (0.1, 5))) for color in COLORS]
    assert np.all(np.diff(lightness) < -10.0)  # grey print has the same order; 14.9 measured


@pytest.mark.usefixtures("words_alone")
def test_no_number_is_green_under_a_verdict_that_promises_nothing() -> None:
    observations = sample()[1]
    calibration = calibrate(
        observations, replace(RADIAL, priors=(Prior("station", "overhead", "height_m", (4.5,), (0.01,)),))
    )
    page = make_report(calibration, observations)
    assert headline(page).startswith("no: ") and 'class="tile good"' not in page
    assert "These maps hold only after its reasons are corrected" in page
    assert "these maps hold only" not in sample_page() and 'class="tile good"' in sample_page()


def test_what_a_lens_shows_is_as_uncertain_as_lenses_scatter() -> None:
    scene, disturbance = built_in_scene("boards")
    calibration = calibrate(simulate(scene, disturbance, seed=1).observations, RADIAL)
    known, (name, seen) = calibration.uncertainty.map_px(), next(iter(calibration.cameras.items()))
    posterior = calibration.posterior
    assert posterior is not None
    keys = [key for key in posterior.keys if key[:2] == ("camera", name)]
    at = posterior.information.columns(keys)
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(len(at)), posterior.covariance[np.ix_(at, at)], 400)
    pixels = np.column_stack([part.ravel() for part in np.meshgrid(known.x_px, known.y_px)])
    rays, every = seen.rays(pixels), []
    for step in steps:
        other = camera_moved(seen, [key.quantity for key in keys], step)
        u, _, vt = np.linalg.svd(other.rays(pixels).T @ rays)  # Kabsch: the rotation between them
        every.append(np.linalg.norm(other.project(rays @ (u @ vt).T) - pixels, axis=1))
    scattered = np.quantile(every, 0.95, axis=0).reshape(known.radius_95_px.shape)
    assert np.median(known.radius_95_px / scattered) == pytest.approx(1.0, abs=0.1)
    assert np.all((known.radius_95_px / scattered > 0.6) & (known.radius_95_px / scattered < 1.6))
    with pytest.raises(InputError, match="there is no camera 'other'"):
        calibration.uncertainty.map_px("other")


# ---- commands -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("words_alone")
def test_commands_write_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, page, again = tmp_path / "one.json", tmp_path / "one.html", tmp_path / "again.html"
    assert main(["calibrate", str(SAMPLE), "-o", str(one), "--report", str(page)]) == 0
    assert str(page) in capsys.readouterr().out
    assert main(["diagnose", str(one), str(SAMPLE), "--report", str(again), "--json"]) in (0, 1)
    assert f'"report": "{again}"' in capsys.readouterr().out
    assert headline(page.read_text(encoding="utf-8")) == headline(again.read_text(encoding="utf-8"))


@pytest.mark.parametrize("command", [["calibrate"], ["diagnose", str(ROOT / "pyproject.toml")]])
def test_a_page_that_cannot_be_written_is_said_before_the_work(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "gone" / "page.html"
    assert main([*command, str(SAMPLE), "--report", str(missing)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and "there is no folder" in said.err
    both = str(tmp_path / "both.csv")
    assert main([*command, str(SAMPLE), "-o", both, "--report", both]) == 2
    assert "give them two names" in capsys.readouterr().err
    assert main([*command, str(SAMPLE), "--report", str(tmp_path / "page.json")]) == 2
    assert "page.json: a report is written as .html or .htm: give one of these endings" in capsys.readouterr().err


def test_the_plotting_library_comes_in_when_a_picture_is_drawn() -> None:
    code = "import sys, ceres_cal.report; print('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


# ---- a real browser -------------------------------------------------------------------------------------------------

# Text that is cut off, elements outside the window, and tables wider than their box.
_CUT_OFF = """
(() => {
  document.querySelectorAll('details').forEach(d => d.open = true);
  const wide = document.documentElement.clientWidth, found = [];
  if (document.documentElement.scrollWidth > wide) found.push('the page scrolls sideways');
  for (const e of document.querySelectorAll('body *')) {
    const box = e.getBoundingClientRect();
    if (!box.width) continue;
    const name = e.tagName + '#' + (e.closest('[id]')?.id) + ': ' + e.textContent.trim().slice(0, 40);
    if (!e.closest('svg') && (box.right > wide + 0.5 || box.left < -0.5)) found.push('outside of the window: ' + name);
    if (!e.closest('svg') && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display != 'inline')
      found.push('wider than its box: ' + name);
    if (e.tagName == 'text') {
      const svg = e.closest('svg').getBoundingClientRect();
      if (box.left < svg.left - 1 || box.right > svg.right + 1 || box.top < svg.top - 1 || box.bottom > svg.bottom + 1)
        found.push('cut off in its picture: ' + name);
      if (parseFloat(getComputedStyle(e).fontSize) * svg.width / e.closest('svg').viewBox.baseVal.width < 8)
        found.push('too small to read: ' + name);
    }
  }
  return found;
})()
"""


# Text with a contrast below 4.5 : 1 (WCAG AA) to its background; pictures have the page's own background.
_PALE = """
(() => {
  const rgb = text => (text.match(/[\\d.]+/g) || []).map(Number), found = new Set();
  const light = c => c.slice(0, 3).map(v => v / 255).map(v => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
  document.querySelectorAll('details').forEach(d => d.open = true);
  for (const e of document.querySelectorAll('body *')) {
    const own = [...e.childNodes].some(n => n.nodeType == 3 && n.textContent.trim());
    if (!own || !e.getBoundingClientRect().width || e.closest('[id^=map] svg, [id^=image] svg, script')) continue;
    let behind = e;
    const colour = () => rgb(getComputedStyle(behind).backgroundColor);
    while (behind.parentElement && colour()[3] === 0) behind = behind.parentElement;
    const style = getComputedStyle(e), ink = light(rgb(e.tagName == 'text' ? style.fill : style.color));
    const ground = light(colour());
    const ratio = (Math.max(ink, ground) + .05) / (Math.min(ink, ground) + .05);
    if (ratio < 4.5) found.add(`${e.tagName} ${ratio.toFixed(1)}: ${e.textContent.trim().slice(0, 30)}`);
  }
  return [...found];
})()
"""


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    with browser() as found:
        yield found


@cache
def two_cameras_page() -> str:
    scene, disturbance = built_in_scene("two-cameras")
    observations = simulate(scene, disturbance, seed=1).observations
    return make_report(calibrate(observations, RADIAL), observations)


def crowded() -> Scene:
    return SCENES["brown/several-stations"]()


@cache
def crowded_page() -> str:
    observations = simulate(crowded(), Disturbance(0.3, 0.3), seed=3).observations
    return make_report(calibrate(observations, Options(lens="brown")), observations)


@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize(
    "name", partly(["sample", "frontal", "two-cameras", "stations"], ["sample", "frontal", "stations"])
)
def test_nothing_is_cut_off_and_nothing_complains(window: Browser, tmp_path: Path, name: str, width: int) -> None:
    if name == "sample":
        page = sample_page()
    elif name == "frontal":
        page = frontal_page()
    elif name == "two-cameras":
        page = two_cameras_page()
    else:
        page = crowded_page()
    file = tmp_path / "page.html"
    file.write_text(page, encoding="utf-8")
    window.open(file, width)
    assert window.run(_CUT_OFF) == []
    assert window.complaints == [] and window.requests == [file.as_uri()]
    drawn = window.run("[...document.querySelectorAll('figure svg')].filter(s => s.clientWidth).length")
    assert drawn == page.count("<figure")


def test_the_pointer_says_what_is_there(window: Browser, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text(sample_page(), encoding="utf-8")
    window.open(file, 1280)
    known = sample()[0].uncertainty.map_sd_mm(height_m=0.0)
    row, column = len(known.y_m) // 2, int(np.argmin(np.abs(known.x_m + 2.0)))
    said = window.run(f"""(() => {{
        const svg = document.querySelector('#map-0-0 svg'), box = svg.getBoundingClientRect();
        const [l, t, r, b, x0, y0, x1, y1] = svg.dataset.axes.split(' ').map(Number);
        const x = l + (r - l) * ({known.x_m[column]} - x0) / (x1 - x0);
        const y = t + (b - t) * ({known.y_m[row]} - y0) / (y1 - y0);
        const at = {{clientX: box.left + x * box.width, clientY: box.top + y * box.height, bubbles: true}};
        svg.dispatchEvent(new PointerEvent('pointermove', at));
        const tip = document.querySelector('#tip'), shown = tip.hidden ? '' : tip.textContent;
        document.body.dispatchEvent(new PointerEvent('pointermove', {{clientX: 5, clientY: 5, bubbles: true}}));
        return [shown, tip.hidden];
    }})()""")
    value = short(float(known.radius_95_mm[row, column]))
    assert said == [f"x {known.x_m[column]:g} m, y {known.y_m[row]:g} m: 95 % within {value} mm", True]
    assert window.complaints == []


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_every_letter_stands_out(window: Browser, tmp_path: Path, mode: str) -> None:
    file = tmp_path / "page.html"
    file.write_text(frontal_page(), encoding="utf-8")
    window.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": mode}])
    window.open(file, 1280)
    assert window.run(_PALE) == []
    window.call("Emulation.setEmulatedMedia", features=[])


def test_hostile_names_run_nothing(window: Browser, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text(sample_page().replace("</main>", "<script>console.log('ran')</script></main>"), encoding="utf-8")
    window.open(file, 1280)
    assert any("Content Security Policy" in one for one in window.complaints)
    assert not any("'ran'" in one and "consoleAPICalled" in one for one in window.complaints)


def test_it_prints_on_a_few_pages(window: Browser, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text(sample_page(), encoding="utf-8")
    window.open(file, 1280)
    window.print_pdf(tmp_path / "page.pdf")
    content = (tmp_path / "page.pdf").read_bytes()
    assert content.startswith(b"%PDF") and 4 <= len(re.findall(rb"/Type\s*/Page\b(?!s)", content)) <= 5  # 4 measured
