"""Heightmaps that open-loop environments render during an action."""

import pytest


@pytest.mark.parametrize(("sequence", "count"), [("pxyr", 2), ("pxyzr", 1)])
def test_a_place_renders_the_heightmap_before_it_only_to_find_its_height(
    make, sequence, count, monkeypatch
):
    env = make(
        "open_loop/block_stacking", seed=0, expert=True, obs_size=32, action_sequence=sequence
    )
    state = env.reset()
    state = env.step(state.set("action", state["expert_action"]))["next"]
    assert state["holding"]
    rendered = []
    heightmap = env.scene.camera.heightmap
    monkeypatch.setattr(
        env.scene.camera, "heightmap", lambda *view: rendered.append(view) or heightmap(*view)
    )
    state = env.step(state.set("action", state["expert_action"]))["next"]
    assert not state["holding"]
    assert len(rendered) == count
