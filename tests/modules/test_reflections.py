"""Equivariance of the close-loop networks to the dihedral group."""

import pytest
import torch

pytest.importorskip("escnn")

from ba_torchrl.modules.base import NETWORKS
from tests.modules.test_equivariance import build, steps, turn_action
from tests.specs import actor_critic_spec


def reflect_action(action, sequence):
    """Reflect the y axis: dy and the yaw change their signs."""
    action = action.clone()
    for letter in set(sequence) & set("yr"):
        action[..., sequence.index(letter)] *= -1
    return action


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize(
    ("size", "sequence", "group_order"),
    [(64, "pxyzr", 4), (64, "pxyz", 8), (64, "rzypx", 4), (128, "pxyzr", 4)],
)
def test_reflections_and_quarter_turns_are_exact(size, sequence, group_order, trained):
    networks = build(size, sequence, group_order=group_order, reflections=True)
    if trained:
        steps(networks, size, len(sequence))
    pixels, holding = torch.rand(2, 1, size, size), torch.tensor([[True], [False]])
    action = torch.rand(2, len(sequence)) * 2 - 1
    with torch.no_grad():
        loc, scale = networks.actor(pixels, holding)
        values = networks.critic(networks.encoder(pixels, holding), action)
        assert loc.abs().max() > 1e-3
        for quarters in range(4):
            image = torch.rot90(pixels.flip(-1), quarters, (-2, -1))
            moved_loc, moved_scale = networks.actor(image, holding)
            tolerance = {"atol": 2e-5 * float(loc.abs().max()), "rtol": 1e-4}
            expected = turn_action(reflect_action(loc, sequence), sequence, quarters)
            torch.testing.assert_close(moved_loc, expected, **tolerance)
            torch.testing.assert_close(moved_scale, scale, rtol=1e-4, atol=0)
            moved_action = turn_action(reflect_action(action, sequence), sequence, quarters)
            moved_values = networks.critic(networks.encoder(image, holding), moved_action)
            tolerance["atol"] = 2e-5 * float(values.abs().max())
            torch.testing.assert_close(moved_values, values, **tolerance)


def test_the_cyclic_group_is_not_equivariant_to_reflections():
    networks = build(64, group_order=4)
    pixels, holding = torch.rand(3, 1, 64, 64), torch.ones(3, 1, dtype=torch.bool)
    with torch.no_grad():
        loc, _ = networks.actor(pixels, holding)
        reflected, _ = networks.actor(pixels.flip(-1), holding)
    assert not torch.allclose(reflected, reflect_action(loc, "pxyzr"), rtol=1e-2)


def test_two_rotations_with_reflections_are_refused():
    config = NETWORKS["equi"](group_order=2, reflections=True, n_hidden=8)
    with pytest.raises(ValueError, match="group_order of at least 3"):
        config.build(actor_critic_spec(64, "pxyzr"))
