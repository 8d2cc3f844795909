"""Refinement of a pair to the photometric optimum at the image's full resolution.

The network is a learned optimiser; here follow Gauss-Newton steps on the same error, source pixels moved by their
depth into the target, but over selected pixels of the full image, with robust weights and an affine brightness:

    r = I_target(pi(theta p)) - (gain I_source(p) + offset),   p the source's points with depth

Steps are those of efficient second-order minimisation (Malis, "Improving vision-based control using efficient
second-order minimization techniques", ICRA 2004): the mean of the gradients of both images. Weights are Student's t
(Kerl, Sturm, Cremers, "Robust odometry estimation for RGB-D cameras", ICRA 2013). The network's estimate is the
prior, so that directions which the image does not show stay where the network left them; it too has Student's tails,
or a network that is surer than it should be would hold on to its error.

What is difficult are pairs that start too far away: the coarsest scale is therefore tried from several starts, and
the lowest error goes on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform
from torch import Tensor
from torch.nn import functional

from fusion_io.records import CameraFrame, FloatArray
from learned.warp import NEAREST_DEPTH_M

POINTS = 4096
"""About so many source pixels take part: the steepest of each cell of a grid."""

LEAST_GRADIENT = 2.0
"""Grey levels a pixel: less is noise, and says nothing about motion."""

LEAST_WITHIN, GAP = 0.5, 9
"""Depth is sparse where less than this share of it has depth all about it; then it has gaps of up to so many pixels."""

COARSEST_WIDTH = 120
"""Images are halved while they stay at least this wide."""

COARSE_STEPS, FINE_STEPS = 6, 3
"""Gauss-Newton steps at the coarsest scale and at each finer one."""

COARSE_SHARE = 4
"""At the coarsest scale every so many-th point is enough."""

DEGREES_OF_FREEDOM = 5.0
"""Of Student's t (Kerl et al., section III-B)."""

MEDIAN_SHARE = 4
"""Every so many-th residual is enough for their median."""

LEAST_SIGMA = 1.0
"""Residuals' standard deviation in grey levels is at least this: images are quantised."""

CORRELATED = 16.0
"""Neighbouring residuals share their causes (depth, interpolation, light): the points count for so many times fewer."""

LIGHT_SIGMA = (0.5, 100.0)
"""Prior of gain and offset (grey levels) about 1 and 0: wide, but an image without texture has nothing better."""

CONVERGED = 1e-5
"""Steps smaller than this, in rad and m, change nothing."""


class Points(NamedTuple):
    """Source pixels that take part: pixel (2, N) at full resolution; point (3, N) m in the source camera; used (N,)."""

    pixel: Tensor
    point: Tensor
    used: Tensor


@dataclass(frozen=True)
class FullFrame:
    """A frame at full resolution: K (3, 3), points (None without depth), and a pyramid.

    images (3, H/s, W/s) for s = 1, 2, 4, ...: grey levels, and their gradients along x and y.
    """

    images: list[Tensor]
    points: Points | None
    K: Tensor


@dataclass(frozen=True)
class Refined:
    """Result for B pairs.

    T_source_target (B, 4, 4); covariance (B, 6, 6), uncalibrated, rotation first, right perturbation;
    improved (B,): whether the error is below that of the start, otherwise the start is returned.
    """

    T_source_target: FloatArray
    covariance: FloatArray
    improved: NDArray[np.bool_]


def prepare_full(frame: CameraFrame) -> FullFrame:
    """The pyramid and the points of a frame."""
    image = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
    images = [image.astype(np.float32)]
    while images[-1].shape[1] >= 2 * COARSEST_WIDTH and images[-1].shape[0] >= 32:
        height, width = (size // 2 for size in images[-1].shape)
        halved = cv2.resize(images[-1][: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        images.append(np.asarray(halved, np.float32))
    points = None if frame.depth is None else select_points(image, frame.depth, frame.camera.K)
    return FullFrame([with_gradients(i) for i in images], points, torch.from_numpy(frame.camera.K))


def with_gradients(image: NDArray[np.float32]) -> Tensor:
    """An image (H, W) and its central differences along x and y, (3, H, W).

    Central, because a one-sided difference shares a pixel's noise with the residual, and the sum over many pixels of
    their product moves every estimate the same way (by 0.03 pixels, a tenth of a milliradian a pair).
    """
    planes = np.empty((3, *image.shape), np.float32)
    planes[0] = image
    for plane, order in zip(planes[1:], ((1, 0), (0, 1)), strict=True):
        cv2.Sobel(image, cv2.CV_32F, *order, dst=plane, ksize=1, scale=0.5)
    return torch.from_numpy(planes)


def select_points(image: NDArray[np.uint8], depth: NDArray[np.float32], K: FloatArray) -> Points:
    """The pixel with the steepest gradient of every cell, if it has depth, inside of what has, and is steep enough."""
    steepness = np.add(*(np.abs(along) for along in cv2.spatialGradient(image)))  # eight times that of Sobel, int16
    steepness *= inside(depth > NEAREST_DEPTH_M)  # false for NaN as well
    cell = max(1, round((image.size / POINTS) ** 0.5))
    steepest, index = functional.max_pool2d(torch.from_numpy(steepness).float()[None], cell, return_indices=True)
    index = index.flatten()
    pixel = torch.stack([index % image.shape[1], index // image.shape[1]]).float()
    used = steepest.flatten() > 8 * LEAST_GRADIENT
    z = torch.from_numpy(np.nan_to_num(depth.ravel()[index.numpy()], nan=1.0, posinf=1.0)).clamp(min=NEAREST_DEPTH_M)
    ray = (pixel - torch.from_numpy(K[:2, 2:]).float()) / torch.from_numpy(K[[0, 1], [0, 1]])[:, None].float()
    return Points(pixel, torch.cat([ray * z, z[None]]), used)


def inside(measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which pixels (H, W) have depth, as has all about them.

    Beside what has none, the sky for one, a pixel shows two surfaces, and its edge moves with the brightness of either.
    It would turn every estimate the same way (on rendered streets by 0.1 mrad, four times what is left). Where depth is
    sparse there are gaps everywhere, which mean nothing.
    """
    around, gaps = np.ones((3, 3), np.uint8), np.ones((GAP, GAP), np.uint8)
    regions = measured.astype(np.uint8)
    within = regions & cv2.erode(regions, around)
    if within.sum() < LEAST_WITHIN * regions.sum():
        within = regions & cv2.erode(cv2.morphologyEx(regions, cv2.MORPH_CLOSE, gaps), around)
    return np.asarray(within, np.bool_)


def refine(
    pairs: Sequence[tuple[FullFrame, FullFrame]], starts: FloatArray, prior: FloatArray, others: FloatArray
) -> Refined:
    """Refine B pairs whose images have the same size; sources must have depth.

    starts (B, 4, 4): T_source_target of the network; prior (B, 6, 6): its covariance; others (M, B, 4, 4): further
    starts, tried at the coarsest scale.
    """
    coarsest = len(pairs[0][0].images) - 1
    problem = Problem(pairs, starts, prior, range(coarsest + 1))
    start = problem.state(coarsest, inverse(starts))
    state = search([*pairs], starts, prior, np.concatenate([starts[None], others]), coarsest)
    for level in range(coarsest, -1, -1):
        state = problem.descend(level, state, FINE_STEPS)
    improved = problem.cost(0, state) < problem.cost(0, start)
    T_target_source = torch.where(improved[:, None, None], state.T_target_source, start.T_target_source)
    information, _ = problem.linearise(0, State(T_target_source, state.light))
    covariance = torch.linalg.inv(information)[:, :6, :6]
    return Refined(inverse(T_target_source.numpy()), covariance.numpy(), improved.numpy())


def search(
    pairs: list[tuple[FullFrame, FullFrame]], starts: FloatArray, prior: FloatArray, begins: FloatArray, level: int
) -> State:
    """The best state at the coarsest scale from several begins (M, B, 4, 4), all of them descended at once."""
    count, size = len(begins), len(pairs)
    repeated = np.tile(starts, (count, 1, 1)), np.tile(prior, (count, 1, 1))
    problem = Problem(pairs * count, *repeated, [level], COARSE_SHARE)
    found = problem.descend(level, problem.state(level, inverse(begins.reshape(-1, 4, 4))), COARSE_STEPS)
    best = problem.cost(level, found).reshape(count, size).argmin(0) * size + torch.arange(size)
    return State(found.T_target_source[best], found.light[best])


class State(NamedTuple):
    """What is estimated, float64: T_target_source (B, 4, 4); light (B, 2), gain and offset in grey levels."""

    T_target_source: Tensor
    light: Tensor


class Level(NamedTuple):
    """One scale: B targets (3, h, w), and the source at its points, (B, 3, N): value and gradients."""

    targets: list[Tensor]
    own: Tensor


class Problem:
    """B pairs as least squares over theta = T_target_source, perturbed on the left, and the light."""

    def __init__(
        self,
        pairs: Sequence[tuple[FullFrame, FullFrame]],
        starts: FloatArray,
        prior: FloatArray,
        levels: Iterable[int],
        share: int = 1,
    ) -> None:
        """For the given scales, with every `share`-th point; starts and prior as in `refine`."""
        points = [source.points for source, _ in pairs if source.points is not None]
        pixel, self.point, self.used = (torch.stack(v)[..., ::share] for v in zip(*points, strict=True))
        self.K = torch.stack([source.K for source, _ in pairs])
        self.starts = RigidTransform.from_matrix(starts)
        self.prior_information = torch.linalg.inv(torch.from_numpy(prior))
        self.levels = {
            level: Level(
                [target.images[level] for _, target in pairs],
                interpolate([source.images[level] for source, _ in pairs], at_level(pixel, level)),
            )
            for level in levels
        }

    def state(self, level: int, T_target_source: FloatArray) -> State:
        """The state at a pose, with the light that fits best there at a scale."""
        T = torch.from_numpy(T_target_source)
        view = self.look(level, T)
        weight = view.visible.double()
        x, y = self.levels[level].own[:, 0].double(), view.values.double()
        count = weight.sum(1).clamp(min=1)
        mean_x, mean_y = (weight * x).sum(1) / count, (weight * y).sum(1) / count
        dx, dy = x - mean_x[:, None], y - mean_y[:, None]
        gain = ((weight * dx * dy).sum(1) + count) / ((weight * dx * dx).sum(1) + count)
        gain = gain.clamp(0.5, 2.0)
        return State(T, torch.stack([gain, mean_y - gain * mean_x], dim=1))

    def descend(self, level: int, state: State, steps: int) -> State:
        """Gauss-Newton steps at a scale."""
        for _ in range(steps):
            information, gradient = self.linearise(level, state)
            step = -torch.linalg.solve(information, gradient)
            turn = torch.from_numpy(RigidTransform.from_exp_coords(step[:, :6].numpy()).as_matrix())
            state = State(turn @ state.T_target_source, state.light + step[:, 6:])
            if step[:, :6].abs().max() < CONVERGED:
                break
        return state

    def linearise(self, level: int, state: State) -> tuple[Tensor, Tensor]:
        """Information (B, 8, 8) and gradient (B, 8) of the objective at a state: rotation, translation, light."""
        view = self.look(level, state.T_target_source)
        values, own = self.levels[level].own[:, 0], self.levels[level].own[:, 1:]
        gain, offset = state.light[:, :1].float(), state.light[:, 1:].float()
        residual = view.values - gain * values - offset
        sigma = scale(residual, view.visible)
        weight = (DEGREES_OF_FREEDOM + 1) / (DEGREES_OF_FREEDOM + (residual / sigma).square())
        weight = weight * view.visible / (CORRELATED * sigma.square())

        gradients = 0.5 * (view.gradients + gain[..., None] * own)
        jacobian = self.jacobian(level, view, gradients, values)
        weighted = jacobian * weight[:, None]
        information = (weighted @ jacobian.transpose(1, 2)).double()
        gradient = (weighted @ residual[..., None])[..., 0].double()

        moved = self.starts.inv() * RigidTransform.from_matrix(state.T_target_source.numpy()).inv()
        off = torch.from_numpy(moved.as_exp_coords())  # a step on the left of theta takes away from this
        pull = (self.prior_information @ off[..., None])[..., 0]
        weight = ((DEGREES_OF_FREEDOM + 6) / (DEGREES_OF_FREEDOM + (off * pull).sum(1))).clamp(max=1)
        information[:, :6, :6] += weight[:, None, None] * self.prior_information
        gradient[:, :6] -= weight[:, None] * pull
        light_information = torch.tensor(LIGHT_SIGMA, dtype=torch.float64) ** -2
        information[:, 6:, 6:] += torch.diag(light_information)
        gradient[:, 6:] += light_information * (state.light - torch.tensor([1.0, 0.0]))
        return information, gradient

    def jacobian(self, level: int, view: View, gradients: Tensor, values: Tensor) -> Tensor:
        """The residuals' derivatives with respect to rotation, translation, gain and offset, (B, 8, N).

        gradients (B, 2, N): of the image at this scale; values (B, N): of the source.
        """
        K = self.K.float()
        gx = gradients[:, 0] * (K[:, 0, 0, None] / 2**level)
        gy = gradients[:, 1] * (K[:, 1, 1, None] / 2**level)
        x, y, inverse_z = view.x, view.y, view.inverse_z
        gz = -(gx * x + gy * y)  # d residual / d point' = (gx, gy, gz) / z;  d point' / d step = (-[point']x, 1)
        rotation = [y * gz - gy, gx - x * gz, x * gy - y * gx]
        translation = [gx * inverse_z, gy * inverse_z, gz * inverse_z]
        return torch.stack([*rotation, *translation, -values, torch.full_like(values, -1.0)], dim=1)

    def cost(self, level: int, state: State) -> Tensor:
        """A robust mean (B,) of the residuals in pixels of displacement; points out of view cost a pixel.

        Comparable between the states of a pair, unlike the objective, whose scale is estimated anew at each.
        """
        view = self.look(level, state.T_target_source)
        used = self.used
        values, own = self.levels[level].own[:, 0], self.levels[level].own[:, 1:]
        residual = view.values - state.light[:, :1].float() * values - state.light[:, 1:].float()
        count = used.sum(1).clamp(min=1)
        unit = ((own.abs().sum(1) * used).sum(1) / count).clamp(min=LEAST_GRADIENT)
        pixels = torch.where(view.visible, residual / unit[:, None], torch.ones_like(residual))
        return (torch.log1p(pixels.square()) * used).sum(1) / count

    def look(self, level: int, T_target_source: Tensor) -> View:
        """Where the points land in the target, and what is seen there."""
        T, images = T_target_source.float(), self.levels[level].targets
        x, y, z = (T[:, :3, :3] @ self.point + T[:, :3, 3:]).unbind(1)
        inverse_z = 1 / z.clamp(min=NEAREST_DEPTH_M)
        x, y = x * inverse_z, y * inverse_z
        K = self.K.float()
        column, row = K[:, 0, 0, None] * x + K[:, 0, 2, None], K[:, 1, 1, None] * y + K[:, 1, 2, None]
        column, row = at_level(column, level), at_level(row, level)
        height, width = images[0].shape[-2:]
        inside = (column >= -0.5) & (row >= -0.5) & (column <= width - 0.5) & (row <= height - 0.5)
        seen = interpolate(images, torch.stack([column, row], dim=1))
        return View(seen[:, 0], seen[:, 1:], inside & self.used & (z > NEAREST_DEPTH_M), x, y, inverse_z)


class View(NamedTuple):
    """The target at the points: values (B, N), gradients (B, 2, N), visible (B, N); x/z, y/z and 1/z of the points."""

    values: Tensor
    gradients: Tensor
    visible: Tensor
    x: Tensor
    y: Tensor
    inverse_z: Tensor


def inverse(T: FloatArray) -> FloatArray:
    """The inverses of poses (B, 4, 4)."""
    return np.asarray(np.linalg.inv(T), np.float64)


def interpolate(images: list[Tensor], pixel: Tensor) -> Tensor:
    """Bilinear samples (B, C, N) of B images (C, H, W) at pixels (B, 2, N); beyond the border, of the border."""
    height, width = images[0].shape[-2:]
    grid = torch.stack(  # -1 and 1 are the outermost centres
        [pixel[:, 0] * (2 / (width - 1)) - 1, pixel[:, 1] * (2 / (height - 1)) - 1], dim=2
    )
    return torch.stack(
        [  # image by image: to stack full images costs more than to sample them
            functional.grid_sample(image[None], g[None, None], align_corners=True, padding_mode="border")[0, :, 0]
            for image, g in zip(images, grid, strict=True)
        ]
    )


def at_level(pixel: Tensor, level: int) -> Tensor:
    """Full-resolution pixel coordinates in an image halved `level` times; centres at integers."""
    return (pixel + 0.5) / 2.0**level - 0.5


def scale(residual: Tensor, visible: Tensor) -> Tensor:
    """A robust standard deviation (B, 1) of the visible residuals (B, N), from their median size."""
    sizes = torch.where(visible, residual.abs(), torch.full_like(residual, torch.nan))
    median = sizes[:, ::MEDIAN_SHARE].nanmedian(1, keepdim=True).values.nan_to_num(LEAST_SIGMA)
    sigma: Tensor = (1.4826 * median).clamp(min=LEAST_SIGMA)
    return sigma
