"""The weights file: what is saved comes back, and what is not such a file is refused in a line."""

from pathlib import Path

import pytest
import torch
from training_samples import TINY, new_model

from fusion_io.errors import LogError
from learned import weights
from learned.covariance import CovarianceModel
from learned.weights import Weights


def test_weights_come_back_as_they_were_saved(tmp_path: Path) -> None:
    covariance = CovarianceModel(gain=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), missing_imu=0.7)
    saved = Weights(new_model(), covariance, CovarianceModel(missing_imu=0.3))
    weights.save(tmp_path / "w.pt", saved, {"seed": 0})
    loaded = weights.load(tmp_path / "w.pt")
    assert loaded.model.config == TINY
    assert (loaded.covariance, loaded.refined_covariance) == (covariance, saved.refined_covariance)
    assert not loaded.model.training
    for name, value in saved.model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], value)


@pytest.mark.parametrize("content", [None, b"", b"hello", b"PK\x03\x04 broken"])
def test_what_is_not_a_weights_file_is_refused_in_a_line(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "w.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError, match=r"w\.pt") as error:
        weights.load(path)
    assert "\n" not in str(error.value)
