"""Demonstrations of a person, who moves the gripper with the keyboard in PyBullet's window."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np
import pybullet
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.demonstrations.episodes import is_success
from ba_torchrl.envs.base import BulletArmEnv

Effect = Literal["p", "x", "y", "z", "r", "fine", "discard", "end"]


class Key(NamedTuple):
    """A key and its effect."""

    code: int
    """As in the events of PyBullet."""
    name: str
    description: str
    effect: Effect
    """The letter of an action's component; or ``fine``, ``discard`` or ``end``."""
    value: float = 0.0
    """Of the component, while the key is down."""


ESCAPE = 27
"""PyBullet closes its window at this key."""
FINE = 0.25
"""Factor of the displacement and of the change of yaw while shift is down."""

KEYS = (
    Key(pybullet.B3G_UP_ARROW, "up arrow", "away from the viewer", "x", -1.0),
    Key(pybullet.B3G_DOWN_ARROW, "down arrow", "toward the viewer", "x", 1.0),
    Key(pybullet.B3G_LEFT_ARROW, "left arrow", "to the left", "y", -1.0),
    Key(pybullet.B3G_RIGHT_ARROW, "right arrow", "to the right", "y", 1.0),
    Key(ord("e"), "e", "up", "z", 1.0),
    Key(ord("d"), "d", "down", "z", -1.0),
    Key(ord("s"), "s", "turn counterclockwise, seen from above", "r", 1.0),
    Key(ord("f"), "f", "turn clockwise", "r", -1.0),
    Key(pybullet.B3G_SHIFT, "shift", "held with these: a quarter of the step", "fine"),
    Key(pybullet.B3G_SPACE, "space", "open or close the gripper", "p"),
    Key(ord("r"), "r", "discard the episode and begin it again", "discard"),
    Key(ord("q"), "q", "end", "end"),
    Key(ESCAPE, "escape", "the same", "end"),
)


class Keyboard:
    """Maps events of keys to actions.

    Args:
        actions: the action space; components outside its sequence have no key.
    """

    def __init__(self, actions: CloseLoopActions) -> None:
        self._sequence = actions.sequence
        absent = set("pxyzr") - set(actions.sequence)
        self.keys = tuple(key for key in KEYS if key.effect not in absent)
        """The keys that have an effect."""
        self.is_open = True
        """Whether the next action opens the gripper."""
        self._held: set[int] = set()

    def open_gripper(self) -> None:
        """Return to the open gripper, with which episodes begin."""
        self.is_open = True

    def read(self, events: Mapping[int, int]) -> np.ndarray | Literal["discard", "end"] | None:
        """Return the action of the keys that were down since the last call.

        Args:
            events: by code of the key, the flags of `pybullet.getKeyboardEvents`.

        Returns:
            The action [A] float32; "discard" or "end"; or None if no key changes anything.
        """
        # a press that is shorter than the time between two calls has only the flag of its end
        active = {
            code
            for code, state in events.items()
            if state & (pybullet.KEY_IS_DOWN | pybullet.KEY_WAS_TRIGGERED)
            or (state and code not in self._held)
        }
        pressed = active - self._held
        self._held = {c for c in active if not events[c] & pybullet.KEY_WAS_RELEASED}
        chosen = [key for key in self.keys if key.code in active]
        for effect in ("end", "discard"):
            if any(key.effect == effect and key.code in pressed for key in chosen):
                return effect
        # also at its release, which may be read together with a short press of another key
        is_fine = any(key.effect == "fine" and key.code in events for key in self.keys)
        factor = FINE if is_fine else 1.0
        value = dict.fromkeys(self._sequence, 0.0)
        for key in chosen:
            if key.effect in value:
                value[key.effect] += factor * key.value
        is_toggled = any(key.effect == "p" and key.code in pressed for key in chosen)
        if not is_toggled and not any(value.values()):
            return None
        self.is_open ^= is_toggled
        value["p"] = 1.0 if self.is_open else -1.0
        return np.array([value[letter] for letter in self._sequence], dtype=np.float32)

    def help(self) -> str:
        """Return the keys and their effects, a line each."""
        return "\n".join(f"  {key.name:<12} {key.description}" for key in self.keys)


class KeyEvents:
    """Reads the keys of PyBullet's window at a fixed rate.

    The window then has no shortcuts, and the mouse does not move objects.

    Args:
        env: made with ``render=True``.
        rate: reads per second, at most.
    """

    def __init__(self, env: BulletArmEnv, rate: float) -> None:
        self._env = env
        self._period_s = 1 / rate
        self._last_s = 0.0
        self._client: int | None = None

    def __call__(self) -> Mapping[int, int]:
        """Wait, and return the events since the last call; `ESCAPE` if the window is closed."""
        time.sleep(max(0.0, self._last_s + self._period_s - time.monotonic()))
        self._last_s = time.monotonic()
        client = self._env.scene.world.client
        try:
            if client != self._client:
                self._prepare(client)
            return pybullet.getKeyboardEvents(physicsClientId=client)
        except pybullet.error:
            return {ESCAPE: pybullet.KEY_WAS_TRIGGERED}

    def _prepare(self, client: int) -> None:
        """Disable what changes the scene, and show the workspace from opposite the robot."""
        for flag in (pybullet.COV_ENABLE_KEYBOARD_SHORTCUTS, pybullet.COV_ENABLE_MOUSE_PICKING):
            pybullet.configureDebugVisualizer(flag, 0, physicsClientId=client)
        workspace = self._env.workspace
        pybullet.resetDebugVisualizerCamera(
            2 * workspace.width, 90, -36, [*workspace.center, 0.1], physicsClientId=client
        )
        self._client = client


def record_demonstrations(
    env: BulletArmEnv,
    events: Callable[[], Mapping[int, int]],
    episodes: int,
    *,
    seed: int,
    only_successful: bool = True,
    show: Callable[[str], None] = print,
) -> Iterator[TensorDict]:
    """Yield the episodes that a person plays, until there are enough or a key ends it.

    The environment takes a step only while a key is down. Episode i begins as
    ``env.reset(seed=seed + i)`` does; one that is not kept begins again.

    Args:
        events: returns the flags of the keys' events, by code.
        only_successful: keep only episodes that reach the goal.
        show: called with the state of the episode as text.

    Yields:
        TensorDicts [T], as `collect_demonstrations` returns.
    """
    keyboard = Keyboard(env.actions)
    kept = 0
    while kept < episodes:
        keyboard.open_gripper()
        state, steps = env.reset(seed=seed + kept), []
        title = f"episode {kept + 1} of {episodes}"
        show(f"{title}: {env.instruction}")
        while not state[keys.DONE]:
            action = keyboard.read(events())
            if action is None:
                continue
            if isinstance(action, str):
                break
            step = env.step(state.set(keys.ACTION, torch.from_numpy(action)))
            steps.append(step.clone())
            state = step_mdp(step)
            gripper = "open" if keyboard.is_open else "closed"
            held = ", holds an object" if state[keys.HOLDING] else ""
            show(f"{title}: step {len(steps)} of {env.max_steps}, gripper {gripper}{held}")
        else:
            episode = torch.stack(steps)
            is_kept = not episode[keys.NEXT, keys.FAULT].any() and (
                is_success(episode) or not only_successful
            )
            result = "success" if is_success(episode) else "no success"
            show(f"{title}: {result}, {'kept' if is_kept else 'begins again'}")
            if is_kept:
                kept += 1
                yield episode
            continue
        if action == "end":
            return
        show(f"{title}: discarded")
