"""CleanRL: its script for SAC, in three places adapted to Gymnasium 1.1, on the id of a state.

git clone https://github.com/vwxyzjn/cleanrl; pip install tensorboard tyro
python recipes/clients/cleanrl.py cleanrl/ --steps 4500
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path, help="of CleanRL's repository")
parser.add_argument("--steps", type=int, default=4500)
parser.add_argument("--log", type=Path, default=Path("cleanrl.jsonl"), help="new file")
options = parser.parse_args()

folder = options.folder.resolve()
sys.path[:0] = [str(Path(__file__).parents[1]), str(folder)]
import stock_scripts  # noqa: E402 -- counts the successes, which the script does not read

ENV = "BulletArm/CloseLoopBlockReaching-StateDense-v0"
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
values = {"env-id": "ENV", "total-timesteps": options.steps, "learning-starts": 500}
values |= {"gamma": 0.95, "tau": 0.02, "policy-lr": 1e-3, "batch-size": 128, "buffer-size": 10_000}
arguments = [word for name, value in values.items() for word in (f"--{name}", str(value))]
sys.argv = ["stock_scripts.py", ENV, "--log", str(options.log), "--", str(script), *arguments]
stock_scripts.main()
