"""Convert recordings into logs: ``python -m fusion_io.convert <kind of recording> ... --out X.mcap``.

Whatever was missing or skipped is counted and printed as one warning on stderr. Exit codes: 0 the log is
written, 1 it could not be, 2 usage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_io.errors import EXIT_FAILED, EXIT_OK, EXIT_USAGE, FusionError, UsageError

if TYPE_CHECKING:
    from fusion_io.recording import Recording

# Modules that bring numpy, scipy or OpenCV are imported by the function that needs them, so that --help
# and usage errors answer at once.

#: What the error of a pair was, per axis (root mean square against ground truth), for a published visual
#: odometry on KITTI 09: 0.043 m and 0.44 mrad, of which a few tenths are the ground truth's own.
SIGMA_TRANSLATION_M = 0.04
SIGMA_ROTATION_RAD = 0.0005


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    args = _parser(argv).parse_args(argv)
    try:
        return args.run(args)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE
    except FusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED


# ------------------------------------------------------------------------------------------------- arguments


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fusion_io.convert", description="Convert a recording into a log.")
    kinds = parser.add_subparsers(title="kinds of recording", required=True, metavar="KIND")

    trajectory = kinds.add_parser("trajectory", help="a published odometry result, as recorded pair estimates")
    _add_trajectory_arguments(trajectory)
    trajectory.set_defaults(run=_convert, kind="trajectory", open=_open_trajectory)

    simulate = kinds.add_parser("simulate", help="a procedural street: RGB-D, IMU, exact ground truth")
    if "simulate" in argv:  # its arguments come from its module, which is too heavy to import for --help
        from fusion_io import simulation

        simulation.add_arguments(simulate)
        simulate.set_defaults(run=simulation.run)
    return parser


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="X.mcap", help="the log to write")


def _add_trajectory_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = """A trajectory becomes a log of pair estimates between its consecutive poses, so that any
        system's output can be fused. Formats: KITTI (12 numbers a line, or 13 with the frame's index in
        front) and TUM (stamp tx ty tz qx qy qz qw)."""
    parser.add_argument("--poses", type=Path, required=True, metavar="FILE", help="the trajectory, KITTI or TUM")
    parser.add_argument(
        "--times",
        type=Path,
        metavar="FILE",
        help="stamps of the frames in seconds, one a line (KITTI's times.txt); TUM needs none",
    )
    parser.add_argument(
        "--imu", type=Path, metavar="FILE.mat", help="the sequence's IMU (or FILE.csv, EuRoC's columns)"
    )
    parser.add_argument("--ground-truth", type=Path, metavar="FILE", help="true poses, KITTI (with --times) or TUM")
    parser.add_argument(
        "--sigma-translation",
        type=_positive,
        default=SIGMA_TRANSLATION_M,
        metavar="M",
        help="standard deviation of a pair's translation, per axis, in metres (default %(default)s: a published "
        "visual odometry's error on KITTI 09; stereo is at about 0.01)",
    )
    parser.add_argument(
        "--sigma-rotation",
        type=_positive,
        default=SIGMA_ROTATION_RAD,
        metavar="RAD",
        help="standard deviation of a pair's rotation, per axis, in radians (default %(default)s, from the same)",
    )
    _add_out(parser)


def _positive(text: str) -> float:
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
        counts = ", ".join(f"{count} {what}" for what, count in sorted(recording.warnings.items()))
        print(f"warning: {counts}", file=sys.stderr)
    return EXIT_OK


def _open_trajectory(args: argparse.Namespace) -> Recording:
    from fusion_io.kitti import read_imu_mat
    from fusion_io.recording import Recording
    from fusion_io.trajectory_files import pair_estimates, read_times, read_trajectory

    stamps_ns = None if args.times is None else read_times(args.times)
    recording = Recording()
    poses = read_trajectory(args.poses, stamps_ns)
    recording.pairs = pair_estimates(poses, args.sigma_translation, args.sigma_rotation)
    if args.ground_truth is not None:
        recording.ground_truth = read_trajectory(args.ground_truth, stamps_ns)
    if args.imu is not None:
        if stamps_ns is None:
            raise UsageError(f"{args.imu}: has no times of its own: give --times")
        recording.imu = read_imu_mat(args.imu, stamps_ns)
    return recording


def _provenance(args: argparse.Namespace) -> dict[str, str]:
    """What made the log: kind and arguments (of paths only the name: logs must not differ by machine), version."""
    from importlib.metadata import version

    values = {name: value for name, value in vars(args).items() if name not in {"run", "open", "out"}}
    texts = {
        name: value.resolve().name if isinstance(value, Path) else str(value)
        for name, value in values.items()
        if value is not None
    }
    return {"version": version("violearner-fusion"), **texts}


def _summary(recording: Recording) -> str:
    counts = {
        "frames": recording.frame_count,
        "pairs": len(recording.pairs),
        "IMU samples": 0 if recording.imu is None else len(recording.imu),
        "ground-truth poses": 0 if recording.ground_truth is None else len(recording.ground_truth),
        "GNSS fixes": len(recording.gnss),
    }
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count)


if __name__ == "__main__":
    sys.exit(main())
