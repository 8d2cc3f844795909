"""Laws of training: exact resume, seeded batches, and weights that come back as they were saved."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from fusion_io.errors import LogError
from learned import train, weights
from learned.covariance import CovarianceModel
from learned.dataset import Pairs
from learned.train import RECIPES, Recipe, draw_batch, learning_rate_factor, optimise
from learned.violearner import NetworkConfig, VIOLearner

TINY = NetworkConfig(height=32, width=64, trunk_filters=4, extra_filters=4, imu_filters=(2, 2, 4, 4, 4, 4, 4))
RECIPE = Recipe(steps=6, batch=2, validate_every=2)


def random_pairs(count: int = 8) -> Pairs:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (2, count, 1, TINY.height, TINY.width), dtype=np.uint8)
    K = np.array([[40, 0, 31.5], [0, 40, 15.5], [0, 0, 1]], dtype=np.float32)
    return Pairs(
        source=images[0],
        target=images[1],
        source_depth=rng.uniform(4, 20, (count, TINY.height, TINY.width)).astype(np.float16),
        K=np.tile(K, (count, 1, 1)),
        imu=rng.normal(size=(count, 20, 6)).astype(np.float32),
        interval_s=np.full(count, 0.1, np.float32),
        T_source_target=np.tile(np.eye(4), (count, 1, 1)),
    )


def new_model() -> VIOLearner:
    torch.manual_seed(0)
    return VIOLearner(TINY)


def test_an_interrupted_training_resumes_to_the_same_curve_and_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = random_pairs()
    through = new_model()
    optimise(through, RECIPE, pairs, pairs, tmp_path / "a", 0, "cpu")

    def interrupted(*arguments: object) -> object:
        if arguments[3] == 5:
            raise KeyboardInterrupt
        return draw_batch(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(train, "draw_batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        optimise(new_model(), RECIPE, pairs, pairs, tmp_path / "b", 0, "cpu")
    monkeypatch.undo()
    resumed = new_model()
    optimise(resumed, RECIPE, pairs, pairs, tmp_path / "b", 0, "cpu")
    assert (tmp_path / "b" / "curve.csv").read_text() == (tmp_path / "a" / "curve.csv").read_text()
    for name, value in through.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name


def test_the_batch_of_a_step_is_a_function_of_seed_and_step() -> None:
    pairs = random_pairs()
    first, again = (draw_batch(pairs, RECIPE, 0, 3, "cpu") for _ in range(2))
    other = draw_batch(pairs, RECIPE, 0, 4, "cpu")
    assert torch.equal(first.source, again.source)
    assert not torch.equal(first.source, other.source)


def test_paper_recipe_is_the_papers() -> None:
    recipe = RECIPES["paper"]
    assert (recipe.batch, recipe.learning_rate, recipe.steps, recipe.validate_every) == (32, 2e-4, 100_000, 500)
    assert train.MOMENTA == (0.9, 0.99)
    assert learning_rate_factor(recipe, 20_000) == 0.5


def test_cosine_decay_ends_low_and_starts_warm() -> None:
    recipe = RECIPES["fast"]
    factors = [learning_rate_factor(recipe, step) for step in range(recipe.steps)]
    assert factors[0] < 0.02
    assert max(factors) <= 1
    assert factors[-1] == pytest.approx(0.01, abs=1e-3)
    assert math.isclose(max(factors), factors[train.WARM_UP_STEPS], rel_tol=0.01)


def test_weights_come_back_as_they_were_saved(tmp_path: Path) -> None:
    model = new_model()
    covariance = CovarianceModel(gain=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), missing_imu=0.7)
    weights.save(tmp_path / "w.pt", model, covariance, {"seed": 0, "recipe": dataclasses.asdict(RECIPE)})
    loaded, loaded_covariance = weights.load(tmp_path / "w.pt")
    assert loaded.config == TINY
    assert loaded_covariance == covariance
    assert not loaded.training
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)


@pytest.mark.parametrize("content", [None, b"", b"hello", b"PK\x03\x04 broken"])
def test_what_is_not_a_weights_file_is_refused_in_a_line(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "w.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError, match=r"w\.pt") as error:
        weights.load(path)
    assert "\n" not in str(error.value)


def test_pairs_survive_a_round_trip_through_a_file(tmp_path: Path) -> None:
    pairs = random_pairs()
    pairs.save(tmp_path / "pairs.npz")
    loaded = Pairs.load(tmp_path / "pairs.npz")
    for field in dataclasses.fields(Pairs):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(pairs, field.name))
