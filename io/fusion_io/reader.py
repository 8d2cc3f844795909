"""Reading logs: ours, other people's, and damaged ones."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from fusion_io import camera, encodings, inertial, messages, mounting, poses, roles, topics
from fusion_io.container import Channel, Contents, MessageFile, MessageIndex
from fusion_io.errors import LogError
from fusion_io.findings import Findings
from fusion_io.records import (
    NANOSECONDS,
    CameraFrame,
    CameraInfo,
    EstimatorSeries,
    FloatArray,
    GnssFix,
    ImuSeries,
    IntArray,
    PairEstimate,
    Trajectory,
)
from fusion_io.recovery import scan
from fusion_io.roles import Topic

# The roles whose times say when the log was recorded, the most telling first.
_TIMED_ROLES = ("image", "camera_info", "pairs", "imu", "gyro", "ground_truth", "gnss")
_OTHER_CLOCK_S = 60.0
_TRIED_MESSAGES = 10
_LISTED_TOPICS = 8
_ASYMMETRY = 1e-6

_T = TypeVar("_T")


def open_log(path: str | Path, topics: Mapping[str, str] | None = None) -> Log:
    """Open a log after reading it once: every chunk is checked, and every message's place noted.

    A damaged log is opened with what is left of it (``Log.damaged``).

    Args:
        path: An MCAP file.
        topics: Role -> topic, where the names of the topics do not say it.

    Raises:
        LogError: not an MCAP file, nothing in it that can be used, or two topics for one role; in one line.
        UsageError: ``topics`` names a role that does not exist, or a topic that cannot play it.

    """
    path = Path(path)
    return Log(path, scan(path, _readable), topics or {})


class Log:
    """A recording. Everything is read when it is asked for, and may be read again.

    Attributes:
        path: The file.
        roles: Role -> topic: image, depth, camera_info, imu (or gyro and accelerometer), ground_truth, pairs, loops,
            gnss, tf_static; those that the log has.
        metadata: Named records of text fields.
        damage: A line for all that is wrong with the file: that it is cut, unfinished, or has bad chunks.
        damaged: Whether there is any.
        start_ns: The first stamp of the camera, or of what there is in its place, and of all that overlaps with it.
        end_ns: The last.

    """

    def __init__(self, path: Path, contents: Contents, chosen: Mapping[str, str]):
        self.path = path
        self.metadata = contents.metadata
        self.damage = contents.faults(path)
        self.damaged = bool(self.damage)
        self._contents = contents
        self._channels = {channel.topic: channel for channel in contents.counts if _readable(channel)}
        self._types = {topic: encodings.ros2_type(channel) for topic, channel in self._channels.items()}
        self._indices: dict[str, MessageIndex] = {}
        self._findings = Findings()
        self._report_damage()
        self.roles = roles.assign(str(path), self._topics(), chosen)
        if not self.roles.keys() & set(_TIMED_ROLES):
            raise LogError(f"{path}: {self._nothing_usable()}")
        self._report_clocks()
        self.start_ns, self.end_ns = self._time_range()

    @functools.cached_property
    def sha256(self) -> str:
        """Digest of the file."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    @property
    def has_frames(self) -> bool:
        """Whether the log has images."""
        return "image" in self.roles

    @property
    def has_pairs(self) -> bool:
        """Whether the log has recorded pair estimates."""
        return "pairs" in self.roles

    # --- Frames ---------------------------------------------------------------------------------

    def frame_stamps(self) -> IntArray:
        """Stamps of the images, or of the camera infos where there are no images; (N,) strictly increasing."""
        for role in ("image", "camera_info"):
            if role in self.roles:
                return self._in_time(role)[0]
        return np.zeros(0, dtype=np.int64)

    def frames(self, stamps_ns: IntArray | None = None) -> Iterator[CameraFrame]:
        """Images with depth and intrinsics: paired, scaled, undistorted. One is held at a time.

        stamps_ns (M,): which of ``frame_stamps``, in any order; None for all of them. Those that cannot be decoded
        are left out, and counted when all are read.

        Raises:
            LogError: there are no images or no intrinsics, or depth or intrinsics cannot belong to the images.
            ValueError: no frame has one of the stamps.

        """
        for role, words in (("image", "images"), ("camera_info", "camera info")):
            if role not in self.roles:
                raise LogError(f"{self.path}: no {words}: frames need images and their intrinsics")
        stamps, images = self._in_time("image")
        info_stamps, infos = self._in_time("camera_info")
        infos = infos[camera.nearest_index(info_stamps, stamps)]
        depths, depth_of = self._depth_beside(stamps)
        chosen = np.arange(len(stamps)) if stamps_ns is None else _places(stamps_ns, stamps)
        unreadable: list[tuple[str, int, ValueError]] = []
        with self._open() as file:
            for i in chosen.tolist():
                stamp, depth = int(stamps[i]), None
                try:
                    image = messages.decode_image(self._type("image"), file.read(images, i))
                except ValueError as error:
                    unreadable.append(("image", stamp, error))
                    continue
                try:
                    if depth_of[i] >= 0:
                        depth = messages.decode_depth(self._type("depth"), file.read(depths, depth_of[i]))
                except ValueError as error:
                    unreadable.append(("depth", stamp, error))
                yield self._frame(CameraFrame(stamp, image, depth, self._camera_info(file, infos, i)))
        for role in ("image", "depth") if stamps_ns is None else ():
            self._report_unreadable(role, [(stamp, error) for which, stamp, error in unreadable if which == role])

    def camera_info(self) -> CameraInfo | None:
        """The first intrinsics as they were recorded, None where there are none that can be used."""
        if "camera_info" not in self.roles:
            return None
        with self._open() as file:
            try:
                return self._camera_info(file, self._in_time("camera_info")[1], 0)
            except LogError:
                return None

    def _in_time(self, role: str) -> tuple[IntArray, MessageIndex]:
        """The messages of a role in order of their stamps; of those with the same stamp, the first recorded."""
        recorded = self._stamps(role)
        stamps, first = np.unique(recorded, return_index=True)
        if role in {"image", "depth"}:
            name = "frames" if role == "image" else "depth"
            again = np.delete(recorded, first)
            self._report(f"duplicate_{name}", role, again, "that repeat a stamp are left out")
            late = np.delete(recorded, inertial.longest_increasing(recorded))
            self._report(f"{name}_out_of_order", role, late[~np.isin(late, again)], "out of order are put in order")
        return stamps, self._index(role)[first]

    def _depth_beside(self, stamps: IntArray) -> tuple[MessageIndex, IntArray]:
        """Depth images, and for each image the index of its own among them or -1: nearest within half a period."""
        if "depth" not in self.roles:
            return self._index("image"), np.full(len(stamps), -1)
        depth_stamps, depths = self._in_time("depth")
        half_period = np.median(np.diff(stamps)) / 2 if len(stamps) > 1 else 0
        depth_of = camera.pair_nearest(stamps, depth_stamps, half_period)
        unused = np.delete(depth_stamps, depth_of[depth_of >= 0])
        self._report("frames_without_depth", "image", stamps[depth_of < 0], "have no depth within half a period")
        self._report("depth_without_frame", "depth", unused, "have no image within half a period and are left out")
        return depths, depth_of

    def _camera_info(self, file: MessageFile, infos: MessageIndex, i: int) -> CameraInfo:
        # ROS names rectified images image_rect*; their intrinsics are in P, and the lens is already undone.
        rectified = "image_rect" in self.roles.get("image", "")
        with self._refusing("camera_info", infos.stamps_ns[i]):
            return messages.decode_camera_info(file.read(infos, i), rectified)

    def _frame(self, raw: CameraFrame) -> CameraFrame:
        """What was recorded, brought to the size of the image and undistorted."""
        height, width = raw.image.shape[:2]
        with self._refusing("depth", raw.stamp_ns):
            depth = None if raw.depth is None else camera.fit_depth(raw.depth, width, height)
        with self._refusing("camera_info", raw.stamp_ns):
            info = camera.fit_camera(raw.camera, width, height)
            return camera.undistorted(CameraFrame(raw.stamp_ns, raw.image, depth, info))

    @contextlib.contextmanager
    def _refusing(self, role: str, stamp_ns: int) -> Iterator[None]:
        """Turn what cannot be right into an error that names file, topic and time."""
        try:
            yield
        except ValueError as error:
            raise LogError(f"{self._named(role)} at {_seconds(stamp_ns)}: {error}") from error

    # --- Series ---------------------------------------------------------------------------------

    def imu(self) -> ImuSeries:
        """IMU samples in order of time, possibly none. Two topics are joined at the times of the gyro.

        Samples that are not finite, and those that go back in time or repeat a stamp, are left out and counted.
        """
        if "imu" in self.roles:
            return self._inertial("imu", slice(0, 6))
        if "gyro" not in self.roles or "accelerometer" not in self.roles:
            return ImuSeries(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        gyro = self._inertial("gyro", slice(0, 3))
        accelerometer = self._inertial("accelerometer", slice(3, 6))
        acceleration, supported = inertial.interpolate(
            accelerometer.stamps_ns, accelerometer.linear_acceleration, gyro.stamps_ns
        )
        alone = gyro.stamps_ns[~supported]
        self._report("gyro_without_accelerometer", "gyro", alone, "have no acceleration around them and are left out")
        return ImuSeries(
            gyro.stamps_ns[supported],
            gyro.angular_velocity[supported],
            acceleration[supported],
            gyro.angular_velocity_std,
            accelerometer.linear_acceleration_std,
        )

    def _inertial(self, role: str, needed: slice) -> ImuSeries:
        """One topic of Imu messages, of whose angular velocity and linear acceleration these numbers are needed."""
        recorded, columns = array("q"), array("d")
        for stamp, sample in self._decoded(role, messages.decode_imu):
            recorded.append(stamp)
            columns.extend(sample.angular_velocity.tolist() if sample.has_angular_velocity else _MISSING)
            columns.extend(sample.linear_acceleration.tolist() if sample.has_linear_acceleration else _MISSING)
            columns.append(sample.angular_velocity_std or np.nan)
            columns.append(sample.linear_acceleration_std or np.nan)
        stamps, samples = np.array(recorded, dtype=np.int64), np.array(columns).reshape(-1, 8)
        finite = inertial.measurable(samples[:, needed])
        self._report(f"{role}_nan", role, stamps[~finite], "without finite values are left out")
        stamps, samples = self._increasing(role, stamps[finite], samples[finite])
        return ImuSeries(stamps, samples[:, 0:3], samples[:, 3:6], _typical(samples[:, 6]), _typical(samples[:, 7]))

    def ground_truth(self) -> Trajectory | None:
        """Poses to compare with, at their own stamps and in their own world; None if there are none."""
        truth = self._poses("ground_truth") if "ground_truth" in self.roles else None
        return None if truth is None else Trajectory(truth.stamps_ns, truth.poses)

    @property
    def trajectory_names(self) -> list[str]:
        """The names of the results that the log holds ("raw", "posegraph", "ekf"), as `trajectory` takes them."""
        prefix = topics.ODOMETRY_PREFIX
        return sorted(
            topic.removeprefix(prefix)
            for topic, message_type in self._types.items()
            if topic.startswith(prefix) and message_type == messages.ODOMETRY
        )

    def trajectory(self, name: str) -> Trajectory | None:
        """A result that an earlier run wrote, with its covariances; None if there is none of this name."""
        return self._poses(topics.ODOMETRY_PREFIX + name) if name in self.trajectory_names else None

    def _poses(self, role: str) -> Trajectory | None:
        """The valid poses of a role or topic in order of time; covariances are zero where only others have one."""
        decode = functools.partial(messages.decode_pose, self._type(role))
        trajectory, invalid, late = poses.in_order(self._decoded(role, decode))
        self._report(f"{role}_invalid", role, invalid, "without a valid pose are left out")
        self._report_late(role, late)
        return trajectory if len(trajectory) else None

    def pairs(self) -> list[PairEstimate]:
        """Recorded pair estimates in order of time, to the bit as they were written; invalid ones are left out."""
        return self._pair_estimates("pairs")

    def skips(self) -> list[PairEstimate]:
        """Recorded pair estimates that skip a frame, in order of time; invalid ones are left out."""
        return self._pair_estimates("skips")

    def loops(self) -> list[PairEstimate]:
        """Recorded loop closures in order of time; invalid ones are left out."""
        return self._pair_estimates("loops")

    def levels(self) -> list[PairEstimate]:
        """Recorded pairs whose hypotheses are the motions after each level of the network, in order of time."""
        return self._pair_estimates("levels")

    def _pair_estimates(self, role: str) -> list[PairEstimate]:
        if role not in self.roles:
            return []
        estimates = [pair for _, pair in self._decoded(role, messages.decode_pair)]
        invalid = [pair.target_stamp_ns for pair in estimates if not _is_valid(pair)]
        self._report(f"{role}_invalid", role, np.array(invalid), "without a valid pose and covariance are left out")
        valid = {(pair.target_stamp_ns, pair.source_stamp_ns): pair for pair in reversed(estimates) if _is_valid(pair)}
        again = len(estimates) - len(invalid) - len(valid)
        self._findings.put(f"duplicate_{role}", again, f"{self._named(role)}: messages that repeat a pair: {again}")
        return [valid[key] for key in sorted(valid)]

    def estimator(self, name: str) -> EstimatorSeries | None:
        """What a back end ("posegraph", "ekf") estimated beside its trajectory, in order of time; None if not there."""
        topic = topics.ESTIMATOR_PREFIX + name
        if self._types.get(topic) != messages.ESTIMATOR_STATE:
            return None
        rows = dict(self._decoded(topic, messages.decode_estimator))
        return EstimatorSeries.joined([rows[stamp] for stamp in sorted(rows)]) if rows else None

    def gnss(self) -> list[GnssFix]:
        """Position fixes in order of time."""
        if "gnss" not in self.roles:
            return []
        decoded = sorted(self._decoded("gnss", messages.decode_gnss), key=lambda item: item[0])
        without_fix = np.array([stamp for stamp, fix in decoded if fix is None])
        self._report("gnss_without_fix", "gnss", without_fix, "without a fix are left out")
        return [replace(fix, stamp_ns=stamp) for stamp, fix in decoded if fix]

    def mounting(self) -> Rotation | None:
        """``rotation_imu_camera`` (v_imu = R v_camera) from the static transforms, None if they do not tell."""
        camera_frame = self._frame_id("camera_info", "image", "pairs")
        imu_frame = self._frame_id("imu", "gyro")
        if "tf_static" not in self.roles or not camera_frame or not imu_frame:
            return None
        transforms = [
            transform for _, message in self._decoded("tf_static", messages.decode_transforms) for transform in message
        ]
        return mounting.rotation_between(transforms, imu_frame, camera_frame)

    # --- Messages of a role ---------------------------------------------------------------------

    def _index(self, role: str) -> MessageIndex:
        topic = self._topic(role)
        if topic not in self._indices:
            with self._open() as file:
                self._indices[topic] = encodings.stamped(file, self._in_cdr(topic))
        return self._indices[topic]

    def _in_cdr(self, topic: str) -> MessageIndex:
        return encodings.in_cdr(self._contents, self._channels[topic])

    def _type(self, role: str) -> str:
        return self._types[self._topic(role)]

    def _topic(self, role: str) -> str:
        """The topic of a role; a topic that plays none stands for itself."""
        return self.roles.get(role, role)

    def _open(self) -> MessageFile:
        return MessageFile(self.path, self._contents.blocks)

    def _stamps(self, role: str) -> IntArray:
        """Header stamps of a role's messages, in order of recording.

        A stamp that was not set is the log time, brought to the clock of those that were.
        """
        index = self._index(role)
        unset = index.stamps_ns == 0
        if not np.any(unset):
            return index.stamps_ns
        offset = 0 if np.all(unset) else int(np.median((index.log_times_ns - index.stamps_ns)[~unset]))
        stamps = np.where(unset, index.log_times_ns - offset, index.stamps_ns)
        filled = stamps[unset & (stamps != 0)]  # a log may well begin at zero
        self._report(f"{role}_unstamped", role, filled, "without a stamp have their log time instead")
        return stamps

    def _decoded(self, role: str, decode: Callable[[bytes | memoryview], _T]) -> Iterator[tuple[int, _T]]:
        """Stamps and contents of a role's messages in order of recording, less those that cannot be decoded."""
        index = self._index(role)
        unreadable: list[tuple[int, ValueError]] = []
        with self._open() as file:
            for i, stamp in enumerate(self._stamps(role).tolist()):
                try:
                    decoded = decode(file.read(index, i))
                except ValueError as error:
                    unreadable.append((stamp, error))
                else:
                    yield stamp, decoded
        self._report_unreadable(role, unreadable)

    def _increasing(self, role: str, stamps: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
        """The longest strictly increasing run of stamps, with its values."""
        kept = inertial.longest_increasing(stamps)
        self._report_late(role, np.delete(stamps, kept))
        return stamps[kept], values[kept]

    def _frame_id(self, *among: str) -> str:
        """The frame of the first of these roles that the log has and that names one."""
        for role in among:
            if role in self.roles:
                topic = self.roles[role]
                name, _ = self._first(topic, functools.partial(messages.frame_id, self._types[topic]))
                if name:
                    return name
        return ""

    def _first(self, topic: str, read: Callable[[bytes | memoryview], str]) -> tuple[str, str]:
        """What the first message says that can be read, and otherwise "" and why not."""
        index, reason = self._in_cdr(topic), ""
        with self._open() as file:
            for i in range(min(len(index), _TRIED_MESSAGES)):
                try:
                    return read(file.read(index, i)), ""
                except ValueError as error:
                    reason = str(error)
        return "", reason

    # --- Topics and time ------------------------------------------------------------------------

    def _topics(self) -> list[Topic]:
        """The topics that can be read, each with the role that it fits, judged by its first message."""
        found = []
        for topic, message_type in self._types.items():
            kind, reason = self._first(topic, functools.partial(roles.kind_of, topic, message_type))
            found.append(Topic(topic, message_type, kind))
            if reason:
                self._findings.remark(f"{self.path}: {topic}: {reason}")
        return found

    def _time_range(self) -> tuple[int, int]:
        spans = [
            (int(stamps.min()), int(stamps.max()))
            for stamps in (self._stamps(role) for role in _TIMED_ROLES if role in self.roles)
        ]
        first, last = spans[0]
        together = [span for span in spans if span[0] <= last and span[1] >= first]
        return min(start for start, _ in together), max(end for _, end in together)

    # --- What was wrong -------------------------------------------------------------------------

    @property
    def warnings(self) -> dict[str, int]:
        """How often each thing was found wrong, in all that has been read so far."""
        return self._findings.counts

    @property
    def notes(self) -> list[str]:
        """A line for each of them, with file, topic and time."""
        return self._findings.notes

    @property
    def remarks(self) -> list[str]:
        """Those of the notes that are worth knowing and no fault."""
        return self._findings.remarks

    def _named(self, role: str) -> str:
        return f"{self.path}: {self._topic(role)}"

    def _report(self, name: str, role: str, stamps: IntArray, what: str) -> None:
        """Count messages of a role, by their stamps."""
        first = f", the first at {_seconds(stamps[0])}" if len(stamps) else ""
        self._findings.put(name, len(stamps), f"{self._named(role)}: messages {what}: {len(stamps)}{first}")

    def _report_late(self, role: str, stamps: IntArray) -> None:
        self._report(f"{role}_backward", role, stamps, "that go back in time or repeat a stamp are left out")

    def _report_unreadable(self, role: str, unreadable: list[tuple[int, ValueError]]) -> None:
        if self._topic(role) in self._types:
            stamps = np.array([stamp for stamp, _ in unreadable], dtype=np.int64)
            reason = unreadable[0][1] if unreadable else ""
            self._report(f"{role}_unreadable", role, stamps, f"cannot be decoded ({reason})")

    def _report_damage(self) -> None:
        for damage in self._contents.damage:
            self._findings.add(damage.name, damage.note)
        self._findings.put("messages_lost", self._contents.messages_lost, self.damage[-1] if self.damage else "")

    def _report_clocks(self) -> None:
        for role, topic in self.roles.items():
            index = self._index(role)
            stamped = index.stamps_ns != 0
            if role == "tf_static" or not np.any(stamped):
                continue
            offset_s = np.median((index.log_times_ns - index.stamps_ns)[stamped]) / NANOSECONDS
            if abs(offset_s) > _OTHER_CLOCK_S:
                self._findings.remark(
                    f"{self.path}: {topic}: the recorder's clock is {offset_s:+.0f} s from the stamps, which are kept"
                )

    def _nothing_usable(self) -> str:
        counts = self._contents.counts
        if not counts:
            return "nothing to work with: it holds no whole message" + (" (cut or damaged)" if self.damaged else "")
        held = [f"{topic} ({kind or 'no schema'}, {encoding})" for topic, kind, encoding in counts]
        more = f" and {len(held) - _LISTED_TOPICS} more" if len(held) > _LISTED_TOPICS else ""
        return (
            "nothing to work with: no images, IMU, poses, positions or pair estimates that can be read; it holds "
            + ", ".join(held[:_LISTED_TOPICS])
            + more
        )


_MISSING = (np.nan, np.nan, np.nan)


def _readable(channel: Channel) -> bool:
    return encodings.ros2_type(channel) in roles.READABLE_TYPES


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns / NANOSECONDS:.3f} s"


def _places(wanted: IntArray, among: IntArray) -> IntArray:
    """The indices of stamps (M,) among others (N,) that increase strictly."""
    places = np.searchsorted(among, wanted)
    if not np.isin(wanted, among).all():
        raise ValueError("no frame has one of the stamps")
    return places


def _typical(deviations: FloatArray) -> float | None:
    """The median of those that are known."""
    known = deviations[np.isfinite(deviations)]
    return float(np.median(known)) if len(known) else None


def _is_valid(pair: PairEstimate) -> bool:
    """Whether a pair estimate can be used: times, a rotation, a covariance that can be inverted."""
    hypotheses = len(pair.hypotheses_translation)
    numbers = (
        pair.quat_wxyz,
        pair.translation,
        pair.covariance,
        pair.hypotheses_quat_wxyz,
        pair.hypotheses_translation,
    )
    return (
        pair.source_stamp_ns < pair.target_stamp_ns
        and all(bool(np.all(np.isfinite(values))) for values in numbers)
        and bool(poses.is_unit(pair.quat_wxyz))
        and bool(np.abs(pair.translation).max() < poses.FARTHEST_M)
        and -1 <= pair.winner < max(hypotheses, 1)
        and bool(np.abs(pair.covariance - pair.covariance.T).max() <= _ASYMMETRY * np.abs(pair.covariance).max())
        and bool(np.linalg.eigvalsh(pair.covariance)[0] > 0)
    )
