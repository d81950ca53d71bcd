"""Whether calibrations still hold, on the scenes of scripts/accuracy/moves.py."""

from dataclasses import replace

import numpy as np
import pytest
from accuracy.checks import KINDS, Kind, checked
from accuracy.moves import CAMERA, DAY, HOME, NOISE, SMALL_SHIFT, SMALL_TILT, seen, thinned
from accuracy.moves import calibrated as calibrated_at_home
from accuracy.scenes import FIELD
from scenery import field_scene, overhead_pose
from scenes import side_by_side
from thorough import partly

from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.renaming import relabelled
from ceres_cal.cli.moves import _checked_station
from ceres_cal.moves.checks import check
from ceres_cal.moves.refits import movements, refit
from ceres_cal.observations import Observations
from ceres_cal.observations.columns import taken
from ceres_cal.problem.parameters import Options, Station
from ceres_cal.problem.structure import Tolerance
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.symmetry import MIRRORED
from ceres_cal.simulate import Disturbance, simulate


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated_at_home(0)


def lines(pose: Pose, seed: int, disturbance: Disturbance = DAY, camera: Camera = CAMERA) -> Observations:
    found = seen(pose, disturbance, seed, camera=camera, spacing_m=0.12).observations
    return thinned(found, (), 100, seed)


@pytest.mark.parametrize("kind", partly(KINDS, KINDS[:3:2]), ids=lambda kind: kind.name)
def test_alarms_are_as_rare_as_stated_whatever_the_observations_are_like(kind: Kind) -> None:
    found = np.array([checked(kind, seed % 4, seed).probability for seed in range(8)])
    assert np.count_nonzero(found < 0.01) <= 1  # 0; `python scripts/run.py checks` has the figures
    assert np.median(found) > 0.25  # at most 0.5: the calibration's own error is allowed for


@pytest.mark.parametrize("seed", [16, 45, 323])
def test_what_is_seen_along_correlated_edges_is_no_movement(seed: int) -> None:
    """Probabilities were 5e-151, 3e-9 and 5e-53, with a move of 2.4 m, when the prior's part was subtracted from the
    whole information: with correlated edges the difference was not positive definite.
    """
    found = checked(KINDS[3], seed % 40, seed)
    assert found.holds and found.probability > 0.1  # 0.54, 0.51 and 0.49


def test_two_lines_accuse_no_camera_that_stands_still(calibration: Calibration) -> None:
    """Where they leave the pose open, or also fit a rotated field, the nearest pose that fits is tested."""
    for seed in range(20, 40):
        found = lines(HOME, seed)
        two = np.random.default_rng(seed).permutation(np.unique(found.curves.feature))[:2]
        few = found.part(np.zeros(len(found.points), dtype=bool), np.isin(found.curves.feature, two))
        assert check(calibration, few)["overhead"].probability > 1e-4  # 1.4e-4; 4 of 20 were below 1e-7, two of them 0


@pytest.mark.parametrize("seed", partly(range(5), [0]))
def test_small_moves_are_found(seed: int) -> None:
    assert not checked(KINDS[0], seed, seed, SMALL_TILT).holds
    assert not checked(KINDS[0], seed, seed, SMALL_SHIFT).holds


def test_more_checks_share_the_false_alarms(calibration: Calibration) -> None:
    """A move found by one check is not significant enough for one of 720; a larger move is."""
    slight = Pose.looking(HOME.position + np.array([0.0012, 0.0, 0.0]), HOME.rotation)
    observations = next(o for o in (lines(slight, s) for s in range(50)) if not check(calibration, o).holds)
    month = check(calibration, observations, checks=720)
    assert month.holds and month.checks == 720
    assert not check(calibration, lines(SMALL_TILT, 1), checks=720).holds


@pytest.mark.parametrize("pose", [SMALL_TILT, SMALL_SHIFT])
def test_sizes_are_those_of_the_movement(calibration: Calibration, pose: Pose) -> None:
    found = check(calibration, lines(pose, 1))["overhead"]
    assert not found.holds and "no longer holds" in found.words
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-4.0, -1.0, 9), np.linspace(-2.0, 2.0, 9)))
    floor = np.column_stack([x, y, 0.0 * x])
    off = 1e3 * np.linalg.norm(CAMERA.at(pose).locate(CAMERA.at(HOME).project(floor)) - floor[:, :2], axis=1)
    assert found.change is not None
    assert found.change.maps[0].mean_mm == pytest.approx(float(np.mean(off)), rel=0.4)  # 3.2 of 3.7 mm, 2.7 of 3.0 mm


def test_a_height_that_is_seen_better_is_no_movement() -> None:
    """A calibration of a field alone, whose height is correlated with phi: poses of a camera moved by 10 mm are 90 mm
    apart. From straight above, where phi may differ much, the size of the move is unknown, but the move is found.
    """
    tilted, above = (overhead_pose(-2.27, -0.12, 4.02, 0.0, tilt_deg, 90.6) for tilt_deg in (-8.0, 0.0))
    for home, moved_mm in ((tilted, 10.0), (above, np.nan)):
        new = lines(Pose.looking(home.position + np.array([0.01, 0.0, 0.0]), home.rotation), 4)
        before = calibrate(lines(home, 3))
        found = check(before, new)
        change = found["overhead"].change
        assert check(before, lines(home, 5)).holds and not found.holds  # which held, straight above, after any move
        assert change is not None
        assert change.moved_mm == pytest.approx(moved_mm, abs=4.0, nan_ok=True)  # 12.5
        shift_m, _ = movements(before, refit(before, new))["overhead"]
        assert 1e3 * shift_m == pytest.approx(moved_mm, abs=4.0, nan_ok=True)  # 12.4


def test_outliers_and_more_noise_are_no_movement(calibration: Calibration) -> None:
    gross = replace(NOISE, outliers=0.2)
    assert check(calibration, lines(HOME, 2, gross)).holds
    dim = replace(NOISE, points_sigma_px=0.6, curves_sigma_px=0.6)
    observations = lines(HOME, 3, dim)
    observations = replace(
        observations, curves=replace(observations.curves, sigma_px=0.5 * observations.curves.sigma_px)
    )
    found = check(calibration, observations)["overhead"]
    assert found.holds and found.misfit.noise[0] == pytest.approx(2.0, rel=0.2)  # 1.9


def test_clicks_that_are_much_noisier_accuse_no_camera_that_stands_still(calibration: Calibration) -> None:
    """With the calibration's noise a pose fitted some of them and the others were strays: 9 of 12 were called moved."""
    accused = 0
    for seed in range(12):
        rng, observations = np.random.default_rng(seed), seen(HOME, NOISE, seed).observations
        chosen = np.sort(rng.permutation(len(observations.points))[:9])
        points = taken(observations.points, np.isin(np.arange(len(observations.points)), chosen))
        pixels = np.clip(points.pixels + rng.normal(0.0, 2.0, points.pixels.shape), 0.0, (1279.0, 959.0))
        curves = taken(observations.curves, np.zeros(len(observations.curves), dtype=bool))
        clicks = replace(observations, points=replace(points, pixels=pixels), curves=curves)
        accused += check(calibration, clicks).holds is False
    assert accused <= 1  # 1


def test_what_is_not_understood_does_not_hold(calibration: Calibration) -> None:
    observations = lines(HOME, 4)
    shuffled = np.random.default_rng(0).permutation(observations.curves.feature)
    found = check(calibration, replace(observations, curves=replace(observations.curves, feature=shuffled)))
    assert not found.holds and "cannot be explained" in found["overhead"].words
    mirrored = relabelled(observations, MIRRORED)  # two thirds of it look the same: the camera is where it was
    assert mirrored is not None
    found = check(calibration, mirrored)
    assert found.holds and "check labels" in found["overhead"].words
    far = Pose.looking(HOME.position + np.array([0.5, 0.2, 0.3]), rotation_exp((0.2, 0.1, np.pi)) @ HOME.rotation)
    assert not check(calibration, lines(far, 5)).holds


def test_another_zoom_or_focus_is_named(calibration: Calibration) -> None:
    """Another focus appeared only as more noise, and the check held."""
    zoomed = replace(CAMERA, phi=1.05 * CAMERA.phi)
    assert not check(calibration, lines(HOME, 6, NOISE, zoomed)).holds  # from almost above, as good as a movement
    focused = replace(CAMERA, lens=Radial((-4.2e-5, 6.1e-7)))
    found = check(calibration, lines(HOME, 7, NOISE, focused))["overhead"]
    assert not found.holds and found.cause == "iris" and "another iris or focus" in found.words
    assert _checked_station(found).data["stations"]["overhead"]["cause"] == "iris"  # in the JSON of the command, too


def test_a_stretched_picture_is_no_noise(calibration: Calibration) -> None:
    """It was taken for much noise, so that the check held, or for a movement; places were off by 0.1 to 0.2 m."""
    for aspect in (0.96, 1.04, 1.07):
        observations = seen(HOME, NOISE, 8, camera=replace(CAMERA, aspect=aspect)).observations
        found = check(calibration, observations)["overhead"]
        assert not found.holds and found.cause == "everything" and "stretched" in found.words, found.words


def test_without_a_field_to_map_the_movement_alone_is_said(calibration: Calibration) -> None:
    without = replace(calibration, targets={})
    for pose, words in (
        (HOME, "holds: no change beyond the uncertainty (probability"),
        (SMALL_TILT, "deg (probability"),
    ):
        found = check(without, lines(pose, 1))["overhead"]
        assert found.change is not None and not found.change.maps and words in found.words
        assert "nan" not in "\n".join(_checked_station(found).lines)


def test_each_station_by_itself() -> None:
    cameras, stations = side_by_side(CAMERA)
    scene = field_scene(FIELD, cameras, stations, spacing_m=0.2)
    options = Options(lens="radial", tolerances={"field": Tolerance(lines_m=0.003)})
    both = calibrate(simulate(scene, NOISE, 0).observations, options)
    pose = stations["right"].cam_from_world
    moved = Station("right", Pose.looking(pose.position, rotation_exp((0.003, 0.0, 0.0)) @ pose.rotation))
    there = field_scene(FIELD, cameras, {**stations, "right": moved}, spacing_m=0.3)
    found = check(both, simulate(there, NOISE, 1).observations)
    assert found["left"].holds and not found["right"].holds and not found.holds


def test_wrong_use(calibration: Calibration) -> None:
    observations = lines(HOME, 7)
    with pytest.raises(InputError, match="between 0 and 1"):
        check(calibration, observations, 1.5)
    with pytest.raises(InputError, match="checks must be 1 or more"):
        check(calibration, observations, checks=0)
    with pytest.raises(InputError, match="does not say how well"):
        check(replace(calibration, posterior=None), observations)
    with pytest.raises(SolutionError, match="wrong camera"):
        check(calibration, replace(observations, cameras={"overhead": (640, 480)}))
    views = tuple(replace(view, station="second") for view in observations.views)
    with pytest.raises(InputError, match="not in the calibration"):
        check(calibration, replace(observations, views=views))
