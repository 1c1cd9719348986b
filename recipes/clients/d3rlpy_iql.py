"""d3rlpy: implicit Q-learning of a robomimic file's states.

pip install d3rlpy==2.8.1
ba-torchrl collect task=close_loop/block_reaching episodes=50 env.obs_type=vec path=demos/reaching
ba-torchrl convert demos/reaching format=hdf5 path=exports/reaching.hdf5
python recipes/clients/d3rlpy_iql.py exports/reaching.hdf5 --steps 1000
"""

from __future__ import annotations

import argparse

import d3rlpy
import h5py
import numpy as np
from played import played

parser = argparse.ArgumentParser()
parser.add_argument("file", help="of ba-torchrl convert format=hdf5")
parser.add_argument("--steps", type=int, default=1000)
options = parser.parse_args()

ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
d3rlpy.seed(0)
columns: dict[str, list[np.ndarray]] = {}
with h5py.File(options.file) as file:
    for demo in file["data"].values():
        # in the order of the id's state
        state = np.concatenate([demo["obs/holding"][:], demo["obs/observation"][:]], axis=1)
        ended = demo["terminated"][:]
        parts = {"observations": state.astype(np.float32), "actions": demo["actions"][:]}
        parts |= {"rewards": demo["rewards"][:], "terminals": ended}
        parts["timeouts"] = demo["dones"][:] - ended
        for name, values in parts.items():
            columns.setdefault(name, []).append(values)
data = d3rlpy.dataset.MDPDataset(
    **{name: np.concatenate(rows) for name, rows in columns.items()},
    action_space=d3rlpy.ActionSpace.CONTINUOUS,
)
agent = d3rlpy.algos.IQLConfig(actor_learning_rate=1e-3, gamma=0.95).create(device="cpu:0")
logs = d3rlpy.logging.NoopAdapterFactory()
agent.fit(data, n_steps=options.steps, n_steps_per_epoch=options.steps, logger_adapter=logs)
played(lambda state: agent.predict(state[None])[0], ENV)
