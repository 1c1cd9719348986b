"""Every hyper-parameter has an effect: algorithms are built with unusual values."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.data.augmentation.rigid import RigidAugmentation
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.replay.symmetric import SymmetricSampler
from ba_torchrl.record.logging import read_scalars
from tests.algorithms import tiny
from tests.algorithms.tiny import make_experiment, transitions

SAC = {
    "optimizer": {"learning_rate": 0.003, "weight_decay": 0.02, "gradient_clamp": 1e-4},
    "gamma": 0.7,
    "tau": 0.3,
    "alpha_init": 0.25,
    "target_entropy": -2.5,
    "entropy_backup": False,
    "imitation": {"name": "demonstrations", "weight": 3.0},
    "exploration_noise": 0.15,
    "batch_size": 6,
    "replay": {
        "name": "prioritized",
        "capacity": 77,
        "priority_exponent": 0.9,
        "importance_exponent": 0.2,
        "weighted_terms": "all",
        "weight_norm": "mean",
        "expert_bonus": 2.5,
    },
    "rotation": {"name": "sampled", "probability": 0.35},
}
SPATIAL_Q = {
    "optimizer": {"learning_rate": 0.002, "weight_decay": 0.03, "gradient_clamp": 1e-4},
    "gamma": 0.6,
    "imitation": {"name": "adet", "weight": 0.7, "first_beta": 7.0, "later_beta": 3.0},
    "target_interval": 3,
    "batch_size": 6,
    "replay": {"name": "symmetric", "capacity": 55},
    "rotation": {"name": "cn", "probability": 0.45, "order": 6},
    "epsilon_init": 1.0,
    "epsilon_end": 0.2,
    "epsilon_updates": 4,
}
KINDS = {"sac": SAC, "spatial_q": SPATIAL_Q}


def build(name, **changes):
    return tiny.build(name, "cnn" if name == "sac" else "asr", **{**KINDS[name], **changes})


@pytest.fixture(params=["sac", "spatial_q"])
def algorithm(request):
    made = build(request.param)
    made.extend(transitions(made))
    return made


def test_a_target_is_the_reward_plus_the_discounted_value():
    sac = build("sac", alpha_init=1e-8)
    batch = transitions(sac)
    torch.manual_seed(3)
    with torch.no_grad():
        target = sac.loss._target(batch)
        batch[keys.NEXT, keys.TERMINATED] |= True
        torch.manual_seed(3)
        reward = sac.loss._target(batch)
        batch[keys.NEXT, keys.TERMINATED] &= False
        torch.manual_seed(3)
        sac.loss.make_value_estimator(gamma=1.0)
        undiscounted = sac.loss._target(batch)
    assert torch.equal(reward, batch[keys.NEXT, keys.REWARD])
    torch.testing.assert_close(target - reward, 0.7 * (undiscounted - reward))


@pytest.mark.parametrize("bootstraps", [True, False])
def test_targets_of_truncated_steps_bootstrap_if_configured(bootstraps):
    sac = build("sac", bootstrap_truncated=bootstraps, alpha_init=1e-8)
    batch = transitions(sac)
    for key in (keys.TRUNCATED, keys.DONE):
        batch[keys.NEXT, key] |= True
    with torch.no_grad():
        target = sac.loss._target(batch)
    assert torch.equal(target, batch[keys.NEXT, keys.REWARD]) != bootstraps
    batch[keys.NEXT, keys.TERMINATED] |= True
    with torch.no_grad():
        assert torch.equal(sac.loss._target(batch), batch[keys.NEXT, keys.REWARD])


def test_the_terms_of_sac_have_their_values():
    loss = build("sac").loss
    assert float(loss.alpha) == pytest.approx(0.25)
    assert float(loss.target_entropy) == -2.5
    assert not loss.entropy_backup
    assert float(loss.demonstration_weight) == 3.0


def test_the_terms_of_spatial_q_have_their_values():
    loss = build("spatial_q").loss
    assert loss.demonstrations == "adet"
    values = (loss.demonstration_weight, loss.first_beta, loss.later_beta)
    assert values == (0.7, 7.0, 3.0)
    assert build("spatial_q", imitation={"name": "dqfd", "margin": 0.4}).loss.margin == 0.4


@pytest.mark.parametrize("name", ["sac", "spatial_q"])
def test_the_loss_has_the_configured_discount_and_importance_weights(name):
    loss = build(name, replay=SAC["replay"]).loss
    assert float(loss.value_estimator.gamma) == pytest.approx(KINDS[name]["gamma"])
    assert (loss.weighted_terms, loss.weight_norm) == ("all", "mean")


def flat(params):
    return torch.cat([value.detach().flatten() for value in params.values(True, True)])


@pytest.mark.parametrize("name", ["qvalue_network", "encoder_network"])
def test_the_target_of_sac_follows_by_tau_at_every_update(name):
    sac = build("sac", optimizer={"learning_rate": 0.1})
    sac.extend(transitions(sac))
    online = getattr(sac.loss, f"{name}_params")
    target = getattr(sac.loss, f"target_{name}_params")
    assert torch.equal(flat(online), flat(target))
    expected = flat(target)
    for _ in range(2):
        sac.update()
        expected = 0.7 * expected + 0.3 * flat(online)
        torch.testing.assert_close(flat(target), expected)
    assert not torch.equal(flat(online), flat(target))


def test_the_target_of_spatial_q_is_copied_at_its_interval():
    spatial = build("spatial_q")
    spatial.extend(transitions(spatial))
    loss, equal = spatial.loss, []
    for _ in range(6):
        spatial.update()
        equal.append(
            torch.equal(flat(loss.value_network_params), flat(loss.target_value_network_params))
        )
    assert equal == [False, False, True, False, False, True]


@pytest.mark.parametrize(("name", "probability"), [("sac", 0.35), ("spatial_q", 0.45)])
def test_batches_are_augmented_with_the_configured_probability(name, probability):
    made = build(name, batch_size=400, replay={"name": "uniform"})
    made.extend(transitions(made))
    kind = SO2Augmentation if name == "sac" else RigidAugmentation
    (augmentation,) = made.replay.transform
    assert isinstance(augmentation, kind)
    assert augmentation.probability == probability
    twin = copy.deepcopy(made.replay._rng)
    original = made.replay.storage[made.replay.sample()["index"]]
    made.replay.set_rng(twin)
    is_moved = (made.sample()[keys.ACTION] != original[keys.ACTION]).any(dim=1).float().mean()
    assert 0.4 * probability < float(is_moved) < 1.3 * probability
    # an update learns from the augmented batch
    seen = []
    augmentation.register_forward_hook(lambda _, __, out: seen.append(out))
    made.loss.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    made.update()
    assert seen[0] is seen[1]


def test_the_order_and_kind_of_rigid_transforms_are_the_configured_ones():
    (augmentation,) = build("spatial_q").replay.transform
    assert (augmentation.transforms, augmentation.order) == ("cn", 6)
    plain = build("sac", rotation={"name": "none"})
    assert not len(plain.replay.transform)


def test_weight_decay_applies_to_the_networks_and_not_to_the_temperature(algorithm):
    config, optimizer = algorithm.config.optimizer, algorithm.optimizer
    decay = {
        id(p): group["weight_decay"] for group in optimizer.param_groups for p in group["params"]
    }
    for name, parameter in algorithm.loss.named_parameters():
        wanted = 0.0 if name == "log_alpha" else config.weight_decay
        assert decay[id(parameter)] == wanted, name
    assert all(group["lr"] == config.learning_rate for group in optimizer.param_groups)


def test_the_gradient_is_clamped_on_the_networks_and_not_on_the_temperature(algorithm):
    algorithm.update()
    for name, parameter in algorithm.loss.named_parameters():
        largest = float(parameter.grad.abs().max())
        if name == "log_alpha":
            assert largest > 1e-2
        else:
            assert largest <= 1.0001e-4, name


def test_the_replay_has_the_configured_size_batch_and_priorities():
    sac = build("sac")
    sampler = sac.replay.sampler
    assert isinstance(sampler, ExpertPrioritizedSampler)
    assert (sampler.alpha, sampler.beta, sampler.expert_bonus) == (0.9, 0.2, 2.5)
    assert (sac.replay.storage.max_size, sac.replay.batch_size) == (77, 6)
    spatial = build("spatial_q")
    assert isinstance(spatial.replay.sampler, SymmetricSampler)
    assert (spatial.replay.storage.max_size, spatial.replay.batch_size) == (55, 6)


@pytest.mark.parametrize("name", ["sac", "spatial_q"])
@pytest.mark.parametrize("replay", ["uniform", "prioritized", "symmetric"])
def test_every_algorithm_learns_from_every_replay(name, replay):
    made = build(name, replay={"name": replay})
    made.extend(transitions(made))
    before = flat(dict_of(made))
    made.update()
    assert not torch.equal(before, flat(dict_of(made)))


def dict_of(algorithm):
    return TensorDict({str(i): p.detach() for i, p in enumerate(algorithm.loss.parameters())})


def test_the_policy_explores_under_random_and_is_greedy_under_deterministic(algorithm):
    state = transitions(algorithm).select(*algorithm.observation_keys)

    def actions(kind):
        with set_exploration_type(kind):
            return [algorithm.policy(state.clone())[keys.ACTION] for _ in range(2)]

    assert not torch.equal(*actions(ExplorationType.RANDOM))
    first, second = actions(ExplorationType.DETERMINISTIC)
    assert torch.equal(first, second)


@pytest.mark.parametrize("policy_average", [0.0, 0.9])
def test_epsilon_decreases_over_its_updates(policy_average):
    spatial = build("spatial_q", optimizer={"policy_average": policy_average})
    spatial.extend(transitions(spatial))
    shares = []
    for _ in range(6):
        shares.append(float(spatial.explorer.epsilon))
        spatial.update()
    assert shares == pytest.approx([1.0, 0.8, 0.6, 0.4, 0.2, 0.2])


def test_collection_explores_and_evaluation_is_greedy(tmp_path):
    changes = {"demonstrations": 0, "total_updates": 3, "min_replay": 4, "video_episodes": 1}
    experiment = make_experiment(tmp_path, "cnn", {"name": "sac", "batch_size": 4}, **changes)
    found = []
    experiment.learner.policy.register_forward_hook(lambda *_: found.append(exploration_type()))
    experiment.run()
    steps = int(read_scalars(tmp_path / "run")["train/env_steps"].values[-1]) // 2
    assert found.count(ExplorationType.RANDOM) == steps == 4
    # three evaluations and the video
    assert found.count(ExplorationType.DETERMINISTIC) >= 4


@pytest.mark.parametrize("replay", ["uniform", "prioritized", "symmetric"])
def test_no_two_uses_of_randomness_draw_the_same_numbers(replay):
    spatial = build("spatial_q", replay={"name": replay})
    generators = {"replay": spatial.replay._rng}
    if replay == "symmetric":
        generators = dict(spatial.replay.sampler.generators)
    generators["augmentation"] = spatial.replay.transform[0]._generator
    generators["exploration"] = spatial.explorer.generator
    torch.manual_seed(spatial.problem.seed)
    draws = {name: tuple(torch.rand(4, generator=g).tolist()) for name, g in generators.items()}
    draws["weights"] = tuple(torch.rand(4).tolist())
    assert len(set(draws.values())) == len(draws), draws


@pytest.mark.parametrize(
    ("name", "network", "settings"),
    [
        ("sac", "cnn", {**tiny.FERM, "imitation": {"name": "successes"}}),
        ("rlpd", "cnn", {}),
        ("iql", "cnn", {}),
        ("bc", "asr", {}),
        ("flow", "equi", {}),
        ("spatial_q", "asr", {}),
    ],
)
def test_parts_are_made_of_what_they_are_given(name, network, settings):
    """None is read from the learner, whose constructor makes them one after the other."""
    learner = tiny.build(name, network, **settings)
    policy, loss, optimizer = learner.trained_policy, learner.loss, learner.optimizer
    inputs = {"config", "problem", "images", "vectors", "observation_keys"}
    for part in vars(learner).keys() - inputs:
        delattr(learner, part)
    networks = learner.make_networks(tiny.network_config(network))
    assert learner.make_policy(networks).out_keys == policy.out_keys
    assert learner.make_loss(networks).state_dict().keys() == loss.state_dict().keys()
    assert isinstance(learner.make_transforms(networks), list)
    assert learner.make_stages(loss)[0] is loss
    assert isinstance(learner.make_first_losses(policy, loss), list)
    updater = learner.make_target_updater(loss)
    assert updater is None or updater.loss_module is loss
    assert learner.make_optimizer(loss).param_groups
    assert learner.make_stepper(optimizer, loss).of(["loss_actor"]) == [optimizer]
    parts = learner.make_acting_transforms(), learner.make_exploration(), learner.make_replay()
    assert len(parts[2]) == 0
