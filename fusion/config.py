"""The configuration of a run: typed, with defaults, read from TOML; unknown names are refused."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from math import hypot
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, ValidationError, field_validator

from fusion.evaluation import KITTI_SEGMENT_LENGTHS_M
from fusion_io.errors import UsageError
from fusion_io.records import PairEstimate

Backend = Literal["posegraph", "ekf", "both"]
FrontendMode = Literal["auto", "violearner", "recorded"]
Record = Literal["light", "all"]
Robust = Literal["gnc", "huber", "none"]
Probability = Annotated[float, Field(gt=0.0, lt=1.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0)]


class Section(BaseModel):
    """A table of the configuration: immutable, and a misspelt name is an error rather than a silent default."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class TopicsConfig(Section):
    """The topic of each role, for logs where name and type do not tell; None lets the reader find it."""

    image: str | None = None
    depth: str | None = None
    camera_info: str | None = None
    imu: str | None = None
    gyro: str | None = None
    accelerometer: str | None = None
    ground_truth: str | None = None
    pairs: str | None = None
    skips: str | None = None
    loops: str | None = None
    gnss: str | None = None
    tf_static: str | None = None


class FrontendConfig(Section):
    """Where the pair estimates come from.

    auto: those recorded in the log if it has any, otherwise the network. weights: a checkpoint of the network, or
    None for the one that ships with the package. adapt: whether the network is first adapted to the log's images.
    refine: whether its estimates are refined to the photometric optimum at full resolution. skips: whether pairs that
    skip one frame are estimated as well, which takes as long again.
    """

    mode: FrontendMode = "auto"
    weights: Path | None = None
    adapt: bool = False
    refine: bool = True
    skips: bool = True


class ImuConfig(Section):
    """What is known about the IMU; whatever is None is estimated from the log.

    rotation_imu_camera_quat_wxyz turns camera vectors into IMU vectors (v_imu = R v_camera); time_offset_s is
    t_imu - t_camera of one event. low_pass_s: time constant of a low-pass filter in the IMU, whose delay is a part of
    the offset; 0 for an IMU without one.
    """

    rotation_imu_camera_quat_wxyz: tuple[float, float, float, float] | None = None
    time_offset_s: float | None = None
    low_pass_s: NotNegative | None = None

    @field_validator("rotation_imu_camera_quat_wxyz")
    @classmethod
    def _unit(cls, quat: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if quat is not None and abs(hypot(*quat) - 1.0) > 0.01:  # written by hand, with few digits
            raise ValueError("must be a unit quaternion")
        return quat


class FusionConfig(Section):
    """What both back ends assume of the sensors.

    The noise of the IMU is that of consumer devices, widened by what the models leave out (vibration, for one):
    gyro_noise (rad/s/sqrt(Hz)), accelerometer_noise (m/s^2/sqrt(Hz)). *_bias_walk: how biases wander (rad/s^2, m/s^3,
    per sqrt(Hz)). *_bias_sigma (rad/s, m/s^2): how far they are from what the calibration found.

    Errors of a front end are correlated in time: beside the covariance of each pair estimate it has a scale error
    (pair_scale_sigma; learned_pair_scale_sigma where the network made the pairs, whose scale is that of the depth; of a
    log that is long enough the pose graph finds out how large it is, and takes this for a first guess) and
    a rate bias (pair_rate_bias_sigma and learned_pair_rate_bias_sigma, rad/s) that change over *_correlation_s, and a
    constant misalignment of its rotations against its translations (pair_misalignment_sigma, rad).

    lever_arm_sigma (m): how far the IMU may be from the camera. gate_probability: how seldom noise alone takes a
    measurement for an outlier.
    """

    gyro_noise: PositiveFloat = 1e-3
    accelerometer_noise: PositiveFloat = 0.09
    gyro_bias_walk: PositiveFloat = 1e-5
    accelerometer_bias_walk: PositiveFloat = 1e-4
    gyro_bias_sigma: PositiveFloat = 2e-4
    accelerometer_bias_sigma: PositiveFloat = 0.2
    pair_scale_sigma: PositiveFloat = 0.025
    learned_pair_scale_sigma: PositiveFloat = 0.005
    pair_scale_correlation_s: PositiveFloat = 10.0
    pair_rate_bias_sigma: PositiveFloat = 3e-3
    learned_pair_rate_bias_sigma: PositiveFloat = 5e-4
    pair_rate_bias_correlation_s: PositiveFloat = 10.0
    pair_misalignment_sigma: PositiveFloat = 7.5e-3
    lever_arm_sigma: PositiveFloat = 1.0
    gate_probability: Probability = 1e-6

    def front_end_sigma(self, pairs: Sequence[PairEstimate]) -> tuple[float, float]:
        """Those of scale error and rate bias of the front end that made the pairs: the network, or another."""
        if any(pair.winner >= 0 for pair in pairs):
            return self.learned_pair_scale_sigma, self.learned_pair_rate_bias_sigma
        return self.pair_scale_sigma, self.pair_rate_bias_sigma


class PoseGraphConfig(FusionConfig):
    """The pose graph back end.

    *_sigma of the mounting (rad) and the time offset (s): of those that are estimated from the log, whose pairs are in
    the graph anyway, and of those that are given. unknown_acceleration (m/s^2/sqrt(Hz)): how the velocity strays where
    no IMU measures it. robust: what becomes of measurements that contradict the others: gnc leaves them out (graduated
    non-convexity), huber believes them less, none believes all.
    """

    mounting_sigma: PositiveFloat = 0.5
    given_mounting_sigma: PositiveFloat = 1e-2
    time_offset_sigma: PositiveFloat = 0.1
    given_time_offset_sigma: PositiveFloat = 1e-3
    unknown_acceleration: PositiveFloat = 5.0
    robust: Robust = "gnc"


class EkfConfig(FusionConfig):
    """The error-state Kalman filter back end.

    Its accelerometer_noise is larger than that of the pose graph: what accelerations tell of scale and attitude is true
    over many seconds, and a filter would believe it at once. Lasting errors of the front end last longer here: what of
    them is constant would else become a bias of the gyro, where the pose graph has gravity against that. mounting_sigma
    (rad), time_offset_sigma (s): where the pose graph has not refined them. gravity_sigma (rad): of its direction at
    first, which accelerations hide. velocity_sigma (m/s): at first, when nothing is known of it. stamp_jitter_s: how
    far a frame's stamp may be from when it was taken.

    angular_acceleration (rad/s^2/sqrt(Hz)) and acceleration (m/s^2/sqrt(Hz)): how the motion strays from a constant one
    where no IMU measures it. After max_rejected_in_a_row pairs were rejected the prediction is taken to be wrong
    instead, and the pairs are believed until both agree.
    """

    accelerometer_noise: PositiveFloat = 1.0
    pair_scale_correlation_s: PositiveFloat = 30.0
    pair_rate_bias_correlation_s: PositiveFloat = 50.0
    mounting_sigma: PositiveFloat = 6e-3
    time_offset_sigma: PositiveFloat = 5e-3
    gravity_sigma: PositiveFloat = 0.3
    velocity_sigma: PositiveFloat = 30.0
    stamp_jitter_s: NotNegative = 2e-3
    angular_acceleration: PositiveFloat = 1.0
    acceleration: PositiveFloat = 5.0
    max_rejected_in_a_row: Annotated[int, Field(ge=0)] = 5


class RetrievalConfig(Section):
    """Where loops are looked for.

    Keyframes: the first frame that is keyframe_distance_m or keyframe_angle_deg away from the keyframe before. Two of
    them are compared where min_time_s and min_path_m lie between. candidates: for each keyframe, so many of the places
    that look most alike, and so many of those that the trajectory puts near: places are near_m plus near_sigmas
    standard deviations apart or less, and their views less than near_angle_deg; two places are place_m of path apart.
    max_drift: share of the path between two frames that the trajectory may be wrong by.
    """

    keyframe_distance_m: PositiveFloat = 2.0
    keyframe_angle_deg: PositiveFloat = 10.0
    min_time_s: PositiveFloat = 10.0
    min_path_m: PositiveFloat = 20.0
    candidates: Annotated[int, Field(ge=1)] = 2
    near_m: PositiveFloat = 5.0
    near_sigmas: PositiveFloat = 3.0
    near_angle_deg: PositiveFloat = 60.0
    place_m: PositiveFloat = 10.0
    max_drift: NotNegative = 0.1


class LoopsConfig(Section):
    """What counts as a loop; with find = false only those that the log has recorded do.

    By features, in both directions: match_ratio, a match is nearer than this times the second nearest; reprojection_px,
    further off it is an outlier; min_inliers, min_inlier_share (of the matches), min_spread (share of the image that
    their convex hull covers). max_distance_m: between the cameras. By all that both frames see: min_overlap, share of
    the source's pixels that the target sees; min_depth, share of those that are where the target sees them, to
    depth_tolerance (relative); min_correlation, of their brightness. gate_probability: how seldom noise alone makes
    the two directions, or features and refinement, contradict each other. rotation_floor_deg, translation_floor_m:
    standard deviations that no loop falls below; those of depth from stereo, which residuals do not show.
    """

    find: bool = True
    retrieval: RetrievalConfig = RetrievalConfig()
    match_ratio: Share = 0.8
    reprojection_px: PositiveFloat = 2.0
    min_inliers: Annotated[int, Field(ge=12)] = 20
    min_inlier_share: Share = 0.5
    min_spread: Share = 0.1
    max_distance_m: PositiveFloat = 10.0
    min_overlap: Share = 0.2
    min_depth: Share = 0.6
    min_correlation: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.5
    depth_tolerance: PositiveFloat = 0.1
    gate_probability: Probability = 1e-6
    rotation_floor_deg: PositiveFloat = 0.1
    translation_floor_m: PositiveFloat = 0.05


class GnssConfig(Section):
    """What is known of a satellite receiver; use = false leaves its positions out.

    sigma (m): of fixes that state no covariance, per axis. antenna: where it is in camera axes (x right, y down, z
    ahead; m), to given_antenna_sigma; where that is not known it is estimated, and lies within antenna_sigma of the
    camera. time_offset_s is t_gnss - t_camera of one event.
    """

    use: bool = True
    sigma: PositiveFloat = 5.0
    antenna: tuple[float, float, float] | None = None
    given_antenna_sigma: PositiveFloat = 0.02
    antenna_sigma: PositiveFloat = 1.0
    time_offset_s: float = 0.0


class RunConfig(Section):
    """Everything that decides the result of a run besides the log itself.

    online: the pose graph runs as a fixed-lag smoother too, which gives what was known at each instant.
    """

    backend: Backend = "both"
    online: bool = False
    record: Record = "light"
    segment_lengths_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = KITTI_SEGMENT_LENGTHS_M
    topics: TopicsConfig = TopicsConfig()
    frontend: FrontendConfig = FrontendConfig()
    imu: ImuConfig = ImuConfig()
    posegraph: PoseGraphConfig = PoseGraphConfig()
    ekf: EkfConfig = EkfConfig()
    loops: LoopsConfig = LoopsConfig()
    gnss: GnssConfig = GnssConfig()


def load(path: Path | None, overrides: dict[str, Any]) -> RunConfig:
    """The configuration of a TOML file (None: the defaults), with the overrides of the command line laid on top.

    Raises UsageError, in one line, for a file that cannot be read, a name that does not exist (with the nearest one
    that does) and a value that does not fit.
    """
    table = _read_toml(path) if path is not None else {}
    where = str(path) if path is not None else "command line"
    try:
        return RunConfig.model_validate(_merged(table, overrides))
    except ValidationError as error:
        raise UsageError(f"{where}: {_first_problem(error)}") from None


def to_toml(config: RunConfig) -> str:
    """The resolved configuration as TOML; what is None (estimated, or unset) is left out, for TOML has no null."""
    return tomli_w.dumps(config.model_dump(mode="json", exclude_none=True))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {' '.join(str(error).split())}") from None


def _merged(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    """Both tables in one, recursively; where both have a value, that of `top`."""
    merged = dict(base)
    for name, value in top.items():
        below = merged.get(name)
        merged[name] = _merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False)[0]
    name = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"unknown name {name!r}{_suggestion(problem['loc'])}"
    return f"{name}: {problem['msg'].removeprefix('Value error, ')}, not {problem['input']!r}"


def _suggestion(location: tuple[int | str, ...]) -> str:
    """Where the unknown name exists; else the nearest one that exists in the table where it stands."""
    if elsewhere := [name for name in _names(RunConfig) if name.split(".")[-1] == location[-1]]:
        return f"; did you mean {' or '.join(map(repr, elsewhere))}?"
    section: type[BaseModel] = RunConfig
    for part in location[:-1]:
        section = section.model_fields[str(part)].annotation  # type: ignore[assignment]  # only sections are nested
    near = get_close_matches(str(location[-1]), section.model_fields, n=1, cutoff=0.0)
    return f"; did you mean {'.'.join([*map(str, location[:-1]), near[0]])!r}?" if near else ""


def _names(section: type[BaseModel]) -> Iterator[str]:
    """All names of a table and of those in it, such as `posegraph.gyro_noise`."""
    for name, field in section.model_fields.items():
        yield name
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from (f"{name}.{inner}" for inner in _names(field.annotation))
