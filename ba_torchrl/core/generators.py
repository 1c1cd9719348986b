"""Random generators that a spawned process can receive.

PyTorch reduces a ``torch.Generator`` to a tensor of its state, whose shared memory is freed before
the process maps it. The import of this module registers the state as bytes instead, with
``multiprocessing`` only: plain pickles and copies are PyTorch's.
"""

from __future__ import annotations

from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch


def seeded_generator(seed: int) -> torch.Generator:
    """Return a generator on the CPU, so that the draws of a seed are the same for all devices."""
    return torch.Generator().manual_seed(seed)


def _reduce(generator: torch.Generator) -> tuple[Any, ...]:
    return _restored, (str(generator.device), bytearray(generator.get_state().numpy()))


def _restored(device: str, state: bytearray) -> torch.Generator:
    generator = torch.Generator(device)
    generator.set_state(torch.frombuffer(state, dtype=torch.uint8))
    return generator


ForkingPickler.register(torch.Generator, _reduce)
