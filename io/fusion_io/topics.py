"""The names of things in a log, and the message that each topic carries."""

from __future__ import annotations

from fusion_io import messages

IMAGE = "/camera/image"
DEPTH = "/camera/depth"
CAMERA_INFO = "/camera/camera_info"
IMU = "/imu"
GROUND_TRUTH = "/ground_truth"
GNSS = "/gnss"
PAIRS = "/violearner/pairs"
SKIPS = "/violearner/skips"
LOOPS = "/violearner/loops"
LEVELS = "/violearner/levels"
TF = "/tf"
TF_STATIC = "/tf_static"
ODOMETRY_PREFIX = "/odometry/"
PATH_PREFIX = "/path/"
ESTIMATOR_PREFIX = "/estimator/"

CAMERA_TOPICS = frozenset({IMAGE, DEPTH, CAMERA_INFO})

_MESSAGE_TYPES = {
    IMAGE: messages.COMPRESSED_IMAGE,
    DEPTH: messages.IMAGE,
    CAMERA_INFO: messages.CAMERA_INFO,
    IMU: messages.IMU,
    GROUND_TRUTH: messages.POSE_STAMPED,
    GNSS: messages.GNSS,
    PAIRS: messages.PAIR_ESTIMATE,
    SKIPS: messages.PAIR_ESTIMATE,
    LOOPS: messages.PAIR_ESTIMATE,
    LEVELS: messages.PAIR_ESTIMATE,
    TF: messages.TRANSFORMS,
    TF_STATIC: messages.TRANSFORMS,
}

_RESULT_TYPES = {
    ODOMETRY_PREFIX: messages.ODOMETRY,
    PATH_PREFIX: messages.PATH,
    ESTIMATOR_PREFIX: messages.ESTIMATOR_STATE,
}


def message_type(topic: str) -> str:
    """The type that we write on a topic of ours."""
    for prefix, result in _RESULT_TYPES.items():
        if topic.startswith(prefix):
            return result
    return _MESSAGE_TYPES[topic]
