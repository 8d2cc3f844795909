"""Adapt a network to a log without labels: `python -m learned.adapt --log X.mcap --out X.pt`.

The network is trained further on the log's own photometric error; ground truth is not looked at. Every tenth pair is
held out, and what is kept are the weights that were best on those: the input weights if nothing was better.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_io.command import answered, command_parser
from fusion_io.errors import EXIT_DAMAGED, EXIT_OK, LogError
from learned.train import positive_integer

if TYPE_CHECKING:
    from fusion_io.reader import Log
    from learned.dataset import PairSet
    from learned.optimisation import Descent
    from learned.violearner import VIOLearner
    from learned.weights import Weights

HELD_OUT_EVERY = 10
SEED = 0


@dataclass(frozen=True)
class Adaptation:
    """How a network is adapted; steps, batch and learning rate as in training, with a cosine decay.

    Held-out pairs are looked at every check_every steps, and it ends early when they have not improved for `patience`
    looks. averaging: what is looked at and kept are the averages of the weights over about 1 / (1 - averaging) steps.
    """

    steps: int = 400
    batch: int = 16
    learning_rate: float = 6e-4
    check_every: int = 50
    patience: int = 3
    averaging: float = 0.98

    def descent(self) -> Descent:
        """The part of it that the optimiser needs."""
        from learned.optimisation import Descent

        return Descent(self.steps, self.batch, self.learning_rate)


@dataclass(frozen=True)
class Adapted:
    """The weights that were best on the held-out pairs after `steps` steps, 0 for the input weights.

    before, after: mean photometric error of the last level on the held-out pairs.
    """

    weights: Weights
    steps: int
    before: float
    after: float

    def __str__(self) -> str:
        if self.steps == 0:
            return f"adaptation does not help (photometric error {self.before:.4f}): the weights stay as they were"
        return (
            f"adapted in {self.steps} steps: photometric error of held-out pairs {self.before:.4f} to {self.after:.4f}"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = command_parser(
        "learned.adapt",
        description="Train a network further on a log's own photometric error, without labels.",
        epilog="Exit codes: 0 all well, also if it does not help, 1 nothing could be computed, 2 usage, "
        "3 computed from a damaged log.",
    )
    parser.add_argument("--log", type=Path, required=True, help="MCAP log with images and depth")
    parser.add_argument("--weights", type=Path, help="weights to begin with (default: those that ship)")
    parser.add_argument("--out", type=Path, required=True, help="the weights file to write")
    parser.add_argument(
        "--steps", type=positive_integer, default=Adaptation.steps, help="at most (default %(default)s)"
    )
    parser.add_argument("--threads", type=positive_integer, help="threads (default: torch's)")
    options = parser.parse_args(arguments)

    return answered(lambda: run(options))


def run(options: argparse.Namespace) -> int:
    """Adapt to a log and say what it was good for; returns the exit code."""
    from fusion_io.reader import open_log

    if options.threads:
        import torch

        torch.set_num_threads(options.threads)
    log = open_log(options.log)
    print(adapt(log, options.weights, options.out, Adaptation(steps=options.steps)))
    return EXIT_DAMAGED if log.damaged else EXIT_OK


def adapt(log: Log, weights: Path | None, out: Path, adaptation: Adaptation | None = None) -> Adapted:
    """Adapt weights (None: those that ship) to a log and write them to a file.

    Raises LogError for unusable weights, a log without images and depth or with too few pairs, and a file that cannot
    be written.
    """
    from tempfile import TemporaryDirectory

    from learned import weights as weights_file
    from learned.dataset import Pairs, PairSet, log_pairs, write_shards

    adaptation = adaptation or Adaptation()
    start = weights_file.load(weights)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=out.parent) as folder:
            paths = write_shards(log_pairs(log, start.model.config), Path(folder))
            adapted = fine_tune(start, PairSet.of(map(Pairs.load, paths)), adaptation)
        errors = {"held_out_error_before": adapted.before, "held_out_error_after": adapted.after}
        weights_file.save(out, adapted.weights, asdict(adaptation) | {"best_step": adapted.steps} | errors)
    except OSError as error:
        raise LogError(f"{out}: {error.strerror}") from None
    return adapted


def fine_tune(weights: Weights, pairs: PairSet, adaptation: Adaptation) -> Adapted:
    """Train the network of `weights` further on nine tenths of the pairs; the best on the rest.

    The covariances stay: there is no truth to fit others on. Raises LogError for too few pairs.
    """
    import torch

    from learned.optimisation import adam, copy_of, descend, draw_batch
    from learned.violearner import VIOLearner

    training, held_out = hold_out(pairs)
    descent = adaptation.descent()
    model, averaged = VIOLearner(weights.model.config), VIOLearner(weights.model.config)
    for each in (model, averaged):
        each.load_state_dict(weights.model.state_dict())
    optimiser = adam(model, descent)
    before = after = photometric_error(averaged, held_out)
    best, best_state, waited = 0, copy_of(averaged), 0
    for step in range(descent.steps):
        descend(model, optimiser, draw_batch(training, descent, SEED, step, "cpu"), descent, step)
        with torch.no_grad():
            for mean, value in zip(averaged.parameters(), model.parameters(), strict=True):
                mean.lerp_(value, 1 - adaptation.averaging)
        if (step + 1) % adaptation.check_every == 0 or step + 1 == descent.steps:
            error = photometric_error(averaged, held_out)
            print(f"step {step + 1}: photometric error of held-out pairs {error:.4f}", file=sys.stderr)
            waited += 1
            if error < after:
                after, best, best_state, waited = error, step + 1, copy_of(averaged), 0
            if waited == adaptation.patience:
                break
    averaged.load_state_dict(best_state)
    return Adapted(replace(weights, model=averaged.eval()), best, before, after)


def hold_out(pairs: PairSet) -> tuple[PairSet, PairSet]:
    """Training pairs, and every tenth. Raises LogError where there is none."""
    import numpy as np

    held_out = np.arange(len(pairs)) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    if not held_out.any():
        raise LogError(f"{len(pairs)} pairs are too few to adapt to: at least {HELD_OUT_EVERY} are needed")
    return pairs.select(np.flatnonzero(~held_out)), pairs.select(np.flatnonzero(held_out))


def photometric_error(model: VIOLearner, pairs: PairSet) -> float:
    """Mean of the last level over all pairs."""
    from learned.optimisation import run

    return float(run(model, pairs, "cpu")["error"].mean())


if __name__ == "__main__":
    sys.exit(main())
