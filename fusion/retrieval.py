"""Which frames may show the same place: keyframes, their local features, and candidates by appearance and by pose.

Local features are SIFT (Lowe, IJCV 2004), compared as RootSIFT (Arandjelovic and Zisserman, CVPR 2012). The appearance
of a keyframe is a VLAD vector (Jegou et al., "Aggregating local image descriptors into compact codes", PAMI 2012) over
a vocabulary learnt from the log itself, so that nothing needs to be shipped or downloaded. Vectors are compared by
brute force, a block of keyframes at a time: one matrix product is faster than an index that only approximates it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from fusion.config import RetrievalConfig
from fusion_io.records import NANOSECONDS, CameraFrame, FloatArray, IntArray, Trajectory
from learned.baselines import grey

MAX_WIDTH = 640
"""Wider images are reduced before local features are looked for."""

FEATURES = 500
"""Local features a keyframe, at most: the strongest."""

WORDS = 64
"""Of the vocabulary."""

LOCAL_SIZE = 32
"""Numbers of a local feature in the vocabulary: its principal components."""

VOCABULARY_FEATURES = 20_000
"""So many features are enough to learn the vocabulary from."""

VOCABULARY_STEPS = 10
"""Of k-means."""

BLOCK = 256
"""Keyframes compared at once."""

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


class Features(NamedTuple):
    """Local features of an image: pixels (N, 2); points (N, 3) m in the camera's frame; descriptors (N, 128)."""

    pixels: Float32
    points: Float32
    descriptors: NDArray[np.uint8]


class Candidate(NamedTuple):
    """Two keyframes, by their indices, that may show the same place; the source is the earlier one."""

    source: int
    target: int


def keyframes(trajectory: Trajectory, config: RetrievalConfig) -> IntArray:
    """The indices (M,) of the keyframes."""
    chosen: list[int] = []
    positions, views = trajectory.poses.translation, trajectory.poses.rotation.as_matrix()
    least_trace = 1.0 + 2.0 * np.cos(np.deg2rad(config.keyframe_angle_deg))
    for i in range(len(trajectory)):
        if chosen:
            moved = np.linalg.norm(positions[i] - positions[chosen[-1]])
            turned = np.sum(views[i] * views[chosen[-1]]) <= least_trace  # trace(R) = 1 + 2 cos(angle)
            if moved < config.keyframe_distance_m and not turned:
                continue
        chosen.append(i)
    return np.array(chosen, dtype=np.int64)


def reduced(frame: CameraFrame) -> CameraFrame:
    """The frame with its image and depth at most `MAX_WIDTH` pixels wide."""
    height, width = frame.image.shape[:2]
    if width <= MAX_WIDTH:
        return frame
    size = MAX_WIDTH, max(1, round(height * MAX_WIDTH / width))
    image = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    depth = None if frame.depth is None else cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return CameraFrame(frame.stamp_ns, image, depth, frame.camera.scaled_to(*size))


def local_features(frame: CameraFrame) -> Features:
    """The features of a frame that have depth; none for a frame without."""
    if frame.depth is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 128), np.uint8))
    keypoints, descriptors = cv2.SIFT.create(nfeatures=FEATURES).detectAndCompute(grey(frame), None)
    pixels = np.array(cv2.KeyPoint.convert(keypoints)).reshape(-1, 2)
    u, v = np.rint(pixels).astype(int).T
    z = frame.depth[v, u]
    known = np.isfinite(z) & (z > 0)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(frame.camera.K).T
    points = (rays * z[:, None])[known].astype(np.float32)
    described = np.zeros((0, 128), np.uint8) if descriptors is None else descriptors.astype(np.uint8)
    return Features(pixels[known], points, described[known])


def root_sift(descriptors: NDArray[np.uint8]) -> Float32:
    """Unit vectors (N, 128) whose products compare the descriptors (N, 128)."""
    values = descriptors.astype(np.float32)
    return np.asarray(np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)))


def appearance(features: Sequence[Features]) -> Float32:
    """What M keyframes look like: vectors (M, WORDS * LOCAL_SIZE), of unit length where there are features.

    The mean over the keyframes is taken off, for what all have in common does not tell them apart.
    """
    vectors = np.zeros((len(features), WORDS * LOCAL_SIZE), np.float32)
    sample = _sample(features)
    if len(sample) < WORDS:
        return vectors
    axes = np.linalg.eigh(np.cov(sample.T))[1][:, -LOCAL_SIZE:].astype(np.float32)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # it keeps its word, which is harmless
        words, _ = kmeans2(sample @ axes, WORDS, iter=VOCABULARY_STEPS, minit="points", rng=np.random.default_rng(0))
    for vector, each in zip(vectors, features, strict=True):
        vector[:] = _vlad(root_sift(each.descriptors) @ axes, words)
    return _unit(vectors - vectors.mean(axis=0))


@dataclass(frozen=True)
class Visits:
    """Where M keyframes are by the trajectory, and which of them may show what an earlier one has seen.

    stamps_ns (M,); seconds (M,); path (M,) m along the trajectory; positions (M, 3) m; forward (M, 3): where the camera
    looks; sigma (M,) m: the largest standard deviation of a position in any direction, 0 where it is unknown.
    """

    config: RetrievalConfig
    stamps_ns: IntArray
    path: FloatArray
    positions: FloatArray
    forward: FloatArray
    sigma: FloatArray

    @classmethod
    def of(cls, trajectory: Trajectory, config: RetrievalConfig) -> Visits:
        """The keyframes of a trajectory."""
        positions = trajectory.poses.translation
        steps = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
        forward = trajectory.poses.rotation.as_matrix()[:, :, 2]
        every = cls(config, trajectory.stamps_ns, np.cumsum(steps), positions, forward, _position_sigma(trajectory))
        return every.only(keyframes(trajectory, config))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def only(self, indices: IntArray) -> Visits:
        """Some of them, in order of time."""
        return Visits(
            self.config,
            self.stamps_ns[indices],
            self.path[indices],
            self.positions[indices],
            self.forward[indices],
            self.sigma[indices],
        )

    @cached_property
    def earlier(self) -> IntArray:
        """So many of the keyframes (M,) are long enough ago to be compared with each."""
        since_ns = self.stamps_ns - round(self.config.min_time_s * NANOSECONDS)
        by_path = np.searchsorted(self.path, self.path - self.config.min_path_m, side="right")
        return np.minimum(by_path, np.searchsorted(self.stamps_ns, since_ns, side="right"))

    def with_partner(self) -> IntArray:
        """The indices of those that another may be near to: the others need no features at all."""
        found = np.zeros(len(self), np.bool_)
        for target in range(len(self)):
            possible = self.possible(target)
            found[: len(possible)] |= possible
            found[target] |= possible.any()
        return np.flatnonzero(found)

    def possible(self, target: int) -> Bools:
        """Which of the earlier keyframes are not further away than the trajectory may be wrong."""
        between = self.path[target] - self.path[: self.earlier[target]]
        return np.asarray(self._distance(target) < self.config.near_m + self.config.max_drift * between)

    def near(self, target: int) -> Bools:
        """Which of the earlier keyframes are near by the trajectory's own covariance, and look the same way."""
        overlap = self.forward[: self.earlier[target]] @ self.forward[target]
        facing = overlap > np.cos(np.deg2rad(self.config.near_angle_deg))
        reach = self.config.near_m + self.config.near_sigmas * self.sigma[target]
        return np.asarray((self._distance(target) < reach) & facing)

    def best_places(self, alike: Float32, allowed: Bools) -> list[int]:
        """The most alike of the earlier keyframes that are allowed, (N,) each, of each place but one."""
        chosen: list[int] = []
        left = np.where(allowed, alike, -np.inf)
        while len(chosen) < self.config.candidates and np.any(left > -np.inf):
            chosen.append(int(np.argmax(left)))
            left[np.abs(self.path[: len(left)] - self.path[chosen[-1]]) < self.config.place_m] = -np.inf
        return chosen

    def _distance(self, target: int) -> FloatArray:
        earlier = self.positions[: self.earlier[target]]
        return np.asarray(np.linalg.norm(earlier - self.positions[target], axis=1))


def candidates(vectors: Float32, visits: Visits) -> Iterator[Candidate]:
    """Pairs of keyframes that may show the same place, in order of their targets; vectors (M, D): what they look like.

    For each keyframe the places that are most alike among all that are possible, and among those that are near.
    """
    for start in range(0, len(vectors), BLOCK):
        block = range(start, min(start + BLOCK, len(vectors)))
        likeness = vectors[block] @ vectors[: visits.earlier[block[-1]]].T
        for target in block:
            alike = likeness[target - start, : visits.earlier[target]]
            allowed = visits.possible(target), visits.near(target)
            found = {source for each in allowed for source in visits.best_places(alike, each)}
            yield from (Candidate(source, target) for source in sorted(found))


def _position_sigma(trajectory: Trajectory) -> FloatArray:
    """The largest standard deviation (N,) of each position in any direction, m; 0 where it is unknown."""
    if trajectory.covariances is None:
        return np.zeros(len(trajectory))
    return np.asarray(np.sqrt(np.linalg.eigvalsh(trajectory.covariances[:, 3:, 3:])[:, -1].clip(min=0.0)))


def _sample(features: Sequence[Features]) -> Float32:
    """Descriptors (K, 128) of all keyframes alike, as unit vectors."""
    total = sum(len(each.descriptors) for each in features)
    stride = max(1, total // VOCABULARY_FEATURES)
    return root_sift(np.concatenate([np.zeros((0, 128), np.uint8), *(each.descriptors[::stride] for each in features)]))


def _vlad(local: Float32, words: Float32) -> Float32:
    """The features' (N, LOCAL_SIZE) sums of differences to the nearest word, each word's sum of unit length, (D,)."""
    sums = np.zeros_like(words)
    if len(local):
        nearest, _ = vq(local, words)
        np.add.at(sums, nearest, local - words[nearest])
    return np.asarray(_unit(_unit(sums).reshape(1, -1))[0])


def _unit(vectors: Float32) -> Float32:
    """Vectors (N, D) of unit length; those that are zero stay so."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
