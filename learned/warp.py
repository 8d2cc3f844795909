"""View synthesis: projection, bilinear sampling, and the Jacobian of the photometric error.

Shapes: B pairs, C channels, H x W pixels. Pixel centres are at integer coordinates; grids are pixel
coordinates (x, y). Everything here is geometry and must run in float32 or better: in bfloat16 a matrix
product moves pixels by up to 2.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

NEAREST_DEPTH_M = 0.1
"""Points closer than this to the camera plane, or behind it, are not visible."""


def rotation_matrix(angles: Tensor) -> Tensor:
    """R = Rz(gamma) Ry(beta) Rx(alpha), (B, 3, 3), from angles (B, 3) = [alpha, beta, gamma] in rad.

    Source: paper, section "3D Affine Transformations", equations for Rx, Ry, Rz and R.
    """
    (ca, cb, cg), (sa, sb, sg) = torch.cos(angles).unbind(-1), torch.sin(angles).unbind(-1)
    rows = [
        torch.stack([cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa], dim=-1),
        torch.stack([sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa], dim=-1),
        torch.stack([-sb, cb * sa, cb * ca], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def project(depth: Tensor, K: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Move the pixels of a grid through space and into the other image.

    depth (B, H, W) m, 0 where unknown; K (B, 3, 3); pose (B, 6) = [alpha, beta, gamma, x, y, z], the
    transform theta. Returns the grid (B, H, W, 2) of pixel coordinates K theta (depth K^-1 p), and the
    mask (B, H, W) of pixels that have depth and land inside the image, in front of the camera.
    """
    height, width = depth.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=depth.dtype, device=depth.device),
        torch.arange(width, dtype=depth.dtype, device=depth.device),
        indexing="ij",
    )
    pixels = torch.stack([x, y, torch.ones_like(x)]).reshape(3, -1)
    # K R K^-1 p d + K t: three numbers a pixel, so the 3x3 products are done once a pair.
    H = K @ rotation_matrix(pose[:, :3]) @ torch.linalg.inv(K)
    points = (H @ pixels) * depth.reshape(len(depth), 1, -1) + K @ pose[:, 3:, None]
    z = points[:, 2]
    in_front = z > NEAREST_DEPTH_M
    grid = points[:, :2] / torch.where(in_front, z, torch.ones_like(z))[:, None]
    inside = (grid[:, 0] >= 0) & (grid[:, 0] <= width - 1) & (grid[:, 1] >= 0) & (grid[:, 1] <= height - 1)
    visible = in_front & inside & (depth.reshape(len(depth), -1) > 0)
    return grid.transpose(1, 2).reshape(*depth.shape, 2), visible.reshape(depth.shape)


def sample(image: Tensor, grid: Tensor) -> Tensor:
    """Bilinear samples (B, C, H', W') of an image (B, C, H, W) at a grid (B, H', W', 2), differentiable by the grid.

    Beyond the border they are those of the border. Source: paper, equation 1.
    """
    height, width = image.shape[-2:]
    # Of a network that has diverged: no place in the image.
    span = grid.new_tensor([max(width - 1, 1), max(height - 1, 1)])
    normalised = 2 * grid.nan_to_num() / span - 1
    return functional.grid_sample(image, normalised, align_corners=True, padding_mode="border")


def sample_gradients(image: Tensor, grid: Tensor) -> Tensor:
    """Derivatives (B, C, H', W', 2) of the samples by (x, y); at a pixel's centre those to its right and below.

    Along x it is the difference of two neighbours, blended along y, and the other way round.
    Source: paper, equations 2 and 3 (the sub-gradients of a spatial transformer).
    """
    height, width = image.shape[-2:]
    x, y = grid.unbind(-1)
    left, top = x.floor().clamp(0, width - 2), y.floor().clamp(0, height - 2)
    along_x = sample(image.diff(dim=-1), torch.stack([left, y], dim=-1))
    along_y = sample(image.diff(dim=-2), torch.stack([x, top], dim=-1))
    return torch.stack([along_x, along_y], dim=-1)


@dataclass(frozen=True)
class PhotometricError:
    """The error of one warp.

    error (B,); warped (B, C, H, W), the reconstruction; and of what the Jacobian is made, detached: the image that was
    sampled, the grid (B, H, W, 2), residual (B, C, H, W), visible (B, H, W) and the errors' n widths.
    """

    error: Tensor
    warped: Tensor
    sampled: Tensor
    grid: Tensor
    residual: Tensor
    visible: Tensor
    widths: tuple[float, ...]

    @cached_property
    def jacobian(self) -> Tensor:
        """Derivative d e / d grid (B, 2 n, H, W) of each pixel's error e, zero where nothing is visible.

        Closed form, (d e / d r) . (d r / d grid); made when asked for, since the last level's poses need none.
        """
        seen = sample_gradients(self.sampled, self.grid) * self.visible[:, None, ..., None]
        slopes = [d_error_d_residual(self.residual, width) for width in self.widths]
        return torch.cat([(slope[..., None] * seen).sum(1) for slope in slopes], dim=-1).permute(0, 3, 1, 2)


def photometric_error(
    sampled: Tensor,
    reference: Tensor,
    depth: Tensor,
    K: Tensor,
    pose: Tensor,
    charbonnier: float,
    lost_error: float,
    jacobian_widths: tuple[float, ...] = (),
) -> PhotometricError:
    """Sample one image where the other's pixels go under the pose, and compare.

    sampled, reference (B, C, H, W); depth (B, H, W) of the pixels that are moved; K, pose as in `project`.
    A pixel's error is the Charbonnier norm sqrt(|r|^2 + c^2) - c of its colour difference r or, with c = 0,
    the squared Euclidean norm |r|^2 (paper, equation 4). The pair's error is the mean over the pixels with
    depth; a pixel that leaves the image costs `lost_error`, so that looking away earns nothing.
    The Jacobian is that of the error itself or, if `jacobian_widths` names some, of the Charbonnier errors
    with those c.
    """
    grid, visible = project(depth, K, pose)
    warped = sample(sampled, grid)
    residual = warped - reference
    squared = residual.square().sum(1)
    pixel_error = torch.sqrt(squared + charbonnier**2) - charbonnier if charbonnier > 0 else squared

    has_depth = (depth > 0).sum((1, 2)).clamp(min=1)
    lost = has_depth - visible.sum((1, 2))
    error = ((pixel_error * visible).sum((1, 2)) + lost_error * lost) / has_depth
    widths = jacobian_widths or (charbonnier,)
    return PhotometricError(error, warped, sampled, grid.detach(), residual.detach(), visible, widths)


def d_error_d_residual(residual: Tensor, charbonnier: float) -> Tensor:
    """Derivative of a pixel's error with respect to its colour difference (B, C, H, W)."""
    if charbonnier > 0:
        return residual / torch.sqrt(residual.square().sum(1, keepdim=True) + charbonnier**2)
    return 2 * residual
