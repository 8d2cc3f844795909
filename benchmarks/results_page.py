"""The page of results: the table of targets, and for each section its figures, its plot and what is to be said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from fusion.evaluation import common
from fusion.plots import GROUND_TRUTH_STYLE, STYLES
from fusion_io.records import Trajectory

COLUMNS = {"posegraph": "pose graph", "ekf": "EKF", "ekf_smoothed": "EKF, smoothed"}
DPI = 72
PANEL_INCHES = 3.6


@dataclass(frozen=True)
class Check:
    """A measure of a log: of the raw trajectory (None: it has none), of the back ends, and what it must not exceed.

    bound: one for all, or by back end; a back end without a bound is only reported.
    """

    log: str
    measure: str
    raw: float | None
    values: Mapping[str, float]
    bound: float | Mapping[str, float]
    form: str = "{:.3g}"

    def limit(self, name: str) -> float | None:
        """The bound of a back end."""
        return self.bound.get(name) if isinstance(self.bound, Mapping) else self.bound


class Table(NamedTuple):
    """Words in rows."""

    headings: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


class Path2d(NamedTuple):
    """Trajectories to be seen from above."""

    title: str
    trajectories: Mapping[str, Trajectory]
    truth: Trajectory


@dataclass(frozen=True)
class Section:
    """What was measured on one kind of log; name is that of its plot and of its remarks."""

    name: str
    title: str
    checks: Sequence[Check]
    tables: Sequence[Table] = ()
    paths: Sequence[Path2d] = field(default_factory=tuple)


def write_page(path: Path, sections: Sequence[Section]) -> None:
    """Write the page, and its plots into the folder of its name beside it."""
    checks = [check for section in sections for check in section.checks]
    parts = [INTRODUCTION, _markdown(_targets(checks))]
    for section in sections:
        parts += [f"## {section.title}", REMARKS[section.name], *map(_markdown, section.tables)]
        if section.paths:
            plot = path.with_suffix("") / f"{section.name}.png"
            plot.parent.mkdir(parents=True, exist_ok=True)
            plot_paths(section.paths).savefig(plot, format="png", dpi=DPI)
            parts.append(f"![{section.title}, from above]({plot.relative_to(path.parent).as_posix()})")
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def plot_paths(paths: Sequence[Path2d]) -> Figure:
    """Trajectories from above, a panel each."""
    figure = Figure(figsize=(PANEL_INCHES * len(paths), PANEL_INCHES + 0.6), layout="constrained")
    panels = figure.subplots(1, len(paths), squeeze=False)[0]
    for axes, path in zip(panels, paths, strict=True):
        _, truth = common(path.trajectories["raw"], path.truth)
        axes.plot(*truth.poses.translation[:, [0, 2]].T, **GROUND_TRUTH_STYLE)
        for name, trajectory in path.trajectories.items():
            axes.plot(*trajectory.poses.translation[:, [0, 2]].T, **STYLES[name])
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(path.title)
        axes.grid(alpha=0.3)
        axes.set_xlabel("x [m]")
    panels[0].set_ylabel("z [m]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _targets(checks: Sequence[Check]) -> Table:
    """The measured figures beside the targets."""
    rows = [
        (
            check.log,
            check.measure,
            "" if check.raw is None else check.form.format(check.raw),
            _bound(check),
            *(_judged(check, name) for name in COLUMNS),
        )
        for check in checks
    ]
    return Table(("log", "measure", "raw", "at most", *COLUMNS.values()), rows)


def _bound(check: Check) -> str:
    if not isinstance(check.bound, Mapping):
        return f"{check.bound:.3g}"
    return ", ".join(f"{COLUMNS[name]} {bound:.3g}" for name, bound in check.bound.items())


def _judged(check: Check, name: str) -> str:
    """A figure and whether it is within its bound."""
    if name not in check.values:
        return ""
    value, limit = check.values[name], check.limit(name)
    shown = check.form.format(value)
    if limit is None:
        return shown
    return f"{shown} yes" if value <= limit else f"**{shown} no**"


def _markdown(table: Table) -> str:
    lines = [table.headings, tuple("---" for _ in table.headings), *table.rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


INTRODUCTION = """\
# Results

This page is made by `make results` from the logs; nothing in it is copied by hand. Each target is an upper bound: *yes*
where it is kept, **no** where it is not. t_rel and r_rel are those of the KITTI devkit, ATE is the root mean square of
positions after rigid alignment, ANEES is 3 where the stated covariances are right. How they are defined:
[metrics](explanation/metrics.md)."""

REMARKS = {
    "published": """\
A real system's odometry on KITTI 09, which stands in for a front end, with the real IMU of 100 Hz. The mounting and the
time offset are estimated from the log alone and compared with a fit of the same kind to the rotations of the ground
truth. Most of that offset is the delay of a low-pass filter in the IMU (60 ms by the truth, 51 by the odometry), which
is found and undone. What is left of the time offset is the odometry's: its own turning is ahead of the truth's, slow or
fast (below), which nothing in the log tells from an offset of the IMU. How large its scale errors are the pose graph
takes from the log: 7 %, where 2.5 % are assumed. As the accelerometer then tells more of the translations it also has
more to say of the mounting, which it knows to half a degree about the vertical. The noise of the accelerometer and the
time over which errors of a front end are correlated were chosen with this log and those of the next section in view, so
that their figures are a little better than those of a new log.""",
    "noise": """\
True poses with the errors of a learned front end (`convert trajectory --noise-seed`): rotation, about each axis, 0.011
deg that fade by 1 % from pair to pair and white 0.05 deg; translation, 0.8 % of it that fade likewise and white 5, 2
and 20 mm. Beyond 07, 09 and 10, which have targets, fewer seeds are run. The gyro of 00 is faulty in places. In 08
positions and accelerometer are at odds by 3 m/s^2 for a second, 10 s after the start, which the pose graph takes for
steps of the accelerometer's bias. That scale errors are smaller than the 2.5 % which are assumed it takes from the log,
too.""",
    "revisit": """\
The last frames of 09 meet its start. Each of them is tied to the nearest early frame by its true relative pose, with a
noise of 0.15 m and 0.3 deg for each axis that differs by seed, recorded in the log as `/violearner/loops`. The filter
is causal: a loop moves its present alone, and in hindsight (smoothed) the way there. As the loops come with the last
25 of 1591 frames, nothing that is causal can lower the ATE by much: the other poses were said before. The pose graph
without loops knows the scale from the accelerometer, which leaves less for loops to tell: while it assumed that scale
errors are smaller, loops lowered its ATE from 6.6 m by 33 %, to 4.4 m.""",
    "rendered": """\
Streets are simulated along the real trajectories, with depth from stereo and moving cars, and the real IMU. The network
estimates the pairs, and loops are looked for in the images. Loops are wrong that are more than 0.5 m or 2 deg off. The
filter is causal: a loop moves its present alone, and in hindsight (smoothed) the way there. Images that are rendered
along a trajectory agree with it better than its real IMU does, so that between loops raw is hard to beat.""",
    "wrong": """\
A fifth of the loops are given another source, a frame from anywhere before, as where two places look alike. The change
is against the run with all loops right, so it includes what the loops that were replaced would have told; beside it is
the ATE with the others alone.""",
    "network": """\
Drive 0039 has an IMU of 10 Hz. The clip of 06 is 50 frames of an almost straight road, of whose IMU a part was filled
in by interpolation; too little is left, and the IMU is left out. What fusion gains there it has from pairs that skip a
frame.""",
    "timing": """\
Loops between true poses as above, on the longest sequence; wall-clock time of one solution with all covariances, on the
machine that made this page. An iteration linearises 10,500 factors of 10,000 variables and solves for them, of which
there are eight; how large scale errors are and whether biases behave takes as long as three of them, the covariances of
all poses and states as long as two, and as long what comes before.""",
}
