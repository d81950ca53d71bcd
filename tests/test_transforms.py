"""Rigid transforms: group axioms, exp and log up to the angle pi, and the paper's angles up to gimbal lock."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import (
    Pose,
    euler_from_rotation,
    left_jacobian,
    nearest_rotation,
    require_rotation,
    rotation_exp,
    rotation_from_euler,
    rotation_log,
    skew,
)

# Angles where formulas change or lose digits: near 0, at the switch to the series, and at or just below pi.
CRITICAL_ANGLES = (0.0, 1e-300, 1e-12, 1e-8, 0.999e-4, 1.001e-4, np.pi - 1e-7, np.pi - 1e-12, np.pi)

quick = settings(deadline=None, max_examples=40)


@st.composite
def directions(draw: st.DrawFn) -> Array:
    v = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)))
    return np.asarray(v / np.linalg.norm(v))


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Array:
    angle = draw(st.floats(0.0, np.pi) | st.sampled_from(CRITICAL_ANGLES))
    return np.asarray(angle * draw(directions()))


metres = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)
poses = st.builds(lambda w, t: Pose(rotation_exp(w), t), rotation_vectors(), metres)
angles = st.floats(-np.pi, np.pi)


def assert_close(a: Pose, b: Pose) -> None:
    assert np.abs(a.rotation - b.rotation).max() < 6e-15  # measured 1.8e-15
    assert np.abs(a.translation - b.translation).max() < 5e-14  # m; measured 1.5e-14


@quick
@given(poses, poses, poses, metres)
def test_poses_are_a_group(a: Pose, b: Pose, c: Pose, x: Array) -> None:
    assert_close((a @ b) @ c, a @ (b @ c))
    assert a @ Pose.identity() == a == Pose.identity() @ a
    assert_close(a @ a.inverse, Pose.identity())
    assert_close(a.inverse @ a, Pose.identity())
    assert_close((a @ b).inverse, b.inverse @ a.inverse)
    assert np.abs((a @ b).transform(x) - a.transform(b.transform(x))).max() < 3e-14  # m; measured 7.1e-15


@quick
@given(poses, metres)
def test_position_is_where_the_camera_is(cam_from_world: Pose, position: Array) -> None:
    assert np.abs(cam_from_world.transform(cam_from_world.position)).max() < 5e-14  # m; measured 1.5e-14
    there = Pose.looking(position, cam_from_world.rotation)
    assert np.abs(there.position - position).max() < 5e-14  # m; measured 1.5e-14
    assert np.array_equal(there.rotation, cam_from_world.rotation)


def test_transform_takes_any_leading_shape() -> None:
    pose = Pose.exp([0.3, -0.2, 0.9, 1.0, 2.0, 3.0])
    points = np.arange(24.0).reshape(2, 4, 3)
    moved = pose.transform(points)
    assert moved.shape == (2, 4, 3)
    # 1e-13 m: one product of a matrix may sum in another order than another, measured 0
    assert np.abs(moved[1, 2] - (pose.rotation @ points[1, 2] + pose.translation)).max() < 1e-13


def test_a_pose_is_frozen() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    pose = Pose(rotation, translation)
    rotation[0, 0] = translation[0] = 7.0
    assert pose == Pose.identity()
    for array in (pose.rotation, pose.translation, pose.position):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(TypeError, match="unhashable"):
        hash(pose)


@pytest.mark.parametrize(
    "rotation, translation, message",
    [(np.eye(4), np.zeros(3), r"rotation must have shape \(3, 3\)"), (np.eye(3), np.zeros((3, 1)), "translation must")],
)
def test_wrong_shapes_are_refused(rotation: Array, translation: Array, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Pose(rotation, translation)


@quick
@given(rotation_vectors())
def test_exp_is_the_rotation_about_that_axis(w: Array) -> None:
    rotation = rotation_exp(w)
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 5e-15  # measured 1.8e-15
    assert np.linalg.det(rotation) > 0.0
    assert np.abs(rotation - Rotation.from_rotvec(w).as_matrix()).max() < 2e-15  # measured 6.7e-16


@quick
@given(rotation_vectors())
def test_log_undoes_exp(w: Array) -> None:
    back = rotation_log(rotation_exp(w))
    angle = np.linalg.norm(w)
    assert np.linalg.norm(back) <= np.pi * (1.0 + 1e-15)
    if np.dot(back, w) < 0.0:  # at half a turn, to rounding, both directions of the axis are the same rotation
        assert angle > np.pi - 1e-14
        back = -back
    assert np.linalg.norm(back - w) <= 3e-15 * angle  # relative, so tiny angles keep their digits; measured 3.7e-16


@quick
@given(rotation_vectors(), metres)
def test_pose_log_undoes_pose_exp(w: Array, t: Array) -> None:
    pose = Pose.exp([*w, *t])
    assert np.array_equal(pose.translation, t)
    assert_close(Pose.exp(pose.log()), pose)


@quick
@given(rotation_vectors(), directions())
def test_left_jacobian_against_differences(w: Array, direction: Array) -> None:
    h = 1e-5
    ahead, behind = rotation_exp(w + h * direction), rotation_exp(w - h * direction)
    turned = rotation_log(ahead @ behind.T) / (2.0 * h)
    assert np.abs(turned - left_jacobian(w) @ direction).max() < 2e-10  # h^2 / 6 and rounding / h; measured 4.3e-11


@quick
@given(directions(), directions())
def test_skew_is_the_cross_product(a: Array, b: Array) -> None:
    assert np.abs(skew(a) @ b - np.cross(a, b)).max() < 1e-15  # measured 1.1e-16


@quick
@given(rotation_vectors(), rotation_vectors(), st.tuples(*[st.floats(0.5, 2.0)] * 2), st.floats(-0.4, 0.4))
def test_nearest_rotation_is_the_polar_factor(w: Array, v: Array, sizes: tuple[float, float], least: float) -> None:
    # R V diag(s) V^T with positive s is a rotation and a symmetric stretch. With its least stretch negative it is a
    # reflection, and the same R is still the nearest with determinant +1.
    rotation, axes = rotation_exp(w), rotation_exp(v)
    stretched = rotation @ axes @ np.diag([*sizes, least]) @ axes.T
    assert np.abs(nearest_rotation(stretched) - rotation).max() < 1e-13  # the gap of 0.1 costs a digit; measured 2e-14


@quick
@given(st.tuples(*[st.floats(-1.0, 1.0)] * 9), rotation_vectors())
def test_no_rotation_is_nearer(entries: tuple[float, ...], w: Array) -> None:
    matrix = np.reshape(entries, (3, 3))
    nearest = nearest_rotation(matrix)
    assert np.abs(nearest @ nearest.T - np.eye(3)).max() < 6e-15  # measured 2.3e-15
    assert np.linalg.det(nearest) > 0.0
    assert np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - rotation_exp(w)) + 1e-14


@quick
@given(angles, angles, angles)
def test_the_papers_matrix_is_three_turns(alpha: float, beta: float, gamma: float) -> None:
    # Section 3.6 prints the product only. Its factors turn the axes, not the points: each is the inverse of exp.
    turns = [rotation_exp(-angle * np.eye(3)[i]) for i, angle in enumerate((alpha, beta, gamma))]
    product = turns[0] @ turns[1] @ turns[2]
    assert np.abs(rotation_from_euler(alpha, beta, gamma) - product).max() < 4e-15  # measured 1.4e-15


@quick
@given(angles, st.floats(-1.5, 1.5), angles)
def test_the_papers_angles_come_back(alpha: float, beta: float, gamma: float) -> None:
    back = euler_from_rotation(rotation_from_euler(alpha, beta, gamma))
    off = np.subtract(back, (alpha, beta, gamma))
    assert np.abs((off + np.pi) % (2.0 * np.pi) - np.pi).max() < 1e-14  # cos(1.5) = 0.07 costs a digit; measured 5e-16


@quick
@given(angles, st.sampled_from([-1.0, 1.0]), st.just(0.0) | st.floats(-17.0, -1.0).map(lambda e: 10.0**e), angles)
def test_the_papers_rotation_comes_back_near_gimbal_lock(alpha: float, sign: float, short: float, gamma: float) -> None:
    # alpha and gamma are known here only to 1e-16 / cos(beta), but their errors must compensate each other.
    rotation = rotation_from_euler(alpha, sign * (np.pi / 2 - short), gamma)
    angles_back = euler_from_rotation(rotation)
    assert abs(angles_back[1]) <= np.pi / 2
    assert np.abs(rotation_from_euler(*angles_back) - rotation).max() < 4e-15  # measured 1.5e-15


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_gamma_is_zero_at_gimbal_lock(sign: float) -> None:
    alpha, beta, gamma = euler_from_rotation(rotation_from_euler(0.4, sign * np.pi / 2, 0.3))
    assert gamma == 0.0 and beta == sign * np.pi / 2
    assert alpha == pytest.approx(0.4 - sign * 0.3, abs=1e-15)  # only this combination is determined


def test_numbers_too_large_for_a_rotation_are_refused_without_a_warning() -> None:
    with pytest.raises(InputError, match="R is not a rotation matrix"):
        require_rotation(np.full((3, 3), 1e200), "R")
