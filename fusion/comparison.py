"""Results beside each other: the measures of all, what one does better than another, where, and beyond noise or not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fusion.evaluation import KITTI_SEGMENT_LENGTHS_M, Metrics, SegmentErrors, evaluate, segment_errors
from fusion.results import Result
from fusion.significance import Difference, paired_difference
from fusion.table import best_of
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, Trajectory

SCHEMA = 1
STRETCHES = 10
"""The path is divided into so many pieces, or fewer where the shortest segment does not fit into them."""

SAME_TIME_S = 1.0
"""Results whose ends are nearer than this cover the same time."""

MEASURES = {"t_rel_percent": "translation_percent", "r_rel_deg_per_100m": "rotation_deg_per_100m"}
"""Measures that are means over segments, and the errors that they are the means of."""


class Contestant(NamedTuple):
    """A trajectory of a result; its name is that of conditions: ``a.posegraph``."""

    result: Result
    trajectory: str

    @property
    def name(self) -> str:
        """What conditions call it."""
        return f"{self.result.key}.{self.trajectory}"

    @property
    def poses(self) -> Trajectory:
        """The trajectory itself."""
        return self.result.trajectories[self.trajectory]


@dataclass(frozen=True, slots=True)
class Stretch:
    """A piece of the path, from start_m to end_m, and the mean errors of the segments that begin there."""

    start_m: float
    end_m: float
    a: Mapping[str, float]
    b: Mapping[str, float]

    def difference(self, measure: str) -> float:
        """How much larger the error of b is."""
        return self.b[measure] - self.a[measure]


@dataclass(frozen=True, slots=True)
class Duel:
    """Two trajectories on the same segments of the ground truth; differences are b less a, by measure.

    stamps_ns (N,): of the frames that both and the ground truth have; path_m (N, 3): the true positions there, in the
    axes of the first camera; distance_m (N,): travelled until then. errors_a, errors_b: by segment, the same segments.
    by_length: the differences for the segments of each length. stretches: along the path, by the shortest segments.
    """

    a: Contestant
    b: Contestant
    stamps_ns: IntArray
    path_m: FloatArray
    distance_m: FloatArray
    errors_a: SegmentErrors
    errors_b: SegmentErrors
    differences: Mapping[str, Difference]
    by_length: Mapping[float, Mapping[str, Difference]]
    stretches: Sequence[Stretch]


@dataclass(frozen=True, slots=True)
class Deviation:
    """How far b is from a where nobody knows the truth: the measures of b with a in the place of the ground truth."""

    a: Contestant
    b: Contestant
    measures: Metrics


@dataclass(frozen=True, slots=True)
class Comparison:
    """All results: the measures by contestant's name, the duels, and deviations where there is no ground truth."""

    results: Sequence[Result]
    segment_lengths_m: Sequence[float]
    metrics: Mapping[str, Metrics]
    duels: Sequence[Duel]
    deviations: Sequence[Deviation]
    notes: Sequence[str]

    @property
    def measures(self) -> dict[str, float | None]:
        """All measures by the names that conditions use: ``a.raw.ate_m``."""
        return {
            f"{name}.{measure}": value
            for name, metrics in self.metrics.items()
            for measure, value in asdict(metrics).items()
        }

    def best(self, measure: str) -> set[str]:
        """The names of the contestants that are nearest to what is right; none where all are equal."""
        values = {name: getattr(metrics, measure) for name, metrics in self.metrics.items()}
        distances = [None if value is None else badness(measure, value) for value in values.values()]
        return {name for name, is_best in zip(values, best_of(distances), strict=True) if is_best}


def compare(
    results: Sequence[Result], ground_truth: Trajectory | None = None, segment_lengths_m: Sequence[float] | None = None
) -> Comparison:
    """Compare results with each other and with the ground truth: the one given, else that of an input.

    segment_lengths_m: by default those that the first run was configured with, else KITTI's.
    """
    lengths = tuple(segment_lengths_m or _recorded_lengths(results) or KITTI_SEGMENT_LENGTHS_M)
    results = [replace(result, ground_truth=_truth_for(result, results, ground_truth)) for result in results]
    metrics = {
        each.name: evaluate(each.poses, each.result.ground_truth, lengths)
        for result in results
        for each in contestants(result)
    }
    duels: list[Duel] = []
    deviations: list[Deviation] = []
    notes = [note for result in results for note in result.notes]
    for a, b in opponents(results):
        truth = a.result.ground_truth
        if truth is not None and (fought := duel(a, b, truth, lengths)) is not None:
            duels.append(fought)
        elif truth is None and (far := deviation(a, b, lengths)) is not None:
            deviations.append(far)
        else:
            also = "" if truth is None else " and the ground truth"
            notes.append(f"{a.name} and {b.name} are not compared: they{also} have no times in common")
    if duels or deviations:
        notes += _coverage(results)
    return Comparison(results, lengths, metrics, duels, deviations, notes)


def badness(measure: str, value: float) -> float:
    """How far a measure is from what is right: an ANEES from 3, anything else from 0."""
    return abs(value - 3.0) if "anees" in measure else abs(value)


def contestants(result: Result) -> list[Contestant]:
    """All trajectories of a result."""
    return [Contestant(result, name) for name in result.trajectories]


def opponents(results: Sequence[Result]) -> Iterator[tuple[Contestant, Contestant]]:
    """Who is compared with whom: every trajectory with that of the same name in the first input, or with all of that.

    In a lone input, all meet the first.
    """
    first = contestants(results[0])
    if len(results) == 1:
        yield from ((first[0], each) for each in first[1:])
    for result in results[1:]:
        for b in contestants(result):
            for a in [each for each in first if each.trajectory == b.trajectory] or first:
                yield a, b


def duel(a: Contestant, b: Contestant, truth: Trajectory, segment_lengths_m: Sequence[float]) -> Duel | None:
    """Judge two trajectories on the same segments; None where they and the truth have fewer than two frames in common.

    Frames are those of a; b and the truth are interpolated to them.
    """
    stamps_ns = a.poses.stamps_ns
    stamps_ns = stamps_ns[b.poses.covers(stamps_ns) & truth.covers(stamps_ns) & a.poses.covers(stamps_ns)]
    if len(stamps_ns) < 2:
        return None
    true_poses = truth.at(stamps_ns)
    errors_a, errors_b = (segment_errors(each.poses.at(stamps_ns), true_poses, segment_lengths_m) for each in (a, b))
    path_m = (true_poses[0].inv() * true_poses).translation
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])
    by_length = {
        length: _differences(*(_of_length(errors, length) for errors in (errors_a, errors_b)))
        for length in np.unique(errors_a.length_m).tolist()
    }
    return Duel(
        a,
        b,
        stamps_ns,
        path_m,
        distance_m,
        errors_a,
        errors_b,
        _differences(errors_a, errors_b),
        by_length,
        _stretches(errors_a, errors_b, distance_m),
    )


def deviation(a: Contestant, b: Contestant, segment_lengths_m: Sequence[float]) -> Deviation | None:
    """How far b is from a; None where they have fewer than two frames in common."""
    measures = evaluate(replace(b.poses, covariances=None), a.poses, segment_lengths_m)
    return None if measures.ate_m is None else Deviation(a, b, measures)


def document(comparison: Comparison) -> dict[str, Any]:
    """The comparison as JSON: inputs with their measures as in metrics.json, differences, deviations."""
    return {
        "schema": SCHEMA,
        "segment_lengths_m": list(comparison.segment_lengths_m),
        "inputs": [
            {
                "key": result.key,
                "name": result.label,
                "path": str(result.path),
                "trajectories": {
                    each.trajectory: asdict(comparison.metrics[each.name]) for each in contestants(result)
                },
            }
            for result in comparison.results
        ],
        "differences": [_duel_document(each) for each in comparison.duels],
        "deviations": [{"a": each.a.name, "b": each.b.name} | asdict(each.measures) for each in comparison.deviations],
        "notes": list(comparison.notes),
    }


def _coverage(results: Sequence[Result]) -> list[str]:
    """Which times each result covers, where they are not the same: then the measures are not of the same drive."""
    spans_ns = np.array(
        [
            (
                min(each.stamps_ns[0] for each in result.trajectories.values()),
                max(each.stamps_ns[-1] for each in result.trajectories.values()),
            )
            for result in results
        ]
    )
    if np.max(np.ptp(spans_ns, axis=0)) < SAME_TIME_S * NANOSECONDS:
        return []
    seconds = (spans_ns - spans_ns.min()) / NANOSECONDS
    covered = [
        f"{result.key} ({result.label}) {start:.1f} to {end:.1f} s"
        for result, (start, end) in zip(results, seconds.tolist(), strict=True)
    ]
    return [
        f"the inputs cover different times: {', '.join(covered)}; the measures of each are over its own time, "
        "differences over the time that both cover"
    ]


def _duel_document(duel: Duel) -> dict[str, Any]:
    return {
        "a": duel.a.name,
        "b": duel.b.name,
        "segments": len(duel.errors_a.start),
        **{measure: _difference_document(each) for measure, each in duel.differences.items()},
        "by_length": [
            {"length_m": length} | {measure: _difference_document(each) for measure, each in differences.items()}
            for length, differences in duel.by_length.items()
        ],
        "stretches": [
            {"start_m": each.start_m, "end_m": each.end_m, "a": dict(each.a), "b": dict(each.b)}
            for each in duel.stretches
        ],
    }


def _difference_document(difference: Difference) -> dict[str, Any]:
    return {**difference._asdict(), "verdict": difference.verdict}


def _recorded_lengths(results: Sequence[Result]) -> Sequence[float] | None:
    """The segment lengths that the first run was configured with."""
    for result in results:
        lengths = (result.settings or {}).get("segment_lengths_m")
        if isinstance(lengths, list) and all(isinstance(each, int | float) and each > 0 for each in lengths):
            return tuple(map(float, lengths))
    return None


def _truth_for(result: Result, results: Sequence[Result], given: Trajectory | None) -> Trajectory | None:
    """The ground truth given, that of the result itself, or that of the first result with any."""
    known = (given, result.ground_truth, *(each.ground_truth for each in results))
    return next((truth for truth in known if truth is not None), None)


def _differences(a: SegmentErrors, b: SegmentErrors) -> dict[str, Difference]:
    found = {measure: paired_difference(a, b, errors) for measure, errors in MEASURES.items()}
    return {measure: difference for measure, difference in found.items() if difference is not None}


def _of_length(errors: SegmentErrors, length_m: float) -> SegmentErrors:
    chosen = errors.length_m == length_m
    return SegmentErrors(*(values[chosen] for values in errors))


def _stretches(a: SegmentErrors, b: SegmentErrors, distance_m: FloatArray) -> list[Stretch]:
    """Mean errors of the shortest segments, by where along the path they begin."""
    if not len(a.start):
        return []
    shortest = float(a.length_m.min())
    a, b = _of_length(a, shortest), _of_length(b, shortest)
    count = int(np.clip(distance_m[-1] // shortest, 1, STRETCHES))
    edges = np.linspace(0.0, distance_m[-1], count + 1)
    of_stretch = np.clip(np.searchsorted(edges, distance_m[a.start], side="right") - 1, 0, count - 1)
    return [
        Stretch(float(edges[k]), float(edges[k + 1]), _means(a, of_stretch == k), _means(b, of_stretch == k))
        for k in np.unique(of_stretch).tolist()
    ]


def _means(errors: SegmentErrors, chosen: np.ndarray[Any, Any]) -> dict[str, float]:
    return {measure: float(np.mean(getattr(errors, name)[chosen])) for measure, name in MEASURES.items()}
