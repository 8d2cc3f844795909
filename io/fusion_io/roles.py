"""Which topic of a log plays which role.

A role is filled by the topic of our own name if the log has it, else by the only topic with a fitting message, else by
the caller's choice. Two candidates are an error that lists them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fusion_io import messages, topics
from fusion_io.errors import LogError, UsageError

CANONICAL = {
    "image": topics.IMAGE,
    "depth": topics.DEPTH,
    "camera_info": topics.CAMERA_INFO,
    "imu": topics.IMU,
    "ground_truth": topics.GROUND_TRUTH,
    "pairs": topics.PAIRS,
    "skips": topics.SKIPS,
    "loops": topics.LOOPS,
    "levels": topics.LEVELS,
    "gnss": topics.GNSS,
    "tf_static": topics.TF_STATIC,
}

_IMAGES = {messages.IMAGE, messages.COMPRESSED_IMAGE}
_POSES = {messages.POSE_STAMPED, messages.POSE_WITH_COVARIANCE, messages.ODOMETRY}
_READABLE = {
    "image": _IMAGES,
    "depth": _IMAGES,
    "camera_info": {messages.CAMERA_INFO},
    "imu": {messages.IMU},
    "gyro": {messages.IMU},
    "accelerometer": {messages.IMU},
    "ground_truth": _POSES,
    "pairs": {messages.PAIR_ESTIMATE},
    "skips": {messages.PAIR_ESTIMATE},
    "loops": {messages.PAIR_ESTIMATE},
    "levels": {messages.PAIR_ESTIMATE},
    "gnss": {messages.GNSS},
    "tf_static": {messages.TRANSFORMS},
}
READABLE_TYPES = frozenset({messages.ESTIMATOR_STATE}).union(*_READABLE.values())

_NOT_PAIRS = {topics.SKIPS, topics.LOOPS, topics.LEVELS}
_ONLY_BY_NAME = {"skips", "loops", "levels", "tf_static"}
_INERTIAL = ("imu", "gyro", "accelerometer")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic with messages that can be read. ``kind`` is the role that its contents fit, or ""."""

    name: str
    message_type: str
    kind: str


def kind_of(topic: str, message_type: str, data: bytes | memoryview) -> str:
    """The role that a topic fits, judged by one of its messages; "" for none.

    Raises:
        ValueError: the message cannot be read.

    """
    if message_type in _IMAGES:
        kind = messages.image_kind(message_type, data)
        return "" if kind == "image" and "depth" in topic.lower() else kind  # depth painted for the eye
    if message_type == messages.IMU:
        return _imu_kind(topic, messages.decode_imu(data))
    if topic.startswith(topics.ODOMETRY_PREFIX):
        return ""  # what we computed is never the truth
    return _KINDS.get(message_type, "")


_KINDS = {
    messages.CAMERA_INFO: "camera_info",
    messages.POSE_STAMPED: "ground_truth",
    messages.PAIR_ESTIMATE: "pairs",
    messages.GNSS: "gnss",
}


def _imu_kind(topic: str, sample: messages.ImuSample) -> str:
    """Both halves of an IMU or one, by the topic's name, by what the message says, by a half that is exactly zero."""
    says_gyro, says_accelerometer = "gyro" in topic.lower(), "accel" in topic.lower()
    gyro = sample.has_angular_velocity and bool(sample.angular_velocity.any())
    accelerometer = sample.has_linear_acceleration and bool(sample.linear_acceleration.any())
    if says_gyro != says_accelerometer:
        gyro, accelerometer = says_gyro, says_accelerometer
    if gyro != accelerometer:
        return "gyro" if gyro else "accelerometer"
    return "imu"


def assign(path: str, candidates: Sequence[Topic], chosen: Mapping[str, str]) -> dict[str, str]:
    """Role -> topic, for all roles that the log can fill.

    Raises:
        LogError: two topics could play a role (all such roles are named).
        UsageError: a role that does not exist was chosen, or a topic that is not there or does not fit.

    """
    roles = {role: _chosen(path, candidates, role, topic) for role, topic in chosen.items()}
    found = {} if roles.keys() & set(_INERTIAL) else _inertial(candidates)
    roles |= {role: fitting[0].name for role, fitting in found.items() if len(fitting) == 1}
    for role in CANONICAL:
        if role not in roles and role != "imu":
            found[role] = _fitting(role, candidates, roles)
            if len(found[role]) == 1:
                roles[role] = found[role][0].name
    choices = {role: fitting for role, fitting in found.items() if len(fitting) > 1}
    if "image" in choices:
        choices.pop("camera_info", None)  # it may be told by the image that is chosen
    if choices:
        raise LogError(f"{path}: {'; '.join(_choice(role, fitting) for role, fitting in choices.items())}")
    return roles


def could_play(role: str, topic: str, message_type: str, kind: str) -> bool:
    """Whether a topic of this kind (`kind_of`) could be chosen for a role that it is not found for by itself."""
    ours = topic in CANONICAL.values() or topic.startswith(topics.ODOMETRY_PREFIX)
    return message_type in _READABLE[role] and kind in {"", role} and not ours


def _chosen(path: str, candidates: Sequence[Topic], role: str, topic: str) -> str:
    if role not in _READABLE:
        raise UsageError(f"there is no role {role!r}: choose from {', '.join(_READABLE)}")
    for candidate in candidates:
        if candidate.name == topic and candidate.message_type in _READABLE[role]:
            return topic
    fitting = [candidate for candidate in candidates if candidate.message_type in _READABLE[role]]
    raise UsageError(f"{path}: topic {topic} cannot be the {_words(role)}; {_list(fitting) or 'no topic'} could be")


def _fitting(role: str, candidates: Sequence[Topic], roles: Mapping[str, str]) -> list[Topic]:
    """The topics that could play this role."""
    for candidate in candidates:
        if candidate.name == CANONICAL[role] and candidate.message_type in _READABLE[role]:
            return [candidate]
    if role in _ONLY_BY_NAME:
        return []
    fitting = [candidate for candidate in candidates if candidate.kind == role and candidate.name not in _NOT_PAIRS]
    if role == "camera_info" and "image" in roles:
        # ROS publishes it beside the image: http://wiki.ros.org/image_transport, "camera_info" in the same namespace.
        beside = [candidate for candidate in fitting if candidate.name in _camera_info_names(roles["image"])]
        return beside or fitting
    return fitting


def _camera_info_names(image_topic: str) -> set[str]:
    """/a/image_raw and /a/image_raw/compressed have their camera info at /a/camera_info."""
    namespace = image_topic.rsplit("/", 1)[0]
    return {f"{namespace}/camera_info", f"{namespace.rsplit('/', 1)[0]}/camera_info"}


def _inertial(candidates: Sequence[Topic]) -> dict[str, list[Topic]]:
    """The topics that could have both halves of an IMU, or those that could have one each."""
    whole = _fitting("imu", candidates, {})
    gyros = [candidate for candidate in candidates if candidate.kind == "gyro"]
    accelerometers = [candidate for candidate in candidates if candidate.kind == "accelerometer"]
    if gyros and accelerometers and not whole:
        return {"gyro": gyros, "accelerometer": accelerometers}
    return {"imu": whole or gyros or accelerometers}


def _choice(role: str, fitting: Sequence[Topic]) -> str:
    """What is to be chosen, and how."""
    return (
        f"{len(fitting)} topics could be the {_words(role)}: {_list(fitting)}; "
        f"choose one, such as --topic {role}={fitting[0].name}"
    )


def _words(role: str) -> str:
    return role.replace("_", " ")


def _list(candidates: Sequence[Topic]) -> str:
    return ", ".join(candidate.name for candidate in candidates)
