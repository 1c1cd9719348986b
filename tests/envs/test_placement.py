"""Episodes whose objects do not fit the scene that is drawn first."""

import pytest

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.envs.episodes import MAX_REFUSED


def refuse(env, monkeypatch, count):
    """Let the task refuse a number of scenes; return the list of its attempts."""
    task, attempts = env.scene.task, []
    initialize = task.initialize_episode

    def initialize_episode(rng):
        attempts.append(rng)
        if len(attempts) <= count:
            raise PlacementError("too wide")
        initialize(rng)

    monkeypatch.setattr(task, "initialize_episode", initialize_episode)
    return attempts


def test_objects_that_do_not_fit_are_drawn_again(make, monkeypatch):
    env = make("close_loop/block_reaching", obs_size=16, seed=0)
    env.reset()
    attempts = refuse(env, monkeypatch, MAX_REFUSED - 1)
    state = env.reset()
    assert len(attempts) == MAX_REFUSED
    assert env.scene.task.is_valid()
    assert not state["done"]


def test_objects_that_never_fit_are_an_error(make, monkeypatch):
    env = make("close_loop/block_reaching", obs_size=16, seed=0)
    env.reset()
    attempts = refuse(env, monkeypatch, 100)
    with pytest.raises(PlacementError, match="too wide"):
        env.reset()
    assert len(attempts) == MAX_REFUSED


def test_wide_pieces_between_narrow_ramps_are_drawn_again(make):
    # in episode 149, a piece with its fixed orientation is wider than the space between the ramps
    env = make("ramp/improvise_house_building_2", obs_size=16, seed=0, random_orientation=False)
    for _ in range(150):
        env.reset()
