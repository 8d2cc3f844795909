"""Weights that ship with the package, and the file format of weights."""

from __future__ import annotations

from copy import copy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from fusion_io.errors import LogError
from learned.covariance import CovarianceModel
from learned.violearner import NetworkConfig, VIOLearner

DEFAULT = Path(__file__).with_name("fast.pt")
FORMAT = 3
COVARIANCES = ("covariance", "start_covariance", "refined_covariance")


@dataclass(frozen=True)
class Weights:
    """A trained network, and the covariances fitted for its winner, for that as a start, and for the refined pose."""

    model: VIOLearner
    covariance: CovarianceModel
    start_covariance: CovarianceModel
    refined_covariance: CovarianceModel

    def as_start(self) -> Weights:
        """The network as it runs where its estimate will be refined: levels are taken less often."""
        model = copy(self.model)
        model.config = replace(model.config, passes=model.config.starting_passes)
        return replace(self, model=model, covariance=self.start_covariance)


def save(path: Path, weights: Weights, training: dict[str, Any]) -> None:
    """Write the network, its configuration, its covariance models and how it was trained as one file."""
    content = {
        "format": FORMAT,
        "config": asdict(weights.model.config),
        "state": {name: value.detach().cpu().clone() for name, value in weights.model.state_dict().items()},
        **{name: getattr(weights, name).to_dict() for name in COVARIANCES},
        "training": training,
    }
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:  # given a path, torch writes its name into the file
        torch.save(content, file)
    partial.replace(path)


def load(path: Path | None = None) -> Weights:
    """The network, ready for inference, and its covariance models.

    Raises LogError for a file that is not weights.
    """
    path = DEFAULT if path is None else path
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise LogError(f"{path}: no such weights file") from None
    except Exception as error:  # torch raises many kinds for a file that is not its own
        raise LogError(f"{path}: not a weights file") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise LogError(f"{path}: not a weights file of format {FORMAT}")
    model = VIOLearner(NetworkConfig(**content["config"]))
    model.load_state_dict(content["state"])
    return Weights(model.eval(), **{name: CovarianceModel(**content[name]) for name in COVARIANCES})
