"""Pictures of an evaluation: `python -m learned.evaluate --plots DIR`.

Figures are made without pyplot: nothing is kept between them, and they need no display. Colours are those that the
colour-blind can tell apart (Okabe and Ito 2008).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from scipy.stats import chi2

from fusion_io.records import NANOSECONDS, FloatArray
from learned.calibration import (
    AXES,
    coverage_bounds,
    inside,
    mean_interval,
    rank_correlation,
    standard_deviations,
)
from learned.comparison import DEFAULT, Comparison
from learned.covariance import hypothesis_spread, nees
from learned.scores import error_norms, mean_poses

COLOURS = {"network": "#0072B2", "refined": "#D55E00"}
MARKERS = {"network": "o", "refined": "s"}
GREY = "0.55"
DPI = 120

UNITS = ("mrad",) * 3 + ("cm",) * 3
SCALES = np.array([1e3] * 3 + [1e2] * 3)

MOST_NEES = 30.0
"""The histogram's last bin holds all above."""

WIDEST_BAND = 8.0
"""Errors over time are shown up to so many times their 95th percentile, so that one outlier does not hide the rest."""


def write_plots(folder: Path, comparison: Comparison, title: str) -> list[Path]:
    """Draw all pictures of a comparison into a folder that exists."""
    paths = []
    for plot in (error_by_level, hypotheses, reliability, nees_histogram, sigma_against_error, errors_over_time):
        paths.append(folder / f"{plot.__name__}.png")
        plot(comparison, title).savefig(paths[-1])
    return paths


def error_by_level(comparison: Comparison, title: str) -> Figure:
    """Pose RMSE after every level, as in the paper's figure of the same name, and after refinement."""
    figure = Figure(figsize=(9, 4.2), dpi=DPI, layout="constrained")
    poses = [*comparison.levels.swapaxes(0, 1), comparison.refined.T_source_target]
    names = [*(f"level {k}" for k in range(comparison.levels.shape[1])), "refined"]
    colours = [COLOURS["network"]] * (len(names) - 1) + [COLOURS["refined"]]
    norms = [error_norms(T, comparison.truth) for T in poses]
    for axes, part, scale, unit in zip(figure.subplots(1, 2), (0, 1), (1.0, 1e3), ("m", "mrad"), strict=True):
        draw_bars(axes, names, [norm[part] for norm in norms], colours, scale)
        axes.set_yscale("log")
        label_plainly(axes.yaxis)
        axes.set_ylabel(f"{('translation', 'rotation')[part]} RMSE a pair [{unit}]")
    figure.suptitle(f"{title}: error by level, with 95 % intervals")
    return figure


def hypotheses(comparison: Comparison, title: str) -> Figure:
    """The paper's section on multi-hypothesis error reduction.

    Left: variance between the hypotheses of a pair by axis. Right: the error of each hypothesis, of their mean, of
    the winner, and of the one that was best in hindsight.
    """
    figure = Figure(figsize=(11, 4.4), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(4, 5))
    mean = mean_poses(comparison.hypotheses)
    sigma = np.sqrt(np.einsum("naa->na", hypothesis_spread(comparison.hypotheses, mean)).mean(0))
    rmse = np.sqrt(np.mean(comparison.errors("network") ** 2, axis=0))
    place = np.arange(len(AXES))
    left.bar(place - 0.2, SCALES * sigma, 0.4, color="#56B4E9", label="between the hypotheses")
    left.bar(place + 0.2, SCALES * rmse, 0.4, color=COLOURS["network"], label="RMSE of the winner")
    left.set_xticks(place, [axis_label(k).replace(" ", "\n", 1) for k in range(len(AXES))], fontsize=8)
    left.set_yscale("log")
    label_plainly(left.yaxis)
    left.set_ylabel("standard deviation [mrad], [cm]")
    left.legend(loc="upper left", fontsize=8)
    left.margins(y=0.2)

    each = list(comparison.hypotheses.swapaxes(0, 1))
    distance = np.stack([error_norms(T, comparison.truth)[0] for T in each])
    wins = [int((comparison.winners == k).sum()) for k in range(len(each))]
    names = [f"{k}\nwon {won}" for k, won in enumerate(wins)]
    values = [*distance, error_norms(mean, comparison.truth)[0]]
    values += [error_norms(comparison.network.T_source_target, comparison.truth)[0], distance.min(0)]
    colours = [GREY] * len(each) + ["#E69F00", COLOURS["network"], "#009E73"]
    draw_bars(right, [*names, "mean", "winner", "best in\nhindsight"], values, colours, 1.0)
    right.set_ylabel("translation RMSE a pair [m]")
    figure.suptitle(f"{title}: the hypotheses")
    return figure


def draw_bars(axes: Axes, names: list[str], values: list[FloatArray], colours: list[str], scale: float) -> None:
    """Root mean squares of some values (N,) each, with their 95 % intervals."""
    heights = scale * np.sqrt([np.mean(value**2) for value in values])
    ends = scale * np.sqrt([mean_interval(value**2) for value in values])
    errors = np.abs(ends.T - heights)
    bars = axes.bar(names, heights, color=colours, yerr=errors, capsize=3, ecolor="0.3")
    axes.bar_label(bars, [f"{height:.3g}" for height in heights], padding=2, fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.margins(y=0.15)


def reliability(comparison: Comparison, title: str) -> Figure:
    """The share of pairs inside the ellipsoid of every nominal probability; honest covariances are on the diagonal."""
    figure = Figure(figsize=(6, 6), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    nominal = np.linspace(0.01, 0.99, 99)
    axes.fill_between(
        nominal, *coverage_bounds(nominal, len(comparison)), color="0.85", label="95 % of honest covariances"
    )
    axes.plot([0, 1], [0, 1], color="0.4", linewidth=1, label="honest")
    for stage, estimates in comparison.stages.items():
        squared = nees(comparison.errors(stage), estimates.covariances)
        shares = [float(inside(squared, p).mean()) for p in nominal]
        line_style = "-" if stage == "refined" else "--"
        axes.plot(nominal, shares, line_style, color=COLOURS[stage], label=f"{stage}, ANEES {squared.mean():.2g}")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="nominal probability of the ellipsoid", ylabel="share of pairs inside")
    axes.set_title(f"{title}: reliability of the 6 dof covariance\nabove the diagonal: too cautious; below: too sure")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize=9)
    return figure


def nees_histogram(comparison: Comparison, title: str) -> Figure:
    """Normalised squared errors beside the chi-square density that honest covariances give."""
    figure = Figure(figsize=(9, 4.2), dpi=DPI, layout="constrained")
    edges = np.linspace(0, MOST_NEES, 31)
    grid = np.linspace(0, MOST_NEES, 301)
    for axes, (stage, estimates) in zip(figure.subplots(1, 2, sharey=True), comparison.stages.items(), strict=True):
        squared = nees(comparison.errors(stage), estimates.covariances)
        shares = np.full(len(squared), 1 / (len(squared) * (edges[1] - edges[0])))
        axes.hist(squared.clip(max=MOST_NEES - 1e-6), edges, weights=shares, color=COLOURS[stage], alpha=0.6)
        axes.plot(grid, chi2.pdf(grid, len(AXES)), color="black", label="chi-square, 6 dof")
        above = int((squared >= MOST_NEES).sum())
        axes.set_title(f"{stage}: mean {squared.mean():.2f}, median {np.median(squared):.2f}", fontsize=10)
        axes.set_xlabel(f"normalised squared error (last bin: {above} of {len(squared)} above {MOST_NEES:.0f})")
        axes.legend()
        axes.set_ylabel("density" if stage == "network" else "")
    figure.suptitle(f"{title}: normalised squared errors")
    return figure


def sigma_against_error(comparison: Comparison, title: str) -> Figure:
    """Stated standard deviation against absolute error of every pair by axis, for both stages."""
    figure = Figure(figsize=(11, 7), dpi=DPI, layout="constrained")
    panels = figure.subplots(2, 3).flat
    ranks = {
        stage: rank_correlation(comparison.errors(stage), estimates.covariances)
        for stage, estimates in comparison.stages.items()
    }
    for k, axes in enumerate(panels):
        shown = []
        for stage, estimates in comparison.stages.items():
            sigma = SCALES[k] * standard_deviations(estimates.covariances)[:, k]
            error = SCALES[k] * np.abs(comparison.errors(stage)[:, k])
            rank = ranks[stage][AXES[k]]
            label = f"{stage}, rank {'-' if rank is None else f'{rank:.2f}'}"
            axes.plot(sigma, error, MARKERS[stage], color=COLOURS[stage], markersize=3, alpha=0.6, label=label)
            shown.append(sigma)
        ends = np.array([np.min(shown) / 2, np.max(shown) * 2])
        for factor, style in ((1, "-"), (3, ":")):
            axes.plot(ends, factor * ends, style, color="black", linewidth=1)
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=(ends[0] / 100, ends[1] * 10))
        label_plainly(axes.xaxis)
        axes.set(xlabel=f"stated sigma [{UNITS[k]}]", ylabel=f"absolute error [{UNITS[k]}]")
        axes.set_title(axis_label(k), fontsize=10)
        axes.grid(alpha=0.3, which="major")
        axes.legend(fontsize=8, loc="lower right")
    figure.suptitle(f"{title}: stated standard deviation against error (solid: 1 sigma, dotted: 3 sigma)")
    return figure


def errors_over_time(comparison: Comparison, title: str) -> Figure:
    """Errors by axis with the stated 3 sigma of the estimates that are used by default, and those of the network."""
    figure = Figure(figsize=(11, 10), dpi=DPI, layout="constrained")
    panels = figure.subplots(len(AXES), 1, sharex=True)
    seconds = (comparison.stamps_ns[:, 0] - comparison.stamps_ns[0, 0]) / NANOSECONDS
    sigma = 3 * SCALES * standard_deviations(comparison.stages[DEFAULT].covariances)
    network, default = (SCALES * comparison.errors(stage) for stage in ("network", DEFAULT))
    for k, axes in enumerate(panels):
        axes.fill_between(seconds, -sigma[:, k], sigma[:, k], color="0.85", label=f"stated 3 sigma, {DEFAULT}")
        axes.plot(seconds, network[:, k], color=COLOURS["network"], linewidth=0.7, alpha=0.8, label="network")
        axes.plot(seconds, default[:, k], color=COLOURS[DEFAULT], linewidth=1, label=DEFAULT)
        axes.set_ylabel(f"{axis_label(k).replace(' ', chr(10), 1)} [{UNITS[k]}]", fontsize=9)
        axes.grid(alpha=0.3)
        widest = WIDEST_BAND * np.quantile(np.abs(default[:, k]), 0.95)
        if widest > 0:
            axes.set_ylim(np.clip(axes.get_ylim(), -widest, widest))
    panels[-1].set_xlabel("time since the first pair [s]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(f"{title}: errors a pair in the axes of the target camera")
    return figure


def label_plainly(axis: Axis) -> None:
    """Mark a logarithmic axis at 1, 2 and 5 of every decade, without powers of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def axis_label(k: int) -> str:
    """The name of an axis in words."""
    return AXES[k].replace("_", " ")
