"""Networks in six degrees of freedom: sizes, shapes, and what each level sees."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.spatial.base import scaled_heights, scaled_in_hand
from ba_torchrl.modules.spatial.pose_values import PoseValues, SceneMapVector
from ba_torchrl.sim.vision.in_hand import IN_HAND_MODES, PickView, crop
from tests.modules.networks import COUNTS, POSE, count, pose as build, pose_batch as batch
from tests.specs import slow_except, spatial_spec

BOTH = ["asr", "equi_deictic_asr"]
SIZE = 64


PAPER = {"width": 1.0, "num_rotations": 16, "num_z": 36, "num_tilts": 7}
# Weights and biases layer by layer, added up by hand.
SCENE_MAP = (256 * 9 + 1) * 128 + (128 * 16 + 1) * 1024 + 1025 * 512
SCENE_VECTOR = (256 + 1) * 1024 + 1025 * 512  # maximum and mean of 128 channels
FLATTENED_SCENE = (256 * 8 * 8 + 1) * 1024 + 1025 * 512


def pose_head(channels, last_map, outputs, scene):
    convs = (9 * channels + 1) * 32 + (9 * 32 + 1) * 64 + (9 * 64 + 1) * 128 + (9 * 128 + 1) * 128
    linear = (128 * last_map**2 + 1) * 1024 + 1025 * 512
    return convs + linear + scene + 1025 * outputs


@pytest.mark.parametrize(("size", "last_map", "millions"), [(24, 3, 4.9), (40, 5, 7.0)])
def test_parameter_counts_of_the_plain_heads_match_the_reference(size, last_map, millions):
    heads = build("asr", 128, size, **PAPER).heads
    expected = [
        pose_head(channels, last_map, outputs, SCENE_MAP)
        for channels, outputs in ((4, 32), (4, 72), (6, 14), (6, 14))
    ]
    assert [count(head) for head in heads] == expected
    assert all(round(number / 1e6, 1) == pytest.approx(millions, abs=0.05) for number in expected)


@pytest.mark.parametrize(
    ("size", "last_map", "millions", "scene_head", "of_yaws", "of_poses"),
    [
        (24, 3, 36.7, "flatten", FLATTENED_SCENE, SCENE_MAP),
        (40, 5, 33.8, "pool", SCENE_VECTOR, SCENE_VECTOR),
    ],
)
def test_parameter_counts_of_the_equivariant_heads(
    size, last_map, millions, scene_head, of_yaws, of_poses
):
    yaws, *poses = build("equi_deictic_asr", 128, size, **PAPER, scene_head=scene_head).heads
    assert {count(head) for head in poses} == {pose_head(6, last_map, 2, of_poses)}
    assert count(yaws.scene) == of_yaws
    reference = count(yaws) - of_yaws + FLATTENED_SCENE
    assert round(reference / 1e6, 1) == millions


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize(
    ("size", "in_hand_size"), slow_except([(32, 24), (64, 40), (128, 24)], [(32, 24), (64, 40)])
)
@pytest.mark.parametrize("name", BOTH)
def test_shapes(name, size, in_hand_size, half):
    network = build(name, size, in_hand_size, half)
    assert network.levels == (
        (("x", "y"), (size, size)),
        *(((component,), (number,)) for component, number in COUNTS.items()),
    )
    assert network.limits["z"] == (0.02, 0.20)
    assert network.limits["ry"] == network.limits["rx"] == (-math.pi / 8, math.pi / 8)
    *observation, chosen = batch(size, in_hand_size)
    first, state = network.first(*observation)
    assert first.shape == (4, size, size)
    for level, number in enumerate(COUNTS.values(), start=1):
        values = network.later(level, state, chosen[:, : level + 1])
        assert values.shape == (4, number)
        assert values.dtype == torch.float32
        assert torch.isfinite(values).all()


def grid(component, index, half):
    """Return the value of an index, metres or radians."""
    if component == "rz":
        return index * (math.pi if half else 2 * math.pi) / 8
    first, last = (0.02, 0.20) if component == "z" else (-math.pi / 8, math.pi / 8)
    return first + index * (last - first) / (COUNTS[component] - 1)


def pose_of(chosen, half):
    """Return the values of chosen indices besides the pixel, by component."""
    pairs = zip(COUNTS, chosen[2:].tolist(), strict=True)
    return {name: grid(name, index, half) for name, index in pairs}


def projection(heightmap, chosen, half, **pose):
    """Return the in-hand image of a pick at chosen indices; components in ``pose`` override."""
    values = pose_of(chosen, half) | pose
    center = (int(chosen[0]) + 0.5, int(chosen[1]) + 0.5)
    z, angles = values.pop("z"), [values[name] for name in ("rz", "ry", "rx")]
    view = PickView(heightmap, heightmap, center, 0.4 / SIZE, z, *angles)
    return IN_HAND_MODES["proj"]().draw(view, 24)


def assert_close(views, expected):
    """Compare; sampled heights are float32, and few voxels are at the height of a level."""
    assert views.shape == expected.shape
    assert (views.numpy() != expected).mean() < 0.01
    assert expected.std() > 0.1


def swapped(pose):
    """Return the pose after half a turn of the tool about its own axis."""
    return pose | {"rz": pose["rz"] + math.pi, "ry": -pose["ry"], "rx": -pose["rx"]}


@pytest.mark.parametrize("half", [True, False])
def test_every_candidate_pose_sees_the_scene_from_itself(half):
    """With yaws of half a turn, first with one order of the fingers, then with the other."""
    views = build("equi_deictic_asr", half=half).views
    heightmap, *_, chosen = batch()
    for number, name in ((1, "z"), (2, "ry"), (3, "rx")):
        found = views[number](heightmap, chosen[:, : number + 2])
        for i in range(4):
            pose = pose_of(chosen[i], half) | dict.fromkeys(("ry", "rx")[number - 1 :], 0.0)
            poses = [pose | {name: grid(name, index, half)} for index in range(COUNTS[name])]
            poses += [swapped(pose) for pose in poses] if half else []
            heights = heightmap[i, 0].numpy()
            expected = [projection(heights, chosen[i], half, **pose) for pose in poses]
            assert_close(found[i], np.stack(expected))


def test_the_plain_levels_see_patches_and_projections_at_the_chosen_pose():
    views = build("asr").views
    heightmap, *_, chosen = batch()
    for i in range(4):
        heights = heightmap[i, 0].numpy()
        center = tuple(chosen[i, :2].numpy() + 0.5)
        for number, yaw in ((0, 0.0), (1, grid("rz", int(chosen[i, 2]), True))):
            found = views[number](heightmap, chosen[:, : number + 2])
            expected = crop(heights, center, 24, yaw)
            np.testing.assert_allclose(found[i, 0, 0], expected, atol=1e-5)
        for number, tilts in ((2, {"ry": 0.0, "rx": 0.0}), (3, {"rx": 0.0})):
            found = views[number](heightmap, chosen[:, : number + 2])
            assert_close(found[i], projection(heights, chosen[i], True, **tilts)[None])


@pytest.mark.parametrize(("views", "values_per_view"), [(1, 6), (5, 1), (4, 2)])
def test_values_equal_those_of_the_concatenated_features_of_each_view(views, values_per_view):
    """Features of the in-hand image and of the scene are computed once per sample."""
    torch.manual_seed(0)
    config = NETWORKS["asr"](width=0.25, precision="float32", voxel_scale=10.0)
    spec = spatial_spec(SIZE, 24, 3, POSE)
    head = PoseValues(spec, config, 3, values_per_view, 24, SceneMapVector(8, SIZE, config))
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    images, hand, scene = (
        torch.rand(3, views, 3, 24, 24),
        torch.rand(3, 3, 24, 24),
        torch.rand(3, 8, 4, 4),
    )
    holding = torch.tensor([[False], [True], [True]])
    with torch.no_grad():
        found = head(images, hand, scene, holding)
        assert found.shape == (3, views * values_per_view)
        for b in range(3):
            for k in range(views):
                x = torch.cat([images[b, k], hand[b]])[None] / 10
                for number, conv in enumerate(head.convs):
                    x = F.relu(conv(x))
                    x = F.max_pool2d(x, 2) if number < 3 else x
                x = F.relu(head.narrow(F.relu(head.wide(x.flatten(1)))))
                x = torch.cat([x, F.relu(head.scene(scene[b : b + 1]))], dim=1)
                pick, place = head.values(x)[0].split(values_per_view)
                part = found[b, k * values_per_view : (k + 1) * values_per_view]
                torch.testing.assert_close(
                    part, place if holding[b] else pick, atol=1e-5, rtol=1e-5
                )


def test_heights_of_later_levels_are_in_voxels():
    """The value of a scale of voxels changes projections and patches alike."""
    config = NETWORKS["asr"](voxel_scale=10.0, height_scale_m=0.05, precision="float32")
    heights, counts = torch.full((1, 1, 2, 2), 0.03), torch.full((1, 3, 2, 2), 6.0)
    assert scaled_heights(config, heights).unique().item() == pytest.approx(0.6)
    in_voxels = config.in_voxels(0.005)
    assert scaled_heights(in_voxels, heights).unique().item() == pytest.approx(0.6)  # 6 voxels
    assert scaled_in_hand(in_voxels, counts).unique().item() == pytest.approx(0.6)
    assert scaled_heights(config.in_voxels(0.00625), heights).unique().item() == pytest.approx(0.48)


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="obs_size of at least 32, got 16"):
        build("asr", 16)
    with pytest.raises(ValueError, match="patch_size of 24 or 40"):
        build("equi_deictic_asr", in_hand_size=32)
    with pytest.raises(ValueError, match="at least 8 pixels"):
        build("asr", in_hand_size=24, patch_size=6)
    with pytest.raises(ValueError, match="multiple of 16"):
        build("equi_deictic_asr", 90)
