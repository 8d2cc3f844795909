"""Laws of the descent: exact resume whatever happens, seeded batches, curves without lost or doubled rows."""

import dataclasses
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from training_samples import new_model, random_pairs, random_set

from fusion_io.errors import LogError
from learned import optimisation
from learned.dataset import PairSet
from learned.optimisation import (
    Descent,
    Interrupted,
    adam,
    ahead,
    bfloat16_layers,
    draw_batch,
    optimise,
    restore,
    translation_rmse,
)

DESCENT = Descent(steps=6, batch=2, learning_rate=1e-3)
LONGER = Descent(steps=12, batch=2, learning_rate=1e-3)

SCRIPT = """
import sys, time
from pathlib import Path
import torch
sys.path.insert(0, sys.argv[1])
from training_samples import new_model, random_set
from learned.optimisation import Descent, optimise
torch.set_num_threads(1)
out = Path(sys.argv[2])
pairs = random_set(out)
optimise(new_model(), Descent(steps=int(sys.argv[3]), batch=2, learning_rate=1e-3), 2, pairs, pairs, out)
"""


def test_an_interrupted_descent_resumes_to_the_same_curve_and_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGINT ends it after the step, between two validations, with a checkpoint."""
    pairs = PairSet.of([random_pairs()])
    through, resumed = new_model(), new_model()
    optimise(through, DESCENT, 2, pairs, pairs, directory(tmp_path / "a"))

    def interrupting(*arguments: object) -> object:
        if arguments[3] == 4:
            signal.raise_signal(signal.SIGINT)
        return draw_batch(*arguments)  # type: ignore[arg-type]

    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patched:
        patched.setattr(optimisation, "draw_batch", interrupting)
        with pytest.raises(Interrupted, match="step 5 of 6"):
            optimise(new_model(), DESCENT, 2, pairs, pairs, directory(tmp_path / "b"))
    assert signal.getsignal(signal.SIGINT) is handler
    assert len(rows(tmp_path / "b")) == 2
    optimise(resumed, DESCENT, 2, pairs, pairs, tmp_path / "b")
    assert len(rows(tmp_path / "b")) == 3
    assert (tmp_path / "b" / "curve.csv").read_bytes() == (tmp_path / "a" / "curve.csv").read_bytes()
    for name, value in through.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name


def test_a_descent_that_is_killed_again_and_again_ends_with_the_same_curve(tmp_path: Path, one_thread: None) -> None:
    """SIGKILL at whatever moment it hits, between two checkpoints or while one is written."""
    through, killed = directory(tmp_path / "a"), directory(tmp_path / "b")
    for pause_s in (0.0, 0.05):
        process = begin_descent(killed)
        before = checkpoint_time(killed)
        while process.poll() is None and checkpoint_time(killed) == before:
            time.sleep(0.001)
        time.sleep(pause_s)
        process.kill()
        process.wait()
    models = []
    for out in (through, killed):
        models.append(new_model())
        pairs = random_set(out)
        optimise(models[-1], LONGER, 2, pairs, pairs, out)
    assert process.returncode == -signal.SIGKILL
    assert (killed / "curve.csv").read_bytes() == (through / "curve.csv").read_bytes()
    assert [row[0] for row in rows(killed)] == [str(step) for step in range(2, LONGER.steps + 1, 2)]
    assert all(torch.equal(value, models[0].state_dict()[name]) for name, value in models[1].state_dict().items())


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Sums depend on the number of threads: as many as the other process has."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def begin_descent(out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", SCRIPT, str(Path(__file__).parent), str(out), str(LONGER.steps)]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)


def checkpoint_time(out: Path) -> int:
    checkpoint = out / "checkpoint.pt"
    return checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0


def directory(path: Path) -> Path:
    path.mkdir()
    return path


def rows(out: Path) -> list[list[str]]:
    return [line.split(",") for line in (out / "curve.csv").read_text().splitlines()[1:]]


def test_the_batch_of_a_step_is_a_function_of_seed_and_step() -> None:
    pairs = PairSet.of([random_pairs()])
    first, again, other, elsewhere = (
        draw_batch(pairs, DESCENT, seed, step, "cpu") for seed, step in ((0, 3), (0, 3), (0, 4), (1, 3))
    )
    assert torch.equal(first.source, again.source)
    assert not torch.equal(first.source, other.source)
    assert not torch.equal(first.source, elsewhere.source)


@pytest.mark.parametrize("drawers", [0, 1, 3])
def test_batches_come_in_order_whoever_draws_them(drawers: int, tmp_path: Path) -> None:
    pairs = random_set(tmp_path)
    batches = ahead(lambda step: draw_batch(pairs, DESCENT, 0, step, "cpu"), range(4, 30), drawers)
    for expected, (step, batch) in enumerate(batches, start=4):
        assert step == expected
        assert torch.equal(batch.imu.nan_to_num(), draw_batch(pairs, DESCENT, 0, step, "cpu").imu.nan_to_num())
    assert expected == 29


def test_what_is_not_a_checkpoint_is_refused_in_a_line(tmp_path: Path) -> None:
    model = new_model()
    for content in (b"", b"hello"):
        (tmp_path / "checkpoint.pt").write_bytes(content)
        with pytest.raises(LogError, match=r"checkpoint\.pt") as error:
            restore(tmp_path / "checkpoint.pt", model, adam(model, DESCENT), "cpu")
        assert "\n" not in str(error.value)


def test_cosine_decay_ends_low_and_starts_warm() -> None:
    descent = Descent(steps=4000, batch=16, learning_rate=1.0)
    rates = [descent.learning_rate_at(step) for step in range(descent.steps)]
    assert rates[0] < 0.02
    assert max(rates) <= 1
    assert rates[-1] == pytest.approx(0.01, abs=1e-3)
    assert math.isclose(max(rates), rates[optimisation.WARM_UP_STEPS], rel_tol=0.01)


def test_the_model_ends_with_the_weights_that_were_best_on_validation(tmp_path: Path) -> None:
    pairs = PairSet.of([random_pairs()])
    model = new_model()
    seen = {}
    optimise(
        model, dataclasses.replace(DESCENT, learning_rate=10.0), 1, pairs, pairs, tmp_path,
        observe=lambda model, step: seen.update({step: optimisation.copy_of(model)}),
    )  # fmt: skip
    errors = [float(row[2]) for row in rows(tmp_path)]
    assert errors != sorted(errors, reverse=True), "the last is the best: nothing to tell apart"
    best = seen[1 + int(np.argmin(errors))]
    assert all(torch.equal(value, best[name]) for name, value in model.state_dict().items())


def test_validation_without_truth_reports_the_photometric_error_alone(tmp_path: Path) -> None:
    pairs = random_pairs()
    blind = dataclasses.replace(pairs, T_source_target=np.full_like(pairs.T_source_target, np.nan))
    optimise(new_model(), DESCENT, 6, PairSet.of([blind]), PairSet.of([blind]), tmp_path)
    (row,) = rows(tmp_path)
    assert np.isfinite(float(row[2]))
    assert row[3:] == ["nan"] * 5


def test_rmse_counts_only_pairs_whose_truth_is_known() -> None:
    poses = np.tile(np.eye(4), (3, 2, 1, 1))
    poses[:, 1, 0, 3] = [1.0, 3.0, 100.0]
    true = np.tile(np.eye(4), (3, 1, 1))
    true[2] = np.nan
    np.testing.assert_allclose(translation_rmse(poses, true), [0.0, math.sqrt(5.0)])


def test_bfloat16_is_for_the_convolutions_and_leaves_no_trace() -> None:
    """Level 0 reads the IMU alone and is exact; later levels are close; afterwards all is as before."""
    model, pairs = new_model().eval(), PairSet.of([random_pairs()])
    exact = optimisation.run(model, pairs, "cpu")["poses"]
    with bfloat16_layers(model, "cpu"):
        rough = optimisation.run(model, pairs, "cpu")["poses"]
    np.testing.assert_array_equal(rough[:, 0], exact[:, 0])
    difference = np.abs(rough - exact)[:, 1:].max()
    assert 0 < difference < 0.02 * np.abs(exact[:, 1:] - exact[:, :1]).max()
    np.testing.assert_array_equal(optimisation.run(model, pairs, "cpu")["poses"], exact)
