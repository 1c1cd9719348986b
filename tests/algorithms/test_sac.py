import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.data.transitions import as_transitions
from tests.algorithms import tiny
from tests.tasks import episodes as played

TASK = "close_loop/block_reaching"
DEPTH_M = 0.39


def build(network="cnn", **config):
    options = {"batch_size": 16, "replay": {**tiny.PER, "capacity": 500}, "rotation": tiny.SO2}
    return tiny.build("sac", network, **{**options, **config})


@pytest.fixture(scope="module")
def demonstrations():
    episodes = played.demonstrations(TASK, 6, num_envs=2, env={"obs_size": 64})
    return torch.cat(
        [
            as_transitions(each, ["depth"], is_demonstration=True, imitates="expert")
            for each in episodes
        ]
    )


@pytest.mark.parametrize("network", ["cnn", "equi"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)
def test_the_policy_writes_nothing_but_the_action_for_any_batch_shape(network, shape):
    policy = build(network).policy
    observation = TensorDict(
        {
            "depth": torch.rand(*shape, 1, 64, 64) * DEPTH_M,
            "holding": torch.ones(*shape, 1, dtype=torch.bool),
        },
        batch_size=shape,
    )
    out = policy(observation)
    assert set(out.keys()) == {"depth", "holding", "action"}
    assert out["action"].shape == (*shape, 5)
    assert (out["action"].abs() <= 1).all()


def test_the_policy_acts_on_quantised_depth():
    sac = build()
    codec = make_codecs(sac.images)["depth"]
    codes = torch.randint(0, 256, (4, 1, 64, 64), dtype=torch.uint8)
    stored = codec.decode(codes)
    nearby = (stored + (torch.rand_like(stored) - 0.5) * 1.9 * codec.max_error_m).clamp(0)
    holding = torch.zeros(4, 1, dtype=torch.bool)
    actions = []
    for depth in (stored, nearby):
        assert not torch.equal(depth, stored) or depth is stored
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            td = TensorDict({"depth": depth, "holding": holding}, batch_size=[4])
            actions.append(sac.policy(td)["action"])
    assert torch.equal(*actions)


def test_the_acting_policy_follows_the_learner(demonstrations):
    sac = build("equi")
    sac.extend(demonstrations)
    td = TensorDict(
        {"depth": torch.rand(1, 1, 64, 64) * DEPTH_M, "holding": torch.zeros(1, 1).bool()},
        batch_size=[1],
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        before = sac.policy(td.clone())["action"]
        sac.policy.eval()  # no filter may be cached in evaluation mode
        sac.update()
        after = sac.policy(td.clone())["action"]
    assert not torch.equal(before, after)


def test_updates_change_priorities_and_counter_and_imitate(demonstrations):
    sac = build(optimizer={"learning_rate": 3e-3})
    sac.extend(demonstrations)
    assert len(sac.replay) == len(demonstrations)
    sampler = sac.replay.sampler
    before = sampler._sum_tree[torch.arange(len(demonstrations))]
    errors = []
    for _ in range(30):
        scalars = sac.update()
        assert not any(value.requires_grad for value in scalars.values())
        errors.append(float(scalars["demonstration_error"]))
    after = sampler._sum_tree[torch.arange(len(demonstrations))]
    assert (torch.as_tensor(before) != torch.as_tensor(after)).sum() > len(demonstrations) / 2
    assert sac.updates == 30
    assert sum(errors[-5:]) < 0.7 * sum(errors[:5])
    assert sampler.beta == 1.0


def test_the_behaviour_term_is_against_the_action_of_the_expert():
    learner = tiny.build("sac", batch_size=6)
    learner.extend(tiny.transitions(learner))
    batch = learner.sample()

    def error(changed=None):
        torch.manual_seed(0)
        data = batch.clone()
        if changed is not None:
            data[changed] = torch.zeros_like(data[changed])
        return float(learner.loss(data)["demonstration_error"])

    assert error(keys.ACTION) == error()
    assert error(keys.TARGET_ACTION) != error()


def test_the_executed_action_is_the_target_where_the_expert_is_not_asked():
    learner = tiny.build("sac", batch_size=6)
    data = tiny.transitions(learner)
    data[keys.NEXT, keys.FAULT] = torch.zeros(len(data), 1, dtype=torch.bool)
    stored = learner.to_transitions(data, is_demonstration=False)
    assert torch.equal(stored[keys.TARGET_ACTION], data[keys.ACTION])
