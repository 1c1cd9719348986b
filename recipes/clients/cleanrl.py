"""CleanRL: its script for SAC, unchanged, with the id of a state as its environment.

git clone https://github.com/vwxyzjn/cleanrl; pip install tensorboard tyro
python recipes/clients/cleanrl.py cleanrl/ --steps 6000
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path, help="of CleanRL's repository")
parser.add_argument("--steps", type=int, default=6000)
parser.add_argument("--log", type=Path, default=Path("cleanrl.jsonl"), help="new file")
options = parser.parse_args()

folder = options.folder.resolve()
sys.path[:0] = [str(Path(__file__).parents[1]), str(folder)]
import stock_scripts  # noqa: E402 -- counts the successes, which the script does not read

ENV = "BulletArm/CloseLoopBlockReaching-StateDense-v0"
values = {"env-id": "ENV", "total-timesteps": options.steps, "learning-starts": 500}
values |= {"gamma": 0.95, "tau": 0.02, "policy-lr": 1e-3, "batch-size": 128, "buffer-size": 10_000}
arguments = [word for name, value in values.items() for word in (f"--{name}", str(value))]
script = str(folder / "cleanrl" / "sac_continuous_action.py")
sys.argv = ["stock_scripts.py", ENV, "--log", str(options.log), "--", script, *arguments]
stock_scripts.main()
