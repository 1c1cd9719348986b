"""Tensors that are computed once per process."""

import torch

from ba_torchrl.modules.layers import cached_constant


def make_constant(calls):
    @cached_constant(maxsize=2)
    def powers(base: float, count: int) -> torch.Tensor:
        calls.append((base, count))
        return base ** torch.arange(count)

    return powers


def test_a_constant_is_computed_once_for_the_same_arguments():
    calls = []
    powers = make_constant(calls)
    first = powers(2.0, 3)
    assert first.tolist() == [1.0, 2.0, 4.0]
    assert powers(2.0, 3) is first
    assert powers(3.0, 2).tolist() == [1.0, 3.0]
    assert calls == [(2.0, 3), (3.0, 2)]
    powers(3.0, 3)  # in place of the oldest
    powers(3.0, 2)
    assert len(calls) == 3
    powers(2.0, 3)
    assert calls[3:] == [(2.0, 3)]
    powers.cache_clear()
    powers(2.0, 3)
    assert len(calls) == 5


def test_a_constant_of_inference_mode_can_be_used_in_training():
    powers = make_constant([])
    with torch.inference_mode():
        first = powers(2.0, 3)
    weight = torch.ones(3, requires_grad=True)
    (weight * powers(2.0, 3)).sum().backward()
    assert weight.grad.tolist() == [1.0, 2.0, 4.0]
    assert powers(2.0, 3) is first
