"""Laws of fast inference: the same estimates to far below the network's error, and the same bits every time."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from learned import inference
from learned.inference import for_inference
from learned.violearner import Batch, Estimate, NetworkConfig, VIOLearner

SMALL = NetworkConfig(trunk_filters=16, extra_filters=16, imu_filters=(4, 4, 8, 8, 8, 8, 8))
CONFIGS = {
    "fast": SMALL,
    "paper": replace(
        SMALL, channels=3, warp="paper", charbonnier=0.0, contrast="none", jacobian_widths=(), geometry=False
    ),
}


def batch(config: NetworkConfig, pairs: int = 3) -> Batch:
    """Smooth random images, a slanted depth with holes."""
    generator = torch.Generator().manual_seed(1)

    def images() -> torch.Tensor:
        coarse = torch.rand(pairs, config.channels, 9, 31, generator=generator)
        return torch.nn.functional.interpolate(coarse, (config.height, config.width), mode="bicubic").clamp(0, 1)

    depth = torch.linspace(4, 20, config.width).repeat(pairs, config.height, 1)
    depth[:, ::7] = 0
    K = torch.tensor([[140.0, 0, 119.5], [0, 140.0, 31.5], [0, 0, 1]]).repeat(pairs, 1, 1)
    imu = torch.randn(pairs, 20, 6, generator=generator)
    return Batch(images(), images(), depth, K, imu, torch.full((pairs,), 0.1))


def estimate(model: VIOLearner, given: Batch) -> Estimate:
    with torch.inference_mode():
        return model(given)  # type: ignore[no-any-return]


@pytest.fixture(params=["fast", "paper"])
def model(request: pytest.FixtureRequest) -> VIOLearner:
    torch.manual_seed(0)
    return VIOLearner(CONFIGS[request.param]).eval()


def test_estimates_stay_as_they_were(model: VIOLearner) -> None:
    """To a hundredth of the unit of the poses, ten times below what a trained network is off by; bfloat16 or not."""
    given = batch(model.config)
    before, after = estimate(model, given), estimate(for_inference(model), given)
    unit = torch.tensor(model.config.motion_scale)
    for a, b in zip(before.poses[:4], after.poses[:4], strict=True):
        assert ((a - b) / unit).abs().max() < 0.01
    assert ((before.hypotheses - after.hypotheses) / unit).abs().max() < 0.01


def test_without_bfloat16_they_are_the_same_up_to_rounding(model: VIOLearner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "multiplies_bfloat16", lambda: False)
    given = batch(model.config)
    before, after = estimate(model, given), estimate(for_inference(model), given)
    np.testing.assert_allclose(after.hypotheses, before.hypotheses, atol=1e-5)


def test_geometry_and_pose_layers_stay_in_float32(model: VIOLearner) -> None:
    fast = for_inference(model)
    found = estimate(fast, batch(model.config))
    assert {p.dtype for p in (*found.poses, *found.errors, found.hypotheses, found.warped)} == {torch.float32}
    heads = [pathway[-1] for pathway in (*fast.refinements, *fast.hypotheses)]
    parts = (*heads, fast.gyro_pathway, fast.accelerometer_pathway)
    assert {p.dtype for part in parts for p in part.parameters()} == {torch.float32}


def test_the_network_itself_is_left_alone(model: VIOLearner) -> None:
    before = {name: value.clone() for name, value in model.state_dict().items()}
    for_inference(model)
    for name, value in model.state_dict().items():
        assert value.dtype == before[name].dtype
        assert torch.equal(value, before[name])
    assert all(p.requires_grad for p in model.parameters())


def test_the_same_input_gives_the_same_bits(model: VIOLearner) -> None:
    given = batch(model.config)
    one, other = (estimate(for_inference(model), given).hypotheses for _ in range(2))
    assert torch.equal(one, other)
