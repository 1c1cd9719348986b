"""CleanRL: its script for SAC, unchanged, with the id of a state as its environment.

git clone https://github.com/vwxyzjn/cleanrl; pip install tensorboard tyro
python recipes/clients/cleanrl.py cleanrl/ --steps 6000
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

RUNNER = Path(__file__).parents[1] / "stock_scripts.py"
"""Counts the successes, which the script does not read."""

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path, help="of CleanRL's repository")
parser.add_argument("--steps", type=int, default=6000)
parser.add_argument("--log", type=Path, default=Path("cleanrl.jsonl"), help="new file")
options = parser.parse_args()

ENV = "BulletArm/CloseLoopBlockReaching-StateDense-v0"
values = {"env-id": "ENV", "total-timesteps": options.steps, "learning-starts": 500}
values |= {"gamma": 0.95, "tau": 0.02, "policy-lr": 1e-3, "batch-size": 128, "buffer-size": 10_000}
script = options.folder.resolve() / "cleanrl" / "sac_continuous_action.py"
arguments = [word for name, value in values.items() for word in (f"--{name}", str(value))]
launch = "import sys; sys.path[:0] = sys.argv.pop(1).split(';'); import stock_scripts; "
launch += "stock_scripts.main()"
paths = f"{RUNNER.parent};{options.folder.resolve()}"
command = [sys.executable, "-c", launch, paths, ENV, "--log", str(options.log), "--", str(script)]
sys.exit(subprocess.call([*command, *arguments]))
