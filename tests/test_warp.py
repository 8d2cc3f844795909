"""Laws of view synthesis: projection, sampling, and the closed-form Jacobian."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from learned.warp import photometric_error, project, rotation_matrix, sample

B, C, H, W = 3, 2, 12, 20


@pytest.fixture
def scene() -> dict[str, torch.Tensor]:
    """Random images with depth (some of it unknown), a camera and small motions, in float64."""
    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 4 + 6 * rand(B, H, W)
    depth[rand(B, H, W) < 0.1] = 0
    K = torch.tensor([[15.0, 0, 9.3], [0, 14.0, 5.6], [0, 0, 1]], dtype=torch.float64).repeat(B, 1, 1)
    scale = torch.tensor([0.05] * 3 + [0.3] * 3)
    return {
        "sampled": rand(B, C, H, W),
        "reference": rand(B, C, H, W),
        "depth": depth,
        "K": K,
        "pose": (rand(B, 6) - 0.5) * scale,
    }


def test_rotation_is_rz_ry_rx() -> None:
    angles = torch.tensor([[0.3, -0.4, 0.7], [0.0, 0.0, 0.0], [1e-7, -1e-7, 1e-7]], dtype=torch.float64)
    expected = Rotation.from_euler("xyz", angles.numpy()).as_matrix()  # extrinsic x, y, z is Rz Ry Rx
    np.testing.assert_allclose(rotation_matrix(angles).numpy(), expected, atol=1e-15)


def test_projection_is_the_pinhole_model(scene: dict[str, torch.Tensor]) -> None:
    grid, visible = project(scene["depth"], scene["K"], scene["pose"])
    K, depth, pose = (scene[name].numpy() for name in ("K", "depth", "pose"))
    b, v, u = 1, 4, 13
    point = depth[b, v, u] * np.linalg.inv(K[b]) @ [u, v, 1]
    moved = K[b] @ (rotation_matrix(scene["pose"][:, :3])[b].numpy() @ point + pose[b, 3:])
    np.testing.assert_allclose(grid[b, v, u].numpy(), moved[:2] / moved[2], atol=1e-12)
    assert not visible[scene["depth"] == 0].any()


def test_zero_motion_is_the_identity(scene: dict[str, torch.Tensor]) -> None:
    grid, visible = project(scene["depth"], scene["K"], torch.zeros(B, 6, dtype=torch.float64))
    values = sample(scene["sampled"], grid)
    seen = (visible & (scene["depth"] > 0))[:, None].expand_as(values)
    np.testing.assert_allclose(values[seen].numpy(), scene["sampled"][seen].numpy(), atol=1e-12)


def test_samples_are_bilinear(scene: dict[str, torch.Tensor]) -> None:
    """Between centres they blend linearly; beyond the border, and at places that are no number, they stay inside."""
    ramp = torch.arange(W, dtype=torch.float64) + 10 * torch.arange(H, dtype=torch.float64)[:, None]
    places = torch.tensor([[3.25, 4.5], [0.0, 0.0], [W - 1, H - 1], [-5.0, 2.5], [3.5, H + 7.0], [torch.nan, 1.0]])
    values = sample(ramp[None, None], places.double()[None, None])[0, 0, 0]
    np.testing.assert_allclose(values.numpy(), [48.25, 0.0, 10 * (H - 1) + W - 1, 25.0, 10 * (H - 1) + 3.5, 10.0])


@pytest.mark.parametrize("charbonnier", [0.0, 0.3])
def test_closed_form_jacobian_equals_autograd(scene: dict[str, torch.Tensor], charbonnier: float) -> None:
    """d E / d G of the sum of pixel errors, through sampling, for the squared and the Charbonnier error."""
    grid, visible = project(scene["depth"], scene["K"], scene["pose"])
    grid = grid.detach().requires_grad_()
    values = sample(scene["sampled"], grid)
    squared = (values - scene["reference"]).square().sum(1)
    pixel_error = torch.sqrt(squared + charbonnier**2) if charbonnier else squared
    (expected,) = torch.autograd.grad((pixel_error * visible).sum(), grid)
    outcome = photometric_error(**scene, charbonnier=charbonnier, lost_error=1.0)
    np.testing.assert_allclose(outcome.jacobian.permute(0, 2, 3, 1).numpy(), expected.numpy(), atol=1e-12)
    assert not outcome.jacobian.requires_grad


def test_jacobian_works_in_inference_mode(scene: dict[str, torch.Tensor]) -> None:
    expected = photometric_error(**scene, charbonnier=0.3, lost_error=1.0).jacobian
    with torch.inference_mode():
        actual = photometric_error(**scene, charbonnier=0.3, lost_error=1.0).jacobian
    np.testing.assert_array_equal(actual.numpy(), expected.numpy())


def test_error_gradient_equals_finite_differences(scene: dict[str, torch.Tensor]) -> None:
    """The gradient that trains the network: d error / d pose."""
    pose = scene.pop("pose").requires_grad_()
    error = photometric_error(**scene, pose=pose, charbonnier=0.3, lost_error=0.0).error.sum()
    (gradient,) = torch.autograd.grad(error, pose)
    step = 1e-7
    for b, k in [(0, 0), (1, 3), (2, 5)]:
        ahead, behind = pose.detach().clone(), pose.detach().clone()
        ahead[b, k] += step
        behind[b, k] -= step
        e = [photometric_error(**scene, pose=p, charbonnier=0.3, lost_error=0.0).error.sum() for p in (ahead, behind)]
        np.testing.assert_allclose(float(gradient[b, k]), float(e[0] - e[1]) / (2 * step), rtol=1e-5)


def test_looking_away_is_not_rewarded(scene: dict[str, torch.Tensor]) -> None:
    """A pose under which nothing is visible costs the full price of lost pixels."""
    away = scene["pose"].clone()
    away[:, 0] = 3.0
    error = photometric_error(**(scene | {"pose": away}), charbonnier=0.3, lost_error=2.0).error
    np.testing.assert_allclose(error.numpy(), 2.0, atol=1e-12)
