import math

import pybullet
import pytest
import torch
from tensordict import TensorDict

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.actions import PICK, PLACE
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.demonstrations.collect import collect_demonstrations, source_config
from ba_torchrl.demonstrations.episodes import collect_episodes
from ba_torchrl.demonstrations.time_reversal import (
    is_reversible,
    make_deconstruction_env,
    replay_scores,
    reverse_episode,
)
from ba_torchrl.sim.geometry import Pose
from ba_torchrl.tasks.structures.deconstruction import UndoRecorder

TASK = "open_loop/house_building_2"
STRUCTURES = [
    "open_loop/block_stacking",
    *(f"open_loop/house_building_{i}" for i in (1, 2, 3, 4)),
    *(f"open_loop/improvise_house_building_{i}" for i in (2, 3)),
]


def flags(*values):
    return torch.tensor(values)[:, None]


def images(*values):
    return torch.tensor(values, dtype=torch.float32)[:, None, None, None].expand(-1, 1, 2, 2)


@pytest.fixture
def taken_apart():
    """A synthetic episode of two picks and places, in which images of state t have the value t."""
    return TensorDict(
        {
            "heightmap": images(0, 1, 2, 3),
            "in_hand": images(0, 101, 0, 103),
            "holding": flags(False, True, False, True),
            "expert_action": torch.zeros(4, 2),
            "action": torch.zeros(4, 2),
            "undo_action": torch.zeros(4, 2),
            "undo_in_hand": images(0, 0, 52, 0),
            "can_undo": flags(False, True, True, True),
            "success": flags(False, False, False, False),
            "fault": flags(False, False, False, False),
            "done": flags(False, False, False, False),
            "terminated": flags(False, False, False, False),
            "truncated": flags(False, False, False, False),
            "step_count": flags(0, 1, 2, 3),
            "next": {
                "heightmap": images(1, 2, 3, 4),
                "in_hand": images(101, 0, 103, 0),
                "holding": flags(True, False, True, False),
                "expert_action": torch.zeros(4, 2),
                "undo_action": torch.tensor([[1.0, 10], [0, 21], [1, 32], [0, 43]]),
                "undo_in_hand": images(0, 52, 0, 54),
                "can_undo": flags(True, True, True, True),
                "success": flags(False, False, False, True),
                "fault": flags(False, False, False, False),
                "reward": flags(0.0, 0.0, 0.0, 1.0),
                "done": flags(False, False, False, True),
                "terminated": flags(False, False, False, True),
                "truncated": flags(False, False, False, False),
                "step_count": flags(1, 2, 3, 4),
            },
        },
        batch_size=[4],
    )


def test_entries_of_a_reversed_episode(taken_apart):
    before = taken_apart.clone()
    built = reverse_episode(taken_apart)
    assert built["heightmap"][:, 0, 0, 0].tolist() == [4, 3, 2, 1]
    assert built["next", "heightmap"][:, 0, 0, 0].tolist() == [3, 2, 1, 0]
    assert built["action"].tolist() == [[0, 43], [1, 32], [0, 21], [1, 10]]
    assert built["holding"].flatten().tolist() == [False, True, False, True]
    assert built["next", "holding"].flatten().tolist() == [True, False, True, False]
    # state 3 is held from the pick in state 4, state 1 from the pick in state 2
    assert built["in_hand"][:, 0, 0, 0].tolist() == [0, 54, 0, 52]
    assert built["next", "in_hand"][:, 0, 0, 0].tolist() == [54, 0, 52, 0]
    at_end = [False, False, False, True]
    assert built["next", "reward"].flatten().tolist() == [0, 0, 0, 1]
    for key in ("success", "done", "terminated"):
        assert built["next", key].flatten().tolist() == at_end
        assert not built[key].any()
    assert not built["next", "truncated"].any()
    assert built["step_count"].flatten().tolist() == [0, 1, 2, 3]
    assert built["next", "step_count"].flatten().tolist() == [1, 2, 3, 4]
    built["heightmap"] = built["heightmap"] + 1
    built["next", "heightmap"] = built["next", "heightmap"] + 1
    assert (taken_apart == before).all()


@pytest.mark.parametrize(
    ("key", "values"),
    [
        (("next", "can_undo"), (True, False, True, True)),
        (("next", "success"), (False, False, False, False)),
        ("holding", (False, True, True, True)),
        (("next", "holding"), (True, False, True, True)),
    ],
)
def test_irreversible_episodes_are_refused(taken_apart, key, values):
    taken_apart[key] = flags(*values)
    assert not is_reversible(taken_apart)
    with pytest.raises(ValueError, match="cannot be reversed"):
        reverse_episode(taken_apart)


class Piece:
    """A body at a pose."""

    def __init__(self, x, y, z, turn=(0.0, 0.0, 0.0, 1.0)):
        self.pose = Pose((x, y, z), turn)

    @property
    def position(self):
        return self.pose[0]


def test_the_inverse_action_restores_the_pose_of_the_body():
    down = pybullet.getQuaternionFromEuler((math.pi, 0.0, 0.0))
    body, other = Piece(0.4, 0.1, 0.05), Piece(0.5, 0.0, 0.015)
    # held 4 mm beside its middle, along the tool's x axis
    grasp = Pose((0.004, 0.0, 0.0), pybullet.invertTransform((0, 0, 0), down)[1])
    before = UndoRecorder({body: body.pose, other: other.pose}, None, None)
    body.pose = Pose((0.6, 0.0, 0.4), body.pose[1])
    undo = before.undo_command(body, grasp)
    assert undo.primitive == PLACE
    assert undo[1:4] == pytest.approx((0.396, 0.1, 0.05))
    assert undo.angles_rad == pytest.approx((0.0, 0.0, 0.0))

    held = UndoRecorder({body: body.pose, other: other.pose}, body, grasp)
    quarter = pybullet.getQuaternionFromEuler((0.0, 0.0, math.pi / 2))
    body.pose = Pose((0.3, -0.1, 0.015), quarter)
    undo = held.undo_command(None, None)
    assert undo.primitive == PICK
    assert undo[1:4] == pytest.approx((0.3, -0.104, 0.015))
    assert undo.rz_rad == pytest.approx(math.pi / 2)
    assert held.undo_command(None, None, lowest_tool_m=lambda *_: 0.014) == undo
    assert held.undo_command(None, None, lowest_tool_m=lambda *_: 0.017) == undo._replace(z_m=0.017)
    place = before.undo_command(body, grasp, lowest_tool_m=lambda *_: 0.2)
    assert place.z_m == pytest.approx(0.05)


def test_an_action_that_moved_no_or_two_bodies_has_no_inverse():
    body, other = Piece(0.4, 0.1, 0.05), Piece(0.5, 0.0, 0.015)
    grasp = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    before = UndoRecorder({body: body.pose, other: other.pose}, None, None)
    assert before.undo_command(None, None) is None
    other.pose = Pose((0.5, 0.004, 0.015), other.pose[1])
    assert before.undo_command(body, grasp) is not None
    other.pose = Pose((0.5, 0.006, 0.015), other.pose[1])
    assert before.undo_command(body, grasp) is None


def test_reversed_actions_build_the_structure():
    scores = replay_scores("open_loop/improvise_house_building_2", 8, seed=100)
    assert scores.reversible >= 0.75
    assert scores.success_rate >= 0.75


@pytest.mark.slow
@pytest.mark.parametrize("task", STRUCTURES)
def test_reversed_actions_build_nine_structures_of_ten(task):
    scores = replay_scores(task, 100, seed=0)
    assert scores.reversible >= 0.9
    assert scores.success_rate >= 0.95


@pytest.mark.parametrize(
    "config",
    [
        {"action_sequence": "pxyzrrr"},
        pytest.param({"in_hand_mode": "proj"}, marks=pytest.mark.slow),
    ],
)
def test_reversed_actions_build_with_other_parameters(config):
    scores = replay_scores(TASK, 4, **config)
    assert scores.reversible == scores.success_rate == 1


def test_low_pieces_are_picked_at_heights_of_the_action_space():
    """The lowest cuboids are 2 cm high: fingers at their centre would touch the floor."""
    scores = replay_scores(
        "open_loop/improvise_house_building_3", 8, seed=50, action_sequence="pxyzr"
    )
    assert scores.reversible >= 0.75
    assert scores.success_rate >= 0.85


def test_structures_with_fixed_orientations_are_built_without_a_yaw():
    config = {"random_orientation": False, "action_sequence": "pxy"}
    scores = replay_scores("open_loop/house_building_1", 5, **config)
    assert scores.reversible == scores.success_rate == 1


@pytest.mark.parametrize("mode", ["raw", "sub", "proj"])
def test_reversed_episodes_equal_their_replay_in_the_simulator(mode):
    """Their actions, executed in an environment, give the observations of the reversed episode."""
    config = {"seed": 5, "in_hand_mode": mode}
    env = make_deconstruction_env(TASK, expert=True, **config)
    plain = ba_torchrl.make(TASK, expert=True, **config)
    try:
        apart = env.rollout(10, lambda td: td.set("action", td["expert_action"].clone()))
        built = reverse_episode(apart)
        reference = plain.rollout(10, lambda td: td.set("action", td["expert_action"].clone()))
        reference = reference.exclude("expert_action", ("next", "expert_action"))
        assert set(built.keys(True, True)) == set(reference.keys(True, True))
        for key in built.keys(True, True):
            assert built[key].dtype == reference[key].dtype, key
            assert built[key].shape[1:] == reference[key].shape[1:], key
        for body, start in zip(plain.scene.task.objects, env.scene.task.objects, strict=True):
            body.set_pose(*start.pose)
        plain.scene.world.settle(max_steps=100)
        plain.scene.controller.reset()
        plain._memory = {}
        for step in built:
            played = plain.step(TensorDict({"action": step["action"]}))["next"]
            assert played["holding"] == step["next", "holding"]
            assert played["success"] == step["next", "success"]
            assert played["reward"] == step["next", "reward"]
            # a pixel at an edge may fall to the other side
            off = (played["heightmap"] - step["next", "heightmap"]).abs() > 3e-3
            assert off.float().mean() < 0.01
            if mode != "proj":
                off = (played["in_hand"] - step["next", "in_hand"]).abs() > 3e-3
                assert off.float().mean() < 0.1
            assert (played["in_hand"].sum() > 0) == (step["next", "in_hand"].sum() > 0)
    finally:
        env.close()
        plain.close()


def test_a_deconstruction_starts_with_the_structure_and_ends_apart():
    env = make_deconstruction_env("open_loop/house_building_3", expert=True, seed=0)
    try:
        state = env.reset()
        task = env.scene.task
        assert task.task.is_success()
        assert not task.is_success()
        assert not state["can_undo"]
        first = state["expert_action"]
        assert torch.equal(env.reset(seed=0)["expert_action"], first)
        for _ in range(6):
            state = env.step(state.set("action", state["expert_action"].clone()))["next"]
            assert state["can_undo"]
        assert state["terminated"]
        assert task.is_success()
        assert not task.task.is_success()
        bodies = list(task.objects)
        for i, body in enumerate(bodies):
            for other in bodies[:i]:
                assert math.dist(body.position[:2], other.position[:2]) > 0.07
    finally:
        env.close()


def test_episodes_are_collected_in_a_vector_of_environments():
    env = ba_torchrl.make_vector_env(
        TASK, 2, parallel=False, seed=0, obs_size=64, **source_config("deconstruction")
    )
    try:
        episodes = collect_demonstrations(env, 3, seed=0, source="deconstruction")
        played = collect_episodes(
            env, lambda td: td.set("action", td["expert_action"].clone()), 3, seed=0
        )
        with pytest.raises(ConfigError, match="expert, deconstruction"):
            collect_demonstrations(env, 1, source="dream")
    finally:
        env.close()
    assert [len(episode) for episode in episodes] == [4, 4, 4]
    for episode, original in zip(episodes, played, strict=True):
        assert torch.equal(episode["heightmap"][0], original["next", "heightmap"][-1])
    transitions = as_transitions(episodes[0], ["heightmap", "in_hand"], is_demonstration=True)
    assert keys.IN_HAND in transitions
    assert (keys.NEXT, keys.IN_HAND) in transitions.keys(include_nested=True)


def test_tasks_without_a_structure_have_no_deconstruction():
    with pytest.raises(ConfigError, match="no meaning for close_loop/block_picking"):
        make_deconstruction_env("close_loop/block_picking")
