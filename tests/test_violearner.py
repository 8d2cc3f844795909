"""Laws of the network: the paper's shapes, additive refinement, winner takes all, and its loss."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from learned.dataset import drop_imu, mirror
from learned.violearner import (
    EXTRA_LAYERS,
    PRESETS,
    SCALES,
    Batch,
    NetworkConfig,
    VIOLearner,
    loss,
    pool_depth,
    pool_intrinsics,
    pose_source_target,
)

SMALL = NetworkConfig(trunk_filters=8, extra_filters=8, imu_filters=(4, 4, 8, 8, 8, 8, 8))


def random_batch(config: NetworkConfig, size: int = 2) -> Batch:
    generator = torch.Generator().manual_seed(1)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    images = rand(2, size, config.channels, config.height, config.width)
    K = torch.tensor([[0.6 * config.width, 0, config.width / 2], [0, config.height, config.height / 2], [0, 0, 1]])
    depth = 4 + 20 * rand(size, config.height, config.width)
    return Batch(images[0], images[1], depth, K.repeat(size, 1, 1), rand(size, 20, 6), torch.full((size,), 0.1))


@pytest.fixture
def model() -> VIOLearner:
    torch.manual_seed(0)
    return VIOLearner(SMALL)


def test_levels_work_at_the_papers_scales() -> None:
    assert SCALES == (8, 4, 2, 1, 1)
    assert EXTRA_LAYERS == (0, 2, 3, 4, 5)


def test_paper_preset_is_the_papers_network() -> None:
    """128 x 480 input, seven IMU layers of 64 to 256 filters and 128 filters on every Jacobian."""
    model = VIOLearner(PRESETS["paper"])
    config = PRESETS["paper"]
    assert (config.height, config.width, config.channels) == (128, 480, 3)
    convolutions = [m for m in model.gyro_pathway.modules() if isinstance(m, torch.nn.Conv2d)]
    assert [c.out_channels for c in convolutions] == [64, 64, 128, 128, 256, 256, 256, 3]
    assert [c.kernel_size for c in convolutions[:7]] == [(3, 5)] * 5 + [(3, 3), (3, 1)]
    assert [c.stride[0] for c in convolutions[:7]] == [1, 1, 2, 2, 2, 1, 1]
    trunk = [m for m in model.trunks[0].modules() if isinstance(m, torch.nn.Conv2d)]
    assert [(c.out_channels, c.kernel_size[0], c.stride[0]) for c in trunk] == [(128, 7, 1), (128, 5, 2), (128, 3, 2)]
    assert sum(p.numel() for p in model.parameters()) == pytest.approx(10.0e6, rel=0.01)


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_forward_gives_five_levels_and_four_hypotheses(preset: str) -> None:
    config = dataclasses.replace(PRESETS[preset], trunk_filters=8, extra_filters=8, imu_filters=(4, 4, 8, 8, 8, 8, 8))
    estimate = VIOLearner(config)(random_batch(config))
    assert [tuple(p.shape) for p in estimate.poses] == [(2, 6)] * 5
    assert estimate.hypotheses.shape == (2, 4, 6)
    assert all(bool(torch.isfinite(p).all()) for p in estimate.poses)


def test_winner_has_the_lowest_error(model: VIOLearner) -> None:
    estimate = model(random_batch(SMALL))
    assert torch.equal(estimate.winner, estimate.hypothesis_errors.argmin(1))
    assert torch.equal(estimate.poses[-1], estimate.hypotheses[torch.arange(2), estimate.winner])


def test_a_level_taken_twice_starts_again_from_its_own_correction(model: VIOLearner) -> None:
    batch = random_batch(SMALL)
    twice = VIOLearner(dataclasses.replace(SMALL, passes=(2, 2, 2, 2))).eval()
    twice.load_state_dict(model.state_dict())
    views, estimate = twice.pyramid(batch), twice(batch)

    def correction(level: int, pose: torch.Tensor) -> torch.Tensor:
        seen = twice.trunk_input(twice.compare(views[level - 1], pose), views[level - 1])
        return twice.refinements[level - 1](twice.trunks[level - 1](seen)) * twice.motion_scale

    for level in (1, 2, 3):
        before = estimate.poses[level - 1]
        once = before + correction(level, before)
        torch.testing.assert_close(estimate.poses[level], once + correction(level, once))


def test_the_last_level_taken_twice_starts_again_from_its_winner(model: VIOLearner) -> None:
    batch = random_batch(SMALL)
    once, views = model(batch), model.pyramid(batch)
    twice = VIOLearner(dataclasses.replace(SMALL, passes=(2, 2, 2, 2))).eval()
    twice.load_state_dict(model.state_dict())
    for trunk, refinement in zip(twice.trunks[:3], twice.refinements, strict=True):  # levels 1 to 3 do nothing
        for layer in (trunk, refinement):
            torch.nn.utils.vector_to_parameters(
                torch.zeros_like(torch.nn.utils.parameters_to_vector(layer.parameters())), layer.parameters()
            )
    model.load_state_dict(twice.state_dict())
    winner = model(batch).poses[-1]
    features = model.trunks[3](model.trunk_input(model.compare(views[3], winner), views[3]))
    again = torch.stack([winner + h(features) * model.motion_scale for h in model.hypotheses], dim=1)
    torch.testing.assert_close(twice(batch).hypotheses, again)
    assert not torch.equal(once.poses[-1], winner)


def test_levels_are_taken_as_often_as_training_and_inference_ask(model: VIOLearner) -> None:
    batch = random_batch(SMALL)
    both = VIOLearner(dataclasses.replace(SMALL, passes=(3, 1, 2, 2), training_passes=(1, 2, 1, 1)))
    both.load_state_dict(model.state_dict())
    for passes, training in ((both.config.passes, False), (both.config.training_passes, True)):
        alone = VIOLearner(dataclasses.replace(SMALL, passes=passes)).eval()
        alone.load_state_dict(model.state_dict())
        assert torch.equal(both.train(training)(batch).poses[-1], alone(batch).poses[-1])


def test_hypotheses_start_different(model: VIOLearner) -> None:
    hypotheses = model(random_batch(SMALL)).hypotheses
    assert float(hypotheses.detach().std(dim=1).min()) > 0


def test_level_0_is_proportional_to_the_interval(model: VIOLearner) -> None:
    imu = random_batch(SMALL).imu
    short, long = model.level_0(imu, torch.tensor([0.05, 0.05])), model.level_0(imu, torch.tensor([0.1, 0.1]))
    torch.testing.assert_close(2 * short, long)


def test_a_missing_imu_reads_as_the_mean(model: VIOLearner) -> None:
    batch = random_batch(SMALL)
    dropped = drop_imu(batch, torch.tensor([True, False]))
    mean = model.level_0(model.imu_mean.expand(2, 20, 6), batch.interval_s)
    torch.testing.assert_close(model.level_0(dropped.imu, batch.interval_s)[0], mean[0])
    assert torch.equal(dropped.imu[1], batch.imu[1])


def test_only_the_winner_learns_in_strict_winner_take_all() -> None:
    torch.manual_seed(0)
    model = VIOLearner(dataclasses.replace(SMALL, loser_share=0.0))
    batch = random_batch(SMALL, size=1)
    estimate = model(batch)
    loss(estimate, model, bias_penalty=0.0).backward()
    for k, pathway in enumerate(model.hypotheses):
        gradients = [p.grad for p in pathway.parameters()]
        learned = any(g is not None and bool(g.any()) for g in gradients)
        assert learned == (k == int(estimate.winner[0]))


def test_losers_learn_a_little_in_relaxed_winner_take_all(model: VIOLearner) -> None:
    loss(model(random_batch(SMALL)), model, bias_penalty=0.0).backward()
    assert all(p.grad is not None and bool(p.grad.any()) for h in model.hypotheses for p in h[-1].parameters())


def test_bias_penalty_is_the_l1_norm_of_the_biases(model: VIOLearner) -> None:
    estimate = model(random_batch(SMALL))
    biases = sum(float(p.detach().abs().sum()) for n, p in model.named_parameters() if n.endswith("bias"))
    difference = (loss(estimate, model, 1e-2) - loss(estimate, model, 0.0)).item()
    assert difference == pytest.approx(1e-2 * biases, rel=1e-3)


@pytest.mark.parametrize("gain", [0.3, 2.0])
def test_contrast_normalisation_cancels_gain_and_offset(model: VIOLearner, gain: float) -> None:
    image = random_batch(SMALL).source
    torch.testing.assert_close(
        model.normalise_contrast(gain * image + 0.1), model.normalise_contrast(image), rtol=0.02, atol=0.02
    )


def test_output_is_the_pose_of_the_target_in_the_source() -> None:
    """theta moves source points to the target in the default warp, and the other way in the paper's."""
    pose = torch.tensor([[0.1, -0.2, 0.05, 0.3, -0.1, 1.2]])
    theta = np.eye(4)
    theta[:3, :3] = Rotation.from_euler("xyz", pose[0, :3].numpy()).as_matrix()
    theta[:3, 3] = pose[0, 3:].numpy()
    np.testing.assert_allclose(pose_source_target(pose, "source_to_target")[0].numpy(), np.linalg.inv(theta), atol=1e-7)
    np.testing.assert_allclose(pose_source_target(pose, "paper")[0].numpy(), theta, atol=1e-7)


def test_pyramid_scales_keep_the_geometry() -> None:
    """A pixel of a coarse view is the mean of the block it covers, and K says so."""
    K = torch.tensor([[[140.0, 0, 119.5], [0, 120.0, 31.5], [0, 0, 1]]])
    for scale in (2, 4, 8):
        coarse = pool_intrinsics(K, scale)[0]
        np.testing.assert_allclose((coarse[0, 2] + 0.5) * scale - 0.5, 119.5, atol=1e-4)
        np.testing.assert_allclose(coarse[1, 1] * scale, 120.0, atol=1e-4)
        np.testing.assert_allclose(coarse[2], [0, 0, 1])
    depth = torch.zeros(1, 2, 2)
    depth[0, 0] = torch.tensor([2.0, 4.0])
    torch.testing.assert_close(pool_depth(depth, 2), torch.tensor([[[8 / 3]]]))


def test_a_mirrored_pair_is_a_mirrored_recording() -> None:
    """Twice mirrored is the same; the gyro sees yaw and roll reversed, the accelerometer sideways."""
    batch = random_batch(SMALL)
    flipped = torch.tensor([True, False])
    once = mirror(batch, flipped)
    assert torch.equal(once.source[0], batch.source[0].flip(-1))
    torch.testing.assert_close(once.imu[0] / batch.imu[0], torch.tensor([-1.0, 1, -1, 1, -1, 1]).expand(20, 6))
    twice = mirror(once, flipped)
    for name in ("source", "target", "source_depth", "K", "imu"):
        torch.testing.assert_close(getattr(twice, name), getattr(batch, name))
        assert torch.equal(getattr(once, name)[1], getattr(batch, name)[1])
