"""Spatial Q-learning on x, y and yaw, and in six degrees of freedom."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.data.transitions import as_transitions
from tests.algorithms import tiny
from tests.algorithms.tiny import SIX_DOF
from tests.tasks.episodes import demonstrations, slow

IMAGES = ["heightmap", "in_hand"]
TASK = "open_loop/block_stacking"
ENV = {"obs_size": 32, "num_objects": 2}


def build(network="asr", sequence=None, *, seed=0, **config):
    units = {"precision": "float32", "height_scale_m": 0.05, "voxel_scale": 10.0}
    options = {"batch_size": 4, **config}
    on = tiny.problem(network, sequence, seed=seed)
    return tiny.build("spatial_q", network, sequence=sequence, sizes=units, on=on, **options)


def collect(count, nearest_action=None, **env):
    options = {"only_successful": True, "nearest_action": nearest_action}
    return demonstrations(TASK, count, env={**ENV, **env}, **options)


def to_transitions(episodes):
    return torch.cat([as_transitions(each, IMAGES, is_demonstration=True) for each in episodes])


@pytest.fixture(scope="module")
def transitions():
    return to_transitions(collect(4))


@pytest.fixture(scope="module")
def pose_episodes():
    nearest = build("asr", SIX_DOF).nearest_action
    return collect(4, nearest, action_sequence=SIX_DOF, in_hand_mode="proj")


def demonstration_error(algorithm, data):
    return float(algorithm.loss(data.clone())["demonstration_error"])


@pytest.mark.parametrize("network", ["fcn", "equi_asr", *slow(["asr", "rot_fcn", "equi_fcn"])])
def test_every_network_learns_the_demonstrations(network, transitions):
    imitation = {"name": "sdqfd", "weight": 10.0}
    algorithm = build(network, optimizer={"learning_rate": 1e-3}, imitation=imitation)
    algorithm.extend(transitions)
    before = demonstration_error(algorithm, transitions)
    for _ in range(40):
        algorithm.update()
    assert demonstration_error(algorithm, transitions) < 0.9 * before


@pytest.mark.parametrize(
    ("network", "demonstrations", "augmentation"),
    [
        ("asr", "dqfd", "se2"),
        pytest.param("asr", "sdqfd", "none", marks=pytest.mark.slow),
        pytest.param("asr", "adet", "none", marks=pytest.mark.slow),
        pytest.param("equi_deictic_asr", "sdqfd", "se2", marks=pytest.mark.slow),
    ],
)
def test_networks_of_six_degrees_of_freedom_learn_the_demonstrations(
    network, demonstrations, augmentation, pose_episodes
):
    imitation = {"name": demonstrations, "weight": 10.0}
    options = {"imitation": imitation, "rotation": {"name": augmentation}}
    algorithm = build(network, SIX_DOF, optimizer={"learning_rate": 1e-3}, **options)
    algorithm.on_demonstrations(pose_episodes)
    data = to_transitions(pose_episodes)
    before = demonstration_error(algorithm, data)
    for _ in range(20):
        algorithm.update()
    assert demonstration_error(algorithm, data) < 0.9 * before
    action = algorithm.policy(data[:6].select(*IMAGES, "holding"))["action"]
    assert action.shape == (6, 7)
    assert torch.equal(algorithm.nearest_action(action), action)


def test_the_actions_of_the_episodes_are_on_the_grid(pose_episodes):
    actions = torch.cat([episode["action"] for episode in pose_episodes])
    for steps in ((actions[:, 3] - 0.02) / (0.18 / 7), actions[:, 5:] / (math.pi / 8)):
        torch.testing.assert_close(steps, steps.round(), atol=1e-4, rtol=0)


def test_the_policy_acts_on_half_precision_heights(transitions):
    algorithm = build()
    state = transitions[:6].select("heightmap", "in_hand", "holding")
    stored = state.clone()
    stored["heightmap"] = state["heightmap"].half().float()
    nearby = stored.clone()
    nearby["heightmap"] = stored["heightmap"] * (1 + 2.0**-13)
    assert torch.equal(algorithm.policy(nearby)["action"], algorithm.policy(stored)["action"])


def test_the_policy_is_greedy_unless_epsilon_is_positive(transitions):
    state = transitions[:6].select("heightmap", "in_hand", "holding")
    with set_exploration_type(ExplorationType.RANDOM):
        greedy = build()
        first, second = (greedy.policy(state.clone())["action"] for _ in range(2))
        assert torch.equal(first, second)
        explorer = build(epsilon_init=1.0, epsilon_end=0.5, epsilon_updates=4)
        first, second = (explorer.policy(state.clone())["action"] for _ in range(2))
        assert not torch.equal(first, second)


def test_a_restored_learner_continues_identically(transitions):
    first = build(target_interval=3, rotation={"name": "se2"})
    first.extend(transitions)
    for _ in range(4):
        first.update()
    second = build(target_interval=3, rotation={"name": "se2"}, seed=5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.load_replay_state(copy.deepcopy(first.replay_state()))
    assert second.updates == 4
    states = [each.explorer.generator.get_state() for each in (first, second)]
    assert torch.equal(*states)
    assert len(second.replay) == len(first.replay)
    for _ in range(3):
        one, other = first.update(), second.update()
        assert float(one["loss_qvalue"]) == pytest.approx(float(other["loss_qvalue"]), rel=1e-6)
    for a, b in zip(first.loss.parameters(), second.loss.parameters(), strict=True):
        torch.testing.assert_close(a, b)
    assert float(one["target_value"]) == pytest.approx(float(other["target_value"]), rel=1e-6)


def test_an_action_without_yaw_supports_networks_without_yaw_only(transitions):
    assert build("fcn", "pxy").policy(transitions[:2])["action"].shape == (2, 3)
    with pytest.raises(ValueError, match="fcn"):
        build("asr", "pxy")
    with pytest.raises(ValueError, match="no yaw"):
        build("fcn", "pxy", rotation={"name": "se2"})


def test_demonstrations_are_executed_as_they_are_learnt(transitions):
    algorithm = build()
    episodes = collect(3, algorithm.nearest_action)
    for episode in episodes:
        assert torch.equal(algorithm.nearest_action(episode["action"]), episode["action"])
    moved = (algorithm.nearest_action(transitions["action"]) - transitions["action"]).abs()
    assert moved[:, 3].max() > 0.01  # the expert's own actions are off the grid
    algorithm.on_demonstrations(episodes)
    stored = algorithm.replay.storage.column("action")
    assert torch.equal(stored, torch.cat([episode["action"] for episode in episodes]))


@pytest.mark.parametrize("sequence", ["pxyr", SIX_DOF])
@pytest.mark.parametrize("yaw", [3.1, 1.5])
def test_a_yaw_that_wraps_reverses_the_image_of_what_is_held_and_negates_tilts(yaw, sequence):
    algorithm = build(sequence=sequence)  # yaws at multiples of pi / 4
    is_six_dof, tilt = sequence == SIX_DOF, math.pi / 8
    image = torch.randint(24, (3 if is_six_dof else 1, 24, 24)) / 32.0
    empty = torch.zeros_like(image)
    states = TensorDict(
        {
            "heightmap": torch.zeros(4, 1, 32, 32),
            "in_hand": torch.stack([empty, image, image, empty]),
            "holding": torch.tensor([False, True, True, False])[:, None],
        },
        [4],
    )
    episode = states[:3].clone()
    # a pick, a place that does nothing, and one that releases
    z, tilts = ([0.05], [[0.9 * tilt, -0.8 * tilt], [tilt, 0.0]]) if is_six_dof else ([], [[], []])
    pick, place = [0, 0.45, 0, *z, yaw, *tilts[0]], [1, 0.4, 0.1, *z, 0.8, *tilts[1]]
    episode["action"] = torch.tensor([pick, place, place], dtype=torch.float32)
    episode["next"] = states[1:].clone()
    episode["next", "reward"] = torch.zeros(3, 1)
    for key in ("done", "terminated", "truncated", "fault"):
        episode["next", key] = torch.zeros(3, 1, dtype=torch.bool)
    algorithm.on_demonstrations([episode])
    stored = algorithm.replay.storage[:3]
    wraps, sign = yaw > 3, -1 if yaw > 3 else 1
    pick, place, _ = stored["action"][:, 4 if is_six_dof else 3 :].tolist()
    swapped = [sign * tilt, -sign * tilt] if is_six_dof else []
    assert pick == pytest.approx([0.0 if wraps else math.pi / 2, *swapped], abs=1e-6)
    kept = [tilt, 0.0] if is_six_dof else []
    assert place == pytest.approx([math.pi / 4, *kept], abs=1e-6)
    expected = image
    if wraps:  # the gripper's x and y axes; those of the three channels are yz, xz and xy
        axes = [(0,), (0,), (0, 1)] if is_six_dof else [(0, 1)]
        expected = torch.stack([each.flip(axis) for each, axis in zip(image, axes, strict=True)])
    for shown in (stored["next", "in_hand"][:2], stored["in_hand"][1:]):
        assert torch.equal(shown, expected.expand(2, -1, -1, -1))
    assert not stored["in_hand"][0].any()
    assert not stored["next", "in_hand"][2].any()


def test_grids_outside_the_workspace_and_other_actions_are_refused():
    sizes = {"max_z_m": 0.3}
    with pytest.raises(ValueError, match=r"grid of z must increase within \[0.01, 0.25\]"):
        tiny.build("spatial_q", "asr", sequence=SIX_DOF, sizes=sizes)
    with pytest.raises(ValueError, match="has x, y, rz; use 'equi_asr'"):
        build("equi_deictic_asr", "pxyr")
    with pytest.raises(ValueError, match="x, y and rz, not z"):
        build("asr", "pxyzr")
