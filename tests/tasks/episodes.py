"""Episodes that the tests play."""


def follow(env, state, steps=1000, action=None):
    """Take expert actions, or the given one, until the episode ends; return every state."""
    seen = []
    for _ in range(steps):
        chosen = state["expert_action"] if action is None else action
        state = env.step(state.clone().set("action", chosen))["next"]
        seen.append(state)
        if state["done"]:
            break
    return seen


def play(env, state, action=None):
    """Act until the episode ends; return the last state."""
    return follow(env, state, action=action)[-1]


def check_lift(env, position, low_m=0.145, high_m=0.155):
    """Check that success requires a grasp of the body at a position and a height of 15 cm."""
    scene = env.scene
    scene.controller.reset(((*position[:2], high_m), 0.0))
    assert not scene.task.is_success()  # high, without the body
    scene.controller.move_to(position, 0.0)
    scene.controller.grip(0.0)
    scene.controller.move_to((*position[:2], low_m), 0.0)
    assert not scene.task.is_success()  # held, at a low height
    scene.controller.move_to((*position[:2], high_m), 0.0)
    assert scene.task.is_success()
    scene.controller.grip(1.0)
    scene.world.settle()
    assert not scene.task.is_success()
