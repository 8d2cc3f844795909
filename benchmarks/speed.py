"""Pairs a second of both presets, from a log of 1242x375 images: by stage, and against the plain version.

``python benchmarks/speed.py [--log X.mcap] [--preset fast] [--rounds 3] [--threads 2]`` prints, for every preset, the
time of each stage, one after the other in batches, and then pairs a second of

* plain: one pair at a time, eager, float32, the Jacobian by autograd through `grid_sample`, without refinement;
* shipped, one pair at a time, without refinement: as fast as a pair can follow another;
* shipped, streaming, as `fusion.run` does: in batches, decoding beside inference, without and with refinement.

The weights are random: they do not matter to the time. Rounds are interleaved, medians are printed. Without a log one
is simulated, rendered at half the size and enlarged, because only its size matters here.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.nn import functional

from fusion_io import simulation
from fusion_io.reader import Log, open_log
from fusion_io.records import CameraFrame, CameraInfo, ImuSeries
from fusion_io.writer import LogWriter
from learned.covariance import CovarianceModel
from learned.estimator import PAIRS_A_BATCH, ReadyFrame, infer, infer_batch, refine_batch
from learned.inference import for_inference, multiplies_bfloat16
from learned.inputs import NetworkFrame, collate, imu_window, prepare
from learned.refinement import prepare_full
from learned.violearner import PRESETS, Batch, NetworkConfig, View, VIOLearner
from learned.warp import project
from learned.weights import Weights

WIDTH, HEIGHT = 1242, 375
PAIRS = 12 * PAIRS_A_BATCH
ONE_BY_ONE = 8
"""Pairs that are computed one at a time: enough for a median, and the plain version is slow."""

NetworkPair = tuple[NetworkFrame, NetworkFrame]


# --- The plain version ----------------------------------------------------------------------------


@dataclass(frozen=True)
class PlainError:
    """The photometric error of one warp, with the graph from each pixel's error back to the grid."""

    error: Tensor
    warped: Tensor
    grid: Tensor
    pixel_errors: list[Tensor]

    @cached_property
    def jacobian(self) -> Tensor:
        """Derivative d e / d grid (B, 2 n, H, W) by autograd."""
        with torch.enable_grad():
            slopes = [torch.autograd.grad(e.sum(), self.grid, retain_graph=True)[0] for e in self.pixel_errors]
        return torch.cat(slopes, dim=-1).permute(0, 3, 1, 2)


class PlainVIOLearner(VIOLearner):
    """The same network with the Jacobian as the paper defines it."""

    def compare(self, view: View, pose: Tensor) -> PlainError:  # type: ignore[override]
        """Error of a pose at one scale: project, `grid_sample`, subtract."""
        grid, visible = project(view.depth, view.K, pose)
        height, width = view.depth.shape[-2:]
        with torch.enable_grad():
            grid = grid.detach().requires_grad_()
            normalised = 2 * grid / grid.new_tensor([width - 1, height - 1]) - 1
            warped = functional.grid_sample(view.sampled, normalised, align_corners=True)
            squared = (warped - view.reference).square().sum(1)
            widths = self.config.jacobian_widths or (self.config.charbonnier,)
            pixel_errors = [charbonnier(squared, width) * visible for width in widths]
        has_depth = (view.depth > 0).sum((1, 2)).clamp(min=1)
        seen = (charbonnier(squared.detach(), self.config.charbonnier) * visible).sum((1, 2))
        lost = self.config.lost_error * (has_depth - visible.sum((1, 2)))
        return PlainError((seen + lost) / has_depth, warped.detach(), grid, pixel_errors)


def charbonnier(squared: Tensor, width: float) -> Tensor:
    """A pixel's error from its squared colour difference."""
    return torch.sqrt(squared + width**2) - width if width > 0 else squared


def check_plain(config: NetworkConfig, pair: NetworkPair) -> float:
    """Largest difference of the two versions' Jacobians on a pair, in float64. Raises AssertionError above rounding."""
    batch = collate([pair], [np.full((20, 6), np.nan)])
    exact = Batch(**{name: value.double() for name, value in vars(batch).items()})
    pose = torch.tensor([[0.002, -0.003, 0.001, 0.02, -0.03, -0.4]], dtype=torch.float64)
    view = VIOLearner(config).pyramid(exact)[-1]
    plain, closed = (kind(config).compare(view, pose).jacobian for kind in (PlainVIOLearner, VIOLearner))
    difference = float((plain - closed).abs().max() / closed.abs().max())
    assert difference < 1e-9, f"the Jacobians differ by {difference:.1e}"
    return difference


# --- Ways through a log ---------------------------------------------------------------------------


def random_weights(config: NetworkConfig, kind: type[VIOLearner] = VIOLearner) -> Weights:
    """A network that has learned nothing."""
    torch.manual_seed(0)
    return Weights(kind(config).eval(), CovarianceModel(), CovarianceModel(), CovarianceModel())


def usable(log: Log) -> Iterator[CameraFrame]:
    """The frames that can be sources: those with depth."""
    return (frame for frame in log.frames() if frame.depth is not None)


def one_by_one(log: Log, config: NetworkConfig, pairs: int, network: Callable[[list[NetworkPair]], object]) -> float:
    """Seconds a pair when every pair is decoded, prepared and computed after the one before."""
    ready = (prepare(frame, config) for frame in usable(log))
    source = next(ready)
    start = time.perf_counter()
    for target in islice(ready, pairs):
        network([(source, target)])
        source = target
    return (time.perf_counter() - start) / pairs


def streaming(log: Log, imu: ImuSeries, weights: Weights, pairs: int, refined: bool) -> float:
    """Seconds a pair of the estimator as it ships."""
    start = time.perf_counter()
    done = sum(1 for _ in infer(weights, islice(usable(log), pairs + 1), log.frame_stamps(), imu, Counter(), refined))
    return (time.perf_counter() - start) / done


class Laps:
    """Seconds by stage: each lap gives a stage the time since the lap before."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._last = time.perf_counter()

    def __call__(self, stage: str) -> None:
        """End a lap of a stage."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now


@contextmanager
def lapped(model: VIOLearner, laps: Laps) -> Iterator[None]:
    """Laps within the network's forward pass."""

    def after(name: str, stage: str) -> None:
        method = getattr(model, name)

        def timed(*arguments: Any) -> Any:
            result = method(*arguments)
            laps(stage)
            return result

        setattr(model, name, timed)

    after("pyramid", "preprocess: pyramid")
    after("level_0", "IMU net")
    passed = 0  # how often the last level was taken

    def before_last_level(*_: Any) -> None:
        nonlocal passed
        laps("hypotheses" if passed % model.config.passes[3] else "levels 1 to 3")
        passed += 1

    hooks = [
        model.register_forward_pre_hook(lambda *_: laps("preprocess: batch")),
        model.trunks[3].register_forward_pre_hook(before_last_level),
        model.register_forward_hook(lambda *_: laps("hypotheses")),
    ]
    try:
        yield
    finally:
        del model.pyramid, model.level_0
        for hook in hooks:
            hook.remove()


def stages(log: Log, imu: ImuSeries, weights: Weights, pairs: int) -> dict[str, float]:
    """Seconds a pair by stage with refinement, batches as in streaming but one stage after the other."""
    weights = weights.as_start()
    weights = replace(weights, model=for_inference(weights.model))
    frames = usable(log)
    laps = Laps()

    def ready() -> ReadyFrame:
        laps("covariance")
        frame = next(frames)
        laps("decode")
        network = prepare(frame, weights.model.config)
        laps("preprocess: size")
        full = prepare_full(frame)
        laps("refinement: points")
        return ReadyFrame(network, full)

    before = ready()
    laps.seconds.clear()
    for _ in range(pairs // PAIRS_A_BATCH):
        batch = [before, *(ready() for _ in range(PAIRS_A_BATCH))]
        before = batch[-1]
        couples = list(pairwise(batch))
        with lapped(weights.model, laps):
            inferences = infer_batch(weights, couples, imu)
        laps("covariance")
        refine_batch(weights, couples, inferences, np.stack([np.eye(4)] * len(couples)))
        laps("refinement: steps")
    laps("covariance")
    return {stage: seconds / (pairs // PAIRS_A_BATCH * PAIRS_A_BATCH) for stage, seconds in laps.seconds.items()}


# --- Log, tables ----------------------------------------------------------------------------------


def write_log(path: Path, frames: int) -> None:
    """A simulated drive, enlarged to 1242x375, with the fine noise that makes real images slow to decode."""
    rng = np.random.default_rng(0)
    made, imu, _ = simulation.clip(0, frames, WIDTH // 2, HEIGHT // 2)
    with LogWriter(path) as log:
        log.imu(imu)
        for frame in made:
            camera = CameraInfo(frame.image.shape[1], frame.image.shape[0], frame.camera.K).scaled_to(WIDTH, HEIGHT)
            grey = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
            image = cv2.resize(grey, (WIDTH, HEIGHT)).astype(np.int16)
            image = np.clip(image + rng.integers(-3, 4, image.shape), 0, 255).astype(np.uint8)
            depth = cv2.resize(np.asarray(frame.depth), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
            log.frame(CameraFrame(frame.stamp_ns, image, depth, camera))


def bare(couples: list[NetworkPair]) -> list[tuple[ReadyFrame, ReadyFrame]]:
    """Pairs of the network's frames as the estimator takes them where nothing is to be refined."""
    return [(ReadyFrame(source, None), ReadyFrame(target, None)) for source, target in couples]


def measure(log: Log, name: str, pairs: int, rounds: int, console: Console) -> None:
    """Both tables of a preset."""
    config, imu = PRESETS[name], log.imu()
    plain, shipped = random_weights(config, PlainVIOLearner), random_weights(config)
    fast = replace(shipped, model=for_inference(shipped.model))

    def plain_network(couples: list[NetworkPair]) -> None:
        windows = [imu_window(imu, source.stamp_ns, target.stamp_ns) for source, target in couples]
        with torch.no_grad():
            plain.model(collate(couples, windows))

    first, second = (prepare(frame, config) for frame in islice(usable(log), 2))
    difference = check_plain(config, (first, second))

    single = min(ONE_BY_ONE, pairs)
    ways: dict[str, Callable[[], float]] = {
        "plain, one pair at a time": lambda: one_by_one(log, config, single, plain_network),
        "one pair at a time": lambda: one_by_one(log, config, single, lambda c: infer_batch(fast, bare(c), imu)),
        "streaming": lambda: streaming(log, imu, shipped, pairs, refined=False),
        "streaming, refined": lambda: streaming(log, imu, shipped, pairs, refined=True),
    }
    plain_network([(first, second)])  # the first call of a kernel compiles it
    infer_batch(fast, bare([(first, second)]), imu)
    split, seconds = defaultdict(list), defaultdict(list)
    for _ in range(rounds):
        for stage, value in stages(log, imu, shipped, pairs).items():
            split[stage].append(value)
        for way, run in ways.items():
            seconds[way].append(run())

    table = Table("stage", "ms a pair", "share", title=f"{name}: one stage after the other")
    medians = {stage: statistics.median(values) for stage, values in split.items()}
    for stage, value in medians.items():
        table.add_row(stage, f"{1e3 * value:.1f}", f"{value / sum(medians.values()):.0%}")
    table.add_row("all", f"{1e3 * sum(medians.values()):.1f}", "100%", style="bold")
    console.print(table)

    table = Table("", "ms a pair", "pairs/s", "times plain", title=f"{name}: from the log to the estimates")
    slowest = statistics.median(seconds["plain, one pair at a time"])
    for way, values in seconds.items():
        value = statistics.median(values)
        table.add_row(way, f"{1e3 * value:.1f}", f"{1 / value:.1f}", f"{slowest / value:.1f}")
    console.print(table)
    console.print(f"The Jacobians of the plain and the shipped version differ by {difference:.0e} of the largest.\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--log", type=Path, help="a log with images, depth and IMU (default: simulated)")
    parser.add_argument("--preset", choices=sorted(PRESETS), help="only this preset")
    parser.add_argument("--rounds", type=int, default=3, help="repetitions of everything (default %(default)s)")
    parser.add_argument("--threads", type=int, help="threads of torch (default: one a core)")
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    console = Console()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.log or Path(folder, "speed.mcap")
        if arguments.log is None:
            write_log(path, PAIRS + 1)
        log = open_log(path)
        pairs = sum(1 for _ in islice(usable(log), PAIRS + 1)) - 1
        if pairs < PAIRS_A_BATCH:
            parser.error(f"{path}: has {pairs + 1} frames with depth, at least {PAIRS_A_BATCH + 1} are needed")
        bfloat16 = "bfloat16 in hardware" if multiplies_bfloat16() else "no bfloat16"
        console.print(
            f"{os.cpu_count()} cores, {torch.get_num_threads()} threads, {bfloat16}, load {os.getloadavg()[0]:.1f}; "
            f"{pairs} pairs, {arguments.rounds} rounds"
        )
        for name in [arguments.preset] if arguments.preset else ["fast", "paper"]:
            measure(log, name, pairs, arguments.rounds, console)


if __name__ == "__main__":
    main()
