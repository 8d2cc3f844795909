"""VIOLearner, the whole network (Shamwell, Leung, Nothwang, IROS 2018).

Level 0 reads only the IMU and guesses the motion; levels 1 to 4 each read the Jacobian of the photometric
error with respect to the sampling grid and add a correction; the last level makes four hypotheses, and the
one with the lowest error wins.

Where the paper is silent, or was changed, and why
--------------------------------------------------
Each is a field of `NetworkConfig` or stands at the line named here. "Measured" refers to trainings of a small
network on simulated streets.

* warp: the paper samples the source on the target's grid with the source's depth ("paper"); that optimum is
  biased by some 6 cm. "source_to_target" moves the source's pixels with their own depth, samples the target
  there and compares with the source; it needs the same inputs and is the default of `fast`.
* charbonnier: the squared error of the paper lets few bright edges rule; `fast` takes sqrt(r^2 + c^2).
* contrast: images are scaled to unit mean absolute gradient at every scale, so that a residual is about a
  displacement in pixels and the Jacobian about unit size whatever the camera, the light or the texture.
  "none" leaves intensities in [0, 1] as they are (`paper`).
* jacobian: detached between levels in both presets (training diverged when gradients flowed through it).
* jacobian_widths: one Jacobian cannot tell a small residual on a strong edge from a large one on a weak edge. `fast`
  reads those of two errors, nearly absolute and nearly squared (a Charbonnier c of 0.05 and 2), whose ratio tells:
  after 600 steps the translation error was 0.22 m where it was 0.36 m with one. `paper` has that of its error.
* geometry: the step that lowers the error depends on depth and camera, which d e / d grid does not show. `fast` reads
  each pixel's ray and inverse depth beside the Jacobian, so that one network serves cameras of 60 to 110 degrees.
* passes: levels 1 to 4 are learned steps of descent, and may be taken more than once. Taken twice by a network that was
  trained for once, the median error of simulated pairs fell from 27 to 18 mm and from 1.7 to 1.2 mrad; trained for
  twice, to 14 mm and 1.0 mrad; trained for longer, and taken 3, 3, 3 and 6 times, to 10 mm and 0.75 mrad. `fast` does
  that, and takes each twice while it is trained, where it costs three times as much; `paper` takes each once. Where a
  refinement follows (`learned.refinement`), the network has to say only where to start (`starting_passes`).
* lost_error: pixels that leave the image cost a constant, else a network learns to look away.
* hypotheses: how much they share is not said. Both presets share the three large layers and separate the rest.
* relaxed winner-take-all: losers get a small share of the gradient (`loser_share`), or hypotheses die;
  zero in `paper`, which updates only the winner.
* IMU: the level's motion is proportional to the time from source to target (`motion_scale` is for 0.1 s), so
  that one network serves any frame rate. IMU channels are standardised with statistics kept in the checkpoint.
  The axes of the 20 x 3 input are time x axis; the last map is averaged over time.
* activation LeakyReLU(0.1), no normalisation, padding "same"; extra layers have kernel 3 and stride 2 and a map
  of 1 x 4 is left at every level, which is averaged after the last convolution.
* output scale: poses are predicted in units of `motion_scale`; heads start small and random (zeros would tie
  the hypotheses for ever).
* colour: `paper` compares RGB; `fast` compares luminance, which grey cameras have as well.
* crop: `paper` keeps the lower 224 of 376 rows (where LiDAR has depth); `fast` keeps all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from learned.warp import NEAREST_DEPTH_M, PhotometricError, photometric_error, rotation_matrix

SCALES = (8, 4, 2, 1, 1)
"""Downsampling of the images at levels 0 to 4 (paper, section "Multi-Scale Projections")."""

EXTRA_LAYERS = (0, 2, 3, 4, 5)
"""Additional convolutions of levels 1 to 4 (paper, section "Online Error Correction and Pose Refinement")."""

GEOMETRY_GAINS = (2.0, 4.0, 10.0)
"""Bring rays of an 80 degree camera, and inverse depths of 10 m, to about unit size."""

HYPOTHESES = 4
IMU_SAMPLES = 20
NOMINAL_INTERVAL_S = 0.1


@dataclass(frozen=True)
class NetworkConfig:
    """Everything that shapes the network; stored in the checkpoint."""

    height: int = 64
    width: int = 240
    channels: int = 1
    keep_lower_fraction: float = 1.0
    trunk_filters: int = 32
    extra_filters: int = 48
    imu_filters: tuple[int, int, int, int, int, int, int] = (32, 32, 64, 64, 96, 96, 96)
    warp: Literal["source_to_target", "paper"] = "source_to_target"
    charbonnier: float = 0.3
    contrast: Literal["gradient", "none"] = "gradient"
    jacobian_gain: float = 2.0
    jacobian_widths: tuple[float, ...] = (0.05, 2.0)
    geometry: bool = True
    passes: tuple[int, int, int, int] = (1, 1, 1, 1)
    training_passes: tuple[int, int, int, int] = (1, 1, 1, 1)
    starting_passes: tuple[int, int, int, int] = (1, 1, 1, 1)
    lost_error: float = 2.0
    loser_share: float = 0.1
    motion_scale: tuple[float, float, float, float, float, float] = (0.01, 0.01, 0.01, 0.05, 0.05, 0.5)


PRESETS: dict[str, NetworkConfig] = {
    "fast": NetworkConfig(passes=(3, 3, 3, 6), training_passes=(2, 2, 2, 2), starting_passes=(3, 3, 3, 1)),
    "paper": NetworkConfig(
        height=128,
        width=480,
        channels=3,
        keep_lower_fraction=224 / 376,
        trunk_filters=128,
        extra_filters=128,
        imu_filters=(64, 64, 128, 128, 256, 256, 256),
        warp="paper",
        charbonnier=0.0,
        contrast="none",
        jacobian_gain=10.0,
        jacobian_widths=(),
        geometry=False,
        lost_error=0.1,
        loser_share=0.0,
    ),
}


@dataclass(frozen=True)
class Batch:
    """Input of the network: B pairs.

    source, target (B, C, H, W) in [0, 1]; source_depth (B, H, W) m, 0 where unknown; K (B, 3, 3) in pixels;
    imu (B, 20, 6): angular velocity rad/s and linear acceleration m/s^2, ten samples over the 100 ms before the
    source and ten from source to target, NaN where nothing was measured; interval_s (B,) source to target.
    """

    source: Tensor
    target: Tensor
    source_depth: Tensor
    K: Tensor
    imu: Tensor
    interval_s: Tensor

    def __len__(self) -> int:
        return len(self.source)


@dataclass(frozen=True)
class Estimate:
    """Output of the network. Poses are [alpha, beta, gamma, x, y, z] of theta (see `warp.project`).

    poses: five (B, 6), after levels 0 to 4, the last being the winner's; errors: five (B,), photometric;
    hypotheses (B, 4, 6) and hypothesis_errors (B, 4) of the last level; winner (B,); warped (B, C, H, W).
    """

    poses: list[Tensor]
    errors: list[Tensor]
    hypotheses: Tensor
    hypothesis_errors: Tensor
    winner: Tensor
    warped: Tensor


@dataclass(frozen=True)
class View:
    """One scale of the pyramid: what the warp samples, what it compares with, depth and K at that scale."""

    sampled: Tensor
    reference: Tensor
    depth: Tensor
    K: Tensor

    @cached_property
    def geometry(self) -> Tensor:
        """Where the pixels lie, (B, 3, H, W) of about unit size: ray x/z and y/z, and 1/z (0 if unknown)."""
        height, width = self.depth.shape[-2:]
        K, x, y = self.K[:, :, :, None, None], torch.arange(width), torch.arange(height)
        ray_x = (x.to(K) - K[:, 0, 2]) / K[:, 0, 0]
        ray_y = (y.to(K)[:, None] - K[:, 1, 2]) / K[:, 1, 1]
        known = self.depth > 0
        inverse = torch.where(known, 1 / self.depth.clamp(min=NEAREST_DEPTH_M), torch.zeros_like(self.depth))
        rows = [ray_x.expand(-1, height, -1), ray_y.expand(-1, -1, width), inverse]
        return torch.stack([gain * row for gain, row in zip(GEOMETRY_GAINS, rows, strict=True)], dim=1)


def conv(inputs: int, outputs: int, kernel: int | tuple[int, int], stride: int) -> nn.Sequential:
    """Convolution with "same" padding and its activation."""
    kernel = kernel if isinstance(kernel, tuple) else (kernel, kernel)
    padding = (kernel[0] // 2, kernel[1] // 2)
    return nn.Sequential(nn.Conv2d(inputs, outputs, kernel, stride, padding), nn.LeakyReLU(0.1, inplace=True))


class Head(nn.Module):
    """The 1x1 convolution that ends a pathway, averaged over its map to (B, outputs)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 1)
        nn.init.normal_(self.conv.weight, std=0.3 / inputs**0.5)
        nn.init.zeros_(self.conv.bias)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        """Numbers (B, outputs) from features (B, inputs, h, w)."""
        return self.conv(features).mean((2, 3))  # type: ignore[no-any-return]


class ImuPathway(nn.Sequential):
    """Seven convolutions over (B, 1, 20, 3), time x axis, then three numbers (paper, "IMU Processing")."""

    def __init__(self, filters: tuple[int, ...]) -> None:
        f = filters
        super().__init__(
            conv(1, f[0], (3, 5), 1),  # 20 x 3
            conv(f[0], f[1], (3, 5), 1),  # 20 x 3
            conv(f[1], f[2], (3, 5), 2),  # 10 x 2
            conv(f[2], f[3], (3, 5), 2),  # 5 x 1
            conv(f[3], f[4], (3, 5), 2),  # 3 x 1
            conv(f[4], f[5], (3, 3), 1),
            conv(f[5], f[6], (3, 1), 1),
            Head(f[6], 3),
        )


class Trunk(nn.Sequential):
    """The three large layers on the Jacobian (B, 2, H/s, W/s) of every level, and what else the config adds to it."""

    def __init__(self, config: NetworkConfig) -> None:
        filters = config.trunk_filters
        inputs = 2 * max(1, len(config.jacobian_widths)) + 3 * config.geometry
        super().__init__(conv(inputs, filters, 7, 1), conv(filters, filters, 5, 2), conv(filters, filters, 3, 2))


class Extra(nn.Sequential):
    """The 2 to 5 layers that follow, down to a map of about 1 x 4, and the pose refinement."""

    def __init__(self, config: NetworkConfig, layers: int) -> None:
        widths = [config.trunk_filters] + [config.extra_filters] * layers
        convolutions = [conv(a, b, 3, 2) for a, b in pairwise(widths)]
        super().__init__(*convolutions, Head(widths[-1], 6))


class VIOLearner(nn.Module):
    """The network; `forward` reads like the paper's figure 2."""

    imu_mean: Tensor
    imu_std: Tensor
    motion_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.gyro_pathway = ImuPathway(config.imu_filters)
        self.accelerometer_pathway = ImuPathway(config.imu_filters)
        self.trunks = nn.ModuleList(Trunk(config) for _ in range(4))
        self.refinements = nn.ModuleList(Extra(config, layers) for layers in EXTRA_LAYERS[1:4])
        self.hypotheses = nn.ModuleList(Extra(config, EXTRA_LAYERS[4]) for _ in range(HYPOTHESES))
        self.register_buffer("imu_mean", torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 9.8]))
        self.register_buffer("imu_std", torch.tensor([0.1, 0.1, 0.1, 2.0, 2.0, 2.0]))
        self.register_buffer("motion_scale", torch.tensor(config.motion_scale), persistent=False)

    def forward(self, batch: Batch) -> Estimate:
        """Estimate theta for every pair; the Jacobians are computed in training and inference alike."""
        passes = self.config.training_passes if self.training else self.config.passes
        views = self.pyramid(batch)
        pose = self.level_0(batch.imu, batch.interval_s)
        outcome = self.compare(views[0], pose)
        poses, errors = [pose], [outcome.error]
        for level in (1, 2, 3):
            for remaining in reversed(range(passes[level - 1])):
                features = self.trunks[level - 1](self.trunk_input(outcome, views[level - 1]))
                pose = pose + self.refinements[level - 1](features) * self.motion_scale
                outcome = self.compare(views[level - 1 if remaining else level], pose)
            poses.append(pose)
            errors.append(outcome.error)

        rows = torch.arange(len(batch), device=pose.device)
        for remaining in reversed(range(passes[3])):
            features = self.trunks[3](self.trunk_input(outcome, views[3]))
            corrections = [pathway(features) * self.motion_scale for pathway in self.hypotheses]
            hypotheses = torch.stack([pose + correction for correction in corrections], dim=1)
            outcomes = [self.compare(views[4], hypothesis) for hypothesis in hypotheses.unbind(1)]
            hypothesis_errors = torch.stack([o.error for o in outcomes], dim=1)
            winner = hypothesis_errors.detach().argmin(1)
            pose = hypotheses[rows, winner]
            if remaining:
                outcome = self.compare(views[3], pose)
        poses.append(pose)
        errors.append(hypothesis_errors[rows, winner])
        warped = torch.stack([o.warped for o in outcomes], dim=1)[rows, winner]
        return Estimate(poses, errors, hypotheses, hypothesis_errors, winner, warped)

    def level_0(self, imu: Tensor, interval_s: Tensor) -> Tensor:
        """The motion (B, 6) that the IMU window (B, 20, 6) alone suggests; unmeasured samples read as the mean."""
        standardised = torch.nan_to_num((imu - self.imu_mean) / self.imu_std, nan=0.0)
        gyro, accelerometer = standardised[:, None, :, :3], standardised[:, None, :, 3:]
        rates = torch.cat([self.gyro_pathway(gyro), self.accelerometer_pathway(accelerometer)], dim=1)
        return rates * self.motion_scale * (interval_s / NOMINAL_INTERVAL_S)[:, None]

    def compare(self, view: View, pose: Tensor) -> PhotometricError:
        """Error and Jacobian of a pose at one scale."""
        c = self.config
        return photometric_error(
            view.sampled, view.reference, view.depth, view.K, pose, c.charbonnier, c.lost_error, c.jacobian_widths
        )

    def trunk_input(self, outcome: PhotometricError, view: View) -> Tensor:
        """The Jacobian (B, 2 n, H, W) at about unit size, and the geometry (B, 3, H, W) if the config asks for it."""
        jacobian = outcome.jacobian * self.config.jacobian_gain
        return torch.cat([jacobian, view.geometry], dim=1) if self.config.geometry else jacobian

    def pyramid(self, batch: Batch) -> list[View]:
        """The views of the five levels."""
        if self.config.warp == "source_to_target":
            sampled, reference = batch.target, batch.source
        else:
            sampled, reference = batch.source, batch.target
        views = {}
        for scale in sorted(set(SCALES)):
            views[scale] = View(
                self.normalise_contrast(pool_image(sampled, scale)),
                self.normalise_contrast(pool_image(reference, scale)),
                pool_depth(batch.source_depth, scale),
                pool_intrinsics(batch.K, scale),
            )
        return [views[scale] for scale in SCALES]

    def normalise_contrast(self, image: Tensor) -> Tensor:
        """Zero mean and unit mean absolute gradient for each image (B, C, H, W), if the config asks for it."""
        if self.config.contrast == "none":
            return image
        gradient = image.diff(dim=-1).abs().mean((1, 2, 3)) + image.diff(dim=-2).abs().mean((1, 2, 3))
        return (image - image.mean((1, 2, 3), keepdim=True)) / (0.5 * gradient + 1e-3)[:, None, None, None]

    def pose_source_target(self, pose: Tensor) -> Tensor:
        """T_source_target (B, 4, 4) from theta (B, 6): the network's own door to the project's convention.

        The default warp moves source points to the target, theta = T_target_source; the paper's moves the target's
        grid into the source, theta = T_source_target.
        """
        return pose_source_target(pose, self.config.warp)


def pose_source_target(pose: Tensor, warp: str) -> Tensor:
    """See `VIOLearner.pose_source_target`; float64 inside, so that the result is a valid rigid transform."""
    pose = pose.double()
    R, t = rotation_matrix(pose[..., :3].reshape(-1, 3)), pose[..., 3:].reshape(-1, 3, 1)
    if warp == "source_to_target":
        R = R.transpose(1, 2)
        t = -R @ t
    matrix = torch.eye(4, dtype=pose.dtype, device=pose.device).repeat(len(R), 1, 1)
    matrix[:, :3, :3], matrix[:, :3, 3:] = R, t
    return matrix.reshape(*pose.shape[:-1], 4, 4)


def pool_image(image: Tensor, scale: int) -> Tensor:
    """An image (B, C, H, W) at a coarser scale: the mean of its pixels."""
    return image if scale == 1 else functional.avg_pool2d(image, scale)


def pool_depth(depth: Tensor, scale: int) -> Tensor:
    """Depth (B, H, W) at a coarser scale: the mean of the valid inverse depths, since image motion goes with those."""
    if scale == 1:
        return depth
    valid = (depth > 0).to(depth.dtype)
    inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-3), torch.zeros_like(depth))
    share, inverse = (
        functional.avg_pool2d(valid[:, None], scale)[:, 0],
        functional.avg_pool2d(inverse[:, None], scale)[:, 0],
    )
    return torch.where(share > 0, share / inverse.clamp(min=1e-6), torch.zeros_like(share))


def pool_intrinsics(K: Tensor, scale: int) -> Tensor:
    """K (B, 3, 3) of an image whose blocks of scale x scale pixels are averaged; centres at integers."""
    pooled = K / scale
    pooled[:, :2, 2] += 0.5 / scale - 0.5
    pooled[:, 2] = K[:, 2]
    return pooled


def loss(estimate: Estimate, model: VIOLearner, bias_penalty: float) -> Tensor:
    """Sum of the levels' errors plus the L1 penalty on the biases (paper, last equation of section III).

    The last level counts the winner and, relaxed, `loser_share` of the mean of all hypotheses.
    """
    share = model.config.loser_share
    last = (1 - share) * estimate.errors[4] + share * estimate.hypothesis_errors.mean(1)
    total = torch.stack([*estimate.errors[:4], last]).sum(0).mean()
    biases = sum(
        (p.abs().sum() for name, p in model.named_parameters() if name.endswith("bias")), start=total.new_zeros(())
    )
    return total + bias_penalty * biases
