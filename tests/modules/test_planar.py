"""Steerable kernels beside escnn's."""

import numpy as np
import pytest
import torch

from ba_torchrl.modules.steerable.kernels import kernel_block
from ba_torchrl.modules.steerable.planar import planar_rotations


def representations(space, flips, order):
    found = {"trivial": space.trivial_repr, "regular": space.regular_repr}
    found["vector"] = space.irrep(1, 1) if flips else space.irrep(1)
    if flips:
        found["signed"] = space.irrep(1, 0)
    elif order % 2 == 0:
        found["quotient"] = space.quotient_repr(2)
    return found


def escnn_kernels(planar_escnn, space, source, target, size):
    """Return escnn's kernels [D, out, in, K * K] and the basis's description, None if empty."""
    types = (planar_escnn.nn.FieldType(space, [each]) for each in (source, target))
    try:
        layer = planar_escnn.nn.R2Conv(*types, size, initialize=False)
    except ValueError as error:
        if "empty" not in str(error):
            raise
        return None
    (kernels,) = (value for name, value in layer.named_buffers() if name.endswith("sampled_basis"))
    info = list(layer.basisexpansion.get_basis_info())
    return kernels.reshape(-1, target.size, source.size, size**2), info


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
    """escnn finds those of dihedral groups by a decomposition that leaves their signs open."""
    planar_escnn = pytest.importorskip("profiling.planar_escnn")
    gspaces = planar_escnn.gspaces
    theirs = (gspaces.flipRot2dOnR2 if flips else gspaces.rot2dOnR2)(order)
    spaces = (theirs, planar_rotations(order, has_flips=flips))
    expected, actual = (representations(space, flips, order) for space in spaces)
    for name, rep in actual.items():
        other = expected[name]
        assert (rep.irreps, rep.is_trivial()) == (tuple(other.irreps), other.is_trivial())
        np.testing.assert_allclose(rep.change_of_basis, other.change_of_basis, atol=1e-6)
    for pair in ((first, second) for first in actual for second in actual):
        for size in sizes:
            known = escnn_kernels(planar_escnn, theirs, *(expected[name] for name in pair), size)
            found = kernel_block(*(actual[name] for name in pair), size)
            if known is None:
                assert found is None
                continue
            kernels, info = known
            assert found.in_irreps == tuple(entry["in_irrep"] for entry in info)
            assert found.out_irreps == tuple(entry["out_irreps_position"] for entry in info)
            ours = found.kernels.permute(0, 1, 4, 2, 3).flatten(3)
            signs = (ours * kernels).sum(dim=(1, 2, 3), keepdim=True).sign()
            assert flips or (signs == 1).all()
            torch.testing.assert_close(ours, signs * kernels, atol=1e-5, rtol=1e-5)


def test_signs_of_dihedral_kernels_are_those_that_policies_were_trained_with():
    group = planar_rotations(4, has_flips=True)
    regular, trivial, vector = group.regular_repr, group.trivial_repr, group.irrep(1, 1)
    sums = []
    for reps, size in (((trivial, regular), 3), ((regular, regular), 3), ((regular, vector), 1)):
        kernels = kernel_block(*reps, size).kernels
        sums.append(float(torch.arange(kernels.numel()).cos() @ kernels.flatten()))
    assert sums == pytest.approx([1.0364, 3.5929, 1.3485], abs=1e-3)


def test_fields_of_two_groups_are_refused():
    regular, other = planar_rotations(4).regular_repr, planar_rotations(8).regular_repr
    with pytest.raises(ValueError, match="of one group"):
        kernel_block(regular, other, 3)
