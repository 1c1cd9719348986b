"""Trained policies: from a run, in a file with its result, and shipped."""

import json
import re
import shlex
import shutil
import sys
from contextlib import closing
from hashlib import sha256
from pathlib import Path

import pytest
import torch
from safetensors.torch import load, save
from tensordict import TensorDict
from torchrl.envs import StepCounter, TransformedEnv

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import header_texts
from ba_torchrl.record.results import PolicyTest, read_result
from ba_torchrl.record.statistics import mean_success
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import evaluation, policy as policies, protocol
from ba_torchrl.training.checkpoint import load as load_checkpoint
from ba_torchrl.training.experiment import Experiment
from docs import shipped as shipped_results
from tests.recipes import recipe
from tests.training.test_experiment import tiny


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a finished run."""
    config = tiny(tmp_path_factory.mktemp("policy"), video_episodes=0)
    Experiment(config, progress=False).run()
    return config.folder


def with_outcomes(*successes):
    """A test with these outcomes."""
    seeds = list(map(protocol.test_seed, range(len(successes))))
    lengths = [7] * len(successes)
    return PolicyTest(updates=6, seeds=seeds, successes=successes, lengths=lengths)


def observed(policy):
    """An observation of the policy's environment."""
    env = policy.make_env(seed=1)
    state = env.reset()
    env.close()
    return state


def test_the_policy_of_a_run_is_greedy_and_has_no_gradient(run):
    policy = ba_torchrl.load_policy(run, device=torch.device("cpu"))
    state = observed(policy)
    first, second = policy(state.clone()), policy(state.clone())
    assert policy.out_keys == ["action"]
    assert set(policy.in_keys) <= set(state.keys())
    assert not first["action"].requires_grad
    assert not policy.training
    torch.testing.assert_close(first["action"], second["action"], rtol=0, atol=0)
    config, _ = load_checkpoint(run)
    env = policy.make_env()
    assert env.config.model_copy(update={"seed": None}) == config.env.config
    env.rollout(2, policy)
    env.close()


@pytest.mark.slow  # of a minute
@pytest.mark.parametrize("task", ["close_loop/block_picking", "open_loop/block_stacking"])
def test_a_policy_is_exported_without_a_pass_before(task):
    policy = ba_torchrl.load_policy(task)
    with closing(policy.make_env(seed=0)) as env:
        seen = env.reset().select(*policy.in_keys)

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.policy = policy

        def forward(self, *entries):
            return self.policy(
                seen.select(*policy.in_keys).update(dict(zip(policy.in_keys, entries, strict=True)))
            )["action"]

    entries = tuple(seen[key] for key in policy.in_keys)
    exported = torch.export.export(Net(), entries, strict=True).module()
    torch.testing.assert_close(exported(*entries), policy(seen.clone())["action"])


def test_an_observation_without_what_the_policy_reads_is_named(run):
    policy = ba_torchrl.load_policy(run)
    state = TensorDict({"holding": torch.zeros(1, dtype=torch.bool)}, batch_size=[])
    with pytest.raises(ConfigError, match=r"reads depth, which is not observed: policy\.make_env"):
        policy(state)


SHIPPED = {"close_loop": "close_loop/block_picking", "open_loop": "open_loop/block_stacking"}


@pytest.fixture(scope="module")
def shipped():
    """The policies of `SHIPPED`, with 64 px each."""
    return {control: ba_torchrl.load_policy(task) for control, task in SHIPPED.items()}


@pytest.mark.parametrize(
    ("control", "changes", "message"),
    [
        ("open_loop", {"obs_size": 128}, r"heightmap of shape \[1, 64, 64\], and this is \[1, 1"),
        ("open_loop", {"in_hand_size": 32}, r"in_hand of shape \[1, 24, 24\], and this is \[1, 32"),
        ("open_loop", {"action_sequence": "pyxr"}, "the environment takes .*'pyxr'"),
        ("open_loop", {"half_rotation": False}, "the environment takes .*half_rotation=False"),
        ("close_loop", {"obs_size": 128}, r"depth of shape \[1, 64, 64\], and this is \[1, 128"),
        ("close_loop", {"obs_type": "vec"}, "reads depth, which is not observed"),
        ("close_loop", {"action_sequence": "xyzpr"}, "the environment takes .*'xyzpr'"),
        ("close_loop", {"dpos": 0.02}, "the environment takes .*dpos_m=0.02"),
    ],
)
def test_another_environment_than_in_training_is_refused(shipped, control, changes, message):
    policy = shipped[control]
    with closing(policy.make_env(**changes)) as env:
        with pytest.raises(ConfigError, match=f"{message}.*policy.make_env"):
            env.rollout(50, policy)
        with pytest.raises(ConfigError, match=message):
            policy.check_env(TransformedEnv(env, StepCounter()))
        if "environment takes" not in message:  # else it is not visible in an observation
            with pytest.raises(ConfigError, match=message):
                policy(env.reset())


def test_vectors_tests_and_commands_refuse_another_environment(shipped, capsys):
    policy, changes, message = shipped["close_loop"], {"dpos": 0.02}, "takes .*dpos_m=0.02"
    options = {**policy.env_config, **changes, "parallel": False}
    with closing(ba_torchrl.make_vector_env(policy.task, 1, **options)) as envs:
        with pytest.raises(ConfigError, match=message):
            envs.rollout(50, policy)
        with pytest.raises(ConfigError, match=message):
            evaluation.evaluate(envs, policy, 1, seed=0)
    with pytest.raises(SystemExit):
        recipe("play", policy.task, "policy=trained", "video=null", "env.dpos=0.02")
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"task": "close_loop/block_reaching"},
            "task close_loop/block_reaching, not close_loop/block_picking",
        ),
        ({"view_scale": 1.2}, "view_scale 1.2, not 1.5"),
        ({"robot": "panda", "max_steps": 2, "expert": True}, None),
    ],
)
def test_another_task_or_view_is_a_warning(shipped, changes, message, caplog):
    policy = shipped["close_loop"]
    made = {"task": policy.task, **policy.env_config, **changes}
    with closing(ba_torchrl.make(**made)) as env:
        for _ in range(2):
            env.rollout(1, policy)
    assert [record.message for record in caplog.records] == (
        [f"the policy was trained in another environment; here: {message}"] if message else []
    )


def test_a_policy_of_another_version_of_its_task_is_said_and_not_exported(
    run, tmp_path, monkeypatch, caplog
):
    policy, path = ba_torchrl.load_policy(run), tmp_path / "p.safetensors"
    monkeypatch.setattr(TASKS[policy.task], "expert_version", 3)
    result = policies.save_policy(policy, path, with_outcomes(1))
    assert (result.task_version, result.expert_version) == (0, 0)
    assert not caplog.records
    monkeypatch.setattr(TASKS[policy.task], "version", 1)
    for source in (run, path):
        policy = ba_torchrl.load_policy(source)
        with pytest.raises(ConfigError, match="its episodes are of version 1: train it again"):
            policies.check_version(policy)
    start = f"the policy was trained in version 0 of {policy.task}, which has version 1 here"
    assert [message.startswith(start) for message in caplog.messages] == [True, True]


def test_any_batch_shape_is_taken(shipped):
    policy = shipped["close_loop"]
    state = observed(policy)
    action = policy(state.clone())["action"]
    batch = policy(state.expand(2, 3).clone())["action"]
    torch.testing.assert_close(batch, action.expand(2, 3, -1))


def test_loading_leaves_the_draws_of_torch_alone(run):
    torch.manual_seed(5)
    expected = torch.rand(3)
    for source in (run, "close_loop/block_picking"):
        torch.manual_seed(5)
        ba_torchrl.load_policy(source)
        assert torch.equal(torch.rand(3), expected)
        assert torch.initial_seed() == 5


def test_actions_have_the_type_of_the_environments_under_autocast(shipped):
    for policy in shipped.values():
        with closing(policy.make_env(seed=0)) as env, torch.autocast("cpu", torch.bfloat16):
            env.rollout(1, policy)


def test_a_file_acts_like_the_run(run, tmp_path):
    policy = ba_torchrl.load_policy(run)
    trained = [weight.clone() for weight in policy.policy.state_dict().values()]
    policies.round_weights(policy)  # to float16, with 11 significant bits
    for weight, before in zip(policy.policy.state_dict().values(), trained, strict=True):
        torch.testing.assert_close(weight, before, rtol=2**-11, atol=2**-25)
    path = tmp_path / "p.safetensors"
    policy.versions = policy.versions._replace(expert=7)  # the run's result knows which took part
    result = policies.save_policy(policy, path, with_outcomes(1, 1, 0, 1))
    assert list(tmp_path.iterdir()) == [path]
    again = ba_torchrl.load_policy(path)
    state = observed(policy)
    torch.testing.assert_close(
        again(state.clone())["action"], policy(state.clone())["action"], rtol=0, atol=0
    )
    assert again.result == read_result(path) == result
    assert (result.last, result.best, result.protocol) == (*2 * [with_outcomes(1, 1, 0, 1)], 1)
    command = "ba-torchrl evaluate policy=p.safetensors episodes=4"
    assert policies.evaluate_command(path.name, result) == command
    result.config["plugins"] = ["mine", "yours.nets"]
    command += " 'plugins=[mine,yours.nets]'"
    assert policies.evaluate_command(path.name, result) == command
    trained = read_result(run)
    assert (result.trained_on.hardware, result.trained_on.versions) == (
        trained.hardware,
        trained.versions,
    )
    copy = policies.save_policy(again, tmp_path / "copy.safetensors", with_outcomes(0))
    assert copy.policy_file == result.policy_file
    assert (copy.last, copy.trained_on) == (with_outcomes(0), result.trained_on)
    for found in (result, copy):
        for name in ("env_steps", "demonstrations", "expert_labels", "expert_version", "seconds"):
            assert getattr(found, name) == getattr(trained, name), name
    assert again.env_config == policy.env_config


def test_a_policy_has_nothing_of_the_machine_of_its_training(run, tmp_path, monkeypatch):
    saved = json.loads((run / "config.json").read_text())
    own = {"threads": 1, "timeout_s": 9, "video_episodes": 7}
    env = {**saved["env"], "render": True}
    paths = {"demonstrations_path": str(tmp_path / "demos"), "demonstrations_mapping": "/m/a.yaml"}
    copy, path = tmp_path / "run", tmp_path / "p.safetensors"
    shutil.copytree(run, copy)
    (copy / "config.json").write_text(json.dumps({**saved, **own, "env": env}))
    monkeypatch.delenv("DISPLAY", raising=False)  # a window would be refused
    policy = ba_torchrl.load_policy(copy)
    assert "render" not in policy.env_config
    policy.config = policy.config.model_copy(update=paths)
    result = policies.save_policy(policy, path, with_outcomes(1))
    assert str(tmp_path).encode() not in path.read_bytes()
    gone = {*own, "device", "parallel", "run_dir", "resume", "start_method", "logger"}
    assert not result.config.keys() & gone
    assert "render" not in result.config["env"]
    assert {name: result.config[name] for name in paths} == {
        "demonstrations_path": "demos",
        "demonstrations_mapping": "a.yaml",
    }
    result.config["env"]["render"] = True  # as an earlier version wrote it
    path.write_bytes(save(load(path.read_bytes()), {"result": result.model_dump_json()}))
    observed(ba_torchrl.load_policy(path))


def test_a_checkpoint_is_loaded_without_a_replay_and_refused_if_it_is_too_small(run, tmp_path):
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    assert load_checkpoint(tmp_path)[1].replay.storage.max_size == 1
    saved = json.loads((run / "config.json").read_text())
    saved["network"]["width"] = 32.0
    (tmp_path / "config.json").write_text(json.dumps(saved))
    with pytest.raises(ConfigError, match=r"/checkpoint-\d+ does not hold the weights of its set"):
        ba_torchrl.load_policy(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"network": {"group_order": 100_000}}, "group_order: must be at most"),
        ({"network": {"n_hidden": 10**9}}, "n_hidden: must be at most"),
        ({"network": {"group_order": 32, "reflections": True}}, "group_order is at most 16 with"),
        (
            {"network": {"group_order": 32, "reflections": False, "n_hidden": 1024}},
            r"does not hold the weights of its settings, .* more than [\d,]+ parameters",
        ),
        ({"env": {"obs_size": 10**6}}, "obs_size: must be at most"),
        ({"env": {"max_steps": 10**30}}, "max_steps: must be at most"),
        ({"algorithm": {"replay": {"name": "prioritized", "capacity": 10**12}}}, "capacity: must"),
    ],
)
def test_absurd_sizes_in_a_file_are_refused_before_a_network_is_built(tmp_path, changes, message):
    whole = policies.shipped_file("close_loop/block_picking").read_bytes()
    path, saved = tmp_path / "p.safetensors", json.loads(header_texts(Path(), whole)["result"])
    for name, values in changes.items():
        saved["config"][name] |= values
    path.write_bytes(save(load(whole), {"result": json.dumps(saved)}))
    with pytest.raises(ConfigError, match=rf"(?s){path}.*{message}"):
        ba_torchrl.load_policy(path)


def test_what_is_no_policy_is_named(run, tmp_path):
    with pytest.raises(ConfigError, match="ships no policy of"):
        ba_torchrl.load_policy("bump/box_palletizing")
    with pytest.raises(ConfigError, match="no run folder and no file"):
        ba_torchrl.load_policy(tmp_path / "none")
    with pytest.raises(ConfigError, match="Did you mean 'close_loop/block_picking'"):
        ba_torchrl.load_policy("close_loop/block_pickng")
    path = tmp_path / "p.safetensors"
    path.touch()
    with pytest.raises(ConfigError, match=r"p.safetensors is not a whole safetensors file"):
        ba_torchrl.load_policy(path)
    policies.save_policy(ba_torchrl.load_policy(run), path, with_outcomes(1))
    saved, whole = json.loads(read_result(path).model_dump_json()), path.read_bytes()
    weights = load(whole)

    def loaded(**changes):
        path.write_bytes(save(weights, {"result": json.dumps({**saved, **changes})}))
        return ba_torchrl.load_policy(path)

    for elsewhere in (
        {"logger": "wandb"},
        {"collector": {"name": "ray"}},
        {"demonstrations_path": "nowhere"},
    ):
        loaded(config={**saved["config"], **elsewhere})
    with pytest.raises(ConfigError, match=r"uses the plugins \[antigravity\].*runs their code"):
        loaded(config={**saved["config"], "plugins": ["antigravity"]})
    assert "antigravity" not in sys.modules
    with pytest.raises(
        ConfigError, match=r"(?s)this version cannot use .*p.safetensors.*unknown .*'new'"
    ):
        loaded(config={**saved["config"], "new": 1})
    with pytest.raises(ConfigError, match=r"p.safetensors has no valid result: format"):
        loaded(format=1)
    with pytest.raises(ConfigError, match=r"no valid result: config: its task, 'close_loop/"):
        loaded(task="open_loop/block_stacking")
    wider = {**saved["config"]["network"], "width": 2 * saved["config"]["network"]["width"]}
    with pytest.raises(ConfigError, match="does not hold the policy of its result"):
        loaded(config={**saved["config"], "network": wider})
    loaded()
    for altered, reason in (
        (whole[:-100], "is not a whole safetensors file"),
        (whole[:-1] + bytes([whole[-1] ^ 1]), "was altered: it does not have the weights"),
        (save(weights), "weights without the result of their policy: .* `ba-torchrl export RUN`"),
    ):
        path.write_bytes(altered)
        with pytest.raises(ConfigError, match=reason):
            ba_torchrl.load_policy(path)


def test_a_file_that_is_replaced_while_it_is_read_is_one_of_the_two(tmp_path, monkeypatch):
    path, read = tmp_path / "p.safetensors", Path.read_bytes
    tasks = ["close_loop/block_picking", "close_loop/block_pushing"]
    first, second = (read(policies.shipped_file(task)) for task in tasks)
    path.write_bytes(first)

    def replaced_after(file):
        content = read(file)
        path.write_bytes(second)
        return content

    monkeypatch.setattr(Path, "read_bytes", replaced_after)
    assert ba_torchrl.load_policy(path).task == tasks[0]


def test_a_run_folder_may_have_the_ending_of_a_policy(run, tmp_path):
    (tmp_path / "a.safetensors").symlink_to(run)
    assert ba_torchrl.load_policy(tmp_path / "a.safetensors").updates


def test_an_export_that_stops_leaves_the_policy_before(run, tmp_path, monkeypatch):
    path, policy = tmp_path / "p.safetensors", ba_torchrl.load_policy(run)
    policies.save_policy(policy, path, with_outcomes(1))
    before = path.read_bytes()
    next(iter(policy.policy.parameters())).add_(1)

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("ba_torchrl.core.files.os.replace", stop)
    with pytest.raises(KeyboardInterrupt):
        policies.save_policy(policy, path, with_outcomes(0))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_two_files_of_an_earlier_version_are_loaded_and_the_command_that_converts_is_said(
    tmp_path, caplog
):
    shipped = ba_torchrl.load_policy("close_loop/block_picking")
    path, file = tmp_path / "old.safetensors", tmp_path / "old.json"
    path.write_bytes(save(load(policies.shipped_file(shipped.task).read_bytes())))
    card = {
        "format": 5,
        "policy_file": sha256(path.read_bytes()).hexdigest(),
        "config": shipped.result.config,
        "updates": shipped.updates,
        "task_version": 0,
        "success_rate": 0.9,
    }
    file.write_text(json.dumps(card))
    policy = ba_torchrl.load_policy(path)
    command = f"`ba-torchrl export {path} path=NEW.safetensors`"
    assert [command in message for message in caplog.messages] == [True]
    assert (policy.updates, policy.result) == (shipped.updates, None)
    for value, expected in zip(policy.parameters(), shipped.parameters(), strict=True):
        assert torch.equal(value, expected)
    policies.save_policy(policy, tmp_path / "new.safetensors", with_outcomes(1))
    new = ba_torchrl.load_policy(tmp_path / "new.safetensors").result
    assert (new.env_steps, new.trained_on) == (None, None)
    file.write_text(json.dumps({**card, "policy_file": "of other weights"}))
    with pytest.raises(ConfigError, match="does not have the weights"):
        ba_torchrl.load_policy(path)
    file.write_text(json.dumps({**card, "format": 4}))
    with pytest.raises(ConfigError, match="`ba-torchrl export RUN`"):
        ba_torchrl.load_policy(path)


def test_the_result_of_a_policy_is_read_without_its_weights(tmp_path):
    """Of a file of 64 GB, without any of its blocks."""
    source = policies.shipped_file("close_loop/block_picking")
    length, text = 2**36, json.dumps(header_texts(source))
    entry = {"dtype": "U8", "shape": [length], "data_offsets": [0, length]}
    header = f'{{"__metadata__": {text}, "weights": {json.dumps(entry)}}}'.encode()
    path = tmp_path / "large.safetensors"
    with path.open("wb") as file:
        file.write(len(header).to_bytes(8, "little") + header)
        file.truncate(8 + len(header) + length)
    assert read_result(path) == read_result(source)
    path.write_bytes((2**40).to_bytes(8, "little") + header)
    with pytest.raises(ConfigError, match="header too large"):
        read_result(path)


QUICK = (
    "close_loop/block_picking",
    "open_loop/improvise_house_building_2",
)


@pytest.mark.parametrize(
    "task",
    [
        pytest.param(task, marks=[] if task in QUICK else pytest.mark.slow)
        for task in policies.shipped_policies()
    ],
)
def test_a_shipped_policy_reaches_the_goal(task):
    """Twenty episodes; the result's interval is of hundreds: its lower end bounds the mean."""
    policy = ba_torchrl.load_policy(task)
    assert policy.task == task
    env = ba_torchrl.make_vector_env(task, 5, parallel=False, **policy.env_config)
    try:
        found = protocol.run_test(env, policy, policy.updates, 20)
    finally:
        env.close()
    assert found.success_rate >= mean_success([[policy.result.last]]).low - 0.2


def test_a_run_is_exported_evaluated_and_played_by_commands(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ("episodes=2", "num_envs=1", "parallel=false")
    recipe("export", str(run), *options)
    file = f"{ba_torchrl.load_policy(run).task.replace('/', '_')}.safetensors"
    assert f"policy  {file}, 0." in capsys.readouterr().out
    recipe("evaluate", file, *options)
    out = capsys.readouterr().out
    success = float(out.split("success_rate ")[1].split()[0])
    assert f"  in file   {success:.2f} (" in out  # the same episodes
    monkeypatch.setenv("HOME", str(tmp_path))
    recipe("export", str(run), "path=~/my files/p=1.safetensors", *options)
    out = capsys.readouterr().out
    check = shlex.split(out.split("  check   ")[1])
    assert check[2] == f"policy={tmp_path}/my files/p=1.safetensors"
    recipe(*check[1:])
    assert f"success_rate {success:.2f} (" in capsys.readouterr().out
    recipe("play", f"policy={file}", "video=film.gif")
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF")


def test_the_test_of_a_shipped_policy_is_written_into_its_file(tmp_path, monkeypatch):
    task, path = "close_loop/block_picking", tmp_path / "p.safetensors"
    monkeypatch.setattr(
        shipped_results, "play", lambda _, settings: with_outcomes(*[0, 1] * settings.episodes)
    )
    shutil.copy(policies.shipped_file(task), path)
    monkeypatch.setattr(shipped_results, "shipped_file", lambda _: path)
    before = read_result(path)
    assert shipped_results.is_tested(task)
    assert shipped_results.take(task, 50) == f"{task}: 0.500 over 100 episodes"
    after = read_result(path)
    assert (after.last.successes, after.best) == ([0, 1] * 50, after.last)
    assert (after.policy_file, after.trained_on) == (before.policy_file, before.trained_on)
    assert not shipped_results.is_tested(task)  # too few episodes
    shutil.copy(policies.shipped_file(task), path)
    monkeypatch.setattr(TASKS[task], "version", 1)
    assert not shipped_results.is_tested(task)


def test_a_shipped_policy_has_the_weights_and_the_number_of_its_result():
    for task in policies.shipped_policies():
        result = ba_torchrl.load_policy(task).result
        assert (result.task, result.trained_on is not None) == (task, True)
        assert result.last.is_citable
