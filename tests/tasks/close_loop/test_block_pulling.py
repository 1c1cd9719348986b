"""Block Pulling with a check of the outlines of the blocks."""

import ba_torchrl


def test_the_expert_keeps_the_outlines_in_the_workspace():
    env = ba_torchrl.make(
        "close_loop/block_pulling",
        workspace_check="bounding_box",
        seed=0,
        obs_size=16,
        expert=True,
    )
    for _ in range(12):
        state = env.reset()
        while not state["done"]:
            state = env.step(state.set("action", state["expert_action"]))["next"]
        assert state["success"]
    env.close()
