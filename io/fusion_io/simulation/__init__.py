"""A procedural street with a camera and an IMU moving through it: logs, and clips to train on.

textures: what surfaces look like; street, ground: what stands where; traffic: what moves; world:
the renderer; motion, carriers: how a car, a hand or a drone moves the camera, and what an IMU
measures; photometry, sensors: what cameras and depth sensors make of it; clips, logs: what comes out.
"""

from __future__ import annotations

# Modules that bring numpy, scipy or OpenCV are imported by the function that needs them: --help answers at once.
import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_io.errors import EXIT_OK, UsageError

if TYPE_CHECKING:
    from fusion_io.recording import Recording
    from fusion_io.records import CameraFrame, ImuSeries, Trajectory

DEFAULT_SECONDS = 20.0
MOTIONS = ("vehicle", "handheld", "drone")
DEPTHS = ("exact", "stereo", "lidar", "tof")


def clip(
    seed: int, frames: int, width: int, height: int, exact_depth: bool = False
) -> tuple[list[CameraFrame], ImuSeries, Trajectory]:
    """A short journey through a fresh random world, to train on; see ``clips.clip``."""
    from fusion_io.simulation import clips

    return clips.clip(seed, frames, width, height, exact_depth)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``python -m fusion_io.convert simulate``."""
    parser.description = """A journey through a procedural street: grey or colour images, depth, an IMU with bias and
        noise, exact ground truth. With --poses the camera follows a given trajectory, and the road with it.
        The same arguments give the same log."""
    parser.add_argument("--out", type=Path, required=True, metavar="X.mcap", help="the log to write")
    parser.add_argument(
        "--seconds",
        type=_positive,
        help=f"length of the drive (default {DEFAULT_SECONDS:g}; with --poses all of the trajectory)",
    )
    parser.add_argument("--seed", type=_count, default=0, help="of the world, the drive and the noise (default 0)")
    parser.add_argument("--size", type=_size, default=(480, 128), metavar="WxH", help="of the images (default 480x128)")
    parser.add_argument(
        "--fov-deg", type=_angle, default=81.0, help="horizontal field of view (default 81, as KITTI's)"
    )
    parser.add_argument("--colour", action="store_true", help="RGB images instead of grey ones")
    parser.add_argument(
        "--motion", choices=MOTIONS, default="vehicle", help="what carries the camera (default vehicle)"
    )
    parser.add_argument(
        "--depth",
        choices=DEPTHS,
        default="exact",
        help="exact to 80 m, or as stereo matching, a LiDAR of 64 lines or a time-of-flight camera of 8 m range has it "
        "(default exact)",
    )
    parser.add_argument(
        "--photometry",
        choices=("clean", "real"),
        default="clean",
        help="clean: a fixed exposure and a little noise; real: automatic exposure with sudden changes, gamma, "
        "vignette, shot noise, blur (default clean)",
    )
    parser.add_argument(
        "--moving-cars", type=_count, default=0, metavar="N", help="cars that come near the camera (default 0)"
    )
    parser.add_argument("--frame-rate", type=_positive, default=10.0, metavar="HZ", help="of the camera (default 10)")
    parser.add_argument("--imu-rate", type=_positive, default=100.0, metavar="HZ", help="of the IMU (default 100)")
    parser.add_argument(
        "--imu-mounting-deg",
        type=_three_numbers,
        default=(0.0, 0.0, 0.0),
        metavar="R,P,Y",
        help="roll, pitch and yaw by which the IMU is turned about its axes from x forward, y left, z up (yaw first; "
        "write a leading minus as --imu-mounting-deg=-90,0,0)",
    )
    parser.add_argument(
        "--imu-offset-ms",
        type=_finite,
        default=0.0,
        metavar="MS",
        help="how much the stamps of the IMU are ahead of the camera's: t_imu = t_camera + offset (default 0)",
    )
    parser.add_argument(
        "--imu-dropout",
        type=_share,
        default=0.0,
        metavar="SHARE",
        help="of IMU samples that are lost, singly; with any there is also a burst every ten seconds (default 0)",
    )
    parser.add_argument("--write-mounting", action="store_true", help="tell the IMU's mounting in /tf_static")
    receiver = parser.add_argument_group("satellite positions, of an antenna above and behind the camera")
    receiver.add_argument("--gnss", type=_positive, metavar="SECONDS", help="a fix every so often (default: none)")
    receiver.add_argument(
        "--gnss-noise", type=_positive, default=1.0, metavar="M", help="standard deviation per axis (default 1)"
    )
    receiver.add_argument(
        "--gnss-outliers",
        type=_share,
        default=0.0,
        metavar="SHARE",
        help="of fixes that are 50 m off, as by reflected signals (default 0)",
    )
    given = parser.add_argument_group("along a given trajectory")
    given.add_argument("--poses", type=Path, metavar="FILE", help="poses of the camera, in KITTI's or TUM's format")
    given.add_argument("--times", type=Path, metavar="FILE", help="stamps of KITTI's poses, seconds, one a line")
    given.add_argument("--imu", type=Path, metavar="FILE.mat", help="the sequence's real IMU, instead of a simulated")


def run(args: argparse.Namespace) -> int:
    """Simulate and write the log; returns the exit code."""
    from importlib.metadata import version

    _check_combination(args)
    recording = _simulate(args)
    names = {name: value for name, value in vars(args).items() if name not in {"run", "out"} and value is not None}
    texts = {name: value.name if isinstance(value, Path) else str(value) for name, value in names.items()}
    recording.write(args.out, {"simulation": {"version": version("violearner-fusion"), **texts}})
    samples = 0 if recording.imu is None else len(recording.imu)
    print(f"{args.out}: {recording.frame_count} frames, {samples} IMU samples")
    return EXIT_OK


def _simulate(args: argparse.Namespace) -> Recording:
    from scipy.spatial.transform import Rotation

    from fusion_io.gnss import Receiver
    from fusion_io.simulation import logs
    from fusion_io.simulation.motion import ROTATION_IMU_CAMERA_KITTI, ImuModel
    from fusion_io.simulation.photometry import REAL_CAMERA, ImageModel
    from fusion_io.simulation.sensors import Lidar, Stereo, TimeOfFlight

    sensors = {"exact": None, "stereo": Stereo(), "lidar": Lidar(), "tof": TimeOfFlight()}
    roll, pitch, yaw = args.imu_mounting_deg
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)  # of the IMU: vectors turn the other way
    mounting = turn.inv() * ROTATION_IMU_CAMERA_KITTI
    receiver = None if args.gnss is None else Receiver(args.gnss, args.gnss_noise, args.seed, args.gnss_outliers)
    setup = logs.Setup(
        seed=args.seed,
        width=args.size[0],
        height=args.size[1],
        fov_deg=args.fov_deg,
        colour=args.colour,
        image_model=REAL_CAMERA if args.photometry == "real" else ImageModel(),
        depth_sensor=sensors[args.depth],
        moving_cars=args.moving_cars,
        imu_rate_hz=args.imu_rate,
        imu=ImuModel(rotation_imu_camera=mounting, time_offset_s=1e-3 * args.imu_offset_ms),
        imu_dropout=args.imu_dropout,
        gnss=receiver,
    )
    if args.poses is None:
        recording = logs.simulate_drive(
            setup, args.seconds or DEFAULT_SECONDS, args.frame_rate, logs.Carrier(args.motion)
        )
    else:
        recording = logs.simulate_along(setup, args.poses, args.times, args.imu, args.seconds)
    if args.write_mounting:
        recording.rotation_imu_camera = mounting
    return recording


def _check_combination(args: argparse.Namespace) -> None:
    """Refuses arguments that do nothing together."""
    if args.poses is None and (args.times is not None or args.imu is not None):
        raise UsageError("--times and --imu belong to --poses")
    if args.poses is not None and args.motion != "vehicle":
        raise UsageError(f"{args.poses}: is the motion: --motion {args.motion} has no place beside it")
    if args.imu is None:
        return
    if args.times is None:
        raise UsageError(f"{args.imu}: has no times of its own: give --times")
    if args.write_mounting or args.imu_mounting_deg != (0.0, 0.0, 0.0):
        raise UsageError(f"{args.imu}: a real IMU has a mounting of its own: neither give nor write one")
    if args.imu_offset_ms != 0.0:
        raise UsageError(f"{args.imu}: a real IMU has a time offset of its own: --imu-offset-ms cannot give one")


# ------------------------------------------------------------------------------------------------- arguments


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def _share(text: str) -> float:
    value = float(text)
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a share from 0 to below 1")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _angle(text: str) -> float:
    value = float(text)
    if not 0 < value < 170:
        raise argparse.ArgumentTypeError(f"{text} is not an angle between 0 and 170")
    return value


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()) or min(int(width), int(height)) < 8:
        raise argparse.ArgumentTypeError(f"{text} is not a size such as 480x128, 8 or more each way")
    return int(width), int(height)


def _three_numbers(text: str) -> tuple[float, ...]:
    numbers = tuple(float(part) for part in text.split(","))
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"{text} is not three numbers such as 10,0,-90")
    return numbers
