"""Priors are compared with the observations: contradictions are named with their size, and widen the uncertainty."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenery import board_scene, field_scene, join, overhead_pose
from scenes import RADIAL, SCENES, camera

from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.calibration import Calibration, calibrating
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import diagnose
from ceres_cal.moves.refit_plan import RefitOptions
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.priors import GaussianPrior
from ceres_cal.problem.structure import Tolerance
from ceres_cal.report.document import Document, Table
from ceres_cal.report.grounds import Judgement, judge_quality
from ceres_cal.report.quality import quality_of
from ceres_cal.report.summary import calibration_sections
from ceres_cal.robust.conflicts import Rest, _beside, contradicted_by, worst_test
from ceres_cal.robust.stated import Statement, contradicted
from ceres_cal.scene.targets import Segment, checkerboard, custom, ssl_field
from ceres_cal.simulate import Disturbance, Station, simulate
from ceres_cal.start.initialise import Start

HEIGHT_M = 4.02
WRONG, RIGHT = ((value, 0.005) for value in (3.0, HEIGHT_M))
NOISE = Disturbance(0.3, 0.3)


@cache
def seen(tilt_deg: float = 8.0, seed: int = 1, outliers: float = 0.0, across: float = 0.5) -> Observations:
    """A field of division B, its lines and corners, from a camera at 4.02 m, tilted by `tilt_deg`,
    with `across` of it.
    """
    pose = overhead_pose(0.1, -0.2, HEIGHT_M, tilt_x_deg=tilt_deg, tilt_y_deg=-across * tilt_deg, yaw_deg=3.0)
    scene = field_scene(
        ssl_field("B"), {"overhead": camera("radial-2-3")}, {"overhead": Station("overhead", pose)}, spacing_m=0.2
    )
    return simulate(scene, replace(NOISE, outliers=outliers), seed=seed).observations


def height(value: float, sigma: float) -> Prior:
    return Prior("station", "overhead", "height_m", (value,), (sigma,))


def under(*priors: Prior, fixed: Mapping[str, float] | None = None, **options: bool) -> Options:
    return Options(**{"lens": "radial", "usual_camera": False, "priors": priors, "fixed": fixed or {}, **options})  # type: ignore[arg-type]


@cache
def wrong() -> Calibration:
    return calibrate(seen(), under(height(*WRONG)))


def verdict(calibration: Calibration, observations: Observations) -> Judgement:
    return judge_quality(quality_of(calibration, observations))


# ---- the row of the table -------------------------------------------------------------------------------------------


def test_a_wrong_height_is_named_with_both_values() -> None:
    (conflict,) = wrong().conflicts
    free = calibrate(seen(), RADIAL)
    assert (conflict.kind, conflict.owner, conflict.quantity, conflict.unit) == ("prior", "overhead", "height", "m")
    assert conflict.stated == 3.0 and conflict.stated_sd == pytest.approx(0.005)
    # The value of the observations alone is solved for with their own noise, not extrapolated.
    assert conflict.seen == pytest.approx(free.station().position[2], abs=1e-3)  # 2.5e-5 measured, of an sd of 0.06
    assert conflict.seen_sd == pytest.approx(
        free.uncertainty.posterior.sd_of("station", "overhead", "height"),
        rel=0.05,  # 0.032 measured
    )
    assert conflict.sigmas == pytest.approx((conflict.seen - 3.0) / np.hypot(0.005, conflict.seen_sd), rel=0.15)
    assert conflict.words in wrong().warnings
    assert conflict.words == (
        "the stated height of station 'overhead', 3.000 ± 0.005 m: the observations alone give 3.970 ± 0.053 m, "
        "16 sigmas apart: correct or remove it"
    )


def test_nothing_is_promised_then() -> None:
    """1 mm at robot height was promised with an error of 27 mm. The height is set aside, and the
    bounds contain both.
    """
    height = wrong().uncertainty.verdict("station", "overhead", "height")
    assert height.value == pytest.approx(HEIGHT_M, abs=0.1) and height.low < 3.0 < HEIGHT_M < height.high
    judged = verdict(wrong(), seen())
    assert judged.level == "no" and "mm" not in judged.headline
    assert judged.headline == "Do not trust this calibration: the observations contradict what was stated beforehand."
    found = diagnose(wrong(), seen())
    assert found.conflicts == wrong().conflicts


def test_a_number_that_contradicts_what_was_stated_is_in_conflict_wherever_it_is_shown() -> None:
    known = wrong().uncertainty
    words = {(one.key.owner, one.key.quantity): one.verdict for one in known.verdicts}
    assert [name for name, word in words.items() if word == "in conflict"] == [("overhead", "height")]
    (row,) = [row for row in known.table() if row["quantity"] == "height"]
    assert row["verdict"] == "in conflict"
    sections = list(calibration_sections(quality_of(wrong(), seen()), ["seen.json"]))
    shown = Document(tuple(sections))
    assert re.search(r"height +3\.\d+ m .*in conflict", shown.text())
    (stated,) = [one for one in shown.data["uncertainty"]["numbers"] if one["key"]["quantity"] == "height"]
    assert stated["verdict"] == "in conflict"
    rows = [r for one in sections for piece in one.pieces if isinstance(piece, Table) for r in piece.rows]
    assert [one[0] for one in rows if "in conflict" in one] == ["height"]


def test_what_holds_without_a_wrong_statement_is_shown_beside_the_bounds_with_it() -> None:
    """For a height in feet, only "869 ± 1399 px" was reported for phi."""
    known, free = wrong().uncertainty, calibrate(seen(), RADIAL).uncertainty
    for number in (("camera", "overhead", "phi"), ("station", "overhead", "height")):
        alone, both = known.undisputed.verdict(*number), known.verdict(*number)
        assert alone.sd == pytest.approx(free.verdict(*number).sd, rel=0.1) and alone.sd < 0.5 * both.sd
    assert free.undisputed is free
    text = Document(tuple(calibration_sections(quality_of(wrong(), seen()), ["seen.json"]))).text()
    assert re.search(r"height +3\.97\d? m +5\d\smm +2\.\d+ to 4\.\d+ m", text)
    assert "± sd of the position: without the contradicted statements" in text


def test_files_keep_conflicts(tmp_path: Path) -> None:
    wrong().save(tmp_path / "calibration.json")
    assert Calibration.load(tmp_path / "calibration.json").conflicts == wrong().conflicts


@pytest.mark.parametrize("tilt_deg", [1.0, 8.0])
def test_a_right_height_is_no_conflict(tilt_deg: float) -> None:
    calibration = calibrate(seen(tilt_deg), under(height(*RIGHT)))
    assert calibration.conflicts == () and calibration.warnings == ()
    assert verdict(calibration, seen(tilt_deg)).headline.startswith("This calibration can be trusted: to ")


def test_outliers_and_rows_thrown_out_hide_nothing() -> None:
    """The wrong height of a tilted camera causes rejections; the solve without it takes these rows back."""
    (conflict,) = calibrate(seen(15.0, outliers=0.1), under(height(*WRONG))).conflicts
    assert abs(conflict.seen - HEIGHT_M) < 4.0 * conflict.seen_sd < 0.1
    assert conflict.sigmas > 30.0


def test_where_nothing_tells_there_is_no_conflict() -> None:
    """From straight above, the observations determine only phi over height, so that any height is possible."""
    assert calibrate(seen(0.5), under(height(*WRONG))).conflicts == ()


@pytest.mark.parametrize("tilt_deg", [0.0, 8.0])
def test_two_heights_contradict_each_other(tilt_deg: float) -> None:
    """Also where the observations do not determine either."""
    calibration = calibrate(seen(tilt_deg), under(height(*RIGHT), height(*WRONG)))
    pair, *others = calibration.conflicts
    assert pair.kind == "priors" and {pair.stated, pair.seen} == {3.0, HEIGHT_M} and pair.sigmas > 100.0
    assert pair.words.startswith("two priors contradict each other: height of station 'overhead' is stated as 4.020 ±")
    assert [one.stated for one in others] == ([3.0] if tilt_deg else [])  # which of them is wrong
    known = calibration.uncertainty.verdict("station", "overhead", "height")
    assert known.low < (HEIGHT_M if tilt_deg else 3.0) < HEIGHT_M + 0.01 < known.high
    assert known.verdict in ("in conflict", "unknown")
    assert known.value == pytest.approx(HEIGHT_M if tilt_deg else 3.51, abs=0.1)
    judged = verdict(calibration, seen(tilt_deg))
    assert judged.level == "no" and not any("model is wrong" in line for _, line in judged.reasons)


@cache
def sample() -> Observations:
    return Observations.load(Path(__file__).parents[1] / "data" / "ssl_field" / "observations.json")


PHI = Prior("camera", "overhead", "phi", (1500.0,), (2.0,))


@pytest.mark.parametrize(
    "lens, stated",
    [pytest.param("auto", PHI, marks=pytest.mark.thorough), ("auto", height(2.0, 0.005)), ("spline", PHI)],
)
def test_nothing_takes_up_a_grossly_wrong_statement(lens: str, stated: Prior) -> None:
    """A phi of 1500 px was confirmed by a spline without a message, a height of 2 m by a board and moving views."""
    calibration = calibrate(sample(), Options(lens=lens, priors=(stated,)))
    (conflict,) = calibration.conflicts
    assert "the observations alone give" in conflict.words and calibration.warnings == (conflict.words,)
    assert calibration.station().phi == pytest.approx(868.6, abs=1.5) and calibration.options.priors == (stated,)
    assert calibration.digest == sample().digest


def test_two_numbers_that_are_held_wrong_are_both_named() -> None:
    """Only phi was named, and another lens was chosen with it."""
    calibration = calibrate(sample(), Options(fixed={"phi": 1736.0, "cx": 600.0}))
    seen = {one.quantity: (one.seen, one.seen_sd) for one in calibration.conflicts}
    truth = {"phi": 868.6, "cx": 647.0}
    assert {*seen} == {*truth}
    assert all(abs(value - truth[name]) < 3.0 * sd < 5.0 for name, (value, sd) in seen.items())


@pytest.mark.parametrize(
    "lens, quantity, held, truth",
    [
        ("radial", "a2", -2e-4, -5.2e-5),
        pytest.param("brown", "k1", -0.2, -0.349, marks=pytest.mark.thorough),
        ("auto", "aspect", 0.98, 1.0),
    ],
)
def test_nothing_takes_up_what_is_held_wrong_of_a_lens(lens: str, quantity: str, held: float, truth: float) -> None:
    """Boards and a line were rejected, and the aspect was explained by a rolling shutter, without a message."""
    calibration = calibrate(sample(), Options(lens=lens, fixed={quantity: held}))
    (conflict,) = calibration.conflicts
    assert (conflict.kind, conflict.quantity) == ("fixed", quantity) and conflict.stated == pytest.approx(held)
    assert abs(conflict.seen - truth) < 3.0 * conflict.seen_sd < 0.2 * abs(held - truth)
    assert "the observations alone give" in conflict.words
    assert not any(word in line for line in calibration.warnings for word in ("whole of", "rolling shutter"))
    assert calibration.options.fixed == {quantity: held} and calibration.options.free_aspect is None


def test_how_far_a_lens_reaches_is_no_statement() -> None:
    assert not calibrate(sample(), Options(lens="spline", fixed={"rim": 900.0})).conflicts


def test_a_right_coefficient_that_is_held_tells_what_does_not_belong() -> None:
    """Without it, a few lines kept an outlier, and phi was 37 px farther off."""
    scene = field_scene(
        ssl_field("B"),
        {"overhead": camera("brown")},
        {"overhead": Station("overhead", overhead_pose(0.1, -0.2, 4.0, tilt_x_deg=8.0, yaw_deg=3.0))},
        spacing_m=1.0,
    )
    held = {"k1": camera("brown").lens.coefficients["k1"]}
    observed = simulate(scene, Disturbance(0.3, 0.3, outliers=0.05), seed=9).observations
    calibration = calibrate(observed, Options(lens="brown", fixed=held))
    phi = calibration.uncertainty.verdict("camera", "overhead", "phi")
    assert not calibration.conflicts and abs(phi.value - 825.0) < phi.sd < 15.0  # 4.3 of 11.3 px


def test_what_is_held_is_known_beside_everything_else() -> None:
    """Lenses are compared with phi free, but they leave the height open by 36 mm only because of phi."""
    known = calibrate(seen(), Options(fixed={"phi": 868.0})).uncertainty
    assert known.posterior.sd_of("station", "overhead", "height") < 0.01
    assert known.posterior.sd_of("station", "overhead", "height") > 0.003


def test_what_is_stated_is_known_beside_lenses_with_another_phi() -> None:
    """With phi to 1 px, which is 5 mm of the height, other lenses left the height open by 13 mm."""
    stated = Options(priors=(Prior("camera", "overhead", "phi", (868.0,), (1.0,)),))
    known = calibrate(seen(), stated).uncertainty.posterior
    assert known.sd_of("camera", "overhead", "phi") <= 1.0
    assert 0.005 < known.sd_of("station", "overhead", "height") < 0.01  # 0.0078 measured


def test_a_fisheye_without_a_wrong_height_is_found_where_it_was_before() -> None:
    """From the estimate with a height of 2.4 m, the observations alone gave 2.16 m, phi 367 px, and errors of 80 mm."""
    pose = overhead_pose(0.1, -0.2, 3.2, tilt_x_deg=9.0, tilt_y_deg=-4.3, yaw_deg=3.0)
    cameras, stations = {"overhead": camera("kannala-brandt")}, {"overhead": Station("overhead", pose)}
    scene = field_scene(ssl_field("B"), cameras, stations, spacing_m=0.2)
    calibration = calibrate(simulate(scene, NOISE, seed=9).observations, Options(priors=(height(2.4, 0.005),)))
    (conflict,) = calibration.conflicts
    assert abs(conflict.seen - 3.2) < 3.0 * conflict.seen_sd < 0.2 and calibration.station().phi > 540.0  # .15, 545


def test_no_lens_takes_up_a_phi_that_is_held_wrong() -> None:
    """With a phi of 1096 px a spline was chosen, and the observations alone gave 1854 +- 17 px instead of 548 px."""
    seen_alone = simulate(SCENES["kannala-brandt/boards"](), NOISE, seed=7).observations
    calibration = calibrate(seen_alone, Options(fixed={"phi": 1096.0}))
    (conflict,) = calibration.conflicts
    assert abs(conflict.seen - 548.0) < 3.0 * conflict.seen_sd < 6.0
    assert calibration.options.fixed == {"phi": 1096.0} and calibration.station().phi == 1096.0


def test_a_right_number_that_is_held_tells_the_lens() -> None:
    """Without it Kannala and Brandt's lens was chosen, and the height had an error of 31 mm with 3 mm stated."""
    held = {"phi": camera("radial-2-3").phi}
    calibration = calibrate(seen(18.0, 3, across=8.6 / 18.0), Options(fixed=held))
    assert calibration.options.lens == "radial" and not calibration.conflicts
    height = calibration.uncertainty.verdict("station", "overhead", "height")
    assert abs(height.value - HEIGHT_M) < 3.0 * height.sd < 0.03  # 5.6 mm measured


def test_statements_that_are_wrong_together_are_all_named() -> None:
    """A phi and a height that are both 20 % too large agree: phi was 1037 px, and neither was named."""
    pose = overhead_pose(0.1, -0.2, HEIGHT_M, tilt_x_deg=7.2, tilt_y_deg=-3.4, yaw_deg=3.0)
    before = {"overhead": camera("radial-2-3")}, {"overhead": Station("overhead", pose)}
    scene = join(
        field_scene(ssl_field("B"), *before, spacing_m=0.2), board_scene(checkerboard(9, 6, 0.1), *before, 5, seed=3)
    )
    phi = Prior("camera", "overhead", "phi", (1.2 * 868.0,), (2.0,))
    calibration = calibrate(simulate(scene, NOISE, seed=5).observations, under(phi, height(1.2 * HEIGHT_M, 0.005)))
    assert {one.quantity for one in calibration.conflicts} == {"phi", "height"}
    assert calibration.station().phi == pytest.approx(868.0, abs=5.0)
    assert calibration.station().position[2] == pytest.approx(HEIGHT_M, abs=0.03)


def test_the_wrong_one_of_two_that_fight_is_named() -> None:
    """A wrong phi makes a correct height look wrong; without the phi the height agrees."""
    phi = Prior("camera", "overhead", "phi", (700.0,), (5.0,))
    (conflict,) = calibrate(seen(), under(height(*RIGHT), phi)).conflicts
    assert (conflict.quantity, conflict.stated) == ("phi", 700.0)
    one, *_ = calibrate(seen(0.5), under(height(*RIGHT), phi)).conflicts
    assert {"height", "phi"} <= set(one.words.replace(",", "").split())  # either may be wrong: both are named


@pytest.mark.parametrize("tilt_deg, seed, stated", [(0.5, 2, RIGHT), (8.0, 1, WRONG)])
def test_no_line_is_blamed_for_what_is_stated(tilt_deg: float, seed: int, stated: tuple[float, float]) -> None:
    """Two whole lines, 34 good rows, were rejected and a line was reported as uncertain because of wrong priors."""
    phi = Prior("camera", "overhead", "phi", (700.0,), (5.0,))
    calibration = calibrate(seen(tilt_deg, seed), under(height(*stated), *([phi] if stated == RIGHT else [])))
    assert calibration.conflicts and not calibration.rejected
    assert not any("the whole of" in warning for warning in calibration.warnings)


@pytest.mark.parametrize(
    "fixed, quantity, truth",
    [
        ({"phi": 700.0}, "phi", 868.0),
        pytest.param({"cx": 600.0}, "cx", 651.3, marks=pytest.mark.thorough),
        ({"a2": 0.0}, "a2", -5.2e-5),
    ],
)
def test_fixed_numbers_are_tested(fixed: dict[str, float], quantity: str, truth: float) -> None:
    (conflict,) = calibrate(seen(), under(fixed=fixed)).conflicts
    assert (conflict.kind, conflict.quantity, conflict.stated_sd) == ("fixed", quantity, 0.0)
    assert conflict.stated == fixed[quantity] and abs(conflict.seen - truth) < 3.0 * conflict.seen_sd
    assert conflict.words.startswith(f"the held {quantity} of camera 'overhead', {fixed[quantity]:g}")
    assert calibrate(seen(), under(fixed={quantity: truth})).conflicts == ()


def test_a_principal_point_held_at_the_middle_is_tested() -> None:
    (conflict,) = calibrate(seen(), under(free_principal_point=False)).conflicts
    assert conflict.kind == "fixed" and conflict.quantity in ("cx", "cy") and conflict.sigmas > 10.0


@cache
def askew(*lines: str) -> Observations:
    """A field with lines painted 12 mm beside their drawing."""
    field, painted = ssl_field("B"), {}
    for line in lines:
        drawn = field.curves[line]
        assert isinstance(drawn, Segment)
        across = np.array([0.012, 0.0, 0.0] if drawn.start[0] == drawn.end[0] else [0.0, 0.012, 0.0])
        painted[line] = Segment(tuple(drawn.start + across), tuple(drawn.end + across), drawn.width_m)
    pose = overhead_pose(0.1, -0.2, HEIGHT_M, tilt_x_deg=8.0)
    scene = field_scene(
        custom({}, {**field.curves, **painted}),
        {"overhead": camera("radial-2-3")},
        {"overhead": Station("overhead", pose)},
        spacing_m=0.1,
        name="field",
    )
    observed = simulate(scene, NOISE, seed=0).observations
    return replace(observed, targets={"field": custom({}, field.curves)})


def test_a_tolerance_that_is_too_tight() -> None:
    """The calibration stays correct, since lines with a tolerance are solved for."""
    observed = askew("HalfwayLine", "CenterLine", "LeftPenaltyStretch")
    calibration = calibrate(observed, Options(lens="radial", tolerances={"field": Tolerance(lines_m=0.002)}))
    conflicts = {conflict.quantity: conflict for conflict in calibration.conflicts}
    assert {conflict.kind for conflict in conflicts.values()} == {"tolerance"}
    assert abs(conflicts["CenterLine"].seen - 0.012) < 0.003  # 13 mm
    assert "contradicted" not in verdict(calibration, observed).headline


def test_one_line_aside_under_a_tolerance_is_a_whole_in_doubt() -> None:
    calibration = calibrate(
        askew("HalfwayLine"), Options(lens="radial", tolerances={"field": Tolerance(lines_m=0.002)})
    )
    assert any("line 'HalfwayLine'" in warning for warning in calibration.warnings)


@pytest.mark.thorough
def test_a_height_measured_after_a_move_is_tested() -> None:
    old, new = calibrate(seen(15.0), RADIAL), seen(14.0, seed=3)
    assert refit(old, new, options=RefitOptions(priors=(height(*RIGHT),))).conflicts == ()
    with pytest.raises(SolutionError, match=r"the stated height of station 'overhead', 3.000 ± 0.005 m.*; or else "):
        refit(old, new, options=RefitOptions(priors=(height(*WRONG),)))
    with pytest.raises(SolutionError, match=r"stated height .*4.220 ± 0.005 m.*; or else station"):
        refit(old, new, options=RefitOptions(priors=(height(HEIGHT_M + 0.2, 0.005),)))
    (conflict,) = refit(old, new, options=RefitOptions(priors=(height(HEIGHT_M + 0.1, 0.005),))).conflicts
    assert conflict.stated == HEIGHT_M + 0.1 and abs(conflict.seen - HEIGHT_M) < 4.0 * conflict.seen_sd


# ---- units ----------------------------------------------------------------------------------------------------------


def test_a_height_that_no_calibration_comes_out_of_is_named() -> None:
    """The height is named, not the labels. Whether a solve with such an error converges depends on rounding."""
    try:
        (conflict,) = calibrate(seen(), under(height(150.0, 5e-6 * 150.0))).conflicts
        words = conflict.words
    except SolutionError as refusal:
        words = str(refusal)
    assert re.search(r"the stated height of station 'overhead', 150.* give 3.9(69|70) ± 0.053 m.*sigmas apart", words)


def test_boards_in_another_unit_are_refused() -> None:
    """With squares of 100 m alone it would fit in any unit; with squares of 1 m it is below the floor."""
    with pytest.raises(
        InputError, match=r"checkerboard: it reaches 943 m from its origin.*give its dimensions in metres"
    ):
        checkerboard(9, 6, 100.0)
    observed = simulate(SCENES["radial-2-3/field-boards"](), NOISE).observations
    targets = {**observed.targets, "board": checkerboard(9, 6, 1.0)}
    with pytest.raises(
        SolutionError, match="target 'board' lies up to 16 m under the floor: its dimensions are too large"
    ):
        calibrate(replace(observed, targets=targets), RADIAL)


# ---- the algebra ----------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**31), st.integers(1, 4), st.floats(1e-2, 1e2))
@settings(max_examples=50)
def test_what_stands_beside_a_prior(seed: int, size: int, strength: float) -> None:
    """C^-1 - P, in any units, is the information of the other observations, also where this is 0 for some numbers; the
    step from the common optimum to that of the others lies in their subspace.
    """
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-6.0, 3.0, size)
    rows = rng.standard_normal((int(rng.integers(0, 2 * size + 1)), size)) / units
    rest, told = rows.T @ rows, np.diag((strength / units) ** 2)
    slope = rest @ (units * rng.standard_normal(size))
    beside, step = _beside(np.asarray(np.linalg.inv(rest + told)), np.asarray(told, dtype=float), slope)
    assert (rest @ step) * units == pytest.approx(slope * units, abs=1e-4 * (1.0 + strength**2))
    assert beside * units[:, None] * units == pytest.approx(
        rest * units[:, None] * units, abs=1e-5 * (1.0 + strength**2)
    )


@given(st.integers(0, 2**31))
@settings(max_examples=20)
def test_what_is_in_dispute_is_in_the_covariance(seed: int) -> None:
    """Two shifts d and e with probabilities p and q: C + p d d^T + q e e^T."""
    from ceres_cal.posterior.posterior import Posterior

    rng = np.random.default_rng(seed)
    keys = tuple(Key("camera", "a", name, "px") for name in "abc")
    rows = rng.standard_normal((6, 3))
    shifts = tuple(10.0 * rng.standard_normal((2, 3)))
    before = Posterior(Information(keys, rows.T @ rows))
    after = before.with_alternatives(keys[::-1], [shift[::-1] for shift in shifts], [0.3, 0.2])
    expected = before.covariance + sum(w * np.outer(d, d) for w, d in zip((0.3, 0.2), shifts, strict=True))
    assert after.covariance == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert after.sd == pytest.approx(np.sqrt(np.diagonal(expected)), rel=1e-6)


# ---- usual cameras --------------------------------------------------------------------------------------------------


def cropped(left_px: int) -> Observations:
    """The picture without its left part: the principal point is no longer near the middle."""
    whole = seen(15.0)
    kept_points, kept_curves = (column.pixels[:, 0] >= left_px for column in (whole.points, whole.curves))
    part = whole.part(kept_points, kept_curves)
    (name, (width, height_px)) = next(iter(whole.cameras.items()))
    return replace(
        part,
        cameras={name: (width - left_px, height_px)},
        points=replace(part.points, pixels=part.points.pixels - (left_px, 0.0)),
        curves=replace(part.curves, pixels=part.curves.pixels - (left_px, 0.0)),
    )


def test_a_cropped_picture_has_no_usual_principal_point() -> None:
    """The data determine it, so that the prior gives way."""
    usual, alone = (calibrate(cropped(400), replace(RADIAL, usual_camera=on)) for on in (True, False))
    assert not usual.conflicts
    assert usual.station().phi == pytest.approx(868.0, rel=0.02)
    off_px = np.subtract(usual.station().principal_point, alone.station().principal_point)
    sd_px = alone.uncertainty.posterior.sd_of("camera", "overhead", "cx")
    assert np.linalg.norm(off_px) < 0.5 * sd_px


def test_what_is_usual_moves_nothing_that_the_data_determine() -> None:
    """Compared with a camera without priors except square pixels."""
    held = replace(RADIAL, usual_camera=True, free_aspect=False, free_skew=False)
    with_it, without = (calibrate(seen(15.0), options) for options in (held, RADIAL))
    sd = without.uncertainty.posterior.sd_of("camera", "overhead", "phi")
    assert with_it.station().phi == pytest.approx(without.station().phi, abs=0.1 * sd)


# ---- where only the calibration without priors succeeds ---------------------------------------------------------


def test_of_several_priors_the_worst_is_contradicted_as_rarely_as_one() -> None:
    """Of four correct heights one was refused at 3.4 standard deviations, which one in 370 is off by chance."""
    estimate = calibrate(seen(), RADIAL).estimate
    heights = {name: Key("station", name, "height", "m") for name in "abcd"}
    station = estimate.stations["overhead"]
    there = replace(estimate, stations=dict.fromkeys("abcd", station))
    height_m = float(station.cam_from_world.position[2])
    stated = [
        GaussianPrior(Information.of_sigmas({key: 0.01}), np.array([height_m + 0.34 * (name == "a")]))
        for name, key in heights.items()
    ]
    known = Information.of_sigmas(dict.fromkeys(heights.values(), 0.1))
    assert contradicted_by(stated, there, known, 1000.0) is None
    assert "the stated height of station 'a'" in (contradicted_by(stated[:1], there, known, 1000.0) or "")
    # Where only the sum is known, its words said "± inf m, 0 sigmas apart", and the file could not be read.
    two = tuple(heights.values())[:2]
    both = GaussianPrior(Information.of_sigmas(dict.fromkeys(two, 0.01)), np.array([height_m + 0.3, height_m]))
    words = contradicted_by([both], there, Information(two, np.full((2, 2), 1e4)), 1000.0) or ""
    assert re.search(rf"station 'a', .* {height_m:.2f} ± 0.01 m, 21 sigmas apart", words), words
    # Almost only the sum: one number of an earlier calibration was "520589918 ± 123653026", and to be removed.
    rest = Rest(there, np.zeros(2), Information(two, 1e4 * np.ones((2, 2)) + 1e-10 * np.diag([1.0, -1.0])), 1000.0)
    matrix = 1e4 * np.array([[1.0, 0.5], [0.5, 1.0]])
    earlier = GaussianPrior(Information(two, matrix), np.array([height_m + 0.3, height_m]))
    one = Statement("earlier", two, (earlier,), np.empty(0))
    words = contradicted(one, worst_test(one, rest), False, ()).words
    assert re.search(r"gives \d\.\d+ ± 0\.01\d? m, .* as two stations of one camera", words), words  # 3.67 ± 0.01


def test_lenses_are_chosen_from_the_papers_where_priors_gave_no_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They were chosen from a start with the lenses that were chosen without priors: a ValueError, for a camera that
    shows too little for a choice.
    """
    starts = []

    def of_lens_asked(task: object, start: Start, *rest: object) -> Calibration:
        starts.append(start)
        return free

    free = calibrate(seen(), Options(lens="brown"))
    monkeypatch.setattr(calibrating, "_of_lens_asked", of_lens_asked)
    calibrating._from_there(free, seen(), Options(priors=(height(*RIGHT),)))
    assert [start.estimate.cameras["overhead"].lens.kind for start in starts] == ["radial"]
