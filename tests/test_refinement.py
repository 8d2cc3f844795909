"""Laws of the refinement: right derivatives, the truth on rendered pairs, and the start where nothing is to be seen."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import RigidTransform

from fusion_io import simulation
from fusion_io.records import CameraFrame, CameraInfo, FloatArray
from learned.refinement import FullFrame, Problem, Refined, inside, prepare_full, refine, with_gradients

SIGMAS = np.array([3e-3, 3e-3, 3e-3, 0.06, 0.06, 0.06])
PRIOR = np.diag(SIGMAS**2)
NO_OTHERS = np.zeros((0, 1, 4, 4))


def rendered(seed: int) -> tuple[list[CameraFrame], FloatArray]:
    """Two frames of a simulated drive with exact depth, and the true T_source_target (4, 4)."""
    frames, _, trajectory = simulation.clip(seed, 2, 480, 144, exact_depth=True)
    return frames, (trajectory.poses[0].inv() * trajectory.poses[1]).as_matrix()


def refined(frames: list[CameraFrame], start: FloatArray, others: FloatArray = NO_OTHERS) -> Refined:
    source, target = (prepare_full(frame) for frame in frames)
    return refine([(source, target)], start[None], PRIOR[None], others)


def distance(T: FloatArray, truth: FloatArray) -> FloatArray:
    """Sizes of the rotation (rad) and the translation (m) between two poses."""
    twist = (RigidTransform.from_matrix(T).inv() * RigidTransform.from_matrix(truth)).as_exp_coords()
    return np.array([np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])])


def perturbed(T: FloatArray, seed: int, sigmas: float = 1.0) -> FloatArray:
    twist = sigmas * SIGMAS * np.random.default_rng(seed).standard_normal(6)
    return np.asarray(T @ RigidTransform.from_exp_coords(twist).as_matrix())


SMOOTH = CameraInfo(96, 64, np.array([[80.0, 0, 47.5], [0, 70.0, 31.5], [0, 0, 1]]))


def smooth_frame(phase: float) -> FullFrame:
    """A picture of waves over a slanted plane: differentiable, but for rounding to grey levels, which is undone."""
    y, x = np.mgrid[: SMOOTH.height, : SMOOTH.width].astype(np.float32)
    waves = 120 + 60 * np.sin(0.11 * x + phase) + 40 * np.cos(0.13 * y - 0.05 * x)
    frame = prepare_full(CameraFrame(0, waves.astype(np.uint8), (4 + 0.02 * x + 0.03 * y).astype(np.float32), SMOOTH))
    frame.images[0] = with_gradients(waves)
    return frame


@pytest.mark.parametrize("axis", range(8))
def test_the_jacobian_is_the_derivative_of_the_residual(axis: int) -> None:
    """Against differences over about a pixel, as the image's gradients are; the median over the points is judged."""
    start = perturbed(np.eye(4), 1)
    problem = Problem([(smooth_frame(0.0), smooth_frame(0.3))], start[None], PRIOR[None], [0])
    state = problem.state(0, np.linalg.inv(start)[None])
    values = problem.levels[0].own[:, 0]

    def residual(step: float) -> tuple[torch.Tensor, torch.Tensor]:
        twist, light = np.zeros(6), torch.zeros(2, dtype=torch.float64)
        if axis < 6:
            twist[axis] = step
        else:
            light[axis - 6] = step
        turn = torch.from_numpy(RigidTransform.from_exp_coords(twist).as_matrix())
        view = problem.look(0, turn @ state.T_target_source)
        gain, offset = (state.light + light).float().unbind(1)
        return view.values - gain[:, None] * values - offset[:, None], view.visible

    h = (6e-3, 6e-3, 6e-3, 0.03, 0.03, 0.1, 1e-3, 0.1)[axis]
    (upper, a), (lower, b) = residual(h), residual(-h)
    view = problem.look(0, state.T_target_source)
    analytic = problem.jacobian(0, view, view.gradients, values)[0, axis]
    both = (a & b)[0]
    numeric = ((upper - lower) / (2 * h))[0]
    assert both.sum() > 100
    error = (analytic - numeric)[both].abs().median()
    assert error < 0.05 * analytic[both].abs().median() + 1e-3


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_it_finds_the_truth_on_rendered_pairs(seed: int) -> None:
    """Within a tenth of what the start was off by."""
    frames, truth = rendered(seed)
    start = perturbed(truth, seed)
    found = refined(frames, start)
    assert found.improved.all()
    assert (distance(found.T_source_target[0], truth) < 0.15 * distance(start, truth)).all()


def test_brightness_does_not_matter() -> None:
    frames, truth = rendered(3)
    darker = np.clip(0.8 * frames[1].image.astype(float) + 12, 0, 255).astype(np.uint8)
    changed = [frames[0], CameraFrame(frames[1].stamp_ns, darker, frames[1].depth, frames[1].camera)]
    start = perturbed(truth, 3)
    one, other = (refined(f, start).T_source_target[0] for f in (frames, changed))
    assert (distance(one, other) < 0.05 * distance(start, truth)).all()


def test_another_start_saves_a_pair_that_begins_too_far_away() -> None:
    """From twenty sigmas away the search ends elsewhere; with the truth's neighbourhood among the starts it does not.

    The prior is as wide as the network would have to say that it is.
    """
    frames, truth = rendered(4)
    pair = [tuple(prepare_full(frame) for frame in frames)]
    start, other = perturbed(truth, 7, 20.0), perturbed(truth, 8)
    wide = 900 * PRIOR[None]
    lost = refine(pair, start[None], wide, NO_OTHERS).T_source_target[0]  # type: ignore[arg-type]
    saved = refine(pair, start[None], wide, other[None, None]).T_source_target[0]  # type: ignore[arg-type]
    assert distance(lost, truth)[1] > 0.1
    assert distance(saved, truth)[1] < 0.02


def test_a_blank_image_leaves_start_and_prior_as_they_were() -> None:
    frames, truth = rendered(3)
    blank = [CameraFrame(f.stamp_ns, np.full_like(f.image, 77), f.depth, f.camera) for f in frames]
    start = perturbed(truth, 1)
    found = refined(blank, start)
    assert not found.improved.any()
    np.testing.assert_allclose(found.T_source_target[0], start, atol=1e-12)
    np.testing.assert_allclose(found.covariance[0], PRIOR, atol=1e-9)


def test_the_covariance_shrinks_where_the_image_tells_and_never_exceeds_the_prior() -> None:
    frames, truth = rendered(3)
    covariance = refined(frames, perturbed(truth, 1)).covariance[0]
    assert np.linalg.eigvalsh(PRIOR - covariance)[0] > 0
    assert (np.sqrt(np.diag(covariance)) < 0.2 * SIGMAS).all()


def test_pairs_do_not_see_each_other() -> None:
    """A pair refined in a batch is the pair refined alone, up to rounding."""
    made = [rendered(seed) for seed in (3, 4)]
    starts = np.stack([perturbed(truth, i) for i, (_, truth) in enumerate(made)])
    pairs = [tuple(prepare_full(frame) for frame in frames) for frames, _ in made]
    together = refine(pairs, starts, np.stack([PRIOR] * 2), np.zeros((0, 2, 4, 4)))  # type: ignore[arg-type]
    for i, (frames, _) in enumerate(made):
        alone = refined(frames, starts[i])
        np.testing.assert_allclose(together.T_source_target[i], alone.T_source_target[0], atol=1e-4)


def test_the_edge_of_what_has_depth_takes_no_part_but_gaps_of_sparse_depth_do_not_matter() -> None:
    dense = np.zeros((40, 60), np.bool_)
    dense[10:30, 20:50] = True
    expected = np.zeros_like(dense)
    expected[11:29, 21:49] = True
    np.testing.assert_array_equal(inside(dense), expected)
    sparse = np.zeros_like(dense)
    sparse[10:30:3, 20:50:2] = True  # lines of a LiDAR
    within = inside(sparse)
    assert not np.any(within & ~sparse)
    assert within.sum() > 0.6 * sparse.sum()
    assert not within[10].any()  # the uppermost line is the edge
    assert not inside(np.zeros_like(dense)).any()


def test_depth_that_is_nan_or_missing_takes_no_part() -> None:
    frames, truth = rendered(3)
    assert frames[0].depth is not None
    holes = frames[0].depth.copy()
    holes[:, ::2], holes[::3] = np.nan, 0
    start = perturbed(truth, 3)
    found = refined([CameraFrame(0, frames[0].image, holes, frames[0].camera), frames[1]], start)
    assert (distance(found.T_source_target[0], truth) < 0.2 * distance(start, truth)).all()


def test_noise_moves_the_estimate_in_no_direction() -> None:
    """A camera that stands still: the mean motion of many noisy pairs is within four standard errors of none."""
    rng = np.random.default_rng(0)
    frames, _ = rendered(3)
    depth = np.full(frames[0].image.shape[:2], 10, dtype=np.float32)
    motions = []
    for _ in range(12):
        pair = [
            CameraFrame(0, np.clip(f.image + rng.normal(0, 4, f.image.shape), 0, 255).astype(np.uint8), depth, f.camera)
            for f in (frames[0], frames[0])
        ]
        motions.append(RigidTransform.from_matrix(refined(pair, np.eye(4)).T_source_target[0]).as_exp_coords()[:3])
    mean, error = np.mean(motions, axis=0), np.std(motions, axis=0) / np.sqrt(12)
    assert (np.abs(mean) < 4 * error + 1e-6).all()


def test_the_same_pair_gives_the_same_bits() -> None:
    frames, truth = rendered(5)
    one, other = (refined(frames, perturbed(truth, 5)) for _ in range(2))
    np.testing.assert_array_equal(one.T_source_target, other.T_source_target)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_state_has_the_light_that_fits_best() -> None:
    first, second = smooth_frame(0.0), smooth_frame(0.0)
    second.images[0] = with_gradients(0.9 * first.images[0][0].numpy() + 7)
    problem = Problem([(first, second)], np.eye(4)[None], PRIOR[None], [0])
    np.testing.assert_allclose(problem.state(0, np.eye(4)[None]).light[0], [0.9, 7.0], atol=0.02)
