"""Bullet's sleeping state, in which a body is not simulated."""

import pybullet

_ASLEEP = pybullet.ACTIVATION_STATE_ENABLE_SLEEPING | pybullet.ACTIVATION_STATE_SLEEP
_AWAKE = pybullet.ACTIVATION_STATE_DISABLE_SLEEPING | pybullet.ACTIVATION_STATE_WAKE_UP


def set_asleep(client: int, body_id: int, is_asleep: bool) -> None:
    """Set whether a body is simulated, from the end of the next physics step on.

    A sleeping body is simulated again as soon as a moving one touches it. No saved state contains
    this.

    Args:
        client: PyBullet's client id.
        body_id: PyBullet's id of the body or robot.
        is_asleep: False for a body that never sleeps.
    """
    state = _ASLEEP if is_asleep else _AWAKE
    pybullet.changeDynamics(body_id, -1, activationState=state, physicsClientId=client)
