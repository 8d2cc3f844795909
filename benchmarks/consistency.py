"""Whether the back ends know how wrong they are: Monte Carlo over drives whose errors are drawn from their model.

``python benchmarks/consistency.py [--runs 150] [--seconds 30] [--hand] [--skips]`` solves drives of `benchmarks.drives`
with both back ends, and prints normalised squared errors by degree of freedom (1 is right, more is overconfident, less
timid) with the 95 % chi-square bounds of their mean over all runs, and the same of the filter's innovations. It asserts
nothing.

Errors at one frame of different runs are independent, so that the bounds are exact but for linearisation; those of the
biases add three axes whose correlations are not looked at, and their bounds are as wide as if these were one.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.drives import EKF, POSE_GRAPH, Drive, car, hand, simulate
from fusion import ekf, posegraph
from fusion.evaluation import pose_errors
from fusion.measurements import Estimate, Mounting
from fusion_io.progress import track
from fusion_io.records import FloatArray, Trajectory

WARM_UP = 10  # frames of the filter's innovations that are left out: it starts with hardly a velocity
FRACTIONS = {"a third": 1 / 3, "two thirds": 2 / 3, "the end": 1.0}
BACK_ENDS = ("posegraph", "ekf")
DIFFERENCE = "difference of the two at the end"  # which may be as small as it likes


@dataclass(frozen=True)
class Square:
    """A normalised squared error, its degrees of freedom, and how many of these are surely independent."""

    value: float
    freedoms: int
    independent: int

    @staticmethod
    def of(error: FloatArray, covariance: FloatArray) -> Square:
        """Of an error (M,) with a covariance (M, M)."""
        return Square(float(error @ np.linalg.solve(covariance, error)), len(error), len(error))

    @staticmethod
    def of_axes(error: FloatArray, std: FloatArray) -> Square:
        """Of an error (M,) whose axes have standard deviations (M,)."""
        return Square(float(np.sum((error / std) ** 2)), len(error), 1)


def squares(drive: Drive, estimates: dict[str, Estimate]) -> dict[tuple[str, str], Square]:
    """All normalised squares of one run, by quantity and back end."""
    found: dict[tuple[str, str], Square] = {}
    for name, estimate in estimates.items():
        of_poses = pose_squares(estimate.trajectory, drive.truth)
        of_rest = {**of_poses, **series_squares(drive, estimate), **mounting_squares(drive, estimate)}
        found |= {(quantity, name): square for quantity, square in of_rest.items()}
    series = estimates["ekf"].series
    assert series is not None
    nis = series.nis[1 + WARM_UP :]
    found["innovations", "ekf"] = Square(float(np.sum(nis)), 6 * len(nis), 6 * len(nis))
    found[DIFFERENCE, "ekf"] = agreement(*(estimates[name].trajectory for name in BACK_ENDS))
    return found


def pose_squares(estimate: Trajectory, truth: Trajectory) -> dict[str, Square]:
    """Of pose, position and orientation at some fractions of the drive."""
    assert estimate.covariances is not None
    position, orientation = pose_errors(estimate.poses, truth.poses)
    found = {}
    for where, fraction in FRACTIONS.items():
        k = round(fraction * (len(truth) - 1))
        covariance = estimate.covariances[k]
        found[f"pose at {where}"] = Square.of(np.append(orientation[k], position[k]), covariance)
        found[f"position at {where}"] = Square.of(position[k], covariance[3:, 3:])
        found[f"orientation at {where}"] = Square.of(orientation[k], covariance[:3, :3])
    return found


def series_squares(drive: Drive, estimate: Estimate) -> dict[str, Square]:
    """Of what is estimated for every frame, at the end."""
    series = estimate.series
    assert series is not None
    scale = series.scale_error[-1:] - drive.front_end[-1, :1]
    return {
        "gyro bias": Square.of_axes(series.gyro_bias[-1] - drive.gyro_bias[-1], series.gyro_bias_std[-1]),
        "accelerometer bias": Square.of_axes(
            series.accelerometer_bias[-1] - drive.accelerometer_bias[-1], series.accelerometer_bias_std[-1]
        ),
        "scale error": Square.of_axes(scale, series.scale_error_std[-1:]),
        "rate bias": Square.of_axes(series.rate_bias[-1] - drive.front_end[-1, 1:], series.rate_bias_std[-1]),
    }


def mounting_squares(drive: Drive, estimate: Estimate) -> dict[str, Square]:
    """Of how the IMU is mounted, its clock, and the misalignment of the front end."""
    found = estimate.mounting
    assert found is not None
    error = mounting_error(drive, found)
    parts = {
        "mounting, rotation": slice(0, 3),
        "mounting, lever arm": slice(3, 6),
        "time offset": slice(6, 7),
        "misalignment": slice(7, 10),
    }
    return {name: Square.of(error[part], found.covariance[part, part]) for name, part in parts.items()}


def mounting_error(drive: Drive, found: Mounting) -> FloatArray:
    """(10,): of what a covariance of `Mounting` speaks."""
    R = found.T_camera_imu[:3, :3]
    turned = Rotation.from_matrix(R.T @ drive.T_camera_imu[:3, :3]).as_rotvec()
    moved = R.T @ (drive.T_camera_imu[:3, 3] - found.T_camera_imu[:3, 3])
    return np.concatenate([turned, moved, [drive.ahead_s - found.ahead_s], drive.misalignment - found.misalignment])


def agreement(graph: Trajectory, filtered: Trajectory) -> Square:
    """Of the difference of the last poses, by the filter's covariance: at most 1, for the graph knows no less.

    The errors of the best estimate have nothing to do with how another differs from it, so that this difference has
    the covariance of the other less that of the best.
    """
    assert filtered.covariances is not None
    position, orientation = pose_errors(filtered.poses[-1:], graph.poses[-1:])
    return Square.of(np.append(orientation, position), filtered.covariances[-1])


def bounds(squares_of_runs: list[Square], probability: float = 0.95) -> tuple[float, float, float]:
    """The mean by degree of freedom, and between what it lies with a probability where the covariances are right."""
    freedoms, independent = (
        sum(getattr(square, name) for square in squares_of_runs) for name in ("freedoms", "independent")
    )
    tail = (1.0 - probability) / 2
    low, high = chi2.ppf([tail, 1.0 - tail], independent) / independent
    return sum(square.value for square in squares_of_runs) / freedoms, float(low), float(high)


def main() -> None:
    """Simulate, solve, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=150)
    parser.add_argument("--seconds", type=float, default=30.0, help="length of a drive")
    parser.add_argument("--hand", action="store_true", help="in the hand of somebody who walks, instead of a car")
    parser.add_argument("--skips", action="store_true", help="with pairs that skip a frame")
    options = parser.parse_args()

    found: dict[tuple[str, str], list[Square]] = defaultdict(list)
    spent_s: dict[str, float] = defaultdict(float)
    for seed in track(range(options.runs), "drives", options.runs):
        drive = simulate(seed, options.seconds, carrier=hand if options.hand else car, skipping=options.skips)
        estimates = {}
        for name in BACK_ENDS:
            began = time.process_time()
            estimates[name] = (
                posegraph.solve(drive.measurements, POSE_GRAPH)
                if name == "posegraph"
                else ekf.solve(drive.measurements, EKF)
            )
            spent_s[name] += time.process_time() - began
        for key, square in squares(drive, estimates).items():
            found[key].append(square)

    console = Console(width=110)
    console.print(table(found, options))
    spent = ", ".join(f"{name} {seconds / options.runs:.2f} s" for name, seconds in spent_s.items())
    console.print(f"processor time a drive: {spent}")


def table(found: dict[tuple[str, str], list[Square]], options: argparse.Namespace) -> Table:
    """A row for each quantity; what is out of bounds is marked."""
    carrier = "hand-held" if options.hand else "car"
    result = Table(title=f"{carrier}: mean normalised squares of {options.runs} drives of {options.seconds:g} s")
    for heading in ("quantity", *BACK_ENDS, "95 % bounds"):
        result.add_column(heading, justify="left" if heading == "quantity" else "right")
    for quantity in dict.fromkeys(quantity for quantity, _ in found):
        cells = []
        for name in BACK_ENDS:
            if (quantity, name) not in found:
                cells.append("")
                continue
            mean, low, high = bounds(found[quantity, name])
            inside = mean <= high and (mean >= low or quantity == DIFFERENCE)
            cells.append(f"{mean:.2f}" + ("" if inside else " *"))
        result.add_row(quantity, *cells, f"{low:.2f} to {high:.2f}")
    return result


if __name__ == "__main__":
    main()
