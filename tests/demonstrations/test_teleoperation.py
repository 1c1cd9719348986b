"""Teleoperation: keys become actions, and what is recorded is what was executed."""

import contextlib
import os
import shutil
import subprocess
import sys
import threading

import numpy as np
import pybullet
import pytest
import torch

import ba_torchrl
from ba_torchrl.cli import EXIT_CODE
from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import atomic_output
from ba_torchrl.demonstrations.collect import collect_demonstrations, source_config
from ba_torchrl.demonstrations.demo_files import read_demonstrations
from ba_torchrl.demonstrations.episodes import is_success
from ba_torchrl.demonstrations.teleoperation import KEYS, Keyboard, record_demonstrations
from tests.recipes import recipe

TASK = "close_loop/block_reaching"
CODES = {key.name: key.code for key in KEYS}
DOWN, PRESSED, RELEASED = (
    pybullet.KEY_IS_DOWN,
    pybullet.KEY_IS_DOWN | pybullet.KEY_WAS_TRIGGERED,
    pybullet.KEY_WAS_RELEASED,
)


def events(state, *names):
    return {CODES[name]: state for name in names}


@pytest.mark.parametrize(
    ("names", "sequence", "action"),
    [
        (["up arrow"], "pxyzr", [1, -1, 0, 0, 0]),
        (["down arrow", "right arrow"], "pxyzr", [1, 1, 1, 0, 0]),
        (["left arrow", "right arrow"], "pxyzr", None),
        (["e", "shift"], "pxyzr", [1, 0, 0, 0.25, 0]),
        (["d", "f"], "rzyxp", [-1, -1, 0, 0, 1]),
        (["space"], "pxyzr", [-1, 0, 0, 0, 0]),
        (["space", "s"], "pxyz", [-1, 0, 0, 0]),
        (["s"], "pxyz", None),
        (["shift"], "pxyz", None),
        ([], "pxyz", None),
    ],
)
def test_keys_that_are_down_are_an_action(names, sequence, action):
    found = Keyboard(CloseLoopActions(sequence)).read(events(PRESSED, *names))
    assert (found is None) == (action is None)
    if action is not None:
        np.testing.assert_array_equal(found, np.float32(action))
        assert found.dtype == np.float32


def test_keys_of_components_that_are_absent_are_not_listed():
    assert "clockwise" in Keyboard(CloseLoopActions("pxyzr")).help()
    assert "clockwise" not in Keyboard(CloseLoopActions("pxyz")).help()


def test_a_held_key_repeats_its_motion_and_toggles_once():
    keyboard = Keyboard(CloseLoopActions("pxyz"))
    for state in (PRESSED, DOWN, DOWN):
        assert keyboard.read(events(state, "e", "space")).tolist() == [-1, 0, 0, 1]
    assert keyboard.read(events(RELEASED, "e", "space")) is None
    assert keyboard.read(events(PRESSED, "space")).tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize("state", [RELEASED, RELEASED | pybullet.KEY_WAS_TRIGGERED])
def test_a_press_between_two_reads_counts_once(state):
    keyboard = Keyboard(CloseLoopActions("pxyz"))
    for opening in (-1, 1, -1):
        assert keyboard.read(events(state, "space")).tolist() == [opening, 0, 0, 0]
        assert keyboard.read({}) is None


def test_shift_counts_for_a_press_that_is_read_with_its_release():
    keyboard = Keyboard(CloseLoopActions("pxyz"))
    assert keyboard.read(events(PRESSED, "shift")) is None
    assert keyboard.read(events(RELEASED, "shift", "e")).tolist() == [1, 0, 0, 0.25]


@pytest.mark.parametrize(
    ("name", "effect"),
    [("r", "discard"), ("q", "end"), ("escape", "end")],
)
def test_keys_that_stop_an_episode_count_once(name, effect):
    keyboard = Keyboard(CloseLoopActions("pxyz"))
    assert keyboard.read(events(PRESSED, name, "e")) == effect
    assert keyboard.read(events(DOWN, name)) is None


# -- episodes ------------------------------------------------------------------------------------


def next_keys(env):
    """Return the keys that bring the tool closer to the block: above it first, then down."""
    scene = env.scene
    distance_m = np.subtract(scene.task.block.position, scene.robot.tool_pose()[0])
    for offset_m, less, more in zip(
        distance_m,
        ("up arrow", "left arrow", "d"),
        ("down arrow", "right arrow", "e"),
        strict=True,
    ):
        if abs(offset_m) > 0.008:
            fine = ["shift"] if abs(offset_m) < 0.04 else []
            return [*fine, less if offset_m < 0 else more]
    raise AssertionError("the block is reached, and the episode continues")


def toward_block(env):
    """Return a source of events that reaches the block, with reads without a key in between."""
    is_idle = False

    def read():
        nonlocal is_idle
        is_idle = not is_idle
        return {} if is_idle else events(RELEASED, *next_keys(env))

    return read


@pytest.fixture
def env():
    env = ba_torchrl.make(TASK, obs_size=24, seed=0)
    yield env
    env.close()


def check_replay(env, episode, seed):
    """Check that the recorded actions give the recorded steps."""
    state = env.reset(seed=seed)
    for step in episode:
        recorded = step.exclude(keys.ACTION, keys.NEXT)
        for key in recorded.keys():  # noqa: SIM118 -- a TensorDict
            assert torch.equal(state[key], recorded[key]), key
        state = env.step(state.set(keys.ACTION, step[keys.ACTION]))[keys.NEXT]
        for key in (*env.observation_spec.keys(), keys.REWARD, keys.DONE):
            assert torch.equal(state[key], step[keys.NEXT, key]), key


def test_episodes_are_recorded_as_they_were_executed(env):
    episodes = list(record_demonstrations(env, toward_block(env), 2, seed=3, show=lambda _: None))
    assert len(episodes) == 2
    for seed, episode in enumerate(episodes, start=3):
        assert is_success(episode)
        assert episode[keys.ACTION][:, 1:4].abs().amax(1).gt(0).all()  # no idle step
        check_replay(env, episode, seed)


def test_entries_are_those_of_collected_demonstrations(env):
    (episode,) = record_demonstrations(env, toward_block(env), 1, seed=0, show=lambda _: None)
    vector = ba_torchrl.make_vector_env(
        TASK, 1, parallel=False, obs_size=24, **source_config("expert")
    )
    try:
        (collected,) = collect_demonstrations(vector, 1, seed=0)
    finally:
        vector.close()
    found, expected = (
        {key: (value.shape[1:], value.dtype) for key, value in each.flatten_keys().items()}
        for each in (episode, collected)
    )
    assert found == expected


def test_a_discarded_episode_begins_again(env):
    reached = toward_block(env)
    script = [events(RELEASED, "e"), events(RELEASED, "space"), events(RELEASED, "r")]
    shown = []
    (episode,) = record_demonstrations(
        env, lambda: script.pop(0) if script else reached(), 1, seed=5, show=shown.append
    )
    assert any("discarded" in text for text in shown)
    assert (episode[keys.ACTION][:, 0] == 1).all()
    check_replay(env, episode, 5)


@pytest.mark.parametrize("only_successful", [True, False])
def test_failed_episodes_are_kept_by_choice(only_successful):
    env = ba_torchrl.make(TASK, obs_size=24, max_steps=2)
    script = 4 * [events(DOWN, "e")] + [events(PRESSED, "q")]
    try:
        episodes = list(
            record_demonstrations(
                env,
                lambda: script.pop(0),
                3,
                seed=0,
                only_successful=only_successful,
                show=lambda _: None,
            )
        )
    finally:
        env.close()
    assert [len(episode) for episode in episodes] == ([] if only_successful else [2, 2])


# -- the command ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["open_loop/block_stacking", "path=new"], "the keyboard moves the gripper of close-loop"),
        ([TASK], "path is missing"),
        (["path=new"], "task is missing"),
        ([TASK, "path=new", "env.render=false"], "leave it out, and look at the window"),
    ],
)
def test_refusals(words, message, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        recipe("teleoperate", *words)
    assert end.value.code == EXIT_CODE
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("end", [KeyboardInterrupt, pybullet.error])
def test_episodes_that_are_complete_are_kept(end, env, tmp_path, monkeypatch):
    def played(*_, **__):
        yield from record_demonstrations(env, toward_block(env), 1, seed=5, show=lambda _: None)
        with pytest.raises(ConfigError, match=r"writes .*demos"), atomic_output(tmp_path / "demos"):
            raise AssertionError("a second writer")
        raise end

    monkeypatch.setattr("ba_torchrl.envs.factory.make", lambda *_, **__: env)
    monkeypatch.setattr("ba_torchrl.demonstrations.teleoperation.record_demonstrations", played)
    words = (TASK, f"path={tmp_path / 'demos'}", "env.obs_size=24")
    with contextlib.suppress(pybullet.error):
        recipe("teleoperate", *words)
    assert read_demonstrations(tmp_path / "demos")[1]["episodes"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["demos"]


@contextlib.contextmanager
def display():
    """A virtual display; yields the environment variables of its clients."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x768x24"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as number:
            yield {**os.environ, "DISPLAY": f":{number.readline().strip()}"}
    finally:
        server.terminate()
        server.wait()


X_NAMES = {"up arrow": "Up", "down arrow": "Down", "left arrow": "Left", "right arrow": "Right"}


@pytest.mark.slow  # the window is drawn by the CPU
@pytest.mark.skipif(
    not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool"
)
@pytest.mark.parametrize("end", ["Escape", "interrupt"])
def test_keys_in_the_window_record_an_episode(end, tmp_path, env):
    """The keys of an episode are sent one by one; the second episode is incomplete and not kept."""
    path = tmp_path / "demos"
    env.reset(seed=7)
    command = [sys.executable, "-m", "ba_torchrl", "teleoperate", TASK, "episodes=2"]
    command += [f"path={path}", "seed=7", "env.obs_size=24", "fps=3"]
    with display() as variables:
        process = subprocess.Popen(
            command,
            env={**variables, "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        limit = threading.Timer(240, process.kill)
        limit.start()

        def send(*names):
            combination = "+".join(X_NAMES.get(name, name) for name in names)
            subprocess.run(["xdotool", "key", combination], env=variables, check=True)

        keyboard, output = Keyboard(env.actions), []
        is_reached = is_discarded = False
        send_keys = next_keys(env)
        try:
            for line in process.stdout:
                output.append(line)
                if not line.startswith("episode "):
                    continue
                if line.startswith("episode 2"):
                    if "step" in line:
                        break
                    if "discarded" not in line:
                        send("space" if is_discarded else "r")
                        is_discarded = True
                elif "success" in line:
                    is_reached = True
                elif not is_reached:
                    send(*send_keys)
                    keyboard.read({})
                    action = keyboard.read(events(RELEASED, *send_keys))
                    state = env.step(env.rand_action().set(keys.ACTION, torch.tensor(action)))
                    is_reached = bool(state[keys.NEXT, keys.DONE])
                    send_keys = [] if is_reached else next_keys(env)
            if end == "Escape":
                send(end)
            else:
                process.send_signal(2)
            output += process.communicate()[0]
        finally:
            limit.cancel()
            process.kill()
            process.wait()
    text = "".join(output)
    assert process.returncode == 0, text
    assert "Traceback" not in text
    assert text.count("discarded") == 1
    (episode,), metadata = read_demonstrations(path)
    assert metadata["source"] == "keyboard"
    assert is_success(episode)
    check_replay(env, episode, 7)
