"""TorchRL's parts around ours: the scripts of recipes/torchrl, and what docs/torchrl.md lists."""

import ast
import contextlib
import importlib
import importlib.util
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl import collectors, envs
from torchrl.checkpoint import Checkpoint
from torchrl.data import (
    LazyTensorStorage,
    MultiStep,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
)
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate
from torchrl.trainers import ReplayBufferTrainer

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.data import ImageCodecs, as_transitions
from tests.specs import slow_except

FOLDER = Path(__file__).parents[1] / "recipes" / "torchrl"
REACH = "close_loop/block_reaching"
TINY = {"demonstrations": 2, "num_envs": 2, "batch_size": 4, "eval_every": 2, "eval_episodes": 2}
RUNS = {
    "sacfd": {"task": REACH, "updates": 3, "width": 8},
    "rlpd": {"task": REACH, "steps": 3, "width": 8, "updates_per_step": 2},
    "sdqfd": {
        "num_objects": 2,
        "pretrain_updates": 1,
        "updates": 4,
        "width": 0.125,
        "num_rotations": 4,
    },
}
LOSSES = {"sacfd": "SACfDLoss", "rlpd": "REDQLoss", "sdqfd": "LevelDQNLoss"}


def script(name):
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recorded(module, name, monkeypatch):
    """Return a list that gets what the script's class or function ``name`` returns, and the
    parameters that it starts with."""
    make, found = getattr(module, name), []

    def call(*args, **options):
        made = make(*args, **options)
        parameters = dict(made.named_parameters()) if isinstance(made, torch.nn.Module) else {}
        found.append((made, {key: value.detach().clone() for key, value in parameters.items()}))
        return made

    monkeypatch.setattr(module, name, call)
    return found


@pytest.mark.parametrize("name", RUNS)
def test_a_script_trains_and_evaluates_alike_with_the_same_seed(
    name, monkeypatch, capsys, tmp_path
):
    module = script(name)
    losses = recorded(module, LOSSES[name], monkeypatch)
    replays = recorded(
        module, "OfflineToOnlineReplayBuffer" if name == "rlpd" else "make_replay", monkeypatch
    )
    storage = {"checkpoint": tmp_path / "run"} if name == "sacfd" else {}
    rates = [module.main(**TINY, **RUNS[name], **options) for options in ({}, storage)]
    assert rates[0] == rates[1]
    assert 0 <= rates[0] <= 1
    assert f"success_rate {rates[0]:.2f} over 2 episodes" in capsys.readouterr().out
    (one, start), (two, _) = ((dict(loss.named_parameters()), old) for loss, old in losses)
    assert all(torch.equal(one[key], two[key]) for key in one)
    assert sum(not torch.equal(one[key], start[key]) for key in one) > len(one) / 2
    replay, _ = replays[0]
    if name == "rlpd":
        assert len(replay.online_buffer) == 6
        assert replay.sample()[keys.IS_DEMONSTRATION].sum() == 2
    else:
        is_demonstration = replay.storage.column(keys.IS_DEMONSTRATION)
        assert is_demonstration.any()
        assert (~is_demonstration).sum() == 6  # three steps of two environments
        truncated = replay.storage.column((keys.NEXT, keys.TRUNCATED))
        assert truncated[~is_demonstration].tolist() == [name == "sacfd"] * 6  # by SACTrainer
    if storage:
        loss = losses[0][0]
        loss.load_state_dict({key: value * 0 for key, value in loss.state_dict().items()})
        Checkpoint(loss_module=loss).load(storage["checkpoint"], components=["loss_module"])
        assert all(torch.equal(one[key], two[key]) for key in one)


@pytest.mark.parametrize(
    "backend", ["threading", pytest.param("multiprocessing", marks=pytest.mark.slow)]
)
def test_a_pool_collects_the_same_demonstrations(backend, capsys):
    settings = {"episodes_per_env": 2, "obs_size": 32, "batch_size": 4}
    batch = script("async_pool").main(**settings, backend=backend)
    assert capsys.readouterr().out.endswith("transitions, success_rate 1.00\n")
    again = script("async_pool").main(**settings, backend="threading")
    assert (batch == again).all()


PUBLIC = {
    "ba_torchrl",
    *(
        f"ba_torchrl.{n}"
        for n in ("core", "data", "demonstrations", "envs", "modules", "objectives")
    ),
}


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_script_uses_public_names(path):
    text = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("ba_torchrl"):
            assert node.module in PUBLIC
            names = {alias.name for alias in node.names}
            assert names <= {*importlib.import_module(node.module).__all__}
        elif isinstance(node, ast.Import):
            assert {alias.name for alias in node.names} <= {"argparse", "ba_torchrl", "torch"}


STACKING = "open_loop/block_stacking"
TASKS = {REACH: {}, STACKING: {"num_objects": 2}}
BATCHED = {
    "SerialEnv": envs.SerialEnv,
    "SerialEnv, without buffers": partial(envs.SerialEnv, use_buffers=False),
    "ParallelEnv": partial(envs.ParallelEnv, mp_start_method="fork"),
    "ParallelEnv, without buffers": partial(
        envs.ParallelEnv, mp_start_method="fork", use_buffers=False
    ),
    "AsyncEnvPool": lambda _, makers: envs.AsyncEnvPool(makers, backend="threading"),
}


def makers(task, **options):
    """Return constructors of two environments with different seeds."""
    make = partial(ba_torchrl.make, task, obs_size=16, **TASKS[task], **options)
    return [partial(make, seed=seed) for seed in (3, 4)]


@pytest.mark.parametrize(
    ("task", "name"),
    slow_except([*product(TASKS, BATCHED)], [*product([REACH], BATCHED), (STACKING, "SerialEnv")]),
)
def test_environments_in_a_vector_of_torchrl(name, task):
    alone = [make() for make in makers(task)]
    expected = torch.stack([env.reset() for env in alone])
    (image,) = [key for key in alone[0].images if key != keys.IN_HAND]
    for env in alone:
        env.close()
    vector = BATCHED[name](2, makers(task))
    try:
        assert torch.equal(vector.reset()[image], expected[image])
        assert vector.rollout(3, break_when_any_done=False).shape == (2, 3)
    finally:
        vector.close()


def with_transform(make, transform):
    return envs.TransformedEnv(make(), transform)


def test_a_codec_is_the_same_inside_and_around_a_vector_of_torchrl():
    plain = makers(REACH)
    with contextlib.closing(plain[0]()) as env:
        codecs = [ImageCodecs(env.images) for _ in range(3)]
    inside = [partial(with_transform, make, codecs[i]) for i, make in enumerate(plain)]
    vectors = [
        envs.ParallelEnv(2, inside, mp_start_method="fork"),
        envs.TransformedEnv(envs.ParallelEnv(2, plain, mp_start_method="fork"), codecs[2]),
    ]
    first, second = (vector.rollout(2) for vector in vectors)
    for vector in vectors:
        vector.close()
    for images in (first["depth"], first["next", "depth"]):
        assert torch.equal(codecs[2](TensorDict(depth=images.clone()))["depth"], images)
    assert torch.equal(first["depth"][:, 0], second["depth"][:, 0])


COLLECTORS = {
    "Collector": lambda make: collectors.Collector(make[0], frames_per_batch=6, total_frames=12),
    "MultiSyncCollector": lambda make: collectors.MultiSyncCollector(
        make, frames_per_batch=6, total_frames=12
    ),
    "MultiAsyncCollector": lambda make: collectors.MultiAsyncCollector(
        make, frames_per_batch=6, total_frames=12
    ),
    "AsyncBatchedCollector": lambda make: collectors.AsyncBatchedCollector(
        make,
        policy=TensorDictModule(
            lambda holding: torch.zeros(len(holding), 5), ["holding"], ["action"]
        ),
        frames_per_batch=6,
        total_frames=12,
        env_backend="threading",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COLLECTORS)
def test_a_collector_of_torchrl_fills_a_replay(name):
    (image,) = (env := makers(REACH)[0]()).images
    env.close()
    collector = COLLECTORS[name](makers(REACH))
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(50), batch_size=4)
    try:
        for data in collector:
            replay.extend(as_transitions(data, [image], is_demonstration=False))
    finally:
        collector.shutdown()
    assert len(replay) == 12
    assert replay.sample()[image].shape == (4, 1, 16, 16)


STOCK_SCRIPT = """
import sys
import gymnasium

env = gymnasium.make(sys.argv[1], expert=True, seed=0)
for _ in range(3):
    _, info = env.reset()
    is_done = False
    while not is_done:
        *_, terminated, truncated, info = env.step(info["expert_action"])
        is_done = terminated or truncated
env.close()
"""


def test_a_script_for_gymnasium_is_measured_by_the_success_flag(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(FOLDER.parent)
    stock_scripts = importlib.import_module("stock_scripts")
    monkeypatch.setattr(stock_scripts, "WINDOW", 2)
    monkeypatch.setenv(stock_scripts.LOG, "")  # restored at the end
    path, log = tmp_path / "script.py", tmp_path / "log.jsonl"
    path.write_text(STOCK_SCRIPT)
    name = "BulletArm/CloseLoopBlockReaching-StateDense-v0"
    monkeypatch.setattr("sys.argv", ["", name, "--log", str(log), "--", str(path), "ENV"])
    stock_scripts.main()
    _, _, row = capsys.readouterr().out.splitlines()
    assert row.split(" | ")[1] == "1.00 of 2"
    assert len(log.read_text().splitlines()) == 3


def test_multi_step_of_torchrl_loses_the_end_inside_its_window():
    ends = torch.tensor([False, False, True])[None, :, None]
    reward = torch.tensor([0.0, 0.0, 1.0])[None, :, None]
    state = torch.arange(4.0)[None, :, None]
    following = {"observation": state[:, 1:], "reward": reward, "done": ends, "terminated": ends}
    steps = TensorDict({"observation": state[:, :-1], "next": following}, [1, 3])
    steps = MultiStep(gamma=0.5, n_steps=3)(steps)
    assert steps["next", "reward"].flatten().tolist() == [0.25, 0.5, 1.0]  # all hold the end
    assert steps["next", "terminated"].flatten().tolist() == [False, False, True]


def test_the_hard_update_of_torchrl_copies_a_step_late():
    actor = QValueActor(torch.nn.Linear(1, 2, bias=False), action_space="categorical")
    loss = DQNLoss(actor, action_space="categorical", delay_value=True)
    updater, copied = HardUpdate(loss, value_network_update_interval=3), []
    (weight,), (target,) = loss.parameters(), loss.target_value_network_params.values(True, True)
    for step in range(1, 13):
        weight.data += 1
        updater.step()
        copied += [step] if torch.equal(weight, target) else []
    assert copied == [4, 8, 12]


def test_a_maximum_value_writer_of_torchrl_with_a_nested_key_is_restored_unusable(tmp_path):
    def make():
        writer = TensorDictMaxValueWriter(rank_key=("next", "reward"))
        return TensorDictReplayBuffer(storage=LazyTensorStorage(4), writer=writer)

    data, buffer, restored = TensorDict({"next": {"reward": [[1.0], [2.0]]}}, [2]), make(), make()
    buffer.extend(data.clone())
    buffer.dumps(tmp_path)
    restored.loads(tmp_path)
    with pytest.raises(KeyError, match="Only NestedKeys are supported"):
        restored.extend(data.clone())


def test_the_replay_trainer_of_torchrl_truncates_every_step():
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(5), batch_size=5)
    batch = TensorDict({"next": {"truncated": torch.zeros(5, 1, dtype=torch.bool)}}, [5])
    ReplayBufferTrainer(replay, flatten_tensordicts=True).extend(batch)
    assert replay["next", "truncated"].all()
