"""Writing logs: MCAP with zstd chunks, checksums and an index, atomically and in order of time."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion_io import messages, topics
from fusion_io.errors import LogError
from fusion_io.messages import (
    CAMERA_FRAME,
    ENU_FRAME,
    IMU_FRAME,
    WORLD_FLU_FRAME,
    WORLD_FRAME,
    FrameTransform,
    ImuSample,
    PoseSample,
)
from fusion_io.records import (
    CameraFrame,
    CameraInfo,
    EstimatorSeries,
    FloatArray,
    GnssFix,
    ImuSeries,
    PairEstimate,
    Trajectory,
)

CHUNK_BYTES = 1 << 20
# Images that wait for others with an earlier stamp: ten frames of image, depth and camera info.
WAITING_IMAGES = 30

_IDENTITY_WXYZ = np.array([1.0, 0.0, 0.0, 0.0])
_FLU_FROM_OPTICAL_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])
_OPTICAL_FROM_FLU_WXYZ = np.array([0.5, 0.5, -0.5, 0.5])


class _Message(NamedTuple):
    """A message that waits for its turn; ``order`` is unique, so that a heap never compares beyond it."""

    stamp_ns: int
    order: int
    topic: str
    data: bytes
    rest: Iterator[tuple[int, bytes]]  # what follows on the same topic, encoded when its turn comes


class LogWriter:
    """A log that appears under its name when it is complete, or not at all.

    Messages are written in order of their stamps, whatever the order of the calls: a series (IMU, trajectory, pairs)
    may be handed over as a whole before the frames and is encoded piece by piece as the frames pass by; frames may be
    out of order by ``WAITING_IMAGES`` messages. Only what comes later than that stands out of order in the file.
    So a log that is cut short holds every topic up to the cut.

    The same calls give the same bytes.

    Args:
        path: The log; an existing one is replaced, and missing folders are made.
        metadata: Named records of text fields, written at the beginning.

    Raises:
        LogError: the file cannot be written (no space left, no permission); then nothing is left behind.

    """

    def __init__(self, path: Path, metadata: Mapping[str, Mapping[str, str]] | None = None):
        self.path = Path(path)
        self._metadata = metadata or {}
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        self._heap: list[_Message] = []
        self._order = itertools.count()
        self._waiting_images = 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def __enter__(self) -> LogWriter:
        with self._expected_errors():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = self._part.open("wb")
            try:
                self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
                self._writer.start(profile="ros2", library="violearner-fusion")
                for name, fields in self._metadata.items():
                    self._writer.add_metadata(name, dict(fields))
            except BaseException:
                self._discard()
                raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None:
            self._discard()
            return
        try:
            with self._expected_errors():
                self._write_until(None)
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._stream.flush()
                os.fsync(self._stream.fileno())
                self._stream.close()
                os.replace(self._part, self.path)
                _sync_folder(self.path.parent)
        except BaseException:
            self._discard()
            raise

    # --- Camera ---------------------------------------------------------------------------------

    def frame(self, frame: CameraFrame) -> None:
        """Image, depth if there is one, and camera info."""
        self.image(frame.stamp_ns, frame.image, frame.camera.frame_id)
        if frame.depth is not None:
            self.depth(frame.stamp_ns, frame.depth, frame.camera.frame_id)
        self.camera_info(frame.stamp_ns, frame.camera)

    def image(self, stamp_ns: int, image: NDArray[np.uint8], frame_id: str = CAMERA_FRAME) -> None:
        """A grey (H, W) or RGB (H, W, 3) image."""
        self._add_image(stamp_ns, topics.IMAGE, messages.encode_image(stamp_ns, image, frame_id))

    def depth(self, stamp_ns: int, depth: NDArray[np.float32], frame_id: str = CAMERA_FRAME) -> None:
        """Depth (H, W) in metres, rounded to 1/256 m."""
        self._add_image(stamp_ns, topics.DEPTH, messages.encode_depth(stamp_ns, depth, frame_id))

    def camera_info(self, stamp_ns: int, info: CameraInfo) -> None:
        """The intrinsics of the image with this stamp."""
        self._add_image(stamp_ns, topics.CAMERA_INFO, messages.encode_camera_info(stamp_ns, info))

    # --- Series ---------------------------------------------------------------------------------

    def imu(self, series: ImuSeries) -> None:
        """IMU samples; the standard deviations go into the covariance fields."""

        def encode(i: int) -> bytes:
            sample = ImuSample(
                series.angular_velocity[i],
                series.linear_acceleration[i],
                series.angular_velocity_std,
                series.linear_acceleration_std,
            )
            return messages.encode_imu(int(series.stamps_ns[i]), sample)

        self._add_series(topics.IMU, ((int(stamp), encode(i)) for i, stamp in enumerate(series.stamps_ns)))

    def ground_truth(self, trajectory: Trajectory) -> None:
        """Poses to compare with, in a world of their own."""
        self._add_trajectory(topics.GROUND_TRUTH, trajectory, messages.encode_pose)

    def trajectory(self, name: str, trajectory: Trajectory) -> None:
        """A result ("raw", "posegraph", "ekf"): odometry of the frame ``camera_<name>``, and its transforms."""
        child = f"{CAMERA_FRAME}_{name}"

        def encode_transform(stamp_ns: int, pose: PoseSample) -> bytes:
            return messages.encode_transforms(stamp_ns, [FrameTransform(WORLD_FRAME, child, pose)])

        self._add_trajectory(
            topics.ODOMETRY_PREFIX + name, trajectory, lambda stamp, pose: messages.encode_odometry(stamp, pose, child)
        )
        self._add_trajectory(topics.TF, trajectory, encode_transform)

    def overview(self, name: str, trajectory: Trajectory) -> None:
        """All poses of a result in one message at its beginning, for viewers that draw no trail of an odometry."""
        if len(trajectory):
            poses = list(_pose_samples(trajectory))
            self._add_series(topics.PATH_PREFIX + name, iter([(poses[0][0], messages.encode_path(poses))]))

    def estimator(self, name: str, series: EstimatorSeries) -> None:
        """What a back end ("posegraph", "ekf") estimated beside its trajectory."""
        encoded = ((int(stamp), messages.encode_estimator(series, i)) for i, stamp in enumerate(series.stamps_ns))
        self._add_series(topics.ESTIMATOR_PREFIX + name, encoded)

    def pairs(self, pairs: Iterable[PairEstimate]) -> None:
        """Pair estimates of consecutive frames, in order of their target stamps."""
        self._add_pairs(topics.PAIRS, list(pairs))

    def pair(self, pair: PairEstimate) -> None:
        """One pair estimate."""
        self._add_pairs(topics.PAIRS, [pair])

    def skips(self, pairs: Iterable[PairEstimate]) -> None:
        """Pair estimates that skip a frame, in order of their target stamps."""
        self._add_pairs(topics.SKIPS, list(pairs))

    def loops(self, loops: Iterable[PairEstimate]) -> None:
        """Loop closures, in order of their target stamps."""
        self._add_pairs(topics.LOOPS, list(loops))

    def levels(self, pairs: Iterable[PairEstimate]) -> None:
        """Pairs whose hypotheses are the motions after each level of the network, in order of their target stamps."""
        self._add_pairs(topics.LEVELS, list(pairs))

    def gnss(self, fix: GnssFix) -> None:
        """One position fix."""
        self._add_series(topics.GNSS, iter([(fix.stamp_ns, messages.encode_gnss(fix))]))

    def mounting(self, rotation_imu_camera: Rotation) -> None:
        """The mounting of the IMU, ``v_imu = rotation_imu_camera.apply(v_camera)``, as a static transform."""
        quat_wxyz = rotation_imu_camera.inv().as_quat(scalar_first=True)
        self._add_static(FrameTransform(CAMERA_FRAME, IMU_FRAME, PoseSample(np.zeros(3), quat_wxyz)))

    def frame_tree(self, shown: str, T_enu_world: FloatArray | None = None) -> None:
        """For viewers: the camera rides on the trajectory of this name, and the world stands upright in `world_flu`.

        With T_enu_world (4, 4) the world has its place on the earth, in `enu`; a frame has no more than one parent.
        """
        if T_enu_world is None:
            upright = FrameTransform(WORLD_FLU_FRAME, WORLD_FRAME, PoseSample(np.zeros(3), _FLU_FROM_OPTICAL_WXYZ))
        else:
            quat_wxyz = Rotation.from_matrix(T_enu_world[:3, :3]).as_quat(scalar_first=True)
            self._add_static(FrameTransform(ENU_FRAME, WORLD_FRAME, PoseSample(T_enu_world[:3, 3], quat_wxyz)))
            upright = FrameTransform(WORLD_FRAME, WORLD_FLU_FRAME, PoseSample(np.zeros(3), _OPTICAL_FROM_FLU_WXYZ))
        self._add_static(
            upright,
            FrameTransform(f"{CAMERA_FRAME}_{shown}", CAMERA_FRAME, PoseSample(np.zeros(3), _IDENTITY_WXYZ)),
        )

    def _add_static(self, *transforms: FrameTransform) -> None:
        self._add_series(topics.TF_STATIC, iter([(0, messages.encode_transforms(0, transforms))]))

    # --- Order of time --------------------------------------------------------------------------

    def _add_image(self, stamp_ns: int, topic: str, data: bytes) -> None:
        heapq.heappush(self._heap, _Message(int(stamp_ns), next(self._order), topic, data, iter(())))
        self._waiting_images += 1
        if self._waiting_images > WAITING_IMAGES:
            self._write_until(WAITING_IMAGES)

    def _add_pairs(self, topic: str, pairs: Sequence[PairEstimate]) -> None:
        self._add_series(topic, ((pair.target_stamp_ns, messages.encode_pair(pair)) for pair in pairs))

    def _add_trajectory(self, topic: str, trajectory: Trajectory, encode: Callable[[int, PoseSample], bytes]) -> None:
        self._add_series(topic, ((stamp, encode(stamp, pose)) for stamp, pose in _pose_samples(trajectory)))

    def _add_series(self, topic: str, source: Iterator[tuple[int, bytes]]) -> None:
        for stamp_ns, data in itertools.islice(source, 1):
            heapq.heappush(self._heap, _Message(stamp_ns, next(self._order), topic, data, source))

    def _write_until(self, waiting_images: int | None) -> None:
        """Write the earliest messages until so few images wait, or all of them."""
        with self._expected_errors():
            while self._heap and (waiting_images is None or self._waiting_images > waiting_images):
                message = heapq.heappop(self._heap)
                self._write(message)
                self._waiting_images -= message.topic in topics.CAMERA_TOPICS
                self._add_series(message.topic, message.rest)

    def _write(self, message: _Message) -> None:
        # What is static holds from the start of what follows; a stamp of zero would make the log look decades long.
        static = message.topic == topics.TF_STATIC
        log_time = self._heap[0].stamp_ns if static and self._heap else message.stamp_ns
        if message.topic not in self._channels:
            self._channels[message.topic] = self._register(message.topic)
        self._writer.add_message(self._channels[message.topic], log_time, message.data, log_time)

    def _register(self, topic: str) -> int:
        type_name = topics.message_type(topic)
        definition = messages.schema_text(type_name).encode()
        schema = self._schemas.get(type_name) or self._writer.register_schema(
            type_name, messages.SCHEMA_ENCODING, definition
        )
        self._schemas[type_name] = schema
        return self._writer.register_channel(topic, messages.MESSAGE_ENCODING, schema)

    # --- All or nothing -------------------------------------------------------------------------

    @contextlib.contextmanager
    def _expected_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def _discard(self) -> None:
        with contextlib.suppress(OSError):  # closing flushes, and there may be no space for that either
            self._stream.close()
        self._part.unlink(missing_ok=True)


def _pose_samples(trajectory: Trajectory) -> Iterator[tuple[int, PoseSample]]:
    """Stamps and poses of a trajectory."""
    if not len(trajectory):
        return
    translations, rotations = trajectory.poses.as_components()
    quats_wxyz = rotations.as_quat(canonical=True, scalar_first=True)
    covariances = itertools.repeat(None) if trajectory.covariances is None else iter(trajectory.covariances)
    for stamp, translation, quat_wxyz, covariance in zip(
        trajectory.stamps_ns, translations, quats_wxyz, covariances, strict=False
    ):
        yield int(stamp), PoseSample(translation, quat_wxyz, covariance)


def _sync_folder(folder: Path) -> None:
    """Make a rename in this folder last through a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
