"""What fusion brings on real recordings, beside what was aimed for: makes ``docs/results.md`` and its plots.

``python benchmarks/results.py [--data ../shared/data] [--cache runs/results] [--only published,noise]`` converts the
recordings under the data folder, runs both back ends, compares with the ground truth and writes the page. What takes
minutes (rendered images, pairs by the network, loops found in images) is kept in the cache folder and used again:
delete it after a change to the network or to how loops are found. A section that was not asked for, or whose data is
absent, is left out of the page.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from results_page import COLUMNS, Check, Path2d, Section, Table, write_page
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation
from threadpoolctl import threadpool_limits

from fusion import chain, ekf, fusing, posegraph
from fusion import run as main_job
from fusion.chain import motions_of
from fusion.config import RunConfig, load
from fusion.evaluation import Metrics, evaluate
from fusion.imu import ImuCalibration, calibrate
from fusion.measurements import Estimate, Measurements
from fusion_io import convert
from fusion_io.errors import EXIT_OK, LogError
from fusion_io.findings import Findings
from fusion_io.reader import Log, open_log
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, PairEstimate, Trajectory
from fusion_io.trajectory_files import pair_estimates
from fusion_io.writer import LogWriter

BACK_ENDS = ("posegraph", "ekf")
WITH_LOOPS = (*BACK_ENDS, "ekf_smoothed")
DEFAULTS = RunConfig()
SEEDS = range(5)
FEWER_SEEDS = range(1)  # for the long sequences that are only reported
NOISY = ("07", "09", "10")
NOISY_REPORTED = ("00", "02", "05", "08")
RENDERED = {"00": 100, "05": 105, "07": 107, "09": 9}  # and the seed of the street
LOOP_SIGMAS = np.repeat([np.deg2rad(0.3), 0.15], 3)
LOOP_NEAR_M, LOOP_GAP_S = 10.0, 30.0
LAST_FRAMES = 25
WRONG_M, WRONG_DEG = 0.5, 2.0  # a loop that is further off is wrong
WRONG_SHARE = 0.2
MANY_LOOPS = 500
SLOW_STEPS = 10.0  # sigma of what is smoothed


@dataclass(frozen=True)
class Place:
    """Where the recordings are, and where what is made of them is kept."""

    data: Path
    cache: Path

    def poses(self, sequence: str) -> Path:
        """Ground truth."""
        return self.data / "kitti/odometry/poses" / f"{sequence}.txt"

    def times(self, sequence: str) -> Path:
        """Stamps of the frames."""
        return self.data / "kitti/odometry/sequences" / sequence / "times.txt"

    def imu(self, sequence: str) -> Path:
        """The IMU of 100 Hz."""
        return self.data / "kitti/odometry/imu" / f"{sequence}.mat"


@dataclass(frozen=True)
class Fused:
    """All that fusion made of one log."""

    truth: Trajectory
    known: Measurements
    calibration: ImuCalibration
    estimates: Mapping[str, Estimate]
    trajectories: Mapping[str, Trajectory]
    metrics: Mapping[str, Metrics]


def main() -> int:
    """Make the sections that are asked for, and the page of them; returns the exit code."""
    arguments = _arguments()
    place = Place(arguments.data, arguments.cache)
    sections = []
    for name in arguments.only or SECTIONS:
        started = perf_counter()
        try:
            sections.append(SECTIONS[name](place))
        except LogError as error:
            print(f"{name}: left out: {error}", file=sys.stderr)
        print(f"{name}: {perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    write_page(arguments.out, sections)
    print(arguments.out)
    return EXIT_OK


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR", help="the recordings")
    parser.add_argument("--cache", type=Path, default=Path("runs/results"), metavar="DIR", help="what is used again")
    parser.add_argument("--out", type=Path, default=Path("docs/results.md"), metavar="FILE.md", help="the page")
    parser.add_argument(
        "--only", type=lambda text: text.split(","), metavar="NAME,...", help=f"of the sections {', '.join(SECTIONS)}"
    )
    return parser.parse_args()


# ---------------------------------------------------------------------------------------------------- sections


def published(place: Place) -> Section:
    """09: a published odometry with the real IMU; with what is asked of consistency, of calibration, of no IMU."""
    log = converted(place, "published-09", *_trajectory(place, "09", published=True))
    fused = fuse(log)
    alone = fuse(log, with_imu=False)
    name = "09, published odometry"
    true_pairs = pair_estimates(fused.truth, 1e-3, 1e-4)
    fit = calibrate(true_pairs, log.imu(), None, None)
    ahead = ahead_ms(fused.known.steps, true_pairs)
    refined = fused.estimates["posegraph"].mounting
    assert refined is not None
    calibration = fused.calibration
    closed_form = _off(fit, calibration.mounting, calibration.time_offset_s)
    in_graph = _off(fit, refined.rotation_imu_camera, calibration.time_offset_s + refined.ahead_s)
    return Section(
        "published",
        "A published odometry on 09, with the real IMU",
        [
            _check(name, "t_rel, %", fused, "t_rel_percent", {"posegraph": 2.37, "ekf": 2.45}),
            _check(name, "r_rel, deg/100 m", fused, "r_rel_deg_per_100m", 0.10),
            _check(name, "t_rel, % (stretch)", fused, "t_rel_percent", 1.8),
            _check(name, "ANEES, position (3 is right)", fused, "anees_position", 6.0),
            _check(name, "ANEES, orientation (3 is right)", fused, "anees_orientation", 6.0),
            Check(name, "mounting, deg from the fit to the truth", None, {"posegraph": in_graph[0]}, 0.3),
            Check(name, "time offset, ms from the fit to the truth", None, {"posegraph": in_graph[1]}, 5.0),
            Check(
                f"{name}, no IMU",
                "largest difference from raw, m or rad",
                0.0,
                {
                    back_end: _largest_difference(alone.trajectories["raw"], alone.trajectories[back_end])
                    for back_end in BACK_ENDS
                },
                1e-6,
                "{:.1e}",
            ),
        ],
        [
            _metrics_table([("09", fused.metrics)]),
            Table(
                ("estimated from the log alone", "mounting, deg off", "time offset, ms off"),
                [
                    ("closed form and refinement", *map("{:.2f}".format, closed_form)),
                    ("refined in the pose graph", *map("{:.2f}".format, in_graph)),
                ],
            ),
            Table(
                ("ms that the odometry's own turning is ahead of the truth's", "pitch", "yaw", "roll"),
                [
                    ("all of it", *map("{:.1f}".format, ahead[0])),
                    ("slower than a second", *map("{:.1f}".format, ahead[1])),
                ],
            ),
        ],
        [_path("09", fused)],
    )


def noise(place: Place) -> Section:
    """Ground truth with the noise of a learned front end, real IMU."""
    checks, rows, paths = [], [], []
    for sequence in (*NOISY, *NOISY_REPORTED):
        seeds = SEEDS if sequence in NOISY else FEWER_SEEDS
        runs = [fuse(_noisy(place, sequence, seed)) for seed in seeds]
        metrics = {name: _mean([run.metrics[name] for run in runs]) for name in runs[0].metrics}
        rows += [(f"{sequence}, seed {seed}", run.metrics) for seed, run in zip(seeds, runs, strict=True)]
        rows.append((f"**{sequence}, mean**", metrics))
        log = f"{sequence}, front-end noise, mean of {len(seeds)} seeds"
        if sequence in NOISY:
            checks.append(_check(log, "t_rel, %", metrics, "t_rel_percent", {"posegraph": 0.87}))
            checks.append(_check(log, "r_rel, deg/100 m", metrics, "r_rel_deg_per_100m", 0.20))
            paths.append(_path(f"{sequence}, seed {seeds[0]}", runs[0]))
        elif (raw := metrics["raw"].t_rel_percent) is not None:
            checks.append(_check(f"{log}: not worse than raw", "t_rel, %", metrics, "t_rel_percent", raw))
    return Section(
        "noise", "The noise of a learned front end, with the real IMU", checks, [_metrics_table(rows)], paths
    )


def revisit(place: Place) -> Section:
    """09 from the published odometry with its real revisit closed."""
    log = converted(place, "published-09", *_trajectory(place, "09", published=True))
    without = fuse(log)
    truth = without.truth
    runs = []
    for seed in SEEDS:
        loops = revisits(truth, np.arange(len(truth) - LAST_FRAMES, len(truth)), np.random.default_rng(seed))
        runs.append(fuse(_with_loops(log, loops, place.cache / f"revisit-09-{seed}.mcap")))
    metrics = {name: _mean([run.metrics[name] for run in runs]) for name in runs[0].metrics}
    name = f"09, revisit closed by {len(loops)} loops, mean of {len(SEEDS)} seeds"
    shares = {
        each: 100 * _value(metrics[each], "ate_m") / _value(without.metrics.get(each, without.metrics["ekf"]), "ate_m")
        for each in WITH_LOOPS
    }
    rows = [("without loops", without.metrics)]
    rows += [(f"loops, seed {seed}", run.metrics) for seed, run in zip(SEEDS, runs, strict=True)]
    return Section(
        "revisit",
        "The revisit at the end of 09",
        [
            Check(name, "ATE, % of that without loops", 100.0, shares, 70.0),
            _check(name, "end error, m", metrics, "end_error_m", 1.0),
        ],
        [_metrics_table([*rows, ("**loops, mean**", metrics)])],
        [_path("09 without loops", without), _path("09, loops of seed 0", runs[0])],
    )


def rendered(place: Place) -> Section:
    """Rendered images along real trajectories, the network's pairs, the real IMU, loops found by the project itself."""
    checks, rows, counts, paths = [], [], [], []
    for sequence in RENDERED:
        fused = fuse(_rendered(place, sequence))
        name = f"{sequence}, rendered"
        raw = _value(fused.metrics["raw"], "ate_m")
        shares = {each: 100 * _value(fused.metrics[each], "ate_m") / raw for each in WITH_LOOPS}
        used = fused.estimates["posegraph"].loops_used
        wrong = wrong_loops(fused.known.loops, fused.truth)
        checks.append(Check(name, "ATE, % of raw", 100.0, shares, 40.0))
        checks.append(Check(name, "wrong loops accepted", None, {"posegraph": int(np.sum(wrong & used))}, 0, "{:.0f}"))
        rows.append((sequence, fused.metrics))
        counts.append((sequence, *map(str, (len(used), int(wrong.sum()), int(used.sum()), int(np.sum(wrong & used))))))
        paths.append(_path(name, fused))
    headings = ("sequence", "loops found", "of them wrong", "used", "of them wrong")
    return Section(
        "rendered",
        "Rendered images with loops that were found in them",
        checks,
        [_metrics_table(rows), Table(headings, counts)],
        paths,
    )


def wrong(place: Place) -> Section:
    """A fifth of the loops of a rendered sequence replaced by wrong ones."""
    log = _rendered(place, "05")
    right = fuse(log)
    loops = right.known.loops
    rows, changes = [], []
    for seed in SEEDS:
        spoilt, replaced = spoil(loops, right.truth, np.random.default_rng(seed))
        estimate = posegraph.solve(replace(right.known, loops=spoilt), DEFAULTS.posegraph)
        ate = _value(evaluate(estimate.trajectory, right.truth), "ate_m")
        left = [loop for loop, bad in zip(loops, replaced, strict=True) if not bad]
        alone = posegraph.solve(replace(right.known, loops=left), DEFAULTS.posegraph)
        ate_alone = _value(evaluate(alone.trajectory, right.truth), "ate_m")
        changes.append(100 * abs(ate / _value(right.metrics["posegraph"], "ate_m") - 1))
        accepted = int(np.sum(estimate.loops_used & replaced))
        wrong_used = f"{accepted} of {int(replaced.sum())}"
        rows.append((str(seed), f"{ate:.3f}", f"{changes[-1]:.1f}", f"{ate_alone:.3f}", wrong_used))
    rows.append(("none replaced", f"{_value(right.metrics['posegraph'], 'ate_m'):.3f}", "", "", ""))
    name = f"05, rendered, {WRONG_SHARE:.0%} of {len(loops)} loops wrong"
    return Section(
        "wrong",
        "Wrong loops",
        [Check(name, f"change of ATE, %, worst of {len(SEEDS)} seeds", None, {"posegraph": max(changes)}, 5.0)],
        [Table(("seed", "ATE, m", "change, %", "ATE of the right loops alone, m", "wrong loops accepted"), rows)],
    )


def network(place: Place) -> Section:
    """Real images: drive 0039 and the clip of 06, pairs by the network."""
    drive = place.data / "kitti/raw/2011_09_26/2011_09_26_drive_0039_sync"
    config = Path("samples/kitti06.toml")
    cases = (
        ("drive 0039", converted(place, "0039", "kitti-raw", "--drive", drive), None, (50.0, 100.0, 150.0)),
        ("clip of 06", open_log("samples/kitti06.mcap"), config, (10.0, 20.0, 30.0, 40.0, 50.0)),
    )
    checks, rows, paths = [], [], []
    for name, log, settings, lengths in cases:
        recorded = _recorded(place, log, settings)
        fused = fuse(recorded, load(settings, {"segment_lengths_m": lengths}))
        for label, measure in (("t_rel, %", "t_rel_percent"), ("r_rel, deg/100 m", "r_rel_deg_per_100m")):
            checks.append(_check(f"{name}, network", label, fused, measure, _value(fused.metrics["raw"], measure)))
        rows.append((f"{name}, segments of {lengths[0]:.0f} to {lengths[-1]:.0f} m", fused.metrics))
        paths.append(_path(name, fused))
    return Section("network", "Real images with the network", checks, [_metrics_table(rows)], paths)


def timing(place: Place) -> Section:
    """How long the batch takes on the longest sequence with many loops."""
    log = _noisy(place, "00", 0)
    known = fuse(log).known
    truth = _truth(log)
    rng = np.random.default_rng(0)
    loops = revisits(truth, np.arange(len(truth)), rng)
    chosen = np.sort(rng.choice(len(loops), min(MANY_LOOPS, len(loops)), replace=False))
    known = replace(known, loops=[loops[i] for i in chosen])
    with threadpool_limits(1, "blas"):  # as in `fusion.fusing`
        started = perf_counter()
        posegraph.solve(known, DEFAULTS.posegraph)
        between = perf_counter()
        ekf.solve(known, DEFAULTS.ekf)
    seconds = {"posegraph": between - started, "ekf": perf_counter() - between}
    name = f"00, {len(truth)} poses, IMU of 100 Hz, {len(chosen)} loops"
    return Section("timing", "Time", [Check(name, "batch, s", None, seconds, {"posegraph": 2.0})])


SECTIONS: dict[str, Callable[[Place], Section]] = {
    section.__name__: section for section in (published, noise, revisit, rendered, wrong, network, timing)
}


# -------------------------------------------------------------------------------------------------------- logs


def converted(place: Place, name: str, *arguments: str | Path) -> Log:
    """The log that the converter makes, from the cache if it is there."""
    path = place.cache / f"{name}.mcap"
    if not path.exists() and convert.main([*map(str, arguments), "--out", str(path)]) != EXIT_OK:
        raise LogError(f"{path}: could not be made")
    return open_log(path)


def _trajectory(place: Place, sequence: str, published: bool = False) -> list[str | Path]:
    """Arguments of the converter: a published result, or the true poses."""
    arguments: list[str | Path] = ["trajectory", "--times", place.times(sequence), "--imu", place.imu(sequence)]
    if published:
        poses = place.data / "kitti/odometry/published/example_1" / f"{sequence}.txt"
        return [*arguments, "--poses", poses, "--ground-truth", place.poses(sequence)]
    return [*arguments, "--poses", place.poses(sequence)]


def _noisy(place: Place, sequence: str, seed: int) -> Log:
    """True poses with the noise of a learned front end."""
    return converted(place, f"noise-{sequence}-{seed}", *_trajectory(place, sequence), "--noise-seed", str(seed))


def _rendered(place: Place, sequence: str) -> Log:
    """A rendered drive along a real trajectory, with the pairs and loops of a run."""
    run = place.cache / f"rendered-{sequence}" / "run.mcap"
    if run.exists():
        return open_log(run)
    images = converted(
        place,
        f"rendered-{sequence}",
        *("simulate", "--poses", place.poses(sequence), "--times", place.times(sequence), "--imu", place.imu(sequence)),
        *("--depth", "stereo", "--photometry", "real", "--moving-cars", "4", "--seed", str(RENDERED[sequence])),
    )
    return _recorded(place, images)


def _recorded(place: Place, log: Log, settings: Path | None = None) -> Log:
    """The log of a run, which holds the pairs of the network and the loops, from the cache if it is there."""
    folder = place.cache / log.path.stem
    run = folder / "run.mcap"
    if not run.exists():
        main_job.main(
            [
                "--log",
                str(log.path),
                "--out",
                str(folder),
                "--quiet",
                *(["--config", str(settings)] if settings else []),
            ]
        )
    return open_log(run)


def _with_loops(log: Log, loops: Sequence[PairEstimate], path: Path) -> Log:
    """The same log, with recorded loops."""
    with LogWriter(path) as writer:
        writer.imu(log.imu())
        writer.ground_truth(_truth(log))
        writer.pairs(log.pairs())
        writer.loops(loops)
    return open_log(path)


def _truth(log: Log) -> Trajectory:
    truth = log.ground_truth()
    if truth is None:
        raise LogError(f"{log.path}: no ground truth")
    return truth


# ------------------------------------------------------------------------------------------------------- loops


def revisits(truth: Trajectory, targets: IntArray, rng: np.random.Generator) -> list[PairEstimate]:
    """A loop for each target frame that has an earlier one nearby, measured with the noise of LOOP_SIGMAS."""
    position, seconds = truth.poses.translation, truth.stamps_ns / NANOSECONDS
    tree = KDTree(position)
    loops = []
    for target in targets.tolist():
        near = np.array(tree.query_ball_point(position[target], LOOP_NEAR_M))
        earlier = near[seconds[target] - seconds[near] > LOOP_GAP_S]
        if not len(earlier):
            continue
        source = int(earlier[np.argmin(np.linalg.norm(position[earlier] - position[target], axis=1))])
        error = rng.normal(scale=LOOP_SIGMAS)
        loops.append(_loop(truth, source, target, error))
    return loops


def _loop(truth: Trajectory, source: int, target: int, error: FloatArray) -> PairEstimate:
    exact = truth.poses[source].inv() * truth.poses[target]
    wrong_by = RigidTransform.from_components(error[3:], Rotation.from_rotvec(error[:3]))
    measured = exact * wrong_by
    return PairEstimate(
        int(truth.stamps_ns[source]),
        int(truth.stamps_ns[target]),
        measured.rotation.as_quat(scalar_first=True),
        measured.translation,
        np.diag(LOOP_SIGMAS**2),
    )


def wrong_loops(loops: Sequence[PairEstimate], truth: Trajectory) -> NDArray[np.bool_]:
    """Which loops (M,) are further from the ground truth than any that is only inaccurate."""
    if not loops:
        return np.zeros(0, dtype=np.bool_)
    source = truth.at(np.array([loop.source_stamp_ns for loop in loops]))
    target = truth.at(np.array([loop.target_stamp_ns for loop in loops]))
    shown = RigidTransform.concatenate([loop.T_source_target for loop in loops])
    error = (source.inv() * target).inv() * shown
    metres = np.linalg.norm(error.translation, axis=1)
    return np.asarray((metres > WRONG_M) | (np.rad2deg(error.rotation.magnitude()) > WRONG_DEG))


def spoil(
    loops: Sequence[PairEstimate], truth: Trajectory, rng: np.random.Generator
) -> tuple[list[PairEstimate], NDArray[np.bool_]]:
    """The loops, a share of them with a source from anywhere, as where two places look alike; and which (M,)."""
    replaced = np.zeros(len(loops), dtype=np.bool_)
    replaced[rng.choice(len(loops), round(WRONG_SHARE * len(loops)), replace=False)] = True

    def elsewhere(loop: PairEstimate) -> PairEstimate:
        while True:
            stamp_ns = int(rng.choice(truth.stamps_ns))
            moved = replace(loop, source_stamp_ns=stamp_ns)
            if stamp_ns < loop.target_stamp_ns and wrong_loops([moved], truth)[0]:
                return moved

    return [elsewhere(loop) if bad else loop for loop, bad in zip(loops, replaced, strict=True)], replaced


# ------------------------------------------------------------------------------------------- fusing and measuring


def fuse(log: Log, config: RunConfig = DEFAULTS, with_imu: bool = True) -> Fused:
    """Both back ends on the recorded pairs and loops of a log, as a run does it."""
    pairs, samples, truth = log.pairs(), log.imu(), _truth(log)
    mounting, findings = main_job.known_mounting(log, config.imu), Findings()
    calibration = calibrate(pairs, samples, mounting, config.imu.time_offset_s, config.imu.low_pass_s)
    if not with_imu:
        calibration = replace(calibration, used=False)
    known = fusing.measurements(pairs, samples, calibration, log.frame_stamps(), findings)
    skips, loops = (fusing.between_steps(each, known.steps) for each in (log.skips(), log.loops()))
    known = replace(known, skips=skips, loops=loops)
    estimates = fusing.fuse(known, config, findings)
    if missing := [name for name in BACK_ENDS if name not in estimates]:
        raise LogError(f"{log.path}: {', '.join(missing)}: {'; '.join(findings.notes)}")
    trajectories = {"raw": chain.chain(known.steps)} | {name: each.trajectory for name, each in estimates.items()}
    metrics = {name: evaluate(each, truth, config.segment_lengths_m) for name, each in trajectories.items()}
    return Fused(truth, known, calibration, estimates, trajectories, metrics)


def _off(fit: ImuCalibration, rotation_imu_camera: Rotation, time_offset_s: float) -> tuple[float, float]:
    """How far a mounting (deg) and a time offset (ms) are from those of a fit."""
    turned = (fit.mounting.inv() * rotation_imu_camera).magnitude()
    return float(np.rad2deg(turned)), 1e3 * abs(time_offset_s - fit.time_offset_s)


def ahead_ms(pairs: Sequence[PairEstimate], truth: Sequence[PairEstimate]) -> FloatArray:
    """How far (2, 3), about each axis, rotations of pairs are ahead of true ones of the same steps: all, and slow ones.

    By least squares on the differences of their rates, that of the true ones times the time.
    """
    rates, true = (
        motions_of(each).rotation.as_rotvec() / np.array([pair.duration_s for pair in each])[:, None]
        for each in (pairs, truth)
    )
    turned, _ = Rotation.align_vectors(rates, true)
    true = turned.apply(true)
    seconds = np.cumsum([pair.duration_s for pair in truth])
    ahead = []
    for smoothed in (lambda x: x, lambda x: gaussian_filter1d(x, SLOW_STEPS, axis=0)):
        slope = np.gradient(smoothed(true), seconds, axis=0)
        ahead.append(1e3 * np.sum(smoothed(rates - true) * slope, axis=0) / np.sum(slope**2, axis=0))
    return np.stack(ahead)


def _largest_difference(one: Trajectory, other: Trajectory) -> float:
    difference = one.poses.inv() * other.poses
    return float(max(np.abs(difference.translation).max(), difference.rotation.magnitude().max()))


def _mean(metrics: Sequence[Metrics]) -> Metrics:
    """The mean of every measure that all have."""
    values = {each.name: [getattr(one, each.name) for one in metrics] for each in fields(Metrics)}
    return Metrics(**{name: None if None in of else float(np.mean(of)) for name, of in values.items()})  # type: ignore[arg-type]


def _value(metrics: Metrics, measure: str) -> float:
    """A measure that must be there."""
    value = getattr(metrics, measure)
    if value is None:
        raise LogError(f"{measure} could not be measured")
    return float(value)


def _check(
    log: str, label: str, of: Fused | Mapping[str, Metrics], measure: str, bound: float | Mapping[str, float]
) -> Check:
    """A measure of raw and fused trajectories against a bound."""
    metrics = of.metrics if isinstance(of, Fused) else of
    values = {name: _value(metrics[name], measure) for name in WITH_LOOPS if name in metrics}
    return Check(log, label, _value(metrics["raw"], measure), values, bound)


def _metrics_table(rows: Sequence[tuple[str, Mapping[str, Metrics]]]) -> Table:
    """Of raw, pose graph and EKF, side by side, each measure; where loops were closed, of the smoothed one, too."""
    names = ("raw", *(WITH_LOOPS if any(WITH_LOOPS[-1] in metrics for _, metrics in rows) else BACK_ENDS))
    shown = {
        "t_rel_percent": ("t_rel, %", "{:.2f}"),
        "r_rel_deg_per_100m": ("r_rel, deg/100 m", "{:.3f}"),
        "ate_m": ("ATE, m", "{:.2f}"),
        "end_error_m": ("end error, m", "{:.2f}"),
        "rpe_translation_m": ("RPE, m", "{:.3f}"),
        "rpe_rotation_rad": ("RPE, rad", "{:.5f}"),
        "anees_position": ("ANEES position", "{:.1f}"),
        "anees_orientation": ("ANEES orientation", "{:.1f}"),
    }

    def cells(metrics: Mapping[str, Metrics]) -> Iterator[str]:
        for measure, (_, form) in shown.items():
            values = [getattr(metrics[name], measure) if name in metrics else None for name in names]
            yield " / ".join("-" if value is None else form.format(value) for value in values)

    headings = (" / ".join(COLUMNS.get(name, name) for name in names), *(heading for heading, _ in shown.values()))
    return Table(headings, [(name, *cells(metrics)) for name, metrics in rows])


def _path(title: str, fused: Fused) -> Path2d:
    return Path2d(title, fused.trajectories, fused.truth)


if __name__ == "__main__":
    sys.exit(main())
