"""The two pictures of a run: the trajectories from above, and the errors over time beside what the back ends claim.

Figures are made without pyplot: nothing is kept between them, and a run needs no display.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusion.evaluation import common, errors_over_time
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, Trajectory

# Colours that the colour-blind can tell apart (Okabe and Ito 2008), and different dashes for print in grey.
STYLES: dict[str, dict[str, Any]] = {
    "raw": {"label": "raw", "color": "0.55", "linestyle": "--", "zorder": 3},  # shows on top of an equal pose graph
    "posegraph": {"label": "pose graph", "color": "#0072B2", "linestyle": "-"},
    "posegraph_online": {"label": "pose graph, online", "color": "#CC79A7", "linestyle": (0, (5, 1))},
    "ekf": {"label": "EKF", "color": "#D55E00", "linestyle": "-."},
    "ekf_smoothed": {"label": "EKF, smoothed", "color": "#E69F00", "linestyle": (0, (3, 1, 1, 1))},
}
GROUND_TRUTH_STYLE: dict[str, Any] = {"label": "ground truth", "color": "black", "linestyle": "-", "linewidth": 1.0}
SIGMA_STYLE: dict[str, Any] = {"linestyle": ":", "linewidth": 1.2}


def plot_trajectories(title: str, trajectories: Mapping[str, Trajectory], ground_truth: Trajectory | None) -> Figure:
    """All trajectories from above, in the axes of the first camera; the ground truth is laid on raw where it begins."""
    figure = Figure(figsize=(8, 8), dpi=120, layout="constrained")
    axes = figure.subplots()
    truth = None if ground_truth is None else _laid_on(trajectories["raw"], ground_truth)
    if truth is not None:
        _draw_path(axes, truth, GROUND_TRUTH_STYLE)
    for name, trajectory in trajectories.items():
        _draw_path(axes, trajectory, STYLES[name])
    axes.plot(0.0, 0.0, "o", color="black", markerfacecolor="white", markersize=9, label="start")
    axes.plot([], [], "s", color="black", markerfacecolor="white", markersize=6, label="end")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(title=title, xlabel="x, to the right of the first camera [m]", ylabel="z, ahead of the first camera [m]")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=6)
    return figure


def plot_errors(title: str, trajectories: Mapping[str, Trajectory], ground_truth: Trajectory | None) -> Figure:
    """Norm of the position and orientation error over time with the stated 3 sigma; without ground truth that alone."""
    figure = Figure(figsize=(9, 7), dpi=120, layout="constrained")
    position, orientation = figure.subplots(2, 1, sharex=True)
    for name, trajectory in trajectories.items():
        if ground_truth is not None:
            errors = errors_over_time(trajectory, ground_truth)
            seconds = _seconds(errors.stamps_ns, trajectory)
            position.plot(seconds, _norm(errors.position_error_m), **STYLES[name])
            orientation.plot(seconds, np.rad2deg(_norm(errors.rotation_error_rad)), **STYLES[name])
        if trajectory.covariances is not None:
            seconds = _seconds(trajectory.stamps_ns, trajectory)
            style = STYLES[name] if ground_truth is None else SIGMA_STYLE | {"color": STYLES[name]["color"]}
            position.plot(seconds, 3.0 * _sigma(trajectory.covariances[:, 3:, 3:]), **style)
            orientation.plot(seconds, 3.0 * np.rad2deg(_sigma(trajectory.covariances[:, :3, :3])), **style)
    shown = "stated 3 sigma of the {}" if ground_truth is None else "error of the {}"
    position.set(title=title, ylabel=f"{shown.format('position')} [m]")
    orientation.set(xlabel="time since the first frame [s]", ylabel=f"{shown.format('orientation')} [deg]")
    if ground_truth is not None:
        position.plot([], [], label="stated 3 sigma", color="0.3", **SIGMA_STYLE)
    for axes in (position, orientation):
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    figure.legend(*position.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _draw_path(axes: Axes, trajectory: Trajectory, style: dict[str, Any]) -> None:
    x, _, z = trajectory.poses.translation.T
    axes.plot(x, z, **style)
    axes.plot(x[-1], z[-1], "s", color=style["color"], markerfacecolor="white", markersize=6)


def _laid_on(estimate: Trajectory, ground_truth: Trajectory) -> Trajectory | None:
    """The ground truth in the world of the estimate, equal to it at the first frame that both know."""
    spanned = ground_truth.covers(estimate.stamps_ns)
    if not spanned.any():
        return None
    _, truth = common(estimate, ground_truth)
    return Trajectory(truth.stamps_ns, estimate.poses[int(np.argmax(spanned))] * truth.poses)


def _seconds(stamps_ns: IntArray, trajectory: Trajectory) -> FloatArray:
    seconds: FloatArray = (stamps_ns - trajectory.stamps_ns[0]) / NANOSECONDS
    return seconds


def _norm(vectors: FloatArray) -> FloatArray:
    norms: FloatArray = np.linalg.norm(vectors, axis=1)
    return norms


def _sigma(covariances: FloatArray) -> FloatArray:
    """Root of the expected squared norm of an error with these covariances (N, 3, 3)."""
    sigma: FloatArray = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    return sigma
