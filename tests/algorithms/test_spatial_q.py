import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import ba_torchrl
from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS, Problem
from ba_torchrl.algorithms.spatial_q import SpatialQConfig
from ba_torchrl.config import parse
from ba_torchrl.data.demos import collect_demonstrations
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.errors import ConfigError
from tests.specs import open_loop_images

IMAGES = ["pixels", "in_hand"]
TASK = "open_loop/block_stacking"
ENV = {"obs_size": 32, "num_objects": 2}
BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
TINY = {"num_rotations": 4, "width": 0.125, "precision": "float32", "height_scale_m": 0.05}


def build(network="asr", sequence="pxyr", *, sizes=None, seed=0, **config):
    torch.manual_seed(seed)
    problem = Problem(
        control="open_loop",
        images=open_loop_images(),
        actions=OpenLoopActions(sequence, BOUNDS),
        total_updates=10,
        seed=seed,
        device=torch.device("cpu"),
    )
    settings = parse(SpatialQConfig, {"batch_size": 4, "buffer_size": 500, **config}, "spatial_q")
    values = TINY if sizes is None else sizes
    return settings.build(parse(NETWORKS[network], values, network), problem)


@pytest.fixture(scope="module")
def transitions():
    env = ba_torchrl.make_vector_env(TASK, 1, parallel=False, expert=True, seed=0, **ENV)
    episodes = collect_demonstrations(env, 4, seed=0, only_successful=True)
    env.close()
    return torch.cat(
        [as_transitions(episode, IMAGES, is_demonstration=True) for episode in episodes]
    )


def online(transitions):
    data = transitions.clone()
    data["is_demonstration"] = torch.zeros_like(data["is_demonstration"])
    return data


@pytest.mark.parametrize("network", ["asr", "fcn", "rot_fcn", "equi_asr", "equi_fcn"])
def test_every_network_learns_the_demonstrations(network, transitions):
    algorithm = build(network, learning_rate=1e-3, demonstration_weight=10.0)
    algorithm.extend(transitions)
    before = float(algorithm.loss(transitions.clone())["demonstration_error"])
    for _ in range(40):
        algorithm.update()
    assert float(algorithm.loss(transitions.clone())["demonstration_error"]) < 0.9 * before


@pytest.mark.parametrize("demonstrations", ["none", "dqfd", "sdqfd", "adet"])
@pytest.mark.parametrize("replay", ["symmetric", "prioritized", "uniform"])
def test_every_loss_takes_steps_on_every_replay(demonstrations, replay, transitions):
    algorithm = build("fcn", demonstrations=demonstrations, replay=replay)
    algorithm.extend(transitions)
    before = [parameter.clone() for parameter in algorithm.loss.parameters()]
    scalars = algorithm.update()
    assert all(math.isfinite(float(value)) for value in scalars.values())
    after = list(algorithm.loss.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_the_policy_acts_on_half_precision_heights(transitions):
    algorithm = build()
    state = transitions[:6].select("pixels", "in_hand", "holding")
    stored = state.clone()
    stored["pixels"] = state["pixels"].half().float()
    nearby = stored.clone()
    nearby["pixels"] = stored["pixels"] * (1 + 2.0**-13)
    assert torch.equal(algorithm.policy(nearby)["action"], algorithm.policy(stored)["action"])


def test_the_policy_is_greedy_unless_epsilon_is_positive(transitions):
    state = transitions[:6].select("pixels", "in_hand", "holding")
    with set_exploration_type(ExplorationType.RANDOM):
        greedy = build()
        first, second = (greedy.policy(state.clone())["action"] for _ in range(2))
        assert torch.equal(first, second)
        explorer = build(epsilon_init=1.0, epsilon_end=0.5, epsilon_updates=4)
        first, second = (explorer.policy(state.clone())["action"] for _ in range(2))
        assert not torch.equal(first, second)


def test_a_restored_learner_continues_identically(transitions):
    first = build(target_interval=3, augmentation="se2")
    first.extend(transitions)
    for _ in range(4):
        first.update()
    second = build(target_interval=3, augmentation="se2", seed=5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.load_replay_state(copy.deepcopy(first.replay_state()))
    assert second.updates == 4
    states = [each.explorer.generator.get_state() for each in (first, second)]
    assert torch.equal(*states)
    assert second.replay_size == first.replay_size
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
        build("fcn", "pxy", augmentation="se2")


def test_networks_and_tasks_of_the_other_control_are_refused():
    spatial, close = parse(SpatialQConfig, {}, "q"), parse(ALGORITHMS["sac"], {}, "sac")
    cnn, fcn = parse(NETWORKS["cnn"], {}, "cnn"), parse(NETWORKS["fcn"], {}, "fcn")
    with pytest.raises(ConfigError, match=r"for close_loop tasks; open_loop tasks take .* asr"):
        spatial.check(cnn, "open_loop")
    with pytest.raises(ConfigError, match=r"for open_loop tasks; close_loop tasks take .* cnn"):
        close.check(fcn, "close_loop")
    with pytest.raises(ConfigError, match="learns open_loop tasks, not close_loop ones"):
        spatial.check(cnn, "close_loop")
    spatial.check(fcn, "open_loop")


def test_demonstrations_are_executed_as_they_are_learnt():
    algorithm = build()
    env = ba_torchrl.make_vector_env(TASK, 1, parallel=False, expert=True, seed=0, **ENV)
    episodes = collect_demonstrations(env, 3, seed=0, nearest_action=algorithm.nearest_action)
    plain = collect_demonstrations(env, 3, seed=0)
    env.close()
    for episode in episodes:
        assert torch.equal(algorithm.nearest_action(episode["action"]), episode["action"])
    moved = (algorithm.nearest_action(plain[0]["action"]) - plain[0]["action"]).abs()
    assert moved[:, 3].max() > 0.01  # the expert's own actions are off the grid
    algorithm.on_demonstrations(episodes)
    stored = algorithm.replay.storage.column("action")
    assert torch.equal(stored, torch.cat([episode["action"] for episode in episodes]))


@pytest.mark.parametrize("yaw", [3.1, 1.5])
def test_a_yaw_that_wraps_reverses_the_image_of_what_is_held(yaw):
    algorithm = build()  # yaws at multiples of pi / 4
    image = torch.rand(1, 24, 24).half().float()
    states = TensorDict(
        {
            "pixels": torch.zeros(4, 1, 32, 32),
            "in_hand": torch.stack(
                [torch.zeros_like(image), image, image, torch.zeros_like(image)]
            ),
            "holding": torch.tensor([False, True, True, False])[:, None],
        },
        [4],
    )
    episode = states[:3].clone()
    # a pick, a place that does nothing, and one that releases
    episode["action"] = torch.tensor(
        [[0, 0.45, 0, yaw], [1, 0.4, 0.1, 0.8], [1, 0.4, 0.1, 0.8]], dtype=torch.float32
    )
    episode["next"] = states[1:].clone()
    episode["next", "reward"] = torch.zeros(3, 1)
    for key in ("done", "terminated", "truncated", "fault"):
        episode["next", key] = torch.zeros(3, 1, dtype=torch.bool)
    algorithm.on_demonstrations([episode])
    stored = algorithm.replay.storage[:3]
    wraps = yaw > 3
    expected = image.flip(-2, -1) if wraps else image
    assert stored["action"][0, 3] == pytest.approx(0.0 if wraps else math.pi / 2)
    for shown in (stored["next", "in_hand"][:2], stored["in_hand"][1:]):
        assert torch.equal(shown, expected.expand(2, -1, -1, -1))
    assert not stored["in_hand"][0].any()
    assert not stored["next", "in_hand"][2].any()
