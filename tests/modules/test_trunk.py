"""Options of the image trunk: the reference of depths and the slope of the activation function."""

import pytest
import torch
import torch.nn.functional as F

from tests.modules.networks import actor_critic

WIDTHS = {"equi": {"n_hidden": 16, "group_order": 8}, "cnn": {}, "ferm": {"width": 0.1}}


def build(network, **options):
    units = {"depth_center_m": 0.2, "depth_scale_m": 0.1}
    return actor_critic(network, **{**units, **WIDTHS[network], **options})


def scene(size=64, *, block=(10, 10), hand_m=0.3):
    """A floor with a block 5 cm high, seen from a height."""
    depth = torch.full((1, 1, size, size), hand_m)
    row, column = block
    depth[..., row : row + 7, column : column + 7] -= 0.05
    return depth


@pytest.mark.parametrize("network", ["equi", "cnn", "ferm"])
def test_inputs_are_heights_above_the_floor_and_its_depth(network):
    trunk = build(network, depth_reference="floor").encoder
    trunk = trunk if hasattr(trunk, "convs") else trunk.trunk
    seen = []
    trunk.convs[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    depth = torch.cat([scene(), scene(hand_m=0.2)])
    trunk(depth, torch.tensor([[True], [False]]))
    (inputs,) = seen
    assert inputs.shape == (2, 3, 64, 64)
    heights, floor, holding = inputs.unbind(1)
    for number, depth in enumerate((0.3, 0.2)):
        assert heights[number, 0, 0] == 0
        assert heights[number, 12, 12] == pytest.approx(0.5, abs=1e-5)
        assert floor[number].min() == floor[number].max() == pytest.approx((depth - 0.2) / 0.1)
    assert holding[0].all()
    assert not holding[1].any()


@pytest.mark.parametrize("network", ["equi", "cnn"])
@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_stages_are_convolution_pool_and_activation(network, slope):
    trunk = build(network, negative_slope=slope).encoder
    depth, holding = torch.rand(2, 1, 64, 64), torch.tensor([[True], [False]])
    x = torch.cat([(depth - 0.2) / 0.1, holding.float()[..., None, None].expand(2, 1, 64, 64)], 1)
    for conv, pools in zip(trunk.convs, trunk.pools, strict=True):
        x = conv(x)
        x = F.max_pool2d(x, 2) if pools else x
        x = torch.where(x > 0, x, slope * x)
    torch.testing.assert_close(trunk(depth, holding), x.flatten(1))


def test_a_block_always_changes_the_action_if_negative_values_pass():
    holding, changes = torch.tensor([[False]]), {0.0: [], 0.1: []}
    for slope, differences in changes.items():
        for seed in range(8):
            actor = build("equi", seed=seed, size=128, negative_slope=slope).actor
            with torch.no_grad():
                here, _ = actor(scene(128, block=(30, 30)), holding)
                there, _ = actor(scene(128, block=(80, 60)), holding)
            differences.append(float((here - there).abs().max()))
    assert min(changes[0.1]) > 1e-4
    assert min(changes[0.0]) < min(changes[0.1])  # some narrow networks with a ReLU are blind
