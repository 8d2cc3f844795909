"""The paper's claims, each tested by an experiment: what an assumption that does not hold costs the estimates.

``python benchmarks/claims.py [--drives 4] [--frames 16] [--weights FILE]`` simulates drives, changes one thing at a
time (the mounting of the IMU, its clock, its rate, samples that are missing, the camera, the light) and prints the
errors of all pairs beside those of the unchanged drives. The same drives, and but for other cameras and lights the same
pixels, are compared. Level 0 is what the network makes of the IMU alone. Depth is exact: it is the ratios that count.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from fusion_io.progress import track
from fusion_io.records import NANOSECONDS, CameraFrame, FloatArray, ImuSeries, Trajectory
from fusion_io.simulation.logs import Setup, simulate_drive
from learned import weights as weights_file
from learned.estimator import infer
from learned.scores import Score, score
from learned.weights import Weights

FIRST_SEED = 9_000_000  # worlds that no training, validation or fit has seen
FRAME_RATE_HZ = 10.0
FASTEST_IMU_HZ = 400
IMU_HZ = 100
FOV_DEG = 81.0
ESTIMATES = ("level 0", "network", "refined")


@dataclass(frozen=True)
class Drive:
    """A simulated drive: its frames, its IMU and the same at 400 Hz, and where the camera was."""

    seed: int
    frames: list[CameraFrame]
    imu: ImuSeries
    fastest_imu: ImuSeries
    truth: Trajectory


Change = Callable[[Drive], Drive]


def simulated(seed: int, frames: int, fov_deg: float = FOV_DEG) -> Drive:
    """A drive with a camera of this field of view; the world and the way do not depend on the camera."""
    setup = Setup(seed=seed, fov_deg=fov_deg, imu_rate_hz=FASTEST_IMU_HZ)
    recording = simulate_drive(setup, frames / FRAME_RATE_HZ, FRAME_RATE_HZ)
    taken = [frame for frame in recording.frames if isinstance(frame, CameraFrame)]
    imu, truth = recording.imu, recording.ground_truth
    assert imu is not None
    assert truth is not None
    return Drive(seed, taken, averaged(imu, FASTEST_IMU_HZ // IMU_HZ), imu, truth)


# --------------------------------------------------------------------------------------------------- changes


def averaged(imu: ImuSeries, count: int) -> ImuSeries:
    """Means over ``count`` samples at a time, as a slower IMU filters what it shows."""
    whole = len(imu) // count * count

    def means(values: FloatArray) -> FloatArray:
        return np.asarray(values[:whole].reshape(-1, count, 3).mean(axis=1))

    stamps = imu.stamps_ns[:whole].reshape(-1, count)
    middle = stamps[:, 0] + (stamps[:, -1] - stamps[:, 0]) // 2
    return ImuSeries(middle, means(imu.angular_velocity), means(imu.linear_acceleration))


def at_rate(drive: Drive, rate_hz: int) -> Drive:
    """Its IMU at another rate."""
    return replace(drive, imu=averaged(drive.fastest_imu, FASTEST_IMU_HZ // rate_hz))


def remounted(drive: Drive, turn: Rotation) -> Drive:
    """Its IMU turned on the vehicle."""
    imu = drive.imu
    return replace(
        drive,
        imu=replace(
            imu,
            angular_velocity=turn.apply(imu.angular_velocity),
            linear_acceleration=turn.apply(imu.linear_acceleration),
        ),
    )


def delayed(drive: Drive, offset_ms: int) -> Drive:
    """Its IMU's clock ahead of the camera's by the offset."""
    offset_ns = offset_ms * NANOSECONDS // 1000
    return replace(drive, imu=replace(drive.imu, stamps_ns=drive.imu.stamps_ns + offset_ns))


def dropping(drive: Drive, share: float) -> Drive:
    """Its IMU without a share of its samples, taken at random; all of them where the share is 1."""
    kept = np.random.default_rng(drive.seed).random(len(drive.imu)) >= share
    imu = drive.imu
    return replace(drive, imu=ImuSeries(imu.stamps_ns[kept], imu.angular_velocity[kept], imu.linear_acceleration[kept]))


def seen_by(drive: Drive, fov_deg: float) -> Drive:
    """The same way through the same world with another camera."""
    return simulated(drive.seed, len(drive.frames), fov_deg)


def lit(drive: Drive, gains: tuple[float, ...], gamma: float = 1.0) -> Drive:
    """Its images with other gains, one a frame in turn, and another gamma."""

    def image(frame: CameraFrame, gain: float) -> NDArray[np.uint8]:
        return np.asarray(np.clip(255 * (frame.image / 255) ** gamma * gain, 0, 255).round(), dtype=np.uint8)

    lights = np.resize(gains, len(drive.frames))
    frames = [replace(f, image=image(f, gain)) for f, gain in zip(drive.frames, lights, strict=True)]
    return replace(drive, frames=frames)


def experiments() -> Iterator[tuple[str, str, Change]]:
    """Claim, what is changed, and the change."""
    for k, turn in enumerate(Rotation.random(5, rng=np.random.default_rng(FIRST_SEED))):
        yield (
            "no extrinsics",
            f"IMU turned by {np.degrees(turn.magnitude()):.0f} deg ({k + 1})",
            partial(remounted, turn=turn),
        )
    for offset_ms in (-50, -25, 25, 50):
        yield "loose synchronisation", f"IMU clock {offset_ms:+d} ms", partial(delayed, offset_ms=offset_ms)
    for rate_hz in (50, 200, 400):
        yield "any IMU", f"{rate_hz} Hz", partial(at_rate, rate_hz=rate_hz)
    for share in (0.1, 0.5):
        yield "any IMU", f"{share:.0%} of the samples dropped", partial(dropping, share=share)
    yield "any IMU", "no IMU", partial(dropping, share=1.0)
    for fov_deg in (60, 70, 95, 110):
        yield "any camera", f"{fov_deg} deg", partial(seen_by, fov_deg=float(fov_deg))
    yield "any light", "half as bright", partial(lit, gains=(0.5,))
    yield "any light", "a third brighter (clips)", partial(lit, gains=(1.33,))
    yield "any light", "gamma 0.6", partial(lit, gains=(1.0,), gamma=0.6)
    yield "any light", "20 % darker in every other frame", partial(lit, gains=(1.0, 0.8))


# ------------------------------------------------------------------------------------------------- evaluation


def evaluate(weights: Weights, drives: list[Drive]) -> dict[str, Score]:
    """Errors over all pairs of all drives, by estimate."""
    estimates: dict[str, list[FloatArray]] = {name: [] for name in ESTIMATES}
    truth = []
    for drive in drives:
        stamps = drive.truth.stamps_ns
        alone, refined = (
            infer(weights, iter(drive.frames), stamps, drive.imu, Counter(), polish) for polish in (False, True)
        )
        for pair in alone:
            estimates["level 0"].append(pair.levels[0])
            estimates["network"].append(pair.pair.T_source_target.as_matrix())
        estimates["refined"] += [each.pair.T_source_target.as_matrix() for each in refined]
        truth.append((drive.truth.poses[:-1].inv() * drive.truth.poses[1:]).as_matrix())
    return {name: score(name, np.stack(poses), np.concatenate(truth)) for name, poses in estimates.items()}


def cells(scores: dict[str, Score], nominal: dict[str, Score]) -> Iterator[str]:
    """Translation and rotation of every estimate, each with its ratio to nominal."""
    for name in ESTIMATES:
        metres, radians = scores[name]["translation_rmse_m"], scores[name]["rotation_rmse_rad"]
        metres_ratio = metres / nominal[name]["translation_rmse_m"]
        radians_ratio = radians / nominal[name]["rotation_rmse_rad"]
        yield f"{metres:.3f} ({metres_ratio:.2f})"
        yield f"{1e3 * radians:.2f} ({radians_ratio:.2f})"


def main() -> int:
    """Simulate, change, evaluate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=4, help="drives, each through a world of its own (default 4)")
    parser.add_argument("--frames", type=int, default=16, help="frames a drive (default 16)")
    parser.add_argument("--weights", type=Path, help="weights file (default: those that ship with the package)")
    options = parser.parse_args()

    weights = weights_file.load(options.weights)
    seeds = [FIRST_SEED + k for k in range(options.drives)]
    drives = [simulated(seed, options.frames) for seed in track(seeds, "render", len(seeds))]
    nominal = evaluate(weights, drives)

    pairs = options.drives * (options.frames - 1)
    table = Table(title=f"{pairs} pairs: RMSE, and its ratio to nominal")
    for column in ("claim", "changed"):
        table.add_column(column)
    for name in ESTIMATES:
        table.add_column(f"{name}, m", justify="right")
        table.add_column(f"{name}, mrad", justify="right")
    table.add_row("", f"nothing: {FOV_DEG:.0f} deg, IMU at {IMU_HZ} Hz", *cells(nominal, nominal))
    previous = ""
    planned = list(experiments())
    for claim, changed, change in track(planned, "experiments", len(planned)):
        if claim != previous:
            table.add_section()
        scores = evaluate(weights, [change(drive) for drive in drives])
        table.add_row(claim if claim != previous else "", changed, *cells(scores, nominal))
        previous = claim
    Console(width=160).print(table)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
