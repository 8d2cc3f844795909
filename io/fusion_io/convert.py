"""Convert recordings into logs: ``python -m fusion_io.convert <kind of recording> ... --out X.mcap``.

Whatever was missing or skipped is counted and printed as one warning on stderr. Exit codes: 0 the log is
written, 1 it could not be, 2 usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_io.command import answered, command_parser
from fusion_io.errors import EXIT_OK, UsageError
from fusion_io.words import counted

if TYPE_CHECKING:
    from fusion_io.front_end_noise import FrontEndNoise
    from fusion_io.images import Framing
    from fusion_io.recording import Recording
    from fusion_io.records import Trajectory

# Modules that bring numpy, scipy or OpenCV are imported by the function that needs them, so that --help
# and usage errors answer at once.

#: What the error of a pair was, per axis (root mean square against ground truth), for a published visual
#: odometry on KITTI 09: 0.043 m and 0.44 mrad.
SIGMA_TRANSLATION_M = 0.04
SIGMA_ROTATION_RAD = 0.0005


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    args = _parser(argv).parse_args(argv)
    return answered(lambda: args.run(args), ": nothing was written")


# ------------------------------------------------------------------------------------------------- arguments


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    parser = command_parser(
        "fusion_io.convert",
        "Convert a recording into a log.",
        "Exit codes: 0 the log is written, 1 it could not be, 2 usage, 130 interrupted.",
    )
    kinds = parser.add_subparsers(title="kinds of recording", required=True, metavar="KIND")

    _add_odometry_arguments(_add_kind(kinds, "kitti-odometry", "a sequence of the odometry benchmark", _open_odometry))
    _add_raw_arguments(_add_kind(kinds, "kitti-raw", "a raw drive of KITTI (..._sync)", _open_raw))
    _add_trajectory_arguments(_add_kind(kinds, "trajectory", "a published odometry result", _open_trajectory))
    _add_folder_arguments(_add_kind(kinds, "folder", "one's own images, depth, IMU and camera file", _open_folder))
    simulate = kinds.add_parser("simulate", help="a procedural street: RGB-D, IMU, exact ground truth")
    if argv[:1] == ["simulate"]:  # its arguments come from its module, which is too heavy to import for --help
        from fusion_io import simulation

        simulation.add_arguments(simulate)
        simulate.set_defaults(run=simulation.run)
    return parser


def _add_kind(
    kinds: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    help_text: str,
    open_recording: Callable[[argparse.Namespace], Recording],
) -> argparse.ArgumentParser:
    """A subcommand that writes the recording which ``open_recording`` makes of its arguments."""
    parser = kinds.add_parser(name, help=help_text)
    parser.add_argument("--out", type=Path, required=True, metavar="X.mcap", help="the log to write")
    parser.set_defaults(kind=name, open=open_recording, run=_convert)
    return parser


def _add_odometry_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = """The official layout: sequences/NN with image_0 and image_1 (grey) or image_2 and image_3
        (colour), calib.txt, times.txt, velodyne if it is there, and poses/NN.txt as ground truth if it is there."""
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="the folder of sequences/ and poses/")
    parser.add_argument("--sequence", required=True, metavar="NN", help="name of the sequence, such as 06")
    imu = parser.add_mutually_exclusive_group()
    imu.add_argument("--imu", type=Path, metavar="FILE.mat", help="the sequence's IMU, ten rows a frame")
    imu.add_argument(
        "--oxts",
        type=Path,
        metavar="DIR",
        help="the folder of the sequence's raw drive, whose OXTS unit is the IMU: ..._extract (100 Hz; the ..._sync "
        "drive beside it tells the times of the frames) or ..._sync (10 Hz)",
    )
    _add_kitti_arguments(parser)


def _add_raw_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = """A drive of rectified images with its OXTS unit as IMU and, moved into the left camera, as
        ground truth."""
    parser.add_argument("--drive", type=Path, required=True, metavar="DIR", help="the drive's folder, ..._sync")
    parser.add_argument(
        "--calib", type=Path, metavar="DIR", help="the folder of calib_*.txt (default: the folder that the drive is in)"
    )
    parser.add_argument(
        "--gnss",
        type=positive_number,
        metavar="SECONDS",
        help="take an OXTS position every so often as a GNSS fix, with noise; the log then has no ground truth, which "
        "comes from the same unit",
    )
    parser.add_argument(
        "--gnss-noise",
        type=positive_number,
        default=1.0,
        metavar="M",
        help="standard deviation of a fix, per axis, in metres (default %(default)g)",
    )
    parser.add_argument("--gnss-seed", type=seed, default=0, metavar="N", help="of that noise (default 0)")
    _add_kitti_arguments(parser)


def _add_kitti_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--depth",
        choices=("stereo", "velodyne"),
        help="where depth comes from (default: stereo, if there is a right camera). A scan's points are sparse, and "
        "nothing is filled in between: take it with --resize to the network's size",
    )
    parser.add_argument(
        "--frames", type=frame_range, default=slice(None), metavar="A:B", help="only frames A to B - 1 (default: all)"
    )
    parser.add_argument("--colour", action="store_true", help="take the colour cameras (default: the grey ones)")
    _add_framing_arguments(parser)


def _add_framing_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--resize", type=image_size, metavar="WxH", help="scale images and depth to this size")
    parser.add_argument(
        "--crop-height",
        type=positive_integer,
        metavar="ROWS",
        help="keep only so many rows, from the bottom (before --resize)",
    )


def _add_trajectory_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = """A trajectory becomes a log of pair estimates between its consecutive poses, so that any
        system's output can be fused. Formats: KITTI (12 numbers a line, or 13 with the frame's index in
        front), TUM (stamp tx ty tz qx qy qz qw), and MCAP logs with odometry or poses."""
    parser.add_argument(
        "--poses", type=Path, required=True, metavar="FILE", help="the trajectory, KITTI, TUM or an MCAP log"
    )
    parser.add_argument("--topic", metavar="NAME", help="the topic of the poses, where an MCAP log has several")
    parser.add_argument(
        "--times",
        type=Path,
        metavar="FILE",
        help="stamps of the frames in seconds, one a line (KITTI's times.txt); TUM needs none",
    )
    parser.add_argument(
        "--imu", type=Path, metavar="FILE.mat", help="the sequence's IMU (or FILE.csv, EuRoC's columns, or LOG.mcap)"
    )
    parser.add_argument("--ground-truth", type=Path, metavar="FILE", help="true poses, KITTI (with --times) or TUM")
    parser.add_argument(
        "--sigma-translation",
        type=positive_number,
        default=SIGMA_TRANSLATION_M,
        metavar="M",
        help="standard deviation of a pair's translation, per axis, in metres (default %(default)s: a published "
        "visual odometry's error on KITTI 09; stereo is at about 0.01)",
    )
    parser.add_argument(
        "--sigma-rotation",
        type=positive_number,
        default=SIGMA_ROTATION_RAD,
        metavar="RAD",
        help="standard deviation of a pair's rotation, per axis, in radians (default %(default)s, from the same)",
    )
    parser.add_argument(
        "--noise-seed",
        type=seed,
        metavar="N",
        help="the poses are true: add the noise of a learned front end (white, and correlated from pair to pair), "
        "whose covariance the pairs then have; they are the ground truth too, if no other is given",
    )
    parser.add_argument(
        "--noise-rotation-drift",
        type=positive_number,
        metavar="DEG",
        help="with --noise-seed: standard deviation of what is correlated in a pair's rotation, per axis, in degrees "
        "(default 0.011: about the errors published for VIOLearner)",
    )


def _add_folder_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = """Images and depth are named by their stamp in nanoseconds (.png, .jpg), on the clock of
        the IMU table."""
    parser.add_argument("--images", type=Path, required=True, metavar="DIR", help="grey or colour images")
    parser.add_argument(
        "--depth", type=Path, required=True, metavar="DIR", help="16-bit PNG registered to the images, 0 where unknown"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        required=True,
        metavar="FILE.yaml",
        help="intrinsics, lens, mounting of the IMU if it is there; of OpenCV, ROS, EuRoC, Kalibr or ORB-SLAM",
    )
    parser.add_argument(
        "--imu", type=Path, metavar="FILE.csv", help="EuRoC's columns: stamp in ns, gyro, accelerometer"
    )
    parser.add_argument("--ground-truth", type=Path, metavar="FILE.tum", help="true poses of the camera, TUM format")
    parser.add_argument(
        "--depth-scale",
        type=positive_number,
        default=0.001,
        metavar="M",
        help="metres per unit of depth (default %(default)s; 0.0002 for TUM RGB-D)",
    )
    _add_framing_arguments(parser)


def positive_integer(text: str) -> int:
    """An integer above zero, as an argument."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def seed(text: str) -> int:
    """An integer that is not negative, as an argument."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def image_size(text: str) -> tuple[int, int]:
    """``480x128`` as (width, height)."""
    width, separator, height = text.partition("x")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT")
    return positive_integer(width), positive_integer(height)


def frame_range(text: str) -> slice:
    """``A:B`` as a slice, either end may be left out."""
    start, separator, end = text.partition(":")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r} is not FIRST:END")
    bounds = [int(bound) if bound else None for bound in (start, end)]
    if any(bound is not None and bound < 0 for bound in bounds):
        raise argparse.ArgumentTypeError(f"{text!r} counts from the end")
    return slice(*bounds)


def positive_number(text: str) -> float:
    """A finite number above zero, as an argument."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


# ------------------------------------------------------------------------------------------- the subcommands


def _convert(args: argparse.Namespace) -> int:
    recording: Recording = args.open(args)
    recording.write(args.out, {"converter": _provenance(args)})
    print(f"{args.out}: {_summary(recording)}")
    if recording.warnings:
        counts = ", ".join(f"{what}: {count}" for what, count in sorted(recording.warnings.items()))
        print(f"warning: {counts}", file=sys.stderr)
    return EXIT_OK


def _open_odometry(args: argparse.Namespace) -> Recording:
    from fusion_io import kitti

    return kitti.open_odometry(
        args.root,
        args.sequence,
        imu=args.imu,
        oxts=args.oxts,
        depth=args.depth,
        frames=args.frames,
        colour=args.colour,
        framing=_framing(args),
    )


def _open_raw(args: argparse.Namespace) -> Recording:
    from fusion_io import kitti
    from fusion_io.gnss import Receiver

    if args.gnss is not None:
        print("no ground truth beside GNSS fixes: both come from the OXTS unit", file=sys.stderr)
    return kitti.open_raw(
        args.drive,
        args.calib,
        depth=args.depth,
        frames=args.frames,
        colour=args.colour,
        gnss=None if args.gnss is None else Receiver(args.gnss, args.gnss_noise, args.gnss_seed),
        framing=_framing(args),
    )


def _open_folder(args: argparse.Namespace) -> Recording:
    from fusion_io.folder import open_folder

    return open_folder(
        args.images,
        args.depth,
        args.camera,
        imu=args.imu,
        ground_truth=args.ground_truth,
        metres_per_unit=args.depth_scale,
        framing=_framing(args),
    )


def _framing(args: argparse.Namespace) -> Framing:
    from fusion_io.images import Framing

    return Framing(args.crop_height, args.resize)


def _open_trajectory(args: argparse.Namespace) -> Recording:
    from fusion_io.folder import read_imu_csv
    from fusion_io.front_end_noise import with_noise
    from fusion_io.kitti import read_imu_mat
    from fusion_io.reader import open_log
    from fusion_io.recording import Recording
    from fusion_io.trajectory_files import pair_estimates, read_times, read_trajectory

    if args.noise_rotation_drift is not None and args.noise_seed is None:
        raise UsageError("--noise-rotation-drift: there is no noise without --noise-seed")
    stamps_ns = None if args.times is None else read_times(args.times)
    recording = Recording()
    poses = _recorded_poses(args.poses, args.topic) if _is_log(args.poses) else read_trajectory(args.poses, stamps_ns)
    recording.pairs = pair_estimates(poses, args.sigma_translation, args.sigma_rotation)
    if args.noise_seed is not None:
        recording.pairs = with_noise(recording.pairs, args.noise_seed, _front_end_noise(args))
        recording.ground_truth = poses
    if args.ground_truth is not None:
        recording.ground_truth = read_trajectory(args.ground_truth, stamps_ns)
    if args.imu is not None and args.imu.suffix.lower() == ".csv":
        recording.imu = read_imu_csv(args.imu, recording.warnings)
    elif args.imu is not None and _is_log(args.imu):
        recording.imu = open_log(args.imu).imu()
    elif args.imu is not None:
        if stamps_ns is None:
            raise UsageError(f"{args.imu}: has no times of its own: give --times")
        recording.imu = read_imu_mat(args.imu, stamps_ns)
    return recording


def _is_log(path: Path) -> bool:
    return path.suffix.lower() == ".mcap"


def _recorded_poses(path: Path, topic: str | None) -> Trajectory:
    """The odometry or the poses of a log; what of it was left out is said on stderr."""
    from fusion_io.odometry import read_trajectories, trajectory_on

    recorded = read_trajectories(path)
    for note in recorded.notes:
        print(f"warning: {note}", file=sys.stderr)
    return trajectory_on(path, recorded, topic)


def _front_end_noise(args: argparse.Namespace) -> FrontEndNoise:
    from fusion_io.front_end_noise import FrontEndNoise

    drift_deg = args.noise_rotation_drift
    return FrontEndNoise() if drift_deg is None else FrontEndNoise(rotation_drift_deg=drift_deg)


def _provenance(args: argparse.Namespace) -> dict[str, str]:
    """What made the log: kind and arguments (of paths only the name: logs must not differ by machine), version."""
    from importlib.metadata import version

    left_out = {"run", "open", "out"}
    given = {name: value for name, value in vars(args).items() if name not in left_out and value is not None}
    return {"version": version("violearner-fusion"), **{name: _text(value) for name, value in given.items()}}


def _text(value: object) -> str:
    """An argument as it was written, but of a path only the name."""
    match value:
        case Path():
            return value.resolve().name
        case slice():
            return ":".join("" if bound is None else str(bound) for bound in (value.start, value.stop))
        case (width, height):
            return f"{width}x{height}"
        case _:
            return str(value)


def _summary(recording: Recording) -> str:
    counts = {
        "frame": recording.frame_count,
        "pair": len(recording.pairs),
        "IMU sample": 0 if recording.imu is None else len(recording.imu),
        "ground-truth pose": 0 if recording.ground_truth is None else len(recording.ground_truth),
        "GNSS fix": len(recording.gnss),
    }
    many = {"GNSS fix": "GNSS fixes"}
    return ", ".join(counted(count, what, many.get(what, "")) for what, count in counts.items() if count)


if __name__ == "__main__":
    sys.exit(main())
