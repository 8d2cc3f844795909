"""A run in a few sentences: whether something takes the result away, how good it is, where it ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from fusion.evaluation import ANEES_DIMENSIONS, CONFIDENCE, MIN_VARIANCE, Metrics, consistency, errors_by_sigmas
from fusion.report.content import ReportContent
from fusion.table import HEADINGS, turned_deg
from fusion_io.records import NIS_DEGREES_OF_FREEDOM, FloatArray, IntArray, Trajectory
from fusion_io.words import counted, metres

Status = Literal["good", "caution", "bad"]

DISAGREEMENT = 3.0  # standard deviations
NAMED_DOUBTS = 3  # of a kind; of more it is said how many

PLACES = ("right", "left"), ("below", "above"), ("ahead", "behind")
TURNS = ("right", "left"), ("up", "down"), ("clockwise", "counterclockwise")


@dataclass(frozen=True, slots=True)
class Verdict:
    """A few sentences, what weighs most first, and whether the eye should stop at them."""

    sentences: Sequence[str]
    status: Status

    @property
    def text(self) -> str:
        """All of it."""
        return " ".join(self.sentences)


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far two back ends are from each other at N common stamps.

    distance_m, angle_rad (N,); sigma_m, sigma_rad (N,): roots of the summed variances of both, so that a difference
    beyond three of them contradicts what they state. They see the same data, which makes this lenient.
    """

    names: tuple[str, str]
    stamps_ns: IntArray
    distance_m: FloatArray
    angle_rad: FloatArray
    sigma_m: FloatArray
    sigma_rad: FloatArray

    @property
    def worst(self) -> float:
        """The largest distance in standard deviations; NaN where neither states any."""
        stated = self.sigma_m**2 > MIN_VARIANCE
        return float(np.max(self.distance_m[stated] / self.sigma_m[stated])) if np.any(stated) else float("nan")


def label(name: str) -> str:
    """What a trajectory is called."""
    return HEADINGS.get(name, name.replace("_", " "))


def verdict(content: ReportContent) -> Verdict:
    """What to know of the run: doubts first, then how good it is, where the camera was at the end, what was found."""
    faults = Counter(event.kind for event in content.events if event.is_fault)
    doubted = doubts(content)
    quality, status = judgement(content)
    found = [_imu(content)]
    if faults:
        # A stretch of wrong pairs is one time: how many pairs are in it, its event says.
        often = (kind if count == 1 else f"{kind} ({count} times)" for kind, count in faults.items())
        found.append(f"found {', '.join(often)}")
    if content.warnings:
        found.append(counted(len(content.warnings), "warning"))
    lines = (*doubted, quality, _end(content), "; ".join(found))
    if any(each.is_lost for each in content.extrapolations):
        status = "bad"
    elif status == "good" and (doubted or faults or content.warnings):
        status = "caution"
    return Verdict([f"{line[0].upper()}{line[1:]}." for line in lines], status)


def doubts(content: ReportContent) -> list[str]:
    """What takes a part of the result away: poses that nothing measured, and a damaged log; in lines without a stop."""
    holes = [each.line(content.start_ns) for each in content.extrapolations]
    lines = holes[:NAMED_DOUBTS]
    if more := holes[NAMED_DOUBTS:]:
        lines.append(counted(len(more), "more such stretch", "more such stretches"))
    if content.damage:
        lines.append(_damage(content))
    return lines


def judgement(content: ReportContent) -> tuple[str, Status]:
    """How good and how sure it is: against the ground truth where there is one, else by how consistent it is."""
    return _accuracy(content) or _consistency(content)


def _damage(content: ReportContent) -> str:
    named = content.damage[:NAMED_DOUBTS]
    more = len(content.damage) - len(named)
    last_s = content.second(int(content.trajectories["raw"].stamps_ns[-1]))
    also = f"; and {counted(more, 'more fault')}" if more else ""
    return f"the log is damaged: {'; '.join(named)}{also}; the result is of what could be read, until {last_s:.1f} s"


def _end(content: ReportContent) -> str:
    """Where the headline's trajectory ends, in the axes of the first camera (x right, y down, z ahead), how turned."""
    trajectory = content.trajectories[content.headline]
    place = _on_sides(trajectory.poses.translation[-1].tolist(), "m", PLACES)
    turn = _on_sides(turned_deg(trajectory.poses.rotation[-1]), "deg", TURNS)
    of_place = of_turn = ""
    if (sigmas := trajectory.end_sigmas) is not None:
        of_place = f" (stated sigma {metres(sigmas[0])})"
        of_turn = f" (stated sigma {np.rad2deg(sigmas[1]):.2g} deg)"
    return f"at the end the camera was {place} of where it began{of_place}, turned {turn}{of_turn}"


def _on_sides(values: Sequence[float], unit: str, sides: Sequence[tuple[str, str]]) -> str:
    """Sizes of values, each with the side that it is on: the first of two where it is positive."""
    return ", ".join(f"{abs(value):.1f} {unit} {side[value < 0.0]}" for value, side in zip(values, sides, strict=True))


def agreements(content: ReportContent) -> list[Agreement]:
    """The headline beside every other fused trajectory."""
    first = content.headline
    found = [
        _agreement((first, name), content.trajectories[first], content.trajectories[name])
        for name in content.fused
        if name != first
    ]
    return [each for each in found if len(each.stamps_ns)]


def nis_bounds() -> tuple[float, float]:
    """Between which the normalised innovation squared of a pair is expected with 95 %."""
    low, high = chi2.interval(CONFIDENCE, NIS_DEGREES_OF_FREEDOM)
    return float(low), float(high)


def _accuracy(content: ReportContent) -> tuple[str, Status] | None:
    """The headline's ATE beside the raw one's, and whether its stated uncertainty holds."""
    name = content.headline
    metrics, raw = content.metrics.get(name), content.metrics.get("raw")
    if metrics is None or metrics.ate_m is None or content.ground_truth is None:
        return None
    length_m = content.trajectories[name].path_length_m
    share = f" ({100.0 * metrics.ate_m / length_m:.2g} %)" if length_m > 0.0 else ""
    text = f"{label(name)}: ATE {metres(metrics.ate_m)} over {metres(length_m)}{share}"
    status: Status = "good"
    if name != "raw" and raw is not None and raw.ate_m is not None:
        worse = metrics.ate_m > raw.ate_m
        text += f", {_compared(metrics.ate_m, raw.ate_m)} raw ({metres(raw.ate_m)})"
        status = "bad" if worse else status
    judged = _judged(metrics)
    if judged:
        text += f"; {', '.join(judged)}"
    if status == "good" and any("overconfident" in each for each in judged):
        status = "caution"
    return text, status


def _judged(metrics: Metrics) -> list[str]:
    """How many times the stated sigmas the errors of position and of orientation are, and what that is called."""
    known = {"position": metrics.anees_position, "orientation": metrics.anees_orientation}
    return [
        f"its {what} errors are {errors_by_sigmas(value):.2g} times its sigmas: {consistency(value)} "
        f"(ANEES {value:.3g}, {ANEES_DIMENSIONS} is right)"
        for what, value in known.items()
        if value is not None
    ]


def _consistency(content: ReportContent) -> tuple[str, Status]:
    """What can be said without ground truth."""
    name, status = content.headline, "good"
    trajectory = content.trajectories[name]
    parts = [f"no ground truth to compare with; {label(name)}: {metres(trajectory.path_length_m)}"]
    for each in agreements(content):
        if np.isfinite(each.worst):
            first, second = map(label, each.names)
            parts.append(
                f"{first} and {second} differ by {metres(float(np.max(each.distance_m)))} at most, "
                f"{each.worst:.1f} sigma"
            )
            status = "caution" if each.worst > DISAGREEMENT else status
    if (series := content.series.get(name)) is not None and np.any(known := np.isfinite(series.nis)):
        low, high = nis_bounds()
        inside = np.mean((series.nis[known] >= low) & (series.nis[known] <= high))
        parts.append(f"NIS inside its 95 % bounds for {100.0 * inside:.0f} % of the pairs")
    return "; ".join(parts), "caution" if status == "caution" else "good"


def _imu(content: ReportContent) -> str:
    if content.imu is None or not len(content.imu):
        return "no IMU"
    if content.calibration is None or not content.calibration.used:
        return "IMU left out"
    refused = content.series and not any(each.knows_imu for each in content.series.values())
    return "IMU calibrated, but no back end used it" if refused else "IMU used"


def _agreement(names: tuple[str, str], first: Trajectory, second: Trajectory) -> Agreement:
    stamps_ns, a, b = np.intersect1d(first.stamps_ns, second.stamps_ns, return_indices=True)
    between = first.poses[a].inv() * second.poses[b]
    variances = np.zeros((len(stamps_ns), 6))
    for trajectory, chosen in ((first, a), (second, b)):
        if trajectory.covariances is not None:
            variances += np.diagonal(trajectory.covariances[chosen], axis1=1, axis2=2)
    return Agreement(
        names,
        stamps_ns,
        np.linalg.norm(between.translation, axis=1),
        between.rotation.magnitude(),
        np.sqrt(variances[:, 3:].sum(axis=1)),
        np.sqrt(variances[:, :3].sum(axis=1)),
    )


def _compared(value: float, other: float) -> str:
    if abs(value - other) < 0.01 * other or metres(value) == metres(other):
        return "the same as"
    return "better than" if value < other else "worse than"
