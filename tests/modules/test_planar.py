"""Steerable kernels of the package beside escnn's."""

import pytest
import torch

pytest.importorskip("escnn")

from ba_torchrl.modules.steerable.kernels import kernel_block
from ba_torchrl.modules.steerable.layers import planar_rotations
from ba_torchrl.modules.steerable.planar import planar_space
from tests.fresh import run_script
from tests.modules.networks import equivariant_outputs


def representations(space, flips, order):
    found = {"trivial": space.trivial_repr, "regular": space.regular_repr}
    found["vector"] = space.irrep(1, 1) if flips else space.irrep(1)
    if flips:
        found["signed"] = space.irrep(1, 0)
    elif order % 2 == 0:
        found["quotient"] = space.quotient_repr(2)
    return found


@pytest.mark.parametrize(
    ("order", "flips", "sizes"),
    [
        (2, False, (1, 3)),
        (3, False, (1, 3)),
        (8, False, (1, 3, 4)),
        (16, False, (1,)),
        (2, True, (3,)),
        (3, True, (1, 3)),
        (4, True, (1, 3, 5)),
    ],
)
def test_kernels_are_those_of_escnn(order, flips, sizes):
    """In the same order and with the same signs: weights of policies are their coefficients."""
    theirs = planar_rotations(order, has_flips=flips)
    ours = planar_space(order, flips)
    expected, actual = (representations(space, flips, order) for space in (theirs, ours))
    for name, rep in actual.items():
        assert (rep.irreps, rep.is_trivial()) == (
            tuple(expected[name].irreps),
            expected[name].is_trivial(),
        )
        change = torch.from_numpy(expected[name].change_of_basis)
        torch.testing.assert_close(torch.from_numpy(rep.change_of_basis), change)
    for pair in ((first, second) for first in actual for second in actual):
        for size in sizes:
            found = kernel_block(ours, *(actual[name] for name in pair), size)
            known = kernel_block(theirs, *(expected[name] for name in pair), size)
            assert (found is None) == (known is None)
            if known is not None:
                assert (found.in_irreps, found.out_irreps) == (known.in_irreps, known.out_irreps)
                torch.testing.assert_close(found.kernels, known.kernels, atol=1e-5, rtol=1e-5)


def test_networks_without_escnn_are_those_with_it(tmp_path):
    torch.save([value.detach() for value in equivariant_outputs()], tmp_path / "expected")
    code = """
import sys
import torch
sys.modules["escnn"] = None
from tests.modules.networks import equivariant_outputs
for found, expected in zip(equivariant_outputs(), torch.load("expected"), strict=True):
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
"""
    run_script(tmp_path, code)
