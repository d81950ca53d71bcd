"""No uncertainty is larger than that of its prior, whatever increases that of the observations."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scenery import field_scene, overhead_pose
from scenes import camera, side_by_side

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.tails import NORMAL_95
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.effects.dependence import Dependence, Scatter
from ceres_cal.observations import Observations, Prior
from ceres_cal.posterior.bent import Ends
from ceres_cal.posterior.files import BendsFile, PosteriorFile, ProfileFile, as_mixtures
from ceres_cal.posterior.mixture import Mixture
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.information import Information, Key, over
from ceres_cal.problem.parameters import AUTO, Options
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, Station, simulate

KEYS = tuple(Key("camera", "a", name, "px") for name in ("phi", "cx", "cy", "k1", "k2"))
ROUNDING = 1.0 + 1e-6


# ---- the algebra ----------------------------------------------------------------------------------------------------


def known(seed: int) -> tuple[Information, Information, np.random.Generator]:
    """Information of observations, large in some directions and 0 in others, and priors on three numbers."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-4.0, 4.0, len(KEYS))
    rows = rng.standard_normal((int(rng.integers(1, 9)), len(KEYS))) * 10.0 ** rng.uniform(-3.0, 3.0) / units
    stated = {KEYS[k]: float(units[k] * 10.0 ** rng.uniform(-3.0, 3.0)) for k in (0, 1, 3)}
    return Information(KEYS, rows.T @ rows), Information.of_sigmas(stated), rng


def own_sd(stated: Information, keys: tuple[Key, ...] = KEYS) -> Array:
    sd = over(stated.spread.sd, stated.keys, keys)
    return np.where(sd > 0.0, sd, np.inf)


@given(st.integers(0, 2**31))
@example(12000)
@settings(max_examples=40)
def test_no_doubt_and_no_scatter_widens_what_was_stated(seed: int) -> None:
    """For any size of the shifts; numbers without a prior are as wide as the shifts."""
    seen, stated, rng = known(seed)
    size = rng.standard_normal(len(KEYS)) * own_sd(stated).min() * 10.0 ** rng.uniform(-2.0, 5.0)
    shifts = list(size * rng.standard_normal((3, len(KEYS))))
    told = Posterior(seen + stated, stated=stated)
    wider = (told.widened(KEYS, shifts), told.with_alternatives(KEYS, shifts, [0.3, 0.2, 0.1]))
    # A prior with 1e-9 of the observations' information is below rounding: infinite before anything widens.
    limit = np.where(np.isinf(told.spread.sd), np.inf, np.fmax(own_sd(stated), told.spread.sd))
    for posterior in wider:
        each = posterior.mixture()
        assert np.all(posterior.spread.sd <= ROUNDING * limit)
        assert np.all(each.sd <= ROUNDING * limit) and np.all(each.variances <= ROUNDING * limit**2)
        assert np.all(np.abs(each.steps) <= ROUNDING * limit)
        assert np.all(posterior.sd <= ROUNDING * own_sd(stated))
        assert np.all(np.abs(posterior.bounds) <= NORMAL_95 * ROUNDING * own_sd(stated)[:, None])


@given(st.integers(0, 2**31), st.floats(-2.0, 4.0))
@settings(max_examples=40)
def test_errors_that_go_together_widen_no_prior(seed: int, strength: float) -> None:
    """However much the observations' score scatters, the prior's information is unchanged."""
    rng = np.random.default_rng(seed)
    rows, half = rng.standard_normal((8, len(KEYS))), rng.standard_normal((len(KEYS), len(KEYS)))
    seen, stated = Information(KEYS, rows.T @ rows), Information.of_sigmas({KEYS[1]: 0.1, KEYS[3]: 3.0})
    root = np.linalg.inv(np.linalg.cholesky((seen + stated).matrix)).T
    along = root.T @ seen.matrix @ root
    score = 10.0**strength * along @ half @ half.T @ along
    wide = Scatter(root, np.eye(len(KEYS)) + score, Dependence()).widened(seen) + stated
    assert np.all(wide.spread.sd <= ROUNDING * own_sd(stated))
    assert np.all(wide.spread.sd >= (seen + stated).spread.sd / ROUNDING)


@given(st.integers(0, 2**31))
@settings(max_examples=40)
def test_ends_are_no_farther_than_stated(seed: int) -> None:
    """The sd with bends is that of the widened information of the observations together with the prior."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-3.0, 3.0, len(KEYS))
    rows = rng.standard_normal((8, len(KEYS))) / units
    seen, stated = Information(KEYS, rows.T @ rows), Information.of_sigmas({KEYS[1]: float(0.1 * units[1])})
    excesses = 3.0 * units * rng.standard_normal((3, len(KEYS)))
    both = np.concatenate([excesses, -excesses])
    raw = Ends(KEYS, np.zeros_like(both), 2.0 * both, 2.0, seen + stated)
    assert raw.beside(Information.nothing(KEYS)) is raw
    ends = raw.beside(stated.over(KEYS))
    variance = (seen + stated).spread.sd ** 2 + np.sum(ends.excesses**2, axis=0)
    expected = (seen.widened(raw.excesses) + stated).spread.sd
    assert np.sqrt(variance) == pytest.approx(expected, rel=1e-5)
    assert np.sqrt(variance[1]) <= ROUNDING * 0.1 * units[1]


@given(st.integers(0, 2**31))
@settings(max_examples=30)
def test_straight_curves_are_the_normal_distribution(seed: int) -> None:
    """Components along weak directions without bends have the same moments, and nearly the same bounds."""
    rng = np.random.default_rng(seed)
    units, count = 10.0 ** rng.uniform(-3.0, 3.0, len(KEYS)), int(rng.integers(1, 5))
    rows = rng.standard_normal((8, len(KEYS))) / units
    known = Information(KEYS, rows.T @ rows)
    values, vectors = np.linalg.eigh(known.spread.covariance / units[:, None] / units)
    axes = 2.0 * (vectors * np.sqrt(values)).T[:count] * units
    both = np.concatenate([axes, -axes])
    mixture = Ends(KEYS, both, both, 2.0, known).mixture(known)
    assert mixture.sd == pytest.approx(known.spread.sd, rel=1e-5)
    assert np.abs(mixture.bounds(NORMAL_95)) == pytest.approx(
        NORMAL_95 * np.column_stack([known.spread.sd] * 2),
        rel=0.15,  # 0.11 measured, of 4 directions
    )


def test_a_valley_ends_where_the_prior_does() -> None:
    steps = np.column_stack([np.linspace(-300.0, 300.0, 13), np.zeros((13, 4))])
    across = tuple(Information(KEYS[1:], np.eye(4)) for _ in steps)
    valley = Mixture.along_phi(KEYS, 800.0, steps, np.zeros(13), across, (False, False))
    stated = Information.of_sigmas({KEYS[0]: 20.0, KEYS[2]: 0.5})
    posterior = Posterior(Information(KEYS, np.eye(5)) + stated, mixtures={"a": valley}, stated=stated)
    assert np.ptp(posterior.bounds, axis=1)[[0, 2]] == pytest.approx(2.0 * NORMAL_95 * np.array([20.0, 0.5]))
    back = PosteriorFile.of(posterior).posterior(KEYS)
    assert np.array_equal(back.bounds, posterior.bounds) and np.array_equal(back.sd, posterior.sd)


@pytest.mark.parametrize("far_up", [4.0, 1e6])  # standard deviations; the farther one once had 8 million components
def test_a_steep_valley_has_few_components(far_up: float) -> None:
    steps = np.column_stack([np.linspace(-30.0, 30.0, 3), np.zeros((3, 4))])
    across = tuple(Information(KEYS[1:], np.eye(4)) for _ in steps)
    valley = Mixture.along_phi(KEYS, 800.0, steps, far_up**2 * np.array([1.0, 0.0, 1.0]), across, (False, False))
    assert len(valley.refined(valley.steps, valley.variances)[0]) < 100
    assert valley.sd[0] == pytest.approx(30.0 / far_up, rel=0.01)


def test_nodes_beyond_all_quantiles_are_not_extrapolated() -> None:
    """Two nodes beyond eight standard deviations with almost equal cost: variances of -2 between them."""
    steps = np.column_stack([np.linspace(-300.0, 300.0, 13), np.zeros((13, 4))])
    across = [Information(KEYS[1:], np.eye(4) * (1.0 + number)) for number in range(13)]
    roots = np.concatenate([[-8.401, -8.404, -8.2, -7.0, -4.0], np.linspace(-1.0, 1.0, 5), [4.0, 9.001, 9.0]])
    valley = Mixture.along_phi(KEYS, 800.0, steps, roots**2, across, (False, False))
    variances = valley.refined(valley.steps, valley.variances)[2]
    assert np.min(variances[:, 1:]) >= 1.0 / 13.0 * (1.0 - 1e-9)
    assert np.all(np.isfinite(valley.sd))


def test_files_of_before_are_read() -> None:
    """Their valley, and one end of each weak direction, become the mixtures that they would be today."""
    steps = np.column_stack([np.linspace(-30.0, 30.0, 13), np.zeros((13, 4))])
    rises, across = np.linspace(-3.0, 3.0, 13) ** 2, Information(KEYS[1:], np.eye(4))
    known = Information(KEYS, np.eye(5))
    triangle = across.matrix[np.tril_indices(4)].tolist()
    valley = ProfileFile(list(KEYS), 800.0, steps.tolist(), rises.tolist(), [triangle] * 13, False, False)
    new = PosteriorFile.of(Posterior(known))

    def read(**of_before: Any) -> Posterior:
        file = msgspec.json.decode(msgspec.json.encode(msgspec.structs.replace(new, **of_before)), type=PosteriorFile)
        return as_mixtures(file, file.posterior(KEYS))

    before = read(profiles={"a": valley})
    assert before.followed == ("a",)
    assert before.bounds[0] == pytest.approx([-10.0 * NORMAL_95, 10.0 * NORMAL_95], rel=0.02)
    bends = BendsFile(list(KEYS[1:]), [[2.0, 0.0, 0.0, 0.0]], [[6.0, 0.0, 0.0, 0.0]], 2.0)
    bent = read(bends=bends)
    assert bent.sd == pytest.approx([1.0, np.sqrt(0.25 + 0.75 * 9.0), 1.0, 1.0, 1.0], rel=1e-6)
    assert not bent.followed and len(bent.mixtures[""].weights) > 10
    for wrong in (
        {"profiles": {"b": valley}},
        {"profiles": {"a": msgspec.structs.replace(valley, rises=[0.0])}},
        {"bends": msgspec.structs.replace(bends, ends=[])},
    ):
        with pytest.raises(InputError, match="calibrate again"):
            read(**wrong)


@given(st.integers(0, 2**31))
@settings(max_examples=30)
def test_parts_add_up_again(seed: int) -> None:
    seen, stated, _ = known(seed)
    whole = seen + stated
    again = whole.less(stated) + stated
    unit = np.sqrt(np.maximum(np.diagonal(whole.matrix), 1e-300))
    assert again.matrix / unit[:, None] / unit == pytest.approx(whole.matrix / unit[:, None] / unit, abs=2e-6)


def test_absent_keys_are_zero() -> None:
    values = np.arange(10.0).reshape(2, 5)
    other = Key("camera", "b", "phi", "px")
    assert over(values, KEYS, (KEYS[3], other, KEYS[0])).tolist() == [[3.0, 0.0, 0.0], [8.0, 0.0, 5.0]]
    assert over(values[:, :0], (), KEYS).tolist() == [[0.0] * 5] * 2
    assert over(values, KEYS, ()).shape == (2, 0)


# ---- calibrations ---------------------------------------------------------------------------------------------------


@cache
def seen(tilt_deg: float, spacing_m: float = 0.2, aside_m: float = 0.0) -> Observations:
    """A field with one displaced line, from a camera at 4 m."""
    pose = overhead_pose(0.1, -0.2, 4.0, tilt_x_deg=tilt_deg, yaw_deg=3.0)
    stations = {"overhead": Station("overhead", pose)}
    scene = field_scene(ssl_field("B"), {"overhead": camera("radial-2-3")}, stations, spacing_m=spacing_m)
    observations = simulate(scene, Disturbance(0.3, 0.3), seed=1).observations
    curves = observations.curves
    line = curves.feature == ssl_field("B").curve_names.index("HalfwayLine")
    return replace(observations, curves=replace(curves, pixels=curves.pixels + aside_m * 217.0 * line[:, None]))


def stated(quantity: str, value: tuple[float, ...], sigma: float) -> Prior:
    owner = "camera" if quantity in ("phi", "principal_point", "a3") else "station"
    return Prior(owner, "overhead", quantity, value, (sigma,) * len(value))


HEIGHT, PHI = stated("height_m", (4.0,), 0.02), stated("phi", (868.0,), 5.0)
POSITION = stated("position_m", (0.1, -0.2, 4.0), 0.003)
CENTRE, A3 = stated("principal_point", (651.3, 468.9), 0.2), stated("a3", (6.1e-7,), 1e-9)
CASES: dict[str, tuple[Observations, Options]] = {
    "a line in doubt": (seen(8.0, aside_m=0.006), Options(lens="radial", priors=(HEIGHT, CENTRE))),
    "other lenses": (seen(8.0), Options(lens=AUTO, priors=(POSITION,))),
    "a valley": (seen(0.0), Options(lens="radial", priors=(stated("height_m", (4.0,), 0.6), CENTRE))),
    "a valley, phi stated": (seen(0.5), Options(lens="radial", priors=(stated("phi", (868.0,), 90.0), A3))),
    "a valley, other lenses": (seen(0.5), Options(lens=AUTO, priors=(stated("height_m", (4.0,), 0.5),))),
    "few observations": (seen(8.0, 2.0), Options(lens="brown", priors=(HEIGHT, PHI))),
    "a conflict": (seen(8.0), Options(lens="radial", priors=(stated("height_m", (3.0,), 0.005), A3))),
    "dimensions": (
        seen(20.0),
        Options(
            lens="radial",
            dimensions=("field/field_length_m",),
            priors=(Prior("target", "field", "field_length_m", (9.0,), (0.001,)), HEIGHT),
        ),
    ),
}


def farthest_over(calibration: Calibration, priors: tuple[Prior, ...]) -> float:
    """The largest standard deviation, or half 95 % interval, over that of its own prior."""
    quantities = {"height_m": ("height",), "position_m": ("x", "y", "height"), "principal_point": ("cx", "cy")}
    over_own = []
    for prior in priors:
        for number, quantity in enumerate(quantities.get(prior.quantity, (prior.quantity,))):
            kind = "dimension" if prior.owner == "target" else prior.owner
            one = calibration.uncertainty.verdict(kind, prior.name, quantity)
            sd = calibration.uncertainty.posterior.sd_of(kind, prior.name, quantity)
            half = 0.5 * (one.high - one.low) / NORMAL_95
            over_own.append(max(one.sd, sd, half) / prior.sigma[number])
    return max(over_own)


@pytest.mark.parametrize("name", CASES)
def test_no_sd_exceeds_its_own_priors(name: str) -> None:
    observations, options = CASES[name]
    calibration = calibrate(observations, options)
    wrong = {one.quantity for one in calibration.conflicts}
    agreed = tuple(one for one in options.priors if one.quantity.removesuffix("_m") not in wrong)
    assert farthest_over(calibration, agreed) <= ROUNDING
    assert bool(calibration.posterior and calibration.posterior.followed) == ("valley" in name)
    assert bool(calibration.conflicts) == ("conflict" in name)


@pytest.mark.thorough
def test_two_cameras_from_straight_above() -> None:
    """The mixture of one camera has no keys of the other; a prior on one height gives nothing for the other."""
    cameras, _ = side_by_side(camera("radial-2-3"))
    stations = {
        name: Station(name, overhead_pose(x_m, 0.0, 4.4, yaw_deg=90.0))
        for name, x_m in (("left", -2.3), ("right", 2.3))
    }
    scene = field_scene(ssl_field("B"), cameras, stations, spacing_m=0.3)
    observations = simulate(scene, Disturbance(0.3, 0.3), seed=2).observations
    height = Prior("station", "left", "height_m", (4.4,), (0.01,))
    calibration = calibrate(observations, Options(lens=AUTO, priors=(height,)))
    verdicts = [calibration.uncertainty.verdict("station", name, "height") for name in ("left", "right")]
    assert verdicts[0].sd <= 0.01 * ROUNDING and verdicts[1].verdict != "known"
    assert calibration.posterior is not None and calibration.posterior.followed == ("right",)
    assert all(calibration.uncertainty.map_px(name).radius_95_px.shape for name in ("left", "right"))
