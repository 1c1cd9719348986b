"""Tasks, robots, observations, networks and algorithms from a user's own module.

What registers runs in processes of its own: a registered task stays registered.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from ba_torchrl import cli, make_vector_env
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.plugins import import_modules
from tests.fresh import run_script

ROOT = Path(__file__).parents[2]
PLUGINS = ("my_tasks", "my_learning")
PLUGIN = "plugins=[my_tasks,my_learning]"
GYM_ID = "BulletArm/MineReachNear-v0"
SMALL = "obs_size=16, seed=0, max_steps=3"


@pytest.fixture
def folder(tmp_path):
    """A folder outside the repository that holds the plugins."""
    for name in PLUGINS:
        shutil.copy(Path(__file__).parent / f"{name}.py", tmp_path)
    return tmp_path


def run(folder, *command, check=True):
    """Run Python in a folder, where the package itself is installed; return the process."""
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    if check:
        assert done.returncode == 0, done.stderr[-3000:]
    return done


def last_line(done):
    return json.loads(done.stdout.splitlines()[-1])


def test_the_parts_of_a_plugin_are_known_after_the_import_and_runs_record_it(folder):
    code = f"""
import json, ba_torchrl, my_tasks, my_learning
from ba_torchrl.training.config import ExperimentConfig

env = ba_torchrl.make("mine/reach_near", robot="mine/kuka", expert=True, {SMALL})
robot = type(env.scene.robot).__name__ if env.reset() is not None else None
print(json.dumps([robot, env.task_class.__name__, "mine/reach_near" in ba_torchrl.list_tasks()]))
for task, observations, network in (
    ("mine/reach_near", [], "mine/flat"),
    ("close_loop/block_reaching", ["mine/opening"], "cnn"),
):
    config = ExperimentConfig.parse(
        {{
            "task": task,
            "env": {{"obs_size": 16, "observations": observations}},
            "algorithm": {{"name": "sac"}},
            "network": {{"name": network}},
        }}
    )
    print(json.dumps(config.plugins))

import gymnasium
from ba_torchrl.tasks.base import TASKS
print(json.dumps(gymnasium.spec({GYM_ID!r}).kwargs))
TASKS.register("mine_reach/near")(my_tasks.ReachNear)
"""
    done = run_script(folder, code, check=False)
    known, *recorded, kwargs = map(json.loads, done.stdout.splitlines()[-4:])
    assert known == ["MyKuka", "ReachNear", True]
    assert recorded == [list(PLUGINS), ["my_tasks"]]
    assert kwargs == {"task": "mine/reach_near", "register_modules": ["my_tasks"]}
    assert "'mine/reach_near' and 'mine_reach/near' have the same Gymnasium id" in done.stderr


@pytest.mark.slow
def test_workers_of_gymnasium_import_the_module_of_the_task(folder):
    code = f"""
import json, gymnasium, my_tasks
env = gymnasium.make_vec(
    {GYM_ID!r}, 2, vectorization_mode="async", vector_kwargs={{"context": "spawn"}}, {SMALL}
)
observation, info = env.reset(seed=[0, 1])
env.close()
print(json.dumps(observation["depth"].shape))
"""
    assert last_line(run(folder, "-c", code)) == [2, 1, 16, 16]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "option", "key", "shape"),
    [
        ("mine/reach_near", "robot='mine/kuka'", "depth", [1, 3, 1, 16, 16]),
        ("close_loop/block_reaching", "observations=['mine/opening']", "opening", [1, 3, 1]),
    ],
)
def test_spawned_workers_import_the_modules_of_what_is_named(folder, task, option, key, shape):
    code = f"""
import json, ba_torchrl, my_tasks
env = ba_torchrl.make_vector_env("{task}", 1, {option}, {SMALL})
rollout = env.rollout(3)
env.close()
print(json.dumps(list(rollout["{key}"].shape)))
"""
    assert last_line(run(folder, "-c", code)) == shape


IN_MAIN = f"""
import json, ba_torchrl
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.close_loop.block_reaching import BlockReaching


@TASKS.register("mine/here")
class Here(BlockReaching):
    goal_distance_m = 0.02


@TASKS.register("mine/here")
class Here(BlockReaching):  # the cell of a notebook, run a second time
    goal_distance_m = 0.01


def play(**options):
    env = ba_torchrl.make_vector_env("mine/here", 1, {SMALL}, **options)
    shape = list(env.rollout(2)["depth"].shape)
    env.close()
    return shape
"""


def test_a_task_of_a_notebook_is_refused_in_spawned_workers(folder):
    code = f"""del __file__  # as in a notebook
{IN_MAIN}
from ba_torchrl.core.errors import ConfigError
message = ""
try:
    play()
except ConfigError as error:
    message = str(error)
print(json.dumps([message, play(parallel=False), play(start_method="fork")]))
"""
    message, *shapes = last_line(run_script(folder, code))
    assert "'mine/here' is defined in a notebook" in message
    assert "move it to a module" in message
    assert shapes == [[1, 2, 1, 16, 16]] * 2


def test_a_task_of_a_script_and_the_modules_of_robot_and_options_reach_its_workers(folder):
    (folder / "extra.py").write_text("import os\nopen(f'seen-{os.getpid()}', 'w').close()\n")
    code = f"""{IN_MAIN}
if __name__ == "__main__":
    import my_tasks

    print(json.dumps(play(robot="mine/kuka", register_modules=["extra"])))
"""
    assert last_line(run_script(folder, code)) == [1, 2, 1, 16, 16]
    assert len(list(folder.glob("seen-*"))) == 2


@pytest.mark.slow
def test_a_module_that_workers_cannot_import_is_named(monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "hidden_name", ModuleType("hidden_name"))
    options = {"register_modules": ["hidden_name"], "obs_size": 16, "max_restarts": 0}
    with pytest.raises(RuntimeError, match="ended with exit code 1"):
        make_vector_env("close_loop/block_reaching", 1, **options)
    error = capfd.readouterr().err
    assert "cannot import the plugin 'hidden_name'" in error
    assert "PYTHONPATH" in error


def install(folder, name, module):
    """Write what an installed package leaves that declares a plugin."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[ba_torchrl.plugins]\n{name} = {module}\n")


BROKEN = {
    "refusing": ("raise RuntimeError('no\\nlicence')", "RuntimeError: no licence"),
    "exiting": ("import sys\nsys.exit(0)", "SystemExit: 0"),
    "unfinished": ("def f(:", "SyntaxError: invalid syntax"),
    "incomplete": ("import no_such_package", "ModuleNotFoundError: No module named"),
}
"""Plugins that cannot be imported: their content, and a part of the message."""


def test_installed_plugins_are_found_and_broken_ones_do_not_stop_the_others(tmp_path):
    packages = tmp_path / "site-packages"
    packages.mkdir()
    shutil.copy(Path(__file__).parent / "my_tasks.py", packages)
    for name, (content, _) in BROKEN.items():
        (packages / f"{name}_plugin.py").write_text(content)
        install(packages, name, f"{name}_plugin")
    install(packages, "good", "my_tasks")
    code = "import json, ba_torchrl; print(json.dumps(ba_torchrl.list_tasks()))"
    done = run_script(tmp_path, code, (packages,))
    assert "mine/reach_near" in last_line(done)
    assert done.stderr.count("PluginWarning") == len(BROKEN)
    for name, (_, message) in BROKEN.items():
        start = f"plugin {name!r} ({name}_plugin) of {name} is not loaded: {message}"
        assert start in done.stderr
        assert f"{name}_plugin.py, line " in done.stderr


@pytest.mark.parametrize("name", BROKEN)
def test_a_plugin_that_cannot_be_imported_is_named_with_its_error(tmp_path, monkeypatch, name):
    content, message = BROKEN[name]
    (tmp_path / f"{name}_plugin.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError) as raised:
        import_modules([f"{name}_plugin"])
    text = str(raised.value)
    assert text.startswith(f"cannot import the plugin '{name}_plugin': {message}")
    assert f"{name}_plugin.py, line " in text
    assert "\n" not in text


TRAINING = (
    "task=mine/reach_near",
    "algorithm=mine/sac",
    "network=mine/flat",
    "network.hidden=4",
    "env.robot=mine/kuka",
    "env.obs_size=16",
    "env.max_steps=5",
    "algorithm.rotation.name=none",
    "algorithm.batch_size=4",
    "demonstrations=2",
    "total_updates=4",
    "eval_every=2",
    "eval_episodes=2",
    "final_eval_episodes=2",
    "num_envs=2",
    "video_episodes=0",
)


@pytest.mark.slow
def test_the_recipes_take_a_plugin(folder):
    recipes = ROOT / "recipes"
    out = run(folder, recipes / "train.py", PLUGIN, *TRAINING, "run_dir=runs/one").stdout
    assert "over 2 episodes" in out
    config = json.loads((folder / "runs/one/config.json").read_text())
    assert config["plugins"] == list(PLUGINS)
    result = json.loads((folder / "runs/one/result.json").read_text())
    assert result["label"] == "mine/sac mine/flat"
    assert result["config"]["network"] == {"name": "mine/flat", "vector_keys": [], "hidden": 4}
    assert result["config"]["algorithm"]["gamma"] == 0.9

    evaluate = (recipes / "evaluate.py", "policy=runs/one", "episodes=2")
    assert "over 2 episodes of mine/reach_near" in run(folder, *evaluate, PLUGIN).stdout
    done = run(folder, *evaluate, check=False)
    assert "runs/one/config.json uses the plugins [my_tasks,my_learning]" in done.stderr
    assert f"add '{PLUGIN}'" in done.stderr

    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    again = (recipes / "evaluate.py", PLUGIN, f"policy={folder}/runs/one", "episodes=1")
    done = run(elsewhere, *again, check=False)
    assert "cannot import the plugin 'my_tasks'" in done.stderr


@pytest.mark.slow
def test_a_benchmark_with_a_plugin_runs_its_jobs(folder):
    arguments = [
        PLUGIN,
        "tasks=[mine/reach_near]",
        "algorithms=[mine/sac]",
        "networks=[mine/flat]",
        "seeds=1",
        "folder=grid",
        "~network.precision",
        *(text for text in TRAINING if not text.startswith(("task=", "algorithm=", "network="))),
    ]
    out = run(folder, ROOT / "recipes" / "benchmark.py", *arguments).stdout
    assert "1 of 1 runs done in grid" in out
    assert (folder / "grid/mine_reach_near/mine_sac_mine_flat/seed0/result.json").exists()


@pytest.mark.slow
def test_other_commands_take_a_plugin(folder):
    def command(*words):
        return run(folder, "-m", "ba_torchrl", *words, PLUGIN).stdout

    task = ("task=mine/reach_near", "env.obs_size=16")
    out = command("collect", *task, "episodes=2", "num_envs=1", "path=demos")
    assert "episodes of mine/reach_near" in out
    assert "1 episodes of mine/reach_near" in command("play", *task, "video=null")
    tasks = "tasks=[mine/reach_near]"
    out = command("experts", tasks, "robots=[mine/kuka]", "episodes=2")
    assert "| `mine/reach_near` | mine/kuka |" in out
    gallery = (ROOT / "recipes" / "gallery.py", PLUGIN, tasks)
    run(folder, *gallery, "deconstructions=[]", "overview=null")
    assert (folder / "runs/gallery/mine_reach_near.png").exists()


def test_an_unknown_task_names_the_way_to_plugins(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", TRAINING[0], "run_dir=runs/two"])
    error = capsys.readouterr().err
    assert "unknown task 'mine/reach_near'" in error
    assert "plugins=[module]" in error
