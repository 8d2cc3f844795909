"""Pairs a second that the simulator renders, beside those that training consumes.

``python benchmarks/simulator.py [--clips 4] [--steps 6]`` renders training clips in one process and in two, takes a few
training steps of the ``fast`` preset on the pairs, and renders frames of a drive at three sizes. Every process has one
thread. Rates are by the wall clock; on a busy machine the processor time beside them is what counts.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import islice

import torch
from rich.console import Console
from rich.table import Table

from fusion_io.simulation.logs import Setup, simulate_drive
from fusion_io.simulation.photometry import REAL_CAMERA
from fusion_io.simulation.sensors import Stereo
from learned.dataset import Pairs, PairSet, begin_worker, simulated_clip
from learned.optimisation import adam, descend, draw_batch
from learned.train import RECIPES, standardise_imu
from learned.violearner import PRESETS, VIOLearner

CONFIG, RECIPE = PRESETS["fast"], RECIPES["fast"]
FRAME_SIZES = {(240, 64): 30, (480, 128): 15, (1242, 375): 4}  # frames to render of each


def rendered(seed: int) -> tuple[Pairs, float]:
    """The pairs of a clip, and the processor time that they took."""
    start = time.process_time()
    return simulated_clip(seed, RECIPE.frames_a_clip, CONFIG), time.process_time() - start


def render(clips: int, workers: int) -> tuple[Pairs, float, float]:
    """Clips rendered by some processes: the pairs, seconds by the wall clock, and of processor time."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=begin_worker) as pool:
        list(pool.map(rendered, range(workers)))  # imports, and the baking of textures
        start = time.perf_counter()
        parts = list(pool.map(rendered, range(100, 100 + clips)))
        wall = time.perf_counter() - start
    return Pairs.concatenate(pairs for pairs, _ in parts), wall, sum(seconds for _, seconds in parts)


def train(pairs: Pairs, steps: int) -> tuple[float, float]:
    """Seconds by the wall clock, and of processor time, of some steps."""
    data, descent, model = PairSet.of([pairs]), RECIPE.descent(), VIOLearner(CONFIG)
    standardise_imu(model, data)
    optimiser = adam(model, descent)

    def step(number: int) -> None:
        descend(model, optimiser, draw_batch(data, descent, 0, number, "cpu"), descent, number)

    step(0)

    def all_steps() -> None:
        for number in range(1, steps + 1):
            step(number)

    return timed(all_steps)


def frames(size: tuple[int, int], count: int) -> tuple[float, float]:
    """Seconds by the wall clock, and of processor time, of frames of a drive as the command simulates them."""
    setup = Setup(width=size[0], height=size[1], image_model=REAL_CAMERA, depth_sensor=Stereo())
    stream = iter(simulate_drive(setup, 10.0, 10.0).frames)
    next(stream)
    return timed(lambda: list(islice(stream, count)))


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the wall clock, and of processor time."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=4, help="to render in each of the two runs (default 4)")
    parser.add_argument("--steps", type=int, default=6, help="of training (default 6)")
    args = parser.parse_args()
    begin_worker()

    table = Table(title=f"{CONFIG.width}x{CONFIG.height}, one thread a process, {os.cpu_count()} cores")
    for column in ("", "a second", "processor ms each"):
        table.add_column(column, justify="left" if not column else "right")

    def row(name: str, count: int, wall: float, processor: float) -> None:
        table.add_row(name, f"{count / wall:.1f}", f"{1e3 * processor / count:.1f}")

    for workers in (1, 2):
        pairs, wall, processor = render(args.clips, workers)
        row(f"pairs rendered, {workers} process{'es' if workers > 1 else ''}", len(pairs), wall, processor)
    torch.set_num_threads(1)
    row("pairs trained on, 1 thread", args.steps * RECIPE.batch, *train(pairs, args.steps))
    for size, count in FRAME_SIZES.items():
        row(f"frames of a drive, {size[0]}x{size[1]}", count, *frames(size, count))
    Console().print(table)


if __name__ == "__main__":
    main()
