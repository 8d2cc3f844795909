"""The figures of a report as data: what is drawn where, in which unit, or why there is nothing to draw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import events
from fusion.evaluation import (
    ANEES_DIMENSIONS,
    CONFIDENCE,
    MIN_VARIANCE,
    anees_bounds,
    common,
    errors_over_time,
    pose_errors,
    segment_errors,
)
from fusion.report.content import ReportContent
from fusion.report.verdict import agreements, label, nis_bounds
from fusion_io.records import (
    NANOSECONDS,
    NIS_DEGREES_OF_FREEDOM,
    EstimatorSeries,
    FloatArray,
    IntArray,
    PairEstimate,
    Trajectory,
)

TIME = "time since the first frame [s]"
CAMERA_AXES = ("x, right", "y, down", "z, ahead")
ROTATION_AXES = ("about x, pitch", "about y, yaw", "about z, roll")
AXES = ("x", "y", "z")

# A series with more samples than this is drawn by the smallest and the largest of each of half as many bins: nothing
# that sticks out is lost.
MAX_SAMPLES = 4000

NEARLY_ZERO = 1e-2  # of a squared distance in standard deviations, where the scale of a logarithmic axis begins

Mode = Literal["lines", "points", "markers", "bars", "band"]


@dataclass(frozen=True, slots=True)
class Line:
    """One series of a figure: N points, NaN where there is a hole.

    style: the name of a colour in report.css. only: the trajectory that has to be chosen for it to show. middle (N,):
    that of a band, whose half width is y; zero if it is None.
    """

    name: str
    x: FloatArray | Sequence[str]
    y: FloatArray
    style: str
    mode: Mode = "lines"
    dash: Literal["solid", "dot", "dash"] = "solid"
    only: str | None = None
    middle: FloatArray | None = None
    legend: bool = True


@dataclass(frozen=True, slots=True)
class Row:
    """One pair of axes."""

    label: str
    lines: Sequence[Line]
    log: bool = False


@dataclass(frozen=True, slots=True)
class Figure:
    """Rows above each other with the same horizontal axis: time if `timed`. missing: why there is nothing to draw."""

    key: str
    title: str
    caption: str
    rows: Sequence[Row] = ()
    missing: str = ""
    xlabel: str = TIME
    timed: bool = True


Builder = Callable[[ReportContent], Figure]


def figures(content: ReportContent) -> dict[str, list[Figure]]:
    """All figures by the section that they stand in."""
    sections: dict[str, Sequence[Builder]] = {
        "errors": (errors, components, segments, pair_errors, level_errors, hypothesis_errors),
        "trust": (nees, nis, innovations, pair_deviations, agreement, loop_residuals),
        "sensors": (motion, periods, biases, front_end, spread),
    }
    return {section: [build(content) for build in builders] for section, builders in sections.items()}


# ---------------------------------------------------------------------------------------------- errors


def errors(content: ReportContent) -> Figure:
    """Norm of the errors of all trajectories over time, and the three sigma that they state."""
    position, orientation = [], []
    for name, trajectory in content.trajectories.items():
        if content.ground_truth is not None:
            series = errors_over_time(trajectory, content.ground_truth)
            seconds = content.seconds(series.stamps_ns)
            position.append(Line(label(name), seconds, _norm(series.position_error_m), name))
            orientation.append(Line(label(name), seconds, np.rad2deg(_norm(series.rotation_error_rad)), name))
        if trajectory.covariances is not None:
            seconds, said = content.seconds(trajectory.stamps_ns), f"3 sigma of {label(name)}"
            sigma = np.sqrt(np.diagonal(trajectory.covariances, axis1=1, axis2=2))
            position.append(Line(said, seconds, 3.0 * _norm(sigma[:, 3:]), name, dash="dot"))
            degrees = 3.0 * np.rad2deg(_norm(sigma[:, :3]))
            orientation.append(Line(said, seconds, degrees, name, dash="dot", legend=False))
    orientation = [_unlisted(line) for line in orientation]
    rows = [Row("position [m]", position), Row("orientation [deg]", orientation)]
    truth = content.ground_truth is not None
    caption = "Distance to the ground truth, with the first poses aligned. Dotted: three times the stated sigma."
    return Figure(
        "errors",
        "Error over time" if truth else "Stated uncertainty over time",
        caption if truth else "No ground truth: three times the sigma that each trajectory states.",
        rows if position else (),
        missing="" if position else "No ground truth and no covariances.",
    )


def components(content: ReportContent) -> Figure:
    """The error of the chosen trajectory by axis, inside the bands of three sigma that it states."""
    found = Figure(
        "components",
        "Error by axis with 3-sigma bands",
        "In the axes of the estimated camera, of the chosen trajectory. An error outside its band was not foreseen.",
        missing="The log has no ground truth.",
    )
    if content.ground_truth is None:
        return found
    rows: list[list[Line]] = [[] for _ in range(6)]
    for name, trajectory in content.trajectories.items():
        series = errors_over_time(trajectory, content.ground_truth)
        seconds = content.seconds(series.stamps_ns)
        values = np.hstack([series.position_error_m, np.rad2deg(series.rotation_error_rad)])
        if not len(seconds):
            continue
        if series.position_sigma_m is not None and series.rotation_sigma_rad is not None:
            sigma = np.hstack([series.position_sigma_m, np.rad2deg(series.rotation_sigma_rad)])
            for axis in range(6):
                rows[axis].append(_band("3 sigma", seconds, 3.0 * sigma[:, axis], name, name))
        for axis in range(6):
            rows[axis].append(Line(label(name), seconds, values[:, axis], name, only=name, legend=axis == 0))
    labels = [f"{name} [m]" for name in CAMERA_AXES] + [f"{name} [deg]" for name in ROTATION_AXES]
    drawn = [Row(name, lines) for name, lines in zip(labels, rows, strict=True) if lines]
    return _drawn(found, drawn, "The ground truth is of another time.")


def segments(content: ReportContent) -> Figure:
    """t_rel and r_rel by the length of the segments."""
    found = Figure(
        "segments",
        "Drift by segment length",
        "Mean over all segments of a length, as in the KITTI devkit.",
        missing="The log has no ground truth.",
        xlabel="segment length [m]",
        timed=False,
    )
    if content.ground_truth is None:
        return found
    translation, rotation = [], []
    for name, trajectory in content.trajectories.items():
        estimate, truth = common(trajectory, content.ground_truth)
        if len(estimate) < 2:
            continue
        each = segment_errors(estimate.poses, truth.poses, content.segment_lengths_m)
        lengths, which = np.unique(each.length_m, return_inverse=True)
        if not len(lengths):
            continue
        count = np.bincount(which)
        t_rel = np.bincount(which, each.translation_percent) / count
        r_rel = np.bincount(which, each.rotation_deg_per_100m) / count
        translation.append(Line(label(name), lengths, t_rel, name, mode="points"))
        rotation.append(Line(label(name), lengths, r_rel, name, mode="points", legend=False))
    shortest = f"The path is shorter than the shortest segment, {min(content.segment_lengths_m):g} m."
    rows = [Row("t_rel [%]", translation), Row("r_rel [deg/100 m]", rotation)]
    return _drawn(found, rows if translation else (), shortest)


def pair_errors(content: ReportContent) -> Figure:
    """The error of each pair estimate against the ground truth."""
    found = Figure(
        "pair-errors",
        "Error of the pair estimates",
        "Each pair against the true motion between its frames.",
        missing="The log has no ground truth for its pairs.",
    )
    truth = _true_motions(content, content.pairs)
    if truth is None:
        return found
    known, motions = truth
    pairs = [content.pairs[i] for i in np.flatnonzero(known).tolist()]
    error = _motions(pairs).inv() * motions
    seconds = content.seconds(_targets(pairs))
    translation, rotation = _norm(error.translation), 1e3 * error.rotation.magnitude()
    stated = np.sqrt(np.diagonal(np.stack([pair.covariance for pair in pairs]), axis1=1, axis2=2))
    return _drawn(
        found,
        [
            Row(
                "translation [m]",
                [
                    Line("pair", seconds, translation, "pairs"),
                    Line("3 sigma", seconds, 3.0 * _norm(stated[:, 3:]), "bound", dash="dot"),
                ],
            ),
            Row(
                "rotation [mrad]",
                [
                    Line("pair", seconds, rotation, "pairs", legend=False),
                    Line("3 sigma", seconds, 3e3 * _norm(stated[:, :3]), "bound", dash="dot", legend=False),
                ],
            ),
        ],
    )


def level_errors(content: ReportContent) -> Figure:
    """Root mean square error after each level of the network, and of what became of them."""
    found = Figure(
        "level-errors",
        "Error by level",
        "RMSE over all pairs. Level 0 is what the IMU alone gives; each further level corrects it on a finer image; "
        "estimate: the last one after refinement, as it was used.",
        missing="The pair estimates were recorded without levels: they did not come from the network.",
        xlabel="",
        timed=False,
    )
    of_pair = {(pair.source_stamp_ns, pair.target_stamp_ns): pair for pair in content.pairs}
    levels = [each for each in content.levels if (each.source_stamp_ns, each.target_stamp_ns) in of_pair]
    truth = _true_motions(content, levels)
    if truth is None:
        return _drawn(found, (), "The log has no ground truth for its pairs.") if levels else found
    known, motions = truth
    shown = [levels[i] for i in np.flatnonzero(known).tolist()]
    after = _each_hypothesis(shown)
    names = [f"level {i}" for i in range(len(after))]
    used = _motions([of_pair[each.source_stamp_ns, each.target_stamp_ns] for each in shown])
    return _drawn(found, _rmse([*names, "estimate"], [*after, used], motions))


def hypothesis_errors(content: ReportContent) -> Figure:
    """Root mean square error of each hypothesis, of the winner, and of what became of it."""
    found = Figure(
        "hypothesis-errors",
        "Error by hypothesis",
        "RMSE over all pairs of the network's last level; estimate: the winner after refinement, as it was used.",
        missing="The pair estimates were recorded without hypotheses: they did not come from the network.",
        xlabel="",
        timed=False,
    )
    pairs = [pair for pair in content.pairs if len(pair.hypotheses_translation)]
    truth = _true_motions(content, pairs)
    if truth is None:
        return _drawn(found, (), "The log has no ground truth for its pairs.") if pairs else found
    known, motions = truth
    pairs = [pairs[i] for i in np.flatnonzero(known).tolist()]
    hypotheses = _each_hypothesis(pairs)
    names = [f"hypothesis {i + 1}" for i in range(len(hypotheses))]
    quats_wxyz, translations = _hypotheses(pairs)
    chosen = np.arange(len(pairs)), np.array([min(max(pair.winner, 0), len(names) - 1) for pair in pairs])
    winner = _transforms(quats_wxyz[chosen], translations[chosen])
    return _drawn(found, _rmse([*names, "winner", "estimate"], [*hypotheses, winner, _motions(pairs)], motions))


# ---------------------------------------------------------------------------------------------- trust


def nees(content: ReportContent) -> Figure:
    """Normalised estimation error squared over time, with the bounds that it should stay in."""
    low, high = (float(bound) for bound in chi2.interval(CONFIDENCE, ANEES_DIMENSIONS))
    found = Figure(
        "nees",
        "NEES: is the stated uncertainty right?",
        f"Squared error by its covariance, 3 degrees of freedom; 95 % of single errors are between {low:.2f} and "
        f"{high:.2f}. Errors of one run hang together, so it may stay on one side for long. What is judged is the mean "
        f"over the run, the ANEES: 3 is right, above {anees_bounds()[1]:.1f} is overconfident.",
        missing="The log has no ground truth.",
    )
    if content.ground_truth is None:
        return found
    position, orientation = [], []
    for name, trajectory in content.trajectories.items():
        estimate, truth = common(trajectory, content.ground_truth)
        if estimate.covariances is None or not len(estimate):
            continue
        seconds = content.seconds(estimate.stamps_ns)
        metres, radians = pose_errors(estimate.poses, truth.poses)
        squares = _above_zero(normalised_square(metres, estimate.covariances[:, 3:, 3:]))
        position.append(Line(label(name), seconds, squares, name))
        squares = _above_zero(normalised_square(radians, estimate.covariances[:, :3, :3]))
        orientation.append(Line(label(name), seconds, squares, name, legend=False))
    if not position:
        return _drawn(found, (), "No trajectory states its covariance where there is ground truth.")
    span = _ends(position[0].x)
    rows = [
        Row("position", [*position, *_bounds(span, low, high)], log=True),
        Row("orientation", [*orientation, *_bounds(span, low, high, legend=False)], log=True),
    ]
    return _drawn(found, rows)


def nis(content: ReportContent) -> Figure:
    """Normalised innovation squared of each back end over time, with the bounds that it should stay in."""
    low, high = nis_bounds()
    shown = {name: each for name, each in content.series.items() if np.any(np.isfinite(each.nis))}
    found = Figure(
        "nis",
        "NIS: do the measurements fit the model?",
        f"Squared innovation of each pair by its covariance, 6 degrees of freedom; 95 % between {low:.2f} and "
        f"{high:.2f} where all is modelled right, with a mean of {NIS_DEGREES_OF_FREEDOM}. Needs no ground truth. The "
        "pose graph's are residuals, after it has used the pair, and smaller. All near zero: nothing but the pairs "
        "spoke of the motion.",
        missing=_without_series(content, "innovations"),
    )
    rows: list[Row] = []
    for name, each in shown.items():
        seconds = content.seconds(each.stamps_ns)
        inside = np.mean((each.nis >= low) & (each.nis <= high), where=np.isfinite(each.nis))
        squares = _above_zero(each.nis)
        said = f"{label(name)}, mean {each.nis_mean:.3g}, {100.0 * inside:.0f} % inside"
        lines = [Line(said, seconds, squares, name)]
        if np.any(out := ~each.used & np.isfinite(each.nis)):
            lines.append(Line("rejected", seconds[out], squares[out], "fault", mode="markers", legend=not rows))
        rows.append(Row(label(name), [*lines, *_bounds(_ends(seconds), low, high, legend=not rows)], log=True))
    return _drawn(found, rows)


def innovations(content: ReportContent) -> Figure:
    """What each pair showed beyond what was predicted."""
    found = Figure(
        "innovations",
        "Innovations",
        "What each pair shows beyond the prediction of the chosen back end, in the axes of the target camera. "
        "They should scatter about zero without a trend.",
        missing=_without_series(content, "innovations"),
    )
    rotation, translation = [], []
    for name, each in content.series.items():
        if np.any(np.isfinite(each.innovation)):
            seconds = content.seconds(each.stamps_ns)
            rotation += _three(seconds, 1e3 * each.innovation[:, :3], name)
            translation += _three(seconds, each.innovation[:, 3:], name, legend=False)
    rows = [Row("rotation [mrad]", rotation), Row("translation [m]", translation)]
    return _drawn(found, rows if rotation else ())


def pair_deviations(content: ReportContent) -> Figure:
    """How far the pairs are from the motion that a back end made of them."""
    low, high = nis_bounds()
    found = Figure(
        "pair-deviations",
        "Pairs against the fused motion",
        "Squared distance of each pair to the motion of the chosen trajectory, by the pair's own covariance. What "
        "sticks out was not believed; all near zero: there was nothing to correct the pairs by.",
        missing="There is no fused trajectory.",
    )
    lines = []
    seconds = content.seconds(_targets(content.pairs))
    for name in content.fused:
        squares = _above_zero(events.deviations(content.pairs, content.trajectories[name]))
        lines.append(Line(label(name), seconds, squares, name, only=name))
    rows = [Row("squared distance", [*lines, *_bounds(_ends(seconds), low, high)], log=True)] if lines else ()
    return _drawn(found, rows)


def agreement(content: ReportContent) -> Figure:
    """How far the back ends are from each other, within what they state."""
    found = Figure(
        "agreement",
        "Agreement of the back ends",
        "Distance between two fused trajectories, and three times the root of their summed variances (dotted). They "
        "see the same data, so more than that means that one of them is wrong about itself.",
        missing="There is only one fused trajectory, or none.",
    )
    position, orientation = [], []
    for each in agreements(content):
        seconds, name = content.seconds(each.stamps_ns), " - ".join(map(label, each.names))
        style = each.names[1]
        position += [
            Line(name, seconds, each.distance_m, style),
            Line("3 sigma", seconds, 3.0 * each.sigma_m, style, dash="dot"),
        ]
        orientation += [
            Line(name, seconds, np.rad2deg(each.angle_rad), style, legend=False),
            Line("3 sigma", seconds, 3.0 * np.rad2deg(each.sigma_rad), style, dash="dot", legend=False),
        ]
    rows = [Row("position [m]", position), Row("orientation [deg]", orientation)]
    return _drawn(found, rows if position else ())


def loop_residuals(content: ReportContent) -> Figure:
    """What is left of each loop closure after the fusion."""
    found = Figure(
        "loop-residuals",
        "Loop closures",
        "What is left between each loop and the chosen trajectory, at the time when the loop closes. Crosses: loops "
        "that were not believed.",
        missing="No loop closures: the log has none, or the camera did not come back.",
    )
    if not content.loops:
        return found
    translation, rotation = [], []
    seconds = content.seconds(_targets(content.loops))
    for name in content.fused:
        trajectory = content.trajectories[name]
        stamps = _spans(content.loops)
        known = trajectory.covers(stamps[:, 0]) & trajectory.covers(stamps[:, 1])
        if not np.any(known):
            continue
        seen = _motions([content.loops[i] for i in np.flatnonzero(known).tolist()])
        moved = trajectory.at(stamps[known, 0]).inv() * trajectory.at(stamps[known, 1])
        residual = seen.inv() * moved
        used = content.loops_used.get(name, np.zeros(0, dtype=np.bool_))
        believed = used[known] if len(used) == len(known) else np.ones(int(known.sum()), dtype=np.bool_)
        for chosen, what, style in ((believed, "believed", name), (~believed, "not believed", "fault")):
            if np.any(chosen):
                at, left = seconds[known][chosen], residual[np.flatnonzero(chosen)]
                named = f"{label(name)}, {what}"
                translation.append(Line(named, at, _norm(left.translation), style, mode="markers", only=name))
                degrees = np.rad2deg(left.rotation.magnitude())
                rotation.append(Line(named, at, degrees, style, mode="markers", only=name, legend=False))
    rows = [Row("translation [m]", translation), Row("rotation [deg]", rotation)]
    return _drawn(found, rows if translation else ())


# ---------------------------------------------------------------------------------------------- sensors


def motion(content: ReportContent) -> Figure:
    """How fast camera and IMU say that they move: where one of them is wrong, they part."""
    pairs = content.pairs
    seconds, duration = content.seconds(_targets(pairs)), np.array([pair.duration_s for pair in pairs])
    moved = _motions(pairs)
    turning = [Line("pairs", seconds, np.rad2deg(moved.rotation.magnitude() / duration), "pairs")]
    speed = [Line("pairs", seconds, _norm(moved.translation) / duration, "pairs", legend=False)]
    trajectory = content.trajectories[content.headline]
    speed.append(Line(label(content.headline), *_speed(content, trajectory), content.headline))
    if content.ground_truth is not None:
        speed.append(Line("ground truth", *_speed(content, content.ground_truth), "truth"))
    rows = [Row("speed [m/s]", speed), Row("turning [deg/s]", turning)]
    if content.imu is not None and len(content.imu) > 1:
        imu, offset_s = content.imu, content.calibration.time_offset_s if content.calibration else 0.0
        at = content.seconds(imu.stamps_ns) - offset_s
        gaps = events.imu_gaps(imu.stamps_ns, "")
        middles_ns = np.array([(gap.start_ns + gap.end_ns) // 2 for gap in gaps], dtype=np.int64)
        holes_s = content.seconds(middles_ns) - offset_s
        gyro = _envelope(at, np.rad2deg(_norm(imu.angular_velocity)))
        turning.insert(0, Line("gyro", *_with_holes(*gyro, holes_s), "imu"))
        accelerometer = _envelope(at, _norm(imu.linear_acceleration))
        lines = [Line("accelerometer", *_with_holes(*accelerometer, holes_s), "imu", legend=False)]
        rows.append(Row("acceleration [m/s²]", lines))
    return Figure(
        "motion",
        "Motion by camera and IMU",
        "Magnitudes, which need no mounting. Where gyro and pairs part, one of them is wrong; the acceleration holds "
        "gravity.",
        rows,
    )


def periods(content: ReportContent) -> Figure:
    """Time from each sample to the one before, of every sensor."""
    rows = []
    for role, stamps_ns in sensor_stamps(content).items():
        seconds, period = content.seconds(stamps_ns[1:]), 1e3 * np.diff(stamps_ns) / (NANOSECONDS)
        if len(period):
            name = content.topic(role)
            style = "imu" if role in {"imu", "gyro"} else "pairs" if role == "pairs" else "truth"
            rows.append(Row(f"{name} [ms]", [Line(name, *_envelope(seconds, period), style, legend=False)], log=True))
    coverage = np.array([pair.imu_coverage for pair in content.pairs])
    if np.any(coverage < 1.0):
        seconds = content.seconds(_targets(content.pairs))
        lines = [Line("IMU coverage", seconds, 100.0 * coverage, "imu", legend=False)]
        rows.append(Row("IMU coverage [%]", lines))
    return Figure(
        "periods",
        "Sensor rates and gaps",
        "Time since the sample before. Peaks are gaps. Coverage: how much of the IMU window of a pair was measured.",
        rows,
        missing="" if rows else "No sensor has two samples.",
    )


def biases(content: ReportContent) -> Figure:
    """The biases of the IMU and the errors of the front end that the chosen back end estimates, with their sigma."""
    found = Figure(
        "biases",
        "IMU biases",
        "Of the chosen back end, in the axes of the IMU, with bands of one sigma.",
        missing=_without_series(content, "biases"),
    )
    return _drawn(
        found,
        _estimated(
            content,
            ("gyro [mrad/s]", 1e3, lambda each: (each.gyro_bias, each.gyro_bias_std)),
            ("accelerometer [m/s²]", 1.0, lambda each: (each.accelerometer_bias, each.accelerometer_bias_std)),
        ),
    )


def front_end(content: ReportContent) -> Figure:
    """The scale error and the rate bias of the front end that the chosen back end estimates, with their sigma."""
    found = Figure(
        "front-end",
        "Scale error and rate bias of the pair estimates",
        "By how much their translations are too long and how much too fast they turn, as the chosen back end estimates "
        "it, with bands of one sigma.",
        missing=_without_series(content, "errors of the front end"),
    )
    return _drawn(
        found,
        _estimated(
            content,
            ("scale error [%]", 100.0, lambda each: (each.scale_error[:, None], each.scale_error_std[:, None])),
            ("rate bias [mrad/s]", 1e3, lambda each: (each.rate_bias, each.rate_bias_std)),
        ),
    )


def spread(content: ReportContent) -> Figure:
    """How far the hypotheses of the network are from each other, per axis, and how well they explain the image."""
    found = Figure(
        "spread",
        "Spread of the hypotheses",
        "Standard deviation of the network's hypotheses per axis, and the photometric error of the best and the worst.",
        missing="The pair estimates were recorded without hypotheses: they did not come from the network.",
    )
    pairs = [pair for pair in content.pairs if len(pair.hypotheses_translation) > 1]
    if not pairs:
        return found
    seconds = content.seconds(_targets(pairs))
    quats_wxyz, translations = _hypotheses(pairs)
    metres = np.std(translations, axis=1)
    estimates = _rotations(np.repeat(np.stack([pair.quat_wxyz for pair in pairs]), quats_wxyz.shape[1], axis=0))
    turned = (estimates.inv() * _rotations(quats_wxyz.reshape(-1, 4))).as_rotvec()
    milliradians = 1e3 * np.std(turned.reshape(translations.shape), axis=1)
    best = np.array([np.min(pair.errors, initial=np.inf) for pair in pairs])
    worst = np.array([np.max(pair.errors, initial=-np.inf) for pair in pairs])
    rows = [
        Row("translation [m]", _three(seconds, metres, None), log=True),
        Row("rotation [mrad]", _three(seconds, milliradians, None, legend=False), log=True),
        Row(
            "photometric error",
            [Line("best", seconds, best, "good"), Line("worst", seconds, worst, "fault")],
        ),
    ]
    return _drawn(found, rows)


def sensor_stamps(content: ReportContent) -> dict[str, IntArray]:
    """The stamps of every sensor by role."""
    found = {"image" if "image" in content.topics else "camera_info": content.frame_stamps_ns}
    if content.imu is not None:
        found["imu" if "imu" in content.topics else "gyro"] = content.imu.stamps_ns
    found["pairs"] = _targets(content.pairs)
    if content.ground_truth is not None:
        found["ground_truth"] = content.ground_truth.stamps_ns
    return {role: stamps for role, stamps in found.items() if len(stamps)}


# ---------------------------------------------------------------------------------------------- parts


def normalised_square(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared norm (N,) of errors (N, 3) by their covariances (N, 3, 3), NaN where nothing is claimed."""
    squares = np.full(len(error), np.nan)
    claimed = np.linalg.eigvalsh(covariance)[:, 0] > MIN_VARIANCE
    whitened = np.linalg.solve(covariance[claimed], error[claimed][..., None])[..., 0]
    squares[claimed] = np.sum(error[claimed] * whitened, axis=1)
    return squares


def _above_zero(squares: FloatArray) -> FloatArray:
    """The same (N,), none below where a logarithmic axis begins; what is NaN stays so."""
    return np.maximum(squares, NEARLY_ZERO)


def _drawn(figure: Figure, rows: Sequence[Row], missing: str = "") -> Figure:
    """A figure with these rows; without any, it says what is missing."""
    return replace(figure, rows=rows, missing="" if rows else missing or figure.missing)


def _estimated(
    content: ReportContent,
    *quantities: tuple[str, float, Callable[[EstimatorSeries], tuple[FloatArray, FloatArray]]],
) -> list[Row]:
    """A row for each quantity that a back end has: its label, its scale, and values and deviations (N, axes)."""
    rows: list[Row] = []
    for name_of_row, scale, read in quantities:
        lines: list[Line] = []
        for name, each in content.series.items():
            values, deviations = (scale * part for part in read(each))
            if not np.any(np.isfinite(values)):
                continue
            seconds = content.seconds(each.stamps_ns)
            for axis in range(values.shape[1]):
                style = AXES[axis] if values.shape[1] > 1 else name
                shown = AXES[axis] if values.shape[1] > 1 else label(name)
                lines.append(_band("1 sigma", seconds, deviations[:, axis], style, name, values[:, axis]))
                lines.append(Line(shown, seconds, values[:, axis], style, only=name, legend=not rows))
        if lines:
            rows.append(Row(name_of_row, lines))
    return rows


def _three(seconds: FloatArray, values: FloatArray, only: str | None, legend: bool = True) -> list[Line]:
    """A line for each axis of values (N, 3)."""
    return [
        Line(name, seconds, column, name, only=only, legend=legend) for name, column in zip(AXES, values.T, strict=True)
    ]


def _band(
    name: str, seconds: FloatArray, half: FloatArray, style: str, only: str, middle: FloatArray | None = None
) -> Line:
    """A band about the middle."""
    return Line(name, seconds, half, style, mode="band", dash="dot", only=only, middle=middle, legend=False)


def _bounds(span: FloatArray, low: float, high: float, legend: bool = True) -> list[Line]:
    """The two bounds of chi square."""
    return [
        Line("95 % bounds", span, np.full(2, low), "bound", dash="dash", legend=legend),
        Line("95 % bounds", span, np.full(2, high), "bound", dash="dash", legend=False),
    ]


def _ends(seconds: FloatArray | Sequence[str]) -> FloatArray:
    return np.array([np.min(np.asarray(seconds)), np.max(np.asarray(seconds))], dtype=np.float64)


def _unlisted(line: Line) -> Line:
    """The same line without a place in the legend."""
    return replace(line, legend=False)


def _without_series(content: ReportContent, what: str) -> str:
    return f"The back ends recorded no {what}." if not content.series else f"No back end has {what} to show."


def _envelope(seconds: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values (N,) as they are, or the smallest and the largest of each bin where there are many, in order of time."""
    if len(values) <= MAX_SAMPLES:
        return seconds, values
    edges = np.linspace(0, len(values), MAX_SAMPLES // 2 + 1).round().astype(np.int64)
    ends = [
        (start + int(np.argmin(values[start:end])), start + int(np.argmax(values[start:end])))
        for start, end in pairwise(edges.tolist())
    ]
    chosen = np.unique(np.array(ends))
    return seconds[chosen], values[chosen]


def _with_holes(seconds: FloatArray, values: FloatArray, holes_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same with a NaN at each of these times, so that no line leads across."""
    places = np.searchsorted(seconds, holes_s)
    return np.insert(seconds, places, holes_s), np.insert(values, places, np.nan)


def _speed(content: ReportContent, trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Seconds and metres a second between consecutive poses."""
    duration = np.diff(trajectory.stamps_ns) / NANOSECONDS
    return content.seconds(trajectory.stamps_ns[1:]), _norm(np.diff(trajectory.poses.translation, axis=0)) / duration


def _true_motions(
    content: ReportContent, pairs: Sequence[PairEstimate]
) -> tuple[NDArray[np.bool_], RigidTransform] | None:
    """Which of N pairs (N,) the ground truth spans, and the true motions of those; None where it spans none."""
    if content.ground_truth is None or not pairs:
        return None
    stamps = _spans(pairs)
    known = content.ground_truth.covers(stamps[:, 0]) & content.ground_truth.covers(stamps[:, 1])
    if not np.any(known):
        return None
    start, end = (content.ground_truth.at(each) for each in stamps[known].T)
    return known, start.inv() * end


def _spans(pairs: Sequence[PairEstimate]) -> IntArray:
    """Source and target stamps (N, 2)."""
    return np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64).reshape(-1, 2)


def _targets(pairs: Sequence[PairEstimate]) -> IntArray:
    return _spans(pairs)[:, 1]


def _motions(pairs: Sequence[PairEstimate]) -> RigidTransform:
    return _transforms(np.stack([pair.quat_wxyz for pair in pairs]), np.stack([pair.translation for pair in pairs]))


def _hypotheses(pairs: Sequence[PairEstimate]) -> tuple[FloatArray, FloatArray]:
    """The hypotheses of N pairs: quaternions (N, M, 4) and translations (N, M, 3), as many as all of them have."""
    count = min(len(pair.hypotheses_translation) for pair in pairs)
    quats_wxyz = np.stack([pair.hypotheses_quat_wxyz[:count] for pair in pairs])
    return quats_wxyz, np.stack([pair.hypotheses_translation[:count] for pair in pairs])


def _each_hypothesis(pairs: Sequence[PairEstimate]) -> list[RigidTransform]:
    """The first hypotheses of N pairs, the second ones, and so on."""
    quats_wxyz, translations = _hypotheses(pairs)
    return [_transforms(quats_wxyz[:, i], translations[:, i]) for i in range(translations.shape[1])]


def _rmse(names: Sequence[str], estimates: Sequence[RigidTransform], motions: RigidTransform) -> list[Row]:
    """A bar for each estimate of N motions: the root mean square of its errors."""
    differences = [estimate.inv() * motions for estimate in estimates]
    metres = np.array([np.sqrt(np.mean(_norm(each.translation) ** 2)) for each in differences])
    milliradians = np.array([1e3 * np.sqrt(np.mean(each.rotation.magnitude() ** 2)) for each in differences])
    return [
        Row("translation [m]", [Line("RMSE", names, metres, "pairs", mode="bars", legend=False)]),
        Row("rotation [mrad]", [Line("RMSE", names, milliradians, "pairs", mode="bars", legend=False)]),
    ]


def _transforms(quats_wxyz: FloatArray, translations: FloatArray) -> RigidTransform:
    return RigidTransform.from_components(translations, _rotations(quats_wxyz))


def _rotations(quats_wxyz: FloatArray) -> Rotation:
    return Rotation.from_quat(quats_wxyz, scalar_first=True)


def _norm(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=-1))
