"""Laws of adaptation: what is kept was best on held-out pairs, and the same pairs give the same weights."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from training_samples import new_model, random_pairs

from fusion_io.errors import LogError
from learned.adapt import Adaptation, fine_tune, hold_out, photometric_error
from learned.covariance import CovarianceModel
from learned.dataset import PairSet
from learned.weights import Weights

QUICK = Adaptation(steps=8, batch=4, check_every=2, averaging=0.5)
WEIGHTS = Weights(new_model(), CovarianceModel(missing_imu=0.5), CovarianceModel(), CovarianceModel())


def pairs() -> PairSet:
    return PairSet.of([random_pairs(20)])


def test_every_tenth_pair_is_held_out() -> None:
    training, held_out = hold_out(PairSet.of([random_pairs(25)]))
    np.testing.assert_array_equal(held_out.places[:, 1], [9, 19])
    assert sorted([*training.places[:, 1], 9, 19]) == list(range(25))


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(LogError, match="9 pairs are too few"):
        hold_out(PairSet.of([random_pairs(9)]))


def still_pairs() -> PairSet:
    """A camera that stands still before smooth textures: there is something to learn, on any machine."""
    noise = random_pairs(20)
    seen = np.stack([[cv2.GaussianBlur(channel, (0, 0), 2.0) for channel in image] for image in noise.source])
    seen = cv2.normalize(seen, None, 0, 255, cv2.NORM_MINMAX)
    return PairSet.of([dataclasses.replace(noise, source=seen, target=seen)])


def test_what_comes_back_is_better_on_held_out_pairs_and_says_by_how_much() -> None:
    adapted = fine_tune(WEIGHTS, still_pairs(), dataclasses.replace(QUICK, learning_rate=1e-2))
    _, held_out = hold_out(still_pairs())
    assert adapted.steps > 0
    assert adapted.after < adapted.before == photometric_error(WEIGHTS.model, held_out)
    assert photometric_error(adapted.weights.model, held_out) == adapted.after
    assert f"adapted in {adapted.steps} steps" in str(adapted)


def test_weights_that_nothing_improves_stay_as_they_were_and_it_ends_early(capsys: pytest.CaptureFixture[str]) -> None:
    """Steps of a size of thousands destroy any network."""
    destroying = dataclasses.replace(QUICK, steps=50, learning_rate=1e6, check_every=8, patience=2)
    adapted = fine_tune(WEIGHTS, pairs(), destroying)
    assert adapted.steps == 0
    assert adapted.after == adapted.before
    assert "does not help" in str(adapted)
    for name, value in WEIGHTS.model.state_dict().items():
        assert torch.equal(adapted.weights.model.state_dict()[name], value)
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_the_input_and_the_covariances_are_left_alone() -> None:
    before = {name: value.clone() for name, value in WEIGHTS.model.state_dict().items()}
    adapted = fine_tune(WEIGHTS, pairs(), QUICK)
    assert all(torch.equal(value, before[name]) for name, value in WEIGHTS.model.state_dict().items())
    assert adapted.weights.covariance == WEIGHTS.covariance
    assert adapted.weights.refined_covariance == WEIGHTS.refined_covariance


def test_the_same_pairs_give_the_same_weights_whatever_the_truth_is_said_to_be() -> None:
    few = random_pairs(20)
    false = dataclasses.replace(few, T_source_target=np.full_like(few.T_source_target, np.nan))
    a, b = (fine_tune(WEIGHTS, PairSet.of([each]), QUICK) for each in (few, false))
    assert a.steps == b.steps
    assert all(
        torch.equal(value, b.weights.model.state_dict()[name]) for name, value in a.weights.model.state_dict().items()
    )
