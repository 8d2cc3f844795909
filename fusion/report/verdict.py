"""A run in one line: how good it is, and whether to trust it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from fusion.evaluation import MIN_VARIANCE
from fusion.report.content import ReportContent
from fusion.table import HEADINGS
from fusion_io.records import FloatArray, IntArray, Trajectory

Status = Literal["good", "caution", "bad"]

NIS_DEGREES_OF_FREEDOM = 6
COVERAGE = 0.95  # of the bounds that are drawn and counted
OVERCONFIDENT = 9.0  # an ANEES of 3 is right; beyond this, errors are sqrt(3) times what is stated
DISAGREEMENT = 3.0  # standard deviations


@dataclass(frozen=True, slots=True)
class Verdict:
    """One line, and whether the eye should stop at it."""

    text: str
    status: Status


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
    """The run in one line: against the ground truth where there is one, else by how consistent it is."""
    faults = Counter(event.kind for event in content.events if event.is_fault)
    accuracy, status = _accuracy(content) or _consistency(content)
    parts = [accuracy, _imu(content)]
    if faults:
        parts.append(
            "found " + ", ".join(kind if count == 1 else f"{kind} ({count})" for kind, count in faults.items())
        )
    if warnings := len(content.warnings):
        parts.append(f"{warnings} {_plural('warning', warnings)}")
    text = "; ".join(parts)
    caution = status == "good" and bool(faults or content.warnings)
    return Verdict(text[0].upper() + text[1:] + ".", "caution" if caution else status)


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
    low, high = chi2.interval(COVERAGE, NIS_DEGREES_OF_FREEDOM)
    return float(low), float(high)


def _accuracy(content: ReportContent) -> tuple[str, Status] | None:
    """The headline's ATE beside the raw one's, and whether its stated uncertainty holds."""
    name = content.headline
    metrics, raw = content.metrics.get(name), content.metrics.get("raw")
    if metrics is None or metrics.ate_m is None or content.ground_truth is None:
        return None
    length_m = content.trajectories[name].path_length_m
    share = f" ({100.0 * metrics.ate_m / length_m:.2g} %)" if length_m > 0.0 else ""
    text = f"{label(name)}: ATE {_metres(metrics.ate_m)} over {_metres(length_m)}{share}"
    status: Status = "good"
    if name != "raw" and raw is not None and raw.ate_m is not None:
        worse = metrics.ate_m > raw.ate_m
        text += f", {_compared(metrics.ate_m, raw.ate_m)} raw ({_metres(raw.ate_m)})"
        status = "bad" if worse else status
    if metrics.anees_position is not None:
        overconfident = metrics.anees_position > OVERCONFIDENT
        honest = "too small" if overconfident else "honest" if metrics.anees_position >= 1.0 else "cautious"
        text += f"; its stated uncertainty is {honest} (ANEES {metrics.anees_position:.3g}, 3 is right)"
        status = "caution" if overconfident and status == "good" else status
    return text, status


def _consistency(content: ReportContent) -> tuple[str, Status]:
    """What can be said without ground truth."""
    name, status = content.headline, "good"
    trajectory = content.trajectories[name]
    parts = [f"no ground truth to compare with; {label(name)}: {_metres(trajectory.path_length_m)}"]
    if trajectory.covariances is not None:
        parts[0] += f", stated sigma at the end {_metres(float(np.sqrt(np.trace(trajectory.covariances[-1, 3:, 3:]))))}"
    for each in agreements(content):
        if np.isfinite(each.worst):
            first, second = map(label, each.names)
            parts.append(
                f"{first} and {second} differ by {_metres(float(np.max(each.distance_m)))} at most, "
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
    if abs(value - other) < 0.01 * other:
        return "the same as"
    return "better than" if value < other else "worse than"


def _metres(value: float) -> str:
    """A length in metres, centimetres below one."""
    return f"{value:.0f} m" if value >= 100.0 else f"{value:.1f} m" if value >= 10.0 else f"{value:.2f} m"


def _plural(word: str, count: int) -> str:
    return word if count == 1 else f"{word}s"
