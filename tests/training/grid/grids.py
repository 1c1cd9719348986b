"""A small grid, and presets that need no Hydra."""

from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.grid.plan import BenchmarkConfig, plan

REACH, PICK = "close_loop/block_reaching", "close_loop/block_picking"
PLACE = "open_loop/block_stacking"
PRESETS = {
    ("algorithm", "sac"): {"name": "sac", "imitation": {"name": "none"}},
    ("algorithm", "sacfd"): {"name": "sac"},
    ("algorithm", "per"): {"name": "sac", "replay": {"name": "prioritized", "expert_bonus": 2.0}},
    ("network", "cnn"): {"name": "cnn"},
    ("network", "small"): {"name": "cnn", "width": 0.25},
}
COMMON = {
    "env": {"obs_size": 64, "max_steps": 8},
    "algorithm": {"batch_size": 8},
    "network": {},
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 2,
    "min_replay": 5,
    "total_updates": 6,
    "eval_every": 2,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "video_episodes": 0,
}


def preset(group, name):
    if (group, name) not in PRESETS:
        raise ConfigError(f"unknown {group} {name!r}. Known: sac, sacfd, cnn, small")
    return PRESETS[group, name]


def grid(tmp_path, **changes):
    values = {
        "name": "little",
        "folder": str(tmp_path / "grid"),
        "tasks": [REACH],
        "algorithms": ["sac"],
        "networks": ["small"],
        "seeds": 2,
    }
    return parse(BenchmarkConfig, {**values, **changes}, "benchmark")


def planned(tmp_path, common=(), **changes):
    return plan(grid(tmp_path, **changes), {**COMMON, **dict(common)}, preset)
