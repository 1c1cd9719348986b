"""Task ids of the packing tasks, and episodes of their experts."""

import math

BIN, BOTTLES, BOXES = (
    f"open_loop/{name}" for name in ("bin_packing", "bottle_arrangement", "box_palletizing")
)
QUARTER_TURN = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
"""A quarter turn about x."""


def follow(env, state, steps=100):
    """Take expert actions until the episode ends; return every state."""
    seen = []
    for _ in range(steps):
        state = env.step(state.clone().set("action", state["expert_action"]))["next"]
        seen.append(state)
        if state["done"]:
            break
    return seen
