"""The configuration of a run: typed, with defaults, read from TOML; unknown names are refused."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from math import hypot
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, ValidationError, field_validator

from fusion.evaluation import KITTI_SEGMENT_LENGTHS_M
from fusion_io.errors import UsageError

Backend = Literal["posegraph", "ekf", "both"]
FrontendMode = Literal["auto", "violearner", "recorded"]
Record = Literal["light", "all"]


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
    loops: str | None = None
    gnss: str | None = None
    tf_static: str | None = None


class FrontendConfig(Section):
    """Where the pair estimates come from.

    auto: those recorded in the log if it has any, otherwise the network. weights: a checkpoint of the network, or
    None for the one that ships with the package. adapt: whether the network is first adapted to the log's images.
    refine: whether its estimates are refined to the photometric optimum at full resolution.
    """

    mode: FrontendMode = "auto"
    weights: Path | None = None
    adapt: bool = False
    refine: bool = True


class ImuConfig(Section):
    """What is known about the IMU; whatever is None is estimated from the log.

    rotation_imu_camera_quat_wxyz turns camera vectors into IMU vectors (v_imu = R v_camera); time_offset_s is
    t_imu - t_camera of one event.
    """

    rotation_imu_camera_quat_wxyz: tuple[float, float, float, float] | None = None
    time_offset_s: float | None = None

    @field_validator("rotation_imu_camera_quat_wxyz")
    @classmethod
    def _unit(cls, quat: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if quat is not None and abs(hypot(*quat) - 1.0) > 0.01:  # written by hand, with few digits
            raise ValueError("must be a unit quaternion")
        return quat


class PoseGraphConfig(Section):
    """The pose graph back end.

    The noise of the IMU is that of consumer devices, widened by what the model leaves out: gyro_noise (rad/s/sqrt(Hz))
    by errors of mounting and time, accelerometer_noise (m/s^2/sqrt(Hz)) by the unknown lever arm to the camera and by
    errors of the pairs that are correlated in time. *_bias_walk: how biases wander (rad/s^2, m/s^3, per sqrt(Hz)).
    *_bias_sigma: how far they may be from zero (rad/s, m/s^2); corrected_gyro_bias_sigma where a navigation system
    has removed the gyro's already. pair_rotation_rate_sigma (rad/s): constant rate errors that a front end is taken
    to be capable of. gate_probability: how seldom noise alone makes IMU and pair contradict each other over one step.
    """

    gyro_noise: PositiveFloat = 1e-3
    accelerometer_noise: PositiveFloat = 0.5
    gyro_bias_walk: PositiveFloat = 1e-5
    accelerometer_bias_walk: PositiveFloat = 1e-4
    gyro_bias_sigma: PositiveFloat = 1e-2
    corrected_gyro_bias_sigma: PositiveFloat = 2e-4
    accelerometer_bias_sigma: PositiveFloat = 0.2
    pair_rotation_rate_sigma: PositiveFloat = 3e-4
    gate_probability: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-6


class EkfConfig(Section):
    """The error-state Kalman filter back end.

    The noise of the IMU is that of consumer devices, widened by what the filter leaves out. gyro_noise
    (rad/s/sqrt(Hz)): also errors of mounting and time. accelerometer_noise (m/s^2/sqrt(Hz)): also the unknown lever
    arm to the camera. *_bias_walk (rad/s^2, m/s^3, per sqrt(Hz)): how biases wander; *_bias_sigma (rad/s, m/s^2): how
    far they are from zero at first, the gyro's once the calibration has removed what it could see. gravity_sigma (rad):
    of its direction at first, which accelerations hide. velocity_sigma (m/s): at first, when nothing is known of it.

    Errors of a front end are correlated in time: beside the covariance of each pair estimate, it has a rate bias
    (pair_rate_bias_sigma, rad/s) and a scale error (pair_scale_sigma) that change over pair_correlation_s.

    angular_acceleration (rad/s^2/sqrt(Hz)) and acceleration (m/s^2/sqrt(Hz)): how the motion strays from a constant one
    where no IMU measures it. gate_probability: how seldom noise alone rejects a pair estimate; after
    max_rejected_in_a_row the prediction is taken to be wrong instead, and the pairs are believed until both agree.
    """

    gyro_noise: PositiveFloat = 5e-4
    accelerometer_noise: PositiveFloat = 1.0
    gyro_bias_walk: PositiveFloat = 1e-5
    accelerometer_bias_walk: PositiveFloat = 1e-4
    gyro_bias_sigma: PositiveFloat = 2e-4
    accelerometer_bias_sigma: PositiveFloat = 0.1
    gravity_sigma: PositiveFloat = 0.3
    velocity_sigma: PositiveFloat = 30.0
    pair_rate_bias_sigma: PositiveFloat = 2e-3
    pair_scale_sigma: PositiveFloat = 0.02
    pair_correlation_s: PositiveFloat = 30.0
    angular_acceleration: PositiveFloat = 1.0
    acceleration: PositiveFloat = 5.0
    gate_probability: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-6
    max_rejected_in_a_row: Annotated[int, Field(ge=0)] = 5


class RunConfig(Section):
    """Everything that decides the result of a run besides the log itself."""

    backend: Backend = "both"
    record: Record = "light"
    segment_lengths_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = KITTI_SEGMENT_LENGTHS_M
    topics: TopicsConfig = TopicsConfig()
    frontend: FrontendConfig = FrontendConfig()
    imu: ImuConfig = ImuConfig()
    posegraph: PoseGraphConfig = PoseGraphConfig()
    ekf: EkfConfig = EkfConfig()


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
    """The nearest name that exists in the table where the unknown one stands."""
    section: type[BaseModel] = RunConfig
    for part in location[:-1]:
        section = section.model_fields[str(part)].annotation  # type: ignore[assignment]  # only sections are nested
    near = get_close_matches(str(location[-1]), section.model_fields, n=1, cutoff=0.0)
    return f"; did you mean {'.'.join([*map(str, location[:-1]), near[0]])!r}?" if near else ""
