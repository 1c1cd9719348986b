"""The scripts of recipes/clients, with other libraries where they are installed."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from ba_torchrl.demonstrations import export_demonstrations
from tests.tasks.episodes import demonstrations

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "recipes" / "clients"
SCRIPTS = sorted(path.name for path in FOLDER.glob("*.py") if path.name != "played.py")
TASK, ENV = "close_loop/block_reaching", {"obs_type": "vec"}
HDF5, ZARR, MINARI = "reaching.hdf5", "reaching.zarr", "reaching-v0"


def test_the_page_has_a_row_for_each_script():
    page = (ROOT / "docs/clients.md").read_text()
    linked = re.findall(r"\]\(\.\./recipes/clients/(\w+\.py)\)", page)
    assert sorted(set(linked) - {"played.py"}) == SCRIPTS


@pytest.mark.parametrize("name", [*SCRIPTS, "played.py"])
def test_a_script_is_a_page_long(name):
    assert len((FOLDER / name).read_text().splitlines()) <= 60


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exports")
    episodes = demonstrations(TASK, 20, env=ENV)
    for path, form in ((HDF5, "hdf5"), (ZARR, "zarr"), (f"minari/{MINARI}", "minari")):
        if form != "minari" or importlib.util.find_spec("minari"):
            export_demonstrations(folder / path, episodes, format=form, task=TASK, env=ENV, seed=0)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "words", "packages", "least"),
    [
        ("sb3.py", ["sac"], ["stable_baselines3"], 0.8),
        ("sb3.py", ["tqc", "--steps", "600"], ["sb3_contrib"], 0),
        ("sb3_her.py", ["--steps", "600"], ["stable_baselines3"], 0),
        ("minari_bc.py", [MINARI], ["minari"], 0.8),
        ("robomimic_bc.py", [HDF5], ["robomimic"], 0.5),
        ("d3rlpy_iql.py", [HDF5, "--steps", "100"], ["d3rlpy"], 0),
        ("diffusion.py", [ZARR, "--steps", "20"], ["diffusion_policy", "diffusers"], 0),
        ("imitation_dagger.py", ["dagger"], ["imitation"], 0.5),
        ("imitation_dagger.py", ["gail", "--steps", "512"], ["imitation"], 0),
        ("skrl_sac.py", ["--steps", "600"], ["skrl"], 0),
        ("tianshou_sac.py", ["--steps", "600"], ["tianshou"], 0),
        ("rllib_sac.py", ["--steps", "600"], ["ray.rllib"], 0),
    ],
)
def test_a_script_runs(script, words, packages, least, exports, monkeypatch):
    for package in packages:
        pytest.importorskip(package)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(exports / "minari"))
    command = [sys.executable, str(FOLDER / script), *words]
    done = subprocess.run(command, cwd=exports, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    success = float(re.search(r"success (\d\.\d\d) of 50", done.stdout)[1])
    assert success >= least
