"""Weights that ship with the package, and the file format of weights."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from fusion_io.errors import LogError
from learned.covariance import CovarianceModel
from learned.violearner import NetworkConfig, VIOLearner

DEFAULT = Path(__file__).with_name("fast.pt")
FORMAT = 1


def save(path: Path, model: VIOLearner, covariance: CovarianceModel, training: dict[str, Any]) -> None:
    """Write the network, its configuration, its covariance model and how it was trained as one file."""
    content = {
        "format": FORMAT,
        "config": asdict(model.config),
        "state": {name: value.detach().cpu().clone() for name, value in model.state_dict().items()},
        "covariance": covariance.to_dict(),
        "training": training,
    }
    partial = path.with_suffix(".partial")
    torch.save(content, partial)
    partial.replace(path)


def load(path: Path | None = None) -> tuple[VIOLearner, CovarianceModel]:
    """The network, ready for inference, and its covariance model. Raises LogError for a file that is not weights."""
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
    return model.eval(), CovarianceModel(**content["covariance"])
