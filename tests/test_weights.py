"""The weights file: what is saved comes back, and what is not such a file is refused in a line."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_samples import TINY, new_model

from fusion_io.errors import LogError
from learned import weights
from learned.covariance import CovarianceModel
from learned.violearner import VIOLearner
from learned.weights import Weights


def test_weights_come_back_as_they_were_saved(tmp_path: Path) -> None:
    covariance = CovarianceModel(gain=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), missing_imu=0.7)
    saved = Weights(new_model(), covariance, CovarianceModel(missing_imu=0.2), CovarianceModel(missing_imu=0.3))
    weights.save(tmp_path / "w.pt", saved, {"seed": 0})
    loaded = weights.load(tmp_path / "w.pt")
    assert loaded.model.config == TINY
    assert loaded.covariance == covariance
    assert (loaded.start_covariance, loaded.refined_covariance) == (saved.start_covariance, saved.refined_covariance)
    assert not loaded.model.training
    for name, value in saved.model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], value)


def test_a_start_takes_its_own_passes_and_covariance_and_leaves_the_network_as_it_was() -> None:
    model = VIOLearner(replace(TINY, passes=(3, 2, 1, 2), starting_passes=(1, 1, 2, 1)))
    weights = Weights(model, CovarianceModel(), CovarianceModel(missing_imu=0.2), CovarianceModel())
    start = weights.as_start()
    assert start.model.config.passes == (1, 1, 2, 1)
    assert start.covariance == weights.start_covariance
    assert weights.model.config.passes == (3, 2, 1, 2)
    for name, value in model.state_dict().items():
        assert start.model.state_dict()[name] is value or torch.equal(start.model.state_dict()[name], value)


@pytest.mark.parametrize("content", [None, b"", b"hello", b"PK\x03\x04 broken"])
def test_what_is_not_a_weights_file_is_refused_in_a_line(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "w.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError, match=r"w\.pt") as error:
        weights.load(path)
    assert "\n" not in str(error.value)
