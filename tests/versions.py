"""Test the package in fresh environments, with the lowest to the newest versions that it allows.

python tests/versions.py                                   # make test-versions
python tests/versions.py --pythons 3.12 --sets newest nightly --folder /tmp/versions
python tests/versions.py --inside                          # in this environment

An environment has the package's wheel with the extra [train]. In it: experts of four tasks, one
update of each algorithm and of each network, environments in processes, and the quick start cut
short. The table of results is printed; an environment that exists is used again. The set "pinned"
has the versions of requirements.txt, "nightly" the latest builds of TorchRL and tensordict on top
of the newest; a failure of the latter is only printed.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = {
    "lowest": ROOT / "requirements-lowest.txt",
    "pinned": ROOT / "requirements.txt",
    "newest": None,
    "nightly": None,
}
"""Constraints of each set of versions."""
NIGHTLY = ("tensordict", "torchrl")
SHOWN = ("torch", "torchrl", "tensordict", "numpy", "pybullet", "gymnasium", "numba", "pydantic")
EXPERTS = (
    "close_loop/block_picking",
    "close_loop/drawer_opening",
    "open_loop/house_building_2",
    "ramp/block_stacking",
)
QUICK_START = (
    "demonstrations=5 pretrain_updates=5 total_updates=10 eval_every=5 eval_episodes=2 "
    "final_eval_episodes=2 video_episodes=1 min_replay=20 run_dir=run"
)


def main() -> int:
    """Return the exit code: 1 if a check failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pythons", nargs="+", default=["3.11", "3.12"])
    parser.add_argument("--sets", nargs="+", choices=CONSTRAINTS, default=list(CONSTRAINTS))
    parser.add_argument("--folder", type=Path, default=ROOT / ".versions")
    parser.add_argument("--inside", action="store_true")
    options = parser.parse_args()
    if options.inside:
        print(json.dumps(check()))
        return 0
    rows = []
    print(f"| python | versions | {' | '.join(SHOWN)} | checks | their minutes |")
    print(f"|{'---|' * (len(SHOWN) + 4)}")
    for python in options.pythons:
        for name in options.sets:
            print(f"== Python {python}, {name} versions", file=sys.stderr)
            rows.append(run(python, name, options.folder / f"{python}-{name}"))
            print(f"| {' | '.join(rows[-1])} |", flush=True)
    return int(any("passed" not in row[-2] for row in rows if row[1] != "nightly"))


def run(python: str, name: str, folder: Path) -> list[str]:
    """Make an environment, run the checks in it, and return a row of the table.

    Args:
        python: version of the interpreter, which is on the path as "python3.11".
        name: of `CONSTRAINTS`.
        folder: of the environment.
    """
    interpreter = folder / "bin/python"
    if not (folder / ".installed").exists():
        install(python, name, folder)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as empty:
        command = [str(interpreter), str(Path(__file__).resolve()), "--inside"]
        done = subprocess.run(command, cwd=empty, capture_output=True, text=True, check=False)
    minutes = f"{(time.perf_counter() - start) / 60:.0f}"
    if done.returncode:
        print(done.stderr[-3000:], file=sys.stderr)
        return [python, name, *[""] * len(SHOWN), "failed", minutes]
    found = json.loads(done.stdout.splitlines()[-1])
    for failure in found["failures"]:
        print(failure, file=sys.stderr)
    count = len(found["failures"])
    checks = f"{count} of {found['checks']} failed" if count else f"{found['checks']} passed"
    return [found["python"], name, *(found["versions"][each] for each in SHOWN), checks, minutes]


def install(python: str, name: str, folder: Path) -> None:
    """Install the package's wheel into a new environment."""
    subprocess.run([f"python{python}", "-m", "venv", "--clear", str(folder)], check=True)
    pip = [str(folder / "bin/python"), "-m", "pip", "install", "--quiet"]
    file = CONSTRAINTS[name]
    constraints = [] if file is None else ["--constraint", str(file)]
    subprocess.run([*pip, "--upgrade", "pip"], check=True)
    with tempfile.TemporaryDirectory() as wheels:
        build = [str(folder / "bin/python"), "-m", "pip", "wheel", "--quiet", "--no-deps"]
        subprocess.run([*build, "--wheel-dir", wheels, str(ROOT)], check=True)
        (wheel,) = Path(wheels).glob("*.whl")
        subprocess.run([*pip, *constraints, f"{wheel}[train]"], check=True)
    if name == "nightly":
        subprocess.run([*pip[:3], "uninstall", "--quiet", "--yes", *NIGHTLY], check=True)
        nightly = [f"{each}-nightly" for each in NIGHTLY]
        subprocess.run([*pip, "--pre", "--no-deps", *nightly], check=True)
    (folder / ".installed").touch()


def check() -> dict[str, object]:
    """Run all checks in this environment; return their number, and a line for each failure."""
    import warnings

    warnings.filterwarnings("ignore")
    checks = {f"expert of {task}": lambda task=task: check_expert(task) for task in EXPERTS}
    checks["environments in processes"] = check_vector
    checks |= {f"update of {name}": each for name, each in updates()}
    checks["quick start"] = check_quick_start
    failures = []
    for name, each in checks.items():
        print(f"{time.strftime('%X')} {name}", file=sys.stderr)
        try:
            each()
        except Exception as error:  # all of them are listed
            failures.append(f"{name}: {type(error).__name__}: {error}")
    return {
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in SHOWN},
        "checks": len(checks),
        "failures": failures,
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return version(f"{package}-nightly")


def check_expert(task: str) -> None:
    """Play an expert's episode in an environment whose specs hold."""
    from torchrl.envs.utils import check_env_specs

    import ba_torchrl
    from ba_torchrl.demonstrations import expert_policy

    env = ba_torchrl.make(task, seed=0, expert=True)
    try:
        check_env_specs(env)
        episode = env.rollout(env.max_steps, expert_policy)
        assert episode["next", "success"].any(), "the expert fails"
    finally:
        env.close()


def check_vector() -> None:
    """Step two environments in processes."""
    import ba_torchrl

    env = ba_torchrl.make_vector_env("close_loop/block_reaching", 2, seed=0, obs_size=16)
    try:
        assert env.rollout(3, break_when_any_done=False).shape == (2, 3)
    finally:
        env.close()


def updates() -> list[tuple[str, object]]:
    """Return a check for each algorithm and for each network: one update."""
    from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
    from ba_torchrl.cli import config_dir
    from ba_torchrl.training.presets import preset, preset_names, started

    with started(config_dir()):
        presets = {
            group: {name: preset(group, name) for name in preset_names(group)}
            for group in ("algorithm", "network")
        }
    usual = {
        "close_loop": ("close_loop/block_picking", "sacfd", "cnn"),
        "open_loop": ("open_loop/block_stacking", "sdqfd", "fcn"),
    }
    cells = []
    for name, values in presets["algorithm"].items():
        for control in sorted(ALGORITHMS[values["name"]].controls):
            network = "ferm" if name == "ferm" else usual[control][2]
            cells.append((control, name, network))
    cells += [
        (NETWORKS[values["name"]].control, usual[NETWORKS[values["name"]].control][1], name)
        for name, values in presets["network"].items()
    ]

    def small(values: dict[str, object]) -> dict[str, object]:
        has_width = "width" in NETWORKS[values["name"]].model_fields
        return {**values, **({"width": 0.25} if has_width else {})}

    def one_update(control: str, algorithm: str, network: str) -> None:
        first = {"contrastive": {"name": "info_nce", "updates": 1}} if algorithm == "ferm" else {}
        values = {
            "task": "ramp/block_stacking" if "deictic" in network else usual[control][0],
            "env": {"obs_size": 142 if algorithm == "ferm" else 64},
            "algorithm": {**presets["algorithm"][algorithm], "batch_size": 2, **first},
            "network": small(presets["network"][network]),
        }
        check_update(values)

    return [
        (
            f"{algorithm} with {network}",
            lambda cell=(control, algorithm, network): one_update(*cell),
        )
        for control, algorithm, network in dict.fromkeys(cells)
    ]


def check_update(values: dict[str, object]) -> None:
    """Take an update on two demonstrations."""
    from ba_torchrl.demonstrations import collect_demonstrations
    from ba_torchrl.envs.factory import make_vector_env
    from ba_torchrl.training.config import ExperimentConfig
    from ba_torchrl.training.learner import build_learner

    config = ExperimentConfig.parse(values)
    learner = build_learner(config)
    env = make_vector_env(config.env, 1, parallel=False, seed=0, expert=True)
    try:
        episodes = collect_demonstrations(env, 2, seed=0, nearest_action=learner.nearest_action)
    finally:
        env.close()
    learner.on_demonstrations(episodes)
    learner.update()
    if config.algorithm.collects:
        learner.update()


def check_quick_start() -> None:
    """Run the quick start, cut short, by the command line; load its policy."""
    import ba_torchrl

    command = [sys.executable, "-m", "ba_torchrl", "train", "--config-name", "quickstart"]
    done = subprocess.run(
        [*command, *QUICK_START.split()], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    policy = ba_torchrl.load_policy("run")
    env = policy.make_env()
    env.rollout(3, policy)
    env.close()


if __name__ == "__main__":
    sys.exit(main())
