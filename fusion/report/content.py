"""What a report is made of, and how a run fills it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion import events, gnss
from fusion.evaluation import KITTI_SEGMENT_LENGTHS_M, Metrics
from fusion.events import Event
from fusion.extrapolation import Extrapolation, extrapolations
from fusion.gnss import PlacedFixes
from fusion.imu import BiasStep, ImuCalibration, on_camera_clock
from fusion.measurements import Mounting
from fusion_io.errors import LogError
from fusion_io.findings import Findings
from fusion_io.records import NANOSECONDS, EstimatorSeries, ImuSeries, IntArray, PairEstimate, Trajectory

if TYPE_CHECKING:
    from fusion.output import Outcome
    from fusion_io.reader import Log

MAX_THUMBNAILS = 200
THUMBNAIL_PERIOD_S = 0.5  # closer together they show the same
MAX_THUMBNAIL_BYTES = 1_100_000  # of all together; a third more in the page
THUMBNAIL_SIZE = 320, 200  # width and height in pixels, at most
THUMBNAIL_QUALITY = 60


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small JPEG of the frame with this stamp."""

    stamp_ns: int
    jpeg: bytes


@dataclass(frozen=True)
class ReportContent:
    """All that a report shows; what is empty is said to be missing rather than drawn.

    trajectories: by name, raw among them. segment_lengths_m: of t_rel and r_rel. series: what a back end estimated
    beside the poses, by its name; mounting: of the IMU, as a back end refined it; loops_used: which of the loops it
    believed (M,). bias_steps: of the IMU. topics: the name of each role. warnings: counts by name, notes: a line for
    each. remarks: what the back ends say, by name. fixes: GNSS positions, where the pose graph found out where the
    world is. levels: pairs whose hypotheses are the motions after each level of the network. damage: a line for each
    fault of the file.
    """

    title: str
    trajectories: Mapping[str, Trajectory]
    metrics: Mapping[str, Metrics]
    pairs: Sequence[PairEstimate]
    frame_stamps_ns: IntArray
    ground_truth: Trajectory | None = None
    segment_lengths_m: Sequence[float] = KITTI_SEGMENT_LENGTHS_M
    imu: ImuSeries | None = None
    calibration: ImuCalibration | None = None
    mounting: Mounting | None = None
    series: Mapping[str, EstimatorSeries] = field(default_factory=dict)
    loops: Sequence[PairEstimate] = ()
    loops_used: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    bias_steps: Sequence[BiasStep] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    warnings: Mapping[str, int] = field(default_factory=dict)
    notes: Sequence[str] = ()
    remarks: Mapping[str, str] = field(default_factory=dict)
    thumbnails: Sequence[Thumbnail] = ()
    fixes: PlacedFixes | None = None
    levels: Sequence[PairEstimate] = ()
    damage: Sequence[str] = ()

    @property
    def start_ns(self) -> int:
        """The first stamp of the trajectories: what all times are counted from."""
        return int(self.trajectories["raw"].stamps_ns[0])

    @property
    def fused(self) -> list[str]:
        """The names of the fused trajectories."""
        return [name for name in self.trajectories if name != "raw"]

    @property
    def headline(self) -> str:
        """The trajectory that the verdict is about: the first fused one, chosen without a look at the ground truth."""
        return self.fused[0] if self.fused else "raw"

    def seconds(self, stamps_ns: IntArray) -> NDArray[np.float64]:
        """Time since the first frame."""
        return np.asarray((np.asarray(stamps_ns) - self.start_ns) / NANOSECONDS)

    def second(self, stamp_ns: int) -> float:
        """The same of one stamp."""
        return (stamp_ns - self.start_ns) / NANOSECONDS

    def topic(self, role: str) -> str:
        """The topic of a role, or the role's own name where it came from elsewhere."""
        return self.topics.get(role, role)

    @cached_property
    def events(self) -> list[Event]:
        """What went wrong with the sensors, in order of time, on the camera's clock."""
        return events.in_order([*self._imu_events(), *self._camera_events()])

    @cached_property
    def extrapolations(self) -> list[Extrapolation]:
        """Where the headline's trajectory rests on no measurement for long."""
        name = self.headline
        series = self.series.get(name)
        imu = None
        if self.imu is not None and self.calibration is not None and series is not None and series.knows_imu:
            imu = on_camera_clock(self.imu, self.calibration)
        used = self.loops_used.get(name, np.zeros(0, dtype=np.bool_))
        loops = [loop for loop, believed in zip(self.loops, used, strict=False) if believed]
        tied = self.fixes is not None and name == "posegraph"
        fixes_ns = self.fixes.stamps_ns[self.fixes.used] if self.fixes and tied else np.zeros(0, dtype=np.int64)
        return extrapolations(self.trajectories[name], self.pairs, imu, loops, fixes_ns)

    def _imu_events(self) -> Iterator[Event]:
        if self.imu is None or not len(self.imu):
            return
        topic = self.topic("imu" if "imu" in self.topics else "gyro")
        offset_s = self.calibration.time_offset_s if self.calibration else 0.0
        offset_ns = round(offset_s * NANOSECONDS)
        shown = [
            replace(event, start_ns=event.start_ns - offset_ns, end_ns=event.end_ns - offset_ns)
            for event in events.of_imu(self.imu, topic)
            if event.kind != events.STAND_STILL  # the trajectory knows better
        ]
        yield from shown
        jumps = events.clock_jumps(self.imu, self.pairs, topic, self.calibration)
        yield from jumps
        if self.calibration is not None:
            known = [event for event in (*shown, *jumps) if event.kind != events.IMU_GAP]
            yield from events.contradictions(self.calibration.faulty_ns, offset_s, known, topic)
        yield from events.bias_steps(self.bias_steps, topic)

    def _camera_events(self) -> Iterator[Event]:
        frames = self.topic("image" if "image" in self.topics else "camera_info")
        pairs = self.topic("pairs")
        yield from events.dropped_frames(self.frame_stamps_ns, frames)
        yield from events.missing_pairs(self.frame_stamps_ns, self.pairs, pairs)
        judged = bool(self.loops) or (self.calibration is not None and self.calibration.used)
        fused = self.trajectories[self.headline] if judged else None
        yield from events.wrong_pairs(self.pairs, pairs, fused, self._rejected())
        yield from events.standing(self.trajectories[self.headline], frames)

    def _rejected(self) -> NDArray[np.bool_]:
        """Which of the pairs a back end left out: those of the headline's series that were not used."""
        rejected = np.zeros(len(self.pairs), dtype=np.bool_)
        if (series := self.series.get(self.headline)) is not None:
            unused = series.stamps_ns[~series.used]
            targets = np.array([pair.target_stamp_ns for pair in self.pairs], dtype=np.int64)
            rejected |= np.isin(targets, unused) & (targets != series.stamps_ns[0])
        return rejected


def content_of(outcome: Outcome) -> ReportContent:
    """What a run has to show; small images of some of its frames are read from the log again."""
    log = outcome.log
    stamps_ns = log.frame_stamps()
    return ReportContent(
        title=log.path.name,
        trajectories=outcome.trajectories,
        metrics=outcome.metrics,
        pairs=outcome.pairs,
        # An interrupted run ends before its log.
        frame_stamps_ns=stamps_ns[stamps_ns <= outcome.trajectories["raw"].stamps_ns[-1]],
        ground_truth=outcome.ground_truth,
        segment_lengths_m=outcome.config.segment_lengths_m,
        imu=outcome.imu,
        calibration=outcome.calibration,
        mounting=outcome.mounting,
        bias_steps=outcome.bias_steps,
        topics=log.roles,
        warnings={**log.warnings, **outcome.findings.counts},
        notes=[*log.notes, *outcome.findings.notes],
        remarks={name: each.note for name, each in outcome.estimates.items()},
        series={name: each.series for name, each in outcome.estimates.items() if each.series is not None},
        loops=outcome.loops,
        loops_used={name: each.loops_used for name, each in outcome.estimates.items()},
        thumbnails=thumbnails(log),
        fixes=_fixes(outcome),
        levels=outcome.levels,
        damage=[line.removeprefix(f"{log.path}: ") for line in log.damage],
    )


def _fixes(outcome: Outcome) -> PlacedFixes | None:
    """The GNSS positions on the pose graph's trajectory, None where they could not be tied to it."""
    known = gnss.positions(outcome.gnss, outcome.config.gnss, Findings())
    if known is None or outcome.georeference is None:
        return None
    return outcome.georeference.in_world(known, outcome.trajectories["posegraph"].stamps_ns)


def thumbnails(log: Log) -> list[Thumbnail]:
    """Small images of frames that are evenly spread over the log, none where it has no images to decode."""
    if not log.has_frames:
        return []
    stamps = log.frame_stamps()
    count = min(MAX_THUMBNAILS, int((stamps[-1] - stamps[0]) / (THUMBNAIL_PERIOD_S * NANOSECONDS)) + 2)
    chosen = stamps[np.unique(np.linspace(0, len(stamps) - 1, count).round().astype(np.int64))]
    try:
        small = [Thumbnail(frame.stamp_ns, _jpeg(frame.image)) for frame in log.frames(chosen)]
    except LogError:  # no intrinsics: the run had no use for the images either
        return []
    while sum(len(each.jpeg) for each in small) > MAX_THUMBNAIL_BYTES:
        small = small[::2]
    return small


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    """An image (H, W) or (H, W, 3) RGB, scaled down to a thumbnail."""
    height, width = image.shape[:2]
    scale = min(1.0, THUMBNAIL_SIZE[0] / width, THUMBNAIL_SIZE[1] / height)
    size = max(round(scale * width), 1), max(round(scale * height), 1)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    bgr = small if small.ndim == 2 else cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY])
    return bytes(encoded.tobytes())
