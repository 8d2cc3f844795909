"""What an imperfect rig makes of exact frames and poses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, Trajectory
from learned.covariance import pose_errors
from learned.held_out import Rig, imperfect, motion_rates, shifted

WIDTH, HEIGHT = 16, 8
K = np.array([[20.0, 0, 8], [0, 20, 4], [0, 0, 1]])
PERFECT = Rig(focal_share=0, centre_share=0, disparity_px=0, stamp_s=0, reference_m=(0, 0, 0), reference_rad=(0, 0, 0))
TWIST = np.array([0.0, 0.02, 0.0, 0.1, -0.05, 0.9])  # of a tenth of a second


def drive(count: int) -> tuple[list[CameraFrame], Trajectory]:
    """Frames of a constant depth, and the poses of a constant motion."""
    stamps = np.arange(count) * (NANOSECONDS // 10)
    camera = CameraInfo(WIDTH, HEIGHT, K)
    depth = np.full((HEIGHT, WIDTH), 10.0, np.float32)
    depth[0] = 0
    frames = [CameraFrame(int(s), np.zeros((HEIGHT, WIDTH), np.uint8), depth, camera) for s in stamps]
    return frames, Trajectory(stamps, RigidTransform.from_exp_coords(np.arange(count)[:, None] * TWIST))


def off(reference: RigidTransform, trajectory: Trajectory) -> np.ndarray:
    """Errors (N, 6) of the reference's poses, in their own axes."""
    return pose_errors(trajectory.poses.as_matrix(), reference.as_matrix())


def test_a_perfect_rig_reports_what_is() -> None:
    frames, trajectory = drive(5)
    reported, reference = imperfect(frames, trajectory, PERFECT, np.random.default_rng(0))
    for frame, exact in zip(reported, frames, strict=True):
        assert_array_equal(frame.camera.K, exact.camera.K)
        assert_allclose(frame.depth, exact.depth, rtol=1e-6)
    assert_allclose(off(reference, trajectory), 0, atol=1e-12)


def test_the_reference_is_off_by_what_is_stated_of_each_axis() -> None:
    rig = Rig(stamp_s=0)
    _, trajectory = drive(4000)
    _, reference = imperfect(drive(1)[0] * 4000, trajectory, rig, np.random.default_rng(1))
    assert_allclose(off(reference, trajectory).std(0), [*rig.reference_rad, *rig.reference_m], rtol=0.05)


def test_a_stamp_that_is_late_claims_the_pose_of_a_later_moment() -> None:
    """Errors are the motion of one and the same dt, whose standard deviation is that of the stamps."""
    rig = Rig(stamp_s=0.001, reference_m=(0, 0, 0), reference_rad=(0, 0, 0))
    _, trajectory = drive(2000)
    _, reference = imperfect(drive(1)[0] * 2000, trajectory, rig, np.random.default_rng(2))
    errors = off(reference, trajectory)
    velocity, rate = motion_rates(trajectory)
    rates = np.concatenate([rate[0], velocity[0]])
    dt = errors @ rates / (rates @ rates)
    assert_allclose(errors, dt[:, None] * rates, atol=1e-4)
    assert_allclose(dt.std(), rig.stamp_s, rtol=0.05)


def test_calibration_is_off_alike_for_all_frames_of_a_clip() -> None:
    frames, trajectory = drive(3)
    reported, _ = imperfect(frames, trajectory, Rig(), np.random.default_rng(3))
    assert not np.array_equal(reported[0].camera.K, K)
    for frame in reported[1:]:
        assert_array_equal(frame.camera.K, reported[0].camera.K)
        assert_array_equal(frame.depth, reported[0].depth)
    assert reported[0].camera.K[0, 0] / reported[0].camera.K[1, 1] == pytest.approx(K[0, 0] / K[1, 1])


@given(depth=st.floats(0.5, 80), shift=st.floats(-0.05, 0.05))
def test_inverse_depth_moves_by_the_shift(depth: float, shift: float) -> None:
    """No depth stays none, and what would be behind the camera has none."""
    moved = shifted(np.array([[depth, 0.0]], np.float32), shift)
    inverse = 1 / depth + shift
    assert moved[0, 1] == 0
    if abs(inverse) > 1e-4:
        assert_allclose(moved[0, 0], 1 / inverse if inverse > 0 else 0, rtol=1e-3)


def test_rates_of_a_constant_motion_are_its_own() -> None:
    _, trajectory = drive(6)
    velocity, rate = motion_rates(trajectory)
    step = trajectory.poses[0].inv() * trajectory.poses[1]
    assert_allclose(velocity, np.tile(10 * step.translation, (6, 1)), atol=1e-9)
    assert_allclose(rate, np.tile(10 * step.rotation.as_rotvec(), (6, 1)), atol=1e-9)
