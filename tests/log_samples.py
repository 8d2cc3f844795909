"""Small logs for the tests: ours, and such as other people's software writes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import messages
from fusion_io.records import CameraFrame, CameraInfo, ImuSeries, PairEstimate, Trajectory
from fusion_io.writer import LogWriter

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
WIDTH, HEIGHT = 32, 24
K = np.array([[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]])
CAMERA = CameraInfo(WIDTH, HEIGHT, K)

RawMessage = tuple[str, str, int, bytes]  # topic, type, log time, data


def grey(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


def depth(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return (np.random.default_rng(seed).integers(256, 5000, (height, width)) / 256).astype(np.float32)


def imu_series(count: int = 200, period: int = 10_000_000, start: int = START, seed: int = 0) -> ImuSeries:
    rng = np.random.default_rng(seed)
    stamps = start + np.arange(count) * period
    return ImuSeries(stamps, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) + [0, 0, 9.81], 1e-3, 2e-2)


def trajectory(count: int = 20, period: int = 100_000_000, covariances: bool = False, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = RigidTransform.from_components(rng.normal(size=(count, 3)), Rotation.random(count, rng=rng))
    roots = rng.normal(size=(count, 6, 6))
    stamps = START + np.arange(count) * period
    return Trajectory(stamps, poses, roots @ roots.transpose(0, 2, 1) if covariances else None)


def pair_estimates(count: int = 19, period: int = 100_000_000, seed: int = 0) -> list[PairEstimate]:
    rng = np.random.default_rng(seed)
    pairs = []
    for i in range(count):
        root = rng.normal(size=(6, 6))
        quats = Rotation.random(5, rng=rng).as_quat(scalar_first=True)
        pairs.append(
            PairEstimate(
                source_stamp_ns=START + i * period,
                target_stamp_ns=START + (i + 1) * period,
                quat_wxyz=quats[0],
                translation=rng.normal(size=3),
                covariance=root @ root.T + 1e-3 * np.eye(6),
                winner=2,
                hypotheses_quat_wxyz=quats[1:],
                hypotheses_translation=rng.normal(size=(4, 3)),
                errors=rng.uniform(size=4),
                imu_coverage=0.9,
            )
        )
    return pairs


def frames(count: int = 20, period: int = 100_000_000) -> list[CameraFrame]:
    return [CameraFrame(START + i * period, grey(i), depth(i), CAMERA) for i in range(count)]


def write_sample(path: Path, count: int = 20) -> Path:
    """A log with everything in it."""
    with LogWriter(path, {"run": {"seed": "0"}}) as log:
        log.mounting(Rotation.from_euler("xyz", [0.1, 0.2, 0.3]))
        log.imu(imu_series(10 * count))
        log.ground_truth(trajectory(count))
        log.trajectory("raw", trajectory(count, covariances=True))
        log.pairs(pair_estimates(count - 1))
        for frame in frames(count):
            log.frame(frame)
    return path


def write_raw(path: Path, items: Iterable[RawMessage], **options: Any) -> Path:
    """Any messages in the order given, as a recorder writes them."""
    channels: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2")
        for topic, message_type, log_time, data in items:
            if topic not in channels:
                schema = writer.register_schema(message_type, "ros2msg", messages.schema_text(message_type).encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    return path


def raw_image(topic: str, stamp: int, pixels: np.ndarray, encoding: str, **changes: Any) -> RawMessage:
    """sensor_msgs/Image as a driver publishes it."""
    height, width = pixels.shape[:2]
    fields = {
        "header": header(stamp),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": pixels.reshape(-1).view(np.uint8),
    }
    return topic, messages.IMAGE, stamp, serialise(messages.IMAGE, **(fields | changes))


def camera_info(topic: str, stamp: int, info: CameraInfo = CAMERA) -> RawMessage:
    return topic, messages.CAMERA_INFO, stamp, messages.encode_camera_info(stamp, info)


def imu_message(topic: str, stamp: int, sample: messages.ImuSample, frame_id: str = "imu") -> RawMessage:
    return topic, messages.IMU, stamp, messages.encode_imu(stamp, sample, frame_id)


def header(stamp: int, frame_id: str = "camera") -> Any:
    time = messages.TYPESTORE.types["builtin_interfaces/msg/Time"](sec=stamp // SECOND, nanosec=stamp % SECOND)
    return messages.TYPESTORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def serialise(message_type: str, **fields: Any) -> bytes:
    return bytes(messages.TYPESTORE.serialize_cdr(messages.TYPESTORE.types[message_type](**fields), message_type))
