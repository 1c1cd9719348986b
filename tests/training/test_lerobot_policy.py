"""Policies of LeRobot in our environments: with a stand-in, and with those that LeRobot trains."""

import json
import sys
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import ba_torchrl
from ba_torchrl.core.errors import ConfigError, MissingPackageError
from ba_torchrl.demonstrations import export_demonstrations
from ba_torchrl.demonstrations.episodes import play_seeds
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.training import lerobot_policy
from ba_torchrl.training.lerobot_policy import LeRobotPolicy, load_lerobot, result_of
from ba_torchrl.training.protocol import run_test
from tests.tasks.episodes import demonstrations

TASK, ENV = "close_loop/block_picking", {"obs_size": 64, "dpos": 0.02, "max_steps": 4}
INPUTS = {"observation.state": (2,), "observation.images.depth": (3, 64, 64)}


class Chunks(torch.nn.Module):
    """As LeRobot's policies: a queue of three actions, of its first observation and of noise."""

    def __init__(self, inputs=INPUTS):
        super().__init__()
        shapes = {name: SimpleNamespace(shape=shape) for name, shape in inputs.items()}
        self.config = SimpleNamespace(
            type="chunks",
            device="cpu",
            input_features=shapes,
            output_features={"action": SimpleNamespace(shape=(5,))},
        )
        self.layer = torch.nn.Linear(2, 5)
        self.reset()

    def reset(self):
        self.queue = deque()

    def select_action(self, batch):
        assert batch["observation.images.depth"].shape == (1, 3, 64, 64)
        assert batch["observation.images.depth"].max() <= 1
        assert batch["task"] == ["pick up the red block"]
        if not self.queue:
            mean = batch["observation.images.depth"].mean() + self.layer(batch["observation.state"])
            self.queue.extend((mean + 0.1 * torch.randn(1, 5)).tanh() for _ in range(3))
        return self.queue.popleft()


def policy_of(module=None):
    trained = SimpleNamespace(
        resolved_env=resolve_env(TASK, ENV),
        observed=None,
        cameras=None,
        updates=7,
        seed=3,
        card=None,
        values={},
    )
    torch.manual_seed(0)
    return LeRobotPolicy(module or Chunks(), lambda batch: batch, lambda a: a, trained, "a/folder")


def actions_of(policy, num_envs, seeds):
    env = ba_torchrl.make_vector_env(TASK, num_envs, parallel=False, **ENV)
    episodes = play_seeds(env, policy, seeds)
    env.close()
    return [episode["action"] for episode in episodes]


def test_an_episode_is_the_same_in_any_number_of_environments():
    policy = policy_of()
    alone = actions_of(policy, 1, [0, 1, 2])
    together = actions_of(policy, 2, [0, 1, 2])
    assert all(map(torch.equal, alone, together))
    assert not torch.equal(alone[0], alone[1])
    assert not torch.equal(alone[0][0], alone[0][1])  # of one chunk


def test_a_rollout_of_one_environment_and_a_test(tmp_path):
    policy = policy_of()
    env = policy.make_env(seed=0)
    rollout = env.rollout(9, policy)
    assert rollout["action"].shape == (4, 5)
    assert len(policy._rows) == 1
    vector = ba_torchrl.make_vector_env(TASK, 2, parallel=False, **ENV)
    test = run_test(vector, policy, policy.updates, episodes=2)
    result = result_of(policy, test)
    assert (result.label, result.seed, result.last.updates) == ("LeRobot chunks", 3, 7)
    assert len(policy._rows) <= 6
    vector.close()
    env.close()


def test_another_environment_or_checkpoint_is_refused():
    policy = policy_of()
    for changes, message in (({"obs_size": 32}, "64, 64"), ({"dpos": 0.05}, "dpos_m=0.02")):
        env = ba_torchrl.make(TASK, **{**ENV, **changes})
        with pytest.raises(ConfigError, match=message):
            env.rollout(1, policy)
        env.close()
    wider = Chunks({**INPUTS, "observation.state": (8,)})
    with pytest.raises(ConfigError, match=r"state of shape \[8\].* has \[2\]: the check"):
        policy_of(wider)
    with pytest.raises(ConfigError, match=r"rgb of shape .* does not have it: the check"):
        policy_of(Chunks({**INPUTS, "observation.images.rgb": (3, 64, 64)}))


@pytest.fixture
def checkpoint(tmp_path):
    folder = tmp_path / "act/checkpoints/000300/pretrained_model"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    (tmp_path / "act/checkpoints/last").symlink_to("000300")
    env = {"type": "ba_torchrl", "task": TASK, "parameters": ENV}
    values = {"dataset": {"root": None}, "env": env, "seed": 1}
    (folder / "train_config.json").write_text(json.dumps(values))
    return tmp_path / "act"


def raise_size_mismatch(folder):
    raise RuntimeError("Errors:\n\tsize mismatch")


def test_a_folder_that_is_no_checkpoint_is_one_sentence(checkpoint, monkeypatch):
    with pytest.raises(ConfigError, match=r"no checkpoint of LeRobot at .*nowhere"):
        load_lerobot(checkpoint / "nowhere")
    monkeypatch.setitem(sys.modules, "lerobot.policies.factory", None)
    with pytest.raises(MissingPackageError, match=r"pip install .*lerobot"):
        load_lerobot(checkpoint)
    configs = SimpleNamespace(PreTrainedConfig=SimpleNamespace(from_pretrained=raise_size_mismatch))
    for name, module in (("policies.factory", SimpleNamespace()), ("configs.policies", configs)):
        monkeypatch.setitem(sys.modules, f"lerobot.{name}", module)
    with pytest.raises(ConfigError, match=r"model: LeRobot cannot load .*: Errors: size mismatch$"):
        load_lerobot(checkpoint)
    place = checkpoint / "checkpoints/last/pretrained_model"
    trained = lerobot_policy._Training(place)
    assert (trained.updates, trained.resolved_env.config.dpos) == (300, 0.02)
    file = place / "train_config.json"
    file.write_text(json.dumps({"dataset": {"root": "exports/moved"}}))
    with pytest.raises(ConfigError, match=r"dataset.root names exports/moved, which is no export"):
        load_lerobot(checkpoint)
    file.write_text("{")
    with pytest.raises(ConfigError, match=r"train_config.json is damaged"):
        load_lerobot(checkpoint)
    file.unlink()
    with pytest.raises(ConfigError, match=r"train_config.json is missing"):
        load_lerobot(checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("act", "chunk_size=8 dim_model=32 n_heads=2 dim_feedforward=32"),
        (
            "diffusion",
            "horizon=8 down_dims=[32,64] num_inference_steps=2 drop_n_last_frames=0 "
            "use_group_norm=true",
        ),
    ],
)
def test_stock_policies_train_on_the_export_and_act(kind, settings, tmp_path, monkeypatch):
    pytest.importorskip("lerobot")
    from lerobot.scripts import lerobot_train

    episodes = demonstrations(TASK, 2, env=ENV)
    data = tmp_path / "picking"
    export_demonstrations(data, episodes, format="lerobot", task=TASK, env=ENV, seed=0)
    settings += f" type={kind} n_action_steps=4 pretrained_backbone_weights=null"
    settings += " device=cpu push_to_hub=false"
    words = [f"--dataset.repo_id=ba_torchrl/picking --dataset.root={data} --output_dir=out"]
    words += [f"--policy.{setting}" for setting in settings.split()]
    words += ["--steps=2 --batch_size=2 --num_workers=0 --env_eval_freq=2 --eval.n_episodes=2"]
    words += [f"--env.type=ba_torchrl --env.task={TASK} --eval.use_async_envs=false"]
    words += ["--env.discover_packages_path=lerobot_env_ba_torchrl"]
    monkeypatch.syspath_prepend(Path(ba_torchrl.__file__).parents[1] / "lerobot_env")
    monkeypatch.chdir(tmp_path)
    words = ["lerobot-train", *" ".join(words).split(), f"--env.parameters={json.dumps(ENV)}"]
    monkeypatch.setattr(sys, "argv", words)
    lerobot_train.main()
    assert len([*Path("out/eval").rglob("*.mp4")]) == 2  # its evaluation during the training
    acting = load_lerobot(tmp_path / "out")
    assert acting.updates == 2
    env = acting.make_env(seed=0)
    assert env.rollout(4, acting)["action"].isfinite().all()
    env.close()
    weights = tmp_path / "out/checkpoints/last/pretrained_model/model.safetensors"
    weights.write_bytes(weights.read_bytes()[:99])
    with pytest.raises(ConfigError, match=r"pretrained_model: LeRobot cannot load it: Safetensor"):
        load_lerobot(tmp_path / "out")
