"""CleanRL: its script for SAC, in three places adapted to Gymnasium 1.1, learns to reach a block.

git clone https://github.com/vwxyzjn/cleanrl; pip install tensorboard tyro
python recipes/clients/cleanrl.py cleanrl/ --steps 6000
"""

from __future__ import annotations

import argparse
import runpy
import sys
import tempfile
from pathlib import Path

import gymnasium
import torch
from played import played

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path, help="of CleanRL's repository")
parser.add_argument("--steps", type=int, default=6000)
options = parser.parse_args()

folder = options.folder.resolve()
sys.path.insert(0, str(folder))
ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
VALUES = {"action_sequence": "pxyz", "random_orientation": False}  # without yaw
REWARD = {"reward": "difference", "reward_discount": 0.95}
# the script takes an id and no values
gymnasium.register("Reaching-v0", lambda **_: gymnasium.make(ENV, **REWARD, **VALUES))
CHANGES = {  # it is for Gymnasium 0.29
    '["final_observation"]': '["final_obs"]',
    'if "final_info" in infos:': "if False:",
    "for i in range(args.num_envs)]": "for i in range(args.num_envs)], autoreset_mode='SameStep'",
}
source = (folder / "cleanrl" / "sac_continuous_action.py").read_text()
for old, new in CHANGES.items():
    assert old in source, f"the script has changed: it has no {old}"
    source = source.replace(old, new)
script = Path(tempfile.mkdtemp()) / "sac_continuous_action.py"
script.write_text(source)
values = {"env-id": "Reaching-v0", "total-timesteps": options.steps, "learning-starts": 500}
values |= {"gamma": 0.95, "tau": 0.02, "policy-lr": 1e-3, "batch-size": 128, "buffer-size": 10_000}
# its automatic temperature begins at 1 and falls to a third in 1000 updates: entropy would pay more
# than success, which ends it
values |= {"alpha": 0.002}
arguments = [word for name, value in values.items() for word in (f"--{name}", str(value))]
sys.argv = [str(script), *arguments, "--no-autotune"]
actor = runpy.run_path(str(script), run_name="__main__")["actor"]


@torch.no_grad()
def act(state: object) -> object:
    """Return the mean action."""
    return actor.get_action(torch.as_tensor(state)[None])[2].numpy()


played(act, ENV, **VALUES)
