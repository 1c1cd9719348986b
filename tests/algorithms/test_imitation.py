"""Behaviour cloning: of close-loop and open-loop policies, and as the initialisation of SAC."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.logging import read_scalars
from tests.algorithms.tiny import OPEN, build, make_experiment, problem, transitions


def losses(folder, name):
    return read_scalars(folder / "run")[f"train/{name}"].values


@pytest.mark.parametrize(
    ("network", "changes"),
    [("cnn", {}), pytest.param("equi", {}, marks=pytest.mark.slow), ("asr", OPEN)],
    ids=["close_loop cnn", "close_loop equi", "open_loop asr"],
)
def test_behaviour_cloning_learns_without_a_step_of_the_environment(tmp_path, network, changes):
    made = make_experiment(
        tmp_path,
        network,
        {"name": "bc", "batch_size": 16},
        **changes,
        total_updates=40,
        eval_every=40,
    )
    assert made.run().updates == 40
    found = losses(tmp_path, "loss_bc")
    assert found[-5:].mean() < 0.9 * found[:5].mean()
    assert losses(tmp_path, "env_steps")[-1] == 0
    assert made.learner.replay.storage.column(keys.IS_DEMONSTRATION).all()


@pytest.mark.parametrize("known", [3, 4, None])
def test_moves_that_are_not_known_are_the_imitated_action(known):
    learner = build("bc", "asr", on=problem("asr", equal_moves=3))
    data = transitions(learner)
    data[keys.NEXT, keys.FAULT] = torch.zeros(len(data), 1, dtype=torch.bool)
    if known:
        data[keys.EXPERT_MOVES] = torch.rand(len(data), known, 4)
    stored = learner.to_transitions(data, is_demonstration=True)
    repeated = data[keys.ACTION][:, None].expand(-1, 3, -1)
    assert torch.equal(
        stored[keys.TARGET_MOVES], data[keys.EXPERT_MOVES] if known == 3 else repeated
    )


def test_demonstrations_of_the_open_loop_are_on_the_grid(tmp_path):
    learner = make_experiment(tmp_path, "asr", {"name": "bc"}, **OPEN).learner
    action = torch.tensor([0.0, 0.4512, 0.0123, 0.3])
    nearest = learner.nearest_action(action)
    assert not torch.equal(nearest, action)
    assert torch.equal(learner.nearest_action(nearest), nearest)


@pytest.mark.parametrize("algorithm", ["bc", "dagger"])
def test_the_imitated_action_is_transformed_with_the_scene(algorithm):
    """The images show a spot at the imitated position, and the executed action is elsewhere."""
    learner = build(algorithm, "asr", rotation={"name": "cn", "order": 4}, batch_size=16)
    data = transitions(learner)
    size = data["heightmap"].shape[-1]
    rows, columns = torch.arange(len(data)) + 2, 20 - torch.arange(len(data)) // 2
    target = data[keys.ACTION].clone()
    for i, low, high in ((1, 0.25, 0.65), (2, -0.2, 0.2)):
        target[:, i] = low + (high - low) * ((rows, columns)[i - 1] + 0.5) / size
    data[keys.TARGET_ACTION] = target
    data["heightmap"] = torch.zeros_like(data["heightmap"])
    data["heightmap"][torch.arange(len(data)), 0, rows, columns] = 0.1
    learner.extend(data)
    batch = learner.sample()
    spots = batch["heightmap"].flatten(1).argmax(dim=1)
    shown = torch.stack([spots // size, spots % size], dim=1)
    target = batch[keys.TARGET_ACTION][:, 1:3]
    chosen = ((target - torch.tensor([0.25, -0.2])) / 0.4 * size).floor().long()
    assert torch.equal(chosen, shown)
    stored = {(int(row), int(column)) for row, column in zip(rows, columns, strict=True)}
    assert any(tuple(place) not in stored for place in shown.tolist())


@pytest.mark.parametrize("algorithm", ["bc", "dagger"])
def test_the_imitated_displacement_is_rotated_with_the_image(algorithm):
    """The images show a spot in the direction of the imitated displacement."""
    rotation = {"name": "sampled", "probability": 1.0}
    learner = build(algorithm, "cnn", rotation=rotation, batch_size=16)
    data = transitions(learner)
    angle = torch.arange(len(data)) * 0.2
    data[keys.TARGET_ACTION][:, 1:3] = 0.5 * torch.stack([angle.cos(), angle.sin()], dim=1)
    size = data[keys.DEPTH].shape[-1]
    rows, columns = (size / 2 + 20 * torch.stack([angle.cos(), angle.sin()])).long()
    data[keys.DEPTH] = torch.zeros_like(data[keys.DEPTH])
    data[keys.DEPTH][torch.arange(len(data)), 0, rows, columns] = 1.0
    learner.extend(data)
    batch = learner.sample()
    spots = batch[keys.DEPTH].flatten(1).argmax(dim=1)
    shown = torch.stack([spots // size, spots % size], dim=1) + 0.5 - size / 2
    imitated = batch[keys.TARGET_ACTION][:, 1:3]
    assert (torch.cosine_similarity(shown, imitated) > 0.99).all()
    torch.testing.assert_close(imitated.norm(dim=1), torch.full((16,), 0.5))
    found = torch.atan2(imitated[:, 1], imitated[:, 0]) % (2 * torch.pi)
    assert ((found[:, None] - angle).abs().amin(dim=1) > 0.01).any()


def test_behaviour_cloning_is_the_pretraining_of_sac(tmp_path):
    init = {"name": "bc", "updates": 30}
    algorithm = {"name": "sac", "init": init, "replay": {"name": "prioritized"}}
    made = make_experiment(tmp_path, "cnn", algorithm, total_updates=32, eval_every=32)
    learner = made.learner
    critic = learner.loss.qvalue_network_params.clone()
    state, taken = {}, []
    minimize = learner.minimize

    def record(batch, stages):
        if learner.updates == 30:
            state["critic"] = learner.loss.qvalue_network_params.clone()
            state["error"] = demonstration_error(learner)
        scalars = minimize(batch, stages)
        taken.append("loss_bc" in scalars)
        return scalars

    learner.minimize = record
    before = []
    on_demonstrations = learner.on_demonstrations

    def measure(episodes):
        on_demonstrations(episodes)
        before.append(demonstration_error(learner))

    learner.on_demonstrations = measure
    made.run()
    assert taken == [True] * 30 + [False] * 2
    assert state["error"] < 0.7 * before[0]
    assert (state["critic"] == critic).all()
    assert not (learner.loss.qvalue_network_params == critic).all()


@pytest.mark.parametrize("name", ["sac", "rlpd", "iql"])
def test_any_actor_is_initialised_and_nothing_else(name):
    learner = build(name, init={"name": "bc", "updates": 1}, batch_size=6)
    learner.extend(transitions(learner))
    before = {key: p.detach().clone() for key, p in learner.loss.named_parameters()}
    scalars = learner.update()
    assert set(scalars.keys()) == ({"loss_bc"} if name == "iql" else {"loss_bc", "entropy"})
    assert learner.updates == 1
    after = learner.loss.named_parameters()
    changed = {key for key, p in after if not torch.equal(p, before[key])}
    assert changed
    assert all(key.startswith("actor_network") for key in changed)
    learner.update()
    assert learner.updates == 2


@pytest.mark.parametrize(
    ("network", "algorithm", "changes"),
    [
        ("cnn", {"name": "bc"}, {}),
        ("asr", {"name": "bc"}, OPEN),
        ("cnn", {"name": "sac", "init": {"name": "bc", "updates": 1}}, {}),
    ],
    ids=["close_loop", "open_loop", "initialisation"],
)
def test_the_expert_is_imitated_in_every_state_of_demonstrations_with_noise(
    tmp_path, network, algorithm, changes
):
    settings = {"total_updates": 2, "eval_every": 2, **changes, "demonstrations_noise": 0.5}
    made = make_experiment(tmp_path, network, algorithm, **settings)
    learner, imitated, episodes = made.learner, [], []
    first = [loss for updates, loss in learner.first_losses if updates]
    (loss,) = first or [learner.loss]
    key = loss.tensor_keys.action
    assert key == keys.TARGET_ACTION
    loss.register_forward_pre_hook(lambda _, args: imitated.append(args[0][key].clone()))
    store = learner.on_demonstrations
    learner.on_demonstrations = lambda each: (episodes.extend(each), store(each))
    made.run()
    played = torch.cat(episodes)
    assert not played[keys.IS_EXPERT].all()
    stored = learner.replay.storage[: len(played)]
    assert stored[keys.IS_DEMONSTRATION].all()
    torch.testing.assert_close(stored[key], played[keys.EXPERT_ACTION])
    assert len(imitated) == (1 if first else 2)
    for label in torch.cat(imitated):
        assert (stored[key] == label).all(dim=-1).any()


@pytest.mark.parametrize(
    ("network", "algorithm", "changes", "counted"),
    [
        ("cnn", {"name": "sac"}, {}, "labelled"),
        pytest.param("cnn", {"name": "rlpd"}, {}, "all", marks=pytest.mark.slow),
        ("cnn", {"name": "iql", "replay": {"name": "symmetric"}}, {}, "all"),
        pytest.param(
            *("asr", {"name": "spatial_q", "imitation": {"name": "none"}}, OPEN, "all"),
            marks=pytest.mark.slow,
        ),
        ("asr", {"name": "spatial_q"}, OPEN, "expert's"),
    ],
    ids=["sac", "rlpd", "iql", "dqn", "sdqfd"],
)
def test_what_of_demonstrations_with_noise_counts_as_demonstrated(
    tmp_path, network, algorithm, changes, counted
):
    """Random actions as well, unless the loss would imitate them."""
    settings = {"demonstrations_noise": 0.5, "min_replay": 10_000, **changes}
    experiment = make_experiment(tmp_path, network, algorithm, **settings, pretrain_updates=2)
    learner, episodes = experiment.learner, []
    store = learner.on_demonstrations
    learner.on_demonstrations = lambda each: (episodes.extend(each), store(each))
    experiment.run()
    played = torch.cat(episodes)
    expert = played[keys.IS_EXPERT]
    assert 0 < expert.sum() < len(expert)
    if counted == "labelled":
        stored = learner.replay.storage[:]
        assert stored[keys.IS_DEMONSTRATION].all()
        torch.testing.assert_close(stored[keys.TARGET_ACTION], played[keys.EXPERT_ACTION])
        torch.testing.assert_close(stored[keys.ACTION], played[keys.ACTION])
        return
    assert keys.TARGET_ACTION not in learner.replay.storage[:]
    number = len(played) if counted == "all" else int(expert.sum())
    assert learner.replay.num_demonstrations == number
    assert len(learner.replay) == len(played)


def test_a_cloned_policy_explores():
    """Without the entropy term, its standard deviation tends to zero."""

    def entropy(weight):
        steps = {"batch_size": 24, "optimizer": {"learning_rate": 3e-3}}
        learner = build("sac", init={"name": "bc", "entropy_weight": weight}, **steps)
        learner.extend(transitions(learner))
        return [float(learner.update()["entropy"]) for _ in range(60)][-1]

    explores, collapses = entropy(0.03), entropy(1e-9)
    assert explores > collapses + 3
    assert explores > -5


def demonstration_error(learner):
    """Return the greedy policy's mean squared error on the demonstrations."""
    data = learner.replay.storage[:]
    data = data[data[keys.IS_DEMONSTRATION][:, 0]]
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        seen = data.select(*learner.observation_keys)
        return float((learner.policy(seen)[keys.ACTION] - data[keys.ACTION]).square().mean())


@pytest.mark.parametrize(
    ("network", "algorithm", "changes", "message"),
    [
        ("cnn", {"name": "bc"}, {"demonstrations": 0}, "learns from demonstrations only"),
        ("cnn", {"name": "sac", "init": {"name": "bc"}}, {}, "500 first updates"),
        ("cnn", {"name": "bc", "replay": {"name": "prioritized"}}, {}, "replay"),
        ("asr", {"name": "bc"}, {}, "network 'asr' is for open_loop"),
        ("cnn", {"name": "flow"}, {"demonstrations": 0}, "learns from demonstrations only"),
        ("cnn", {"name": "flow", "horizon": 2, "executed": 3}, {}, r"executed \(3\) must be at"),
        ("cnn", {"name": "flow", "rotation": {"name": "stored"}}, {}, "rotation.name 'stored'"),
        ("asr", {"name": "flow"}, OPEN, "algorithm 'flow' learns close_loop tasks"),
        ("cnn", {"name": "dagger", "rotation": {"name": "cn"}}, {}, "rotation.name: 'cn'"),
        ("asr", {"name": "bc", "rotation": {"name": "sampled"}}, OPEN, "rotation.name: 'sampled'"),
    ],
)
def test_what_cannot_run_is_refused(tmp_path, network, algorithm, changes, message):
    with pytest.raises(ConfigError, match=message):
        make_experiment(tmp_path, network, algorithm, **changes)
