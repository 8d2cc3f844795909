"""Laws of training: what a folder was begun with, mixtures, weights that come back as they were saved."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from training_samples import TINY, random_pairs

from fusion_io.errors import EXIT_USAGE, LogError, UsageError
from learned import train, weights
from learned.covariance import CovarianceModel
from learned.dataset import PairSet
from learned.train import RECIPES, Source
from learned.violearner import PRESETS, VIOLearner

NETWORK = dataclasses.asdict(PRESETS["fast"])


def test_paper_recipe_is_the_papers() -> None:
    recipe = RECIPES["paper"]
    assert (recipe.batch, recipe.learning_rate, recipe.steps, recipe.validate_every) == (32, 2e-4, 100_000, 500)
    assert recipe.validation_share == 0.05
    assert recipe.bias_penalty > 0
    assert recipe.descent().learning_rate_at(20_000) == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("text", "source"),
    [
        ("sim", Source()),
        ("sim:40", Source(clips=40)),
        ("sim:40@0.5", Source(clips=40, weight=0.5)),
        ("a/seq09.mcap", Source(Path("a/seq09.mcap"))),
        ("a/seq09.mcap@2", Source(Path("a/seq09.mcap"), weight=2.0)),
        ("me@home/seq09.mcap", Source(Path("me@home/seq09.mcap"))),
    ],
)
def test_a_source_is_the_simulator_or_a_log_with_a_weight(text: str, source: Source) -> None:
    assert train._source(text) == source


@pytest.mark.parametrize("text", ["sim:0", "sim:x", "sim@0", "sim@-1", "sim@nan", "a.mcap@inf"])
def test_a_source_that_makes_no_sense_is_a_usage_error(text: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as error:
        train.main(["--out", str(tmp_path), "--data", text])
    assert error.value.code == EXIT_USAGE


def test_the_same_command_may_go_on(tmp_path: Path) -> None:
    for _ in range(2):
        train.begin(tmp_path / "out", "paper", RECIPES["paper"], 0, [Source(clips=4)], "float32", None, NETWORK)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["preset"] == "paper"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"preset": "paper"}, 'preset "fast", not "paper"'),
        ({"recipe": dataclasses.replace(RECIPES["fast"], steps=9)}, "recipe.steps 4000, not 9"),
        ({"seed": 1}, "seed 0, not 1"),
        ({"data": [Source(clips=4)]}, r"data .*not .*4"),
        ({"precision": "bf16"}, "precision"),
        ({"start": Path(__file__)}, "weights null, not"),
        ({"network": NETWORK | {"trunk_filters": 8}}, "network.trunk_filters 32, not 8"),
    ],
)
def test_other_settings_than_the_folder_was_begun_with_are_refused(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    begun = {"preset": "fast", "recipe": RECIPES["fast"], "seed": 0, "data": [Source()], "precision": "float32"}
    begun |= {"start": None, "network": NETWORK}
    train.begin(tmp_path, **begun)
    with pytest.raises(UsageError, match=words) as error:
        train.begin(tmp_path, **(begun | change))
    assert "\n" not in str(error.value)


def test_a_log_that_is_not_there_is_refused_before_anything_is_rendered(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"absent\.mcap"):
        train.train("fast", RECIPES["fast"], tmp_path / "out", data=[Source(tmp_path / "absent.mcap")])
    assert not (tmp_path / "out").exists()


def test_the_imu_is_standardised_by_what_was_measured_and_left_alone_where_nothing_was() -> None:
    model = VIOLearner(TINY)
    before = model.imu_mean.clone()
    pairs = random_pairs()
    silent = dataclasses.replace(pairs, imu=np.full_like(pairs.imu, np.nan))
    train.standardise_imu(model, PairSet.of([silent]))
    assert torch.equal(model.imu_mean, before)
    train.standardise_imu(model, PairSet.of([silent, pairs]))
    np.testing.assert_allclose(model.imu_mean.numpy(), pairs.imu.reshape(-1, 6).mean(0), atol=1e-5)


def test_a_training_begins_with_the_weights_of_a_file(tmp_path: Path) -> None:
    torch.manual_seed(1)
    start = VIOLearner(TINY)
    start.imu_mean += 1.0
    weights.save(
        tmp_path / "start.pt", weights.Weights(start, CovarianceModel(), CovarianceModel(), CovarianceModel()), {}
    )
    torch.manual_seed(2)
    model = VIOLearner(dataclasses.replace(TINY, passes=(2, 2, 2, 2)))  # how often a level is taken changes no shape
    train.begin_with(model, tmp_path / "start.pt")
    for name, value in start.state_dict().items():
        assert torch.equal(model.state_dict()[name], value)
    with pytest.raises(LogError, match=r"start\.pt: weights of a network of another shape") as error:
        train.begin_with(VIOLearner(dataclasses.replace(TINY, trunk_filters=9)), tmp_path / "start.pt")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "x"])
def test_a_learning_rate_that_makes_no_sense_is_a_usage_error(text: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as error:
        train.main(["--out", str(tmp_path), "--learning-rate", text])
    assert error.value.code == EXIT_USAGE
