"""A network made fast for inference on a CPU; what it says stays the same to far below its error.

The convolutions over the Jacobian are nearly all of the network's arithmetic. They run in bfloat16 where the CPU
multiplies it in hardware, and with channels last, which saves oneDNN its reordering. Everything else stays in float32:
the geometry, because there bfloat16 moves pixels by up to 2.7; the layers that end in the pose, and those of the IMU,
because they cost nothing. On recorded pairs the hypotheses move by 0.1 mrad and 3 mm, no more than with the three large
layers alone in bfloat16.

Not `torch.compile`: its warm-up takes about half a minute, which is longer than a short log takes as a whole.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from learned.violearner import VIOLearner


def for_inference(model: VIOLearner) -> VIOLearner:
    """A copy of a network that infers faster; the network itself stays as it was, to be trained or stored."""
    fast = copy.deepcopy(model).eval().requires_grad_(False)
    precision = torch.bfloat16 if multiplies_bfloat16() else torch.float32
    for trunk in fast.trunks:
        convert(trunk, precision)
    for pathway in (*fast.refinements, *fast.hypotheses):
        *layers, head = pathway
        for layer in layers:
            convert(layer, precision)
        convert(head, torch.float32)
    return fast


def convert(layers: nn.Module, precision: torch.dtype) -> None:
    """Let layers compute on channels-last maps in a precision, whatever they are given."""
    layers.to(dtype=precision, memory_format=torch.channels_last)  # type: ignore[call-overload]

    def converted(module: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return tuple(maps.to(precision, memory_format=torch.channels_last) for maps in inputs)

    layers.register_forward_pre_hook(converted)


def multiplies_bfloat16() -> bool:
    """Whether this CPU has instructions for products of bfloat16 (AMX or AVX-512 BF16), not just emulation."""
    capabilities: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.4 does not have it
    return any(capabilities.get(name) for name in ("amx_bf16", "avx512_bf16"))
