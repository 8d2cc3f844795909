"""From radiance to the grey levels of a camera: exposure, noise, vignette, blur, gamma, eight bits."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion_io.records import FloatArray
from fusion_io.simulation.textures import Float32

WHITE = 255.0


@dataclass(frozen=True, slots=True)
class ImageModel:
    """What a camera does to the light; the defaults are a fixed exposure with a noise of one grey level.

    brightness: factor on the exposure that would be right. adaptation: the share of the way to the
    right exposure that the gain goes with every frame; wander: standard deviation of what else the
    gain does, as a ratio, and of the black level; step_probability: of a sudden change by about a
    quarter. The level is white * (gain * radiance) ** gamma. read_noise is in grey levels,
    shot_noise too, at white: its variance is proportional to the light. vignette: the light that
    the corners lose. blur_px: of the lens; exposure_s: how long a turning camera smears.
    """

    brightness: float = 1.0
    adaptation: float = 0.0
    wander: float = 0.0
    step_probability: float = 0.0
    gamma: float = 1.0
    gamma_wander: float = 0.0
    read_noise: float = 1.0
    shot_noise: float = 0.0
    vignette: float = 0.0
    blur_px: float = 0.0
    exposure_s: float = 0.0


#: What an ordinary camera on a moving car does.
REAL_CAMERA = ImageModel(
    adaptation=0.15,
    wander=0.01,
    step_probability=0.01,
    gamma=0.9,
    gamma_wander=0.01,
    read_noise=1.0,
    shot_noise=3.0,
    vignette=0.2,
    blur_px=0.3,
    exposure_s=0.005,
)


class Imager:
    """A camera that takes one image after the other; its exposure remembers."""

    def __init__(self, model: ImageModel, K: FloatArray, rng: np.random.Generator) -> None:
        """K (3, 3): of the pinhole camera, pixel centres at integers."""
        self._model, self._K, self._rng = model, K, rng
        self._gain: float | None = None
        self._step = 1.0

    def take(self, radiance: Float32, angular_velocity: FloatArray) -> NDArray[np.uint8]:
        """The image of a radiance, (H, W) or (H, W, 3), seen while turning at (3,) rad/s, camera axes."""
        model, rng = self._model, self._rng
        light = self._vignetted(self._blurred(radiance, angular_velocity))
        right = model.brightness * exposure(light)
        self._gain = right if self._gain is None else self._gain * (right / self._gain) ** model.adaptation
        if rng.random() < model.step_probability:
            self._step = float(np.exp(rng.normal(0.0, 0.25)))
        self._step **= 1.0 - model.adaptation  # which the automatic exposure takes back
        gain = self._gain * self._step * (1.0 + model.wander * rng.standard_normal())
        level = light * np.float32(gain)
        variance = (model.read_noise / WHITE) ** 2 + (model.shot_noise / WHITE) ** 2 * level
        level += np.sqrt(variance, dtype=np.float32) * rng.standard_normal(level.shape, np.float32)
        level += np.float32(0.4 * model.wander * rng.standard_normal())
        gamma = model.gamma * (1.0 + model.gamma_wander * rng.standard_normal())
        level = np.clip(level, 0.0, 1.0, out=level)
        if gamma != 1.0:
            level = np.asarray(cv2.pow(level, gamma), np.float32)
        return np.asarray(np.rint(level * np.float32(WHITE)), np.uint8)

    def _blurred(self, radiance: Float32, angular_velocity: FloatArray) -> Float32:
        if self._model.blur_px > 0.15:  # less is nothing
            radiance = np.asarray(cv2.GaussianBlur(radiance, (0, 0), self._model.blur_px), np.float32)
        wx, wy, _ = angular_velocity * self._model.exposure_s
        smear = np.array([-self._K[0, 0] * wy, self._K[1, 1] * wx])  # pixels, in the middle of the image
        if np.hypot(*smear) < 0.3:
            return radiance
        return np.asarray(cv2.filter2D(radiance, -1, smear_kernel(smear), borderType=cv2.BORDER_REPLICATE), np.float32)

    def _vignetted(self, radiance: Float32) -> Float32:
        """Darker with the square of the distance from the middle."""
        if self._model.vignette == 0.0:
            return radiance
        y, x = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in radiance.shape[:2])
        fall = 1.0 - np.float32(0.5 * self._model.vignette) * (x * x + (y * y)[:, None])
        return np.asarray(radiance * (fall if radiance.ndim == 2 else fall[..., None]))


def smear_kernel(smear_px: FloatArray) -> Float32:
    """The mean over a straight line of (2,) pixels, centred, as a kernel (n, n), n odd."""
    radius = int(np.ceil(0.5 * np.abs(smear_px).max()))
    kernel = np.zeros((2 * radius + 3, 2 * radius + 3), np.float32)
    count = 4 * radius + 5
    places = ((np.arange(count)[:, None] + 0.5) / count - 0.5) * smear_px + radius + 1
    whole = np.floor(places).astype(int)
    part = places - whole
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            np.add.at(kernel, (whole[:, 1] + dy, whole[:, 0] + dx), weight)
    return np.asarray(kernel / kernel.sum(), np.float32)


def exposure(radiance: Float32) -> float:
    """The gain that an automatic exposure picks: the median goes a bit below mid grey."""
    return 0.42 / max(float(np.median(radiance)), 1e-3)
