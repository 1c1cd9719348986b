"""Spatial Q-learning in six degrees of freedom."""

import math

import pytest
import torch
from tensordict import TensorDict

import ba_torchrl
from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.algorithms.base import NETWORKS, Problem
from ba_torchrl.algorithms.spatial_q import SpatialQConfig
from ba_torchrl.config import parse
from ba_torchrl.data.demos import collect_demonstrations
from ba_torchrl.data.transitions import as_transitions
from tests.specs import open_loop_images

TASK = "open_loop/block_stacking"
ENV = {
    "obs_size": 32,
    "num_objects": 2,
    "action_sequence": "pxyzrrr",
    "in_hand_mode": "proj",
}
BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
TINY = {
    "num_rotations": 4,
    "num_z": 8,
    "num_tilts": 3,
    "width": 0.125,
    "precision": "float32",
    "height_scale_m": 0.05,
    "voxel_scale": 10.0,
}
BOTH = ["asr", "equi_deictic_asr"]


def build(network="asr", sequence="pxyzrrr", sizes=TINY, **config):
    torch.manual_seed(0)
    problem = Problem(
        control="open_loop",
        images=open_loop_images(channels=3),
        actions=OpenLoopActions(sequence, BOUNDS),
        total_updates=10,
        seed=0,
        device=torch.device("cpu"),
    )
    settings = parse(SpatialQConfig, {"batch_size": 4, "buffer_size": 500, **config}, "spatial_q")
    return settings.build(parse(NETWORKS[network], sizes, network), problem)


@pytest.fixture(scope="module")
def episodes():
    env = ba_torchrl.make_vector_env(TASK, 1, parallel=False, expert=True, seed=0, **ENV)
    nearest = build().nearest_action
    found = collect_demonstrations(env, 4, seed=0, only_successful=True, nearest_action=nearest)
    env.close()
    return found


@pytest.mark.parametrize(
    ("demonstrations", "augmentation"), [("sdqfd", "none"), ("dqfd", "se2"), ("adet", "none")]
)
@pytest.mark.parametrize("network", BOTH)
def test_both_networks_learn_the_demonstrations(network, demonstrations, augmentation, episodes):
    pytest.importorskip("escnn")
    algorithm = build(
        network,
        demonstrations=demonstrations,
        augmentation=augmentation,
        learning_rate=1e-3,
        demonstration_weight=10.0,
    )
    algorithm.on_demonstrations(episodes)
    data = torch.cat(
        [as_transitions(e, ["pixels", "in_hand"], is_demonstration=True) for e in episodes]
    )
    before = float(algorithm.loss(data.clone())["demonstration_error"])
    for _ in range(20):
        algorithm.update()
    assert float(algorithm.loss(data.clone())["demonstration_error"]) < 0.9 * before
    action = algorithm.policy(data[:6].select("pixels", "in_hand", "holding"))["action"]
    assert action.shape == (6, 7)
    assert torch.equal(algorithm.nearest_action(action), action)


def test_the_actions_of_the_episodes_are_on_the_grid(episodes):
    actions = torch.cat([episode["action"] for episode in episodes])
    steps = (actions[:, 3] - 0.02) / (0.18 / 7)
    torch.testing.assert_close(steps, steps.round(), atol=1e-4, rtol=0)
    steps = actions[:, 5:] / (math.pi / 8)
    torch.testing.assert_close(steps, steps.round(), atol=1e-4, rtol=0)


@pytest.mark.parametrize("yaw", [3.1, 1.5])
def test_a_yaw_that_wraps_negates_the_tilts_and_reverses_the_projections(yaw):
    algorithm = build()  # yaws at multiples of pi / 4
    tilt = math.pi / 8
    image = torch.randint(24, (3, 24, 24)).float()
    empty = torch.zeros_like(image)
    states = TensorDict(
        {
            "pixels": torch.zeros(3, 1, 32, 32),
            "in_hand": torch.stack([empty, image, empty]),
            "holding": torch.tensor([False, True, False])[:, None],
        },
        [3],
    )
    episode = states[:2].clone()
    episode["action"] = torch.tensor(
        [[0, 0.45, 0, 0.05, yaw, 0.9 * tilt, -0.8 * tilt], [1, 0.4, 0.1, 0.05, 0.8, tilt, 0.0]]
    )
    episode["next"] = states[1:].clone()
    episode["next", "reward"] = torch.zeros(2, 1)
    for key in ("done", "terminated", "truncated", "fault"):
        episode["next", key] = torch.zeros(2, 1, dtype=torch.bool)
    algorithm.on_demonstrations([episode])
    stored = algorithm.replay.storage[:2]
    sign = -1 if yaw > 3 else 1
    pick, place = stored["action"]
    expected = [0.0 if yaw > 3 else math.pi / 2, sign * tilt, -sign * tilt]
    assert pick[4:].tolist() == pytest.approx(expected, abs=1e-6)
    assert place[4:].tolist() == pytest.approx([math.pi / 4, tilt, 0.0], abs=1e-6)
    # the gripper's x and y axes are reversed: axes yz, xz and xy of the three channels
    swapped = torch.stack([image[0].flip(0), image[1].flip(0), image[2].flip(0, 1)])
    for shown in (stored["next", "in_hand"][0], stored["in_hand"][1]):
        assert torch.equal(shown, swapped if yaw > 3 else image)
    assert not stored["in_hand"][0].any()


def test_grids_outside_the_workspace_and_other_actions_are_refused():
    with pytest.raises(ValueError, match=r"grid of z must increase within \[0.01, 0.25\]"):
        build(sizes={**TINY, "max_z_m": 0.3})
    with pytest.raises(ValueError, match="has x, y, rz; use 'equi_asr'"):
        build("equi_deictic_asr", "pxyr")
    with pytest.raises(ValueError, match="x, y and rz, not z"):
        build("asr", "pxyzr")
