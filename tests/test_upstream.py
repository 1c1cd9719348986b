"""The patches of docs/upstream, against the installed TorchRL."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torchrl

FOLDER = Path(__file__).parents[1] / "docs" / "upstream"
PATCHES = sorted(FOLDER.glob("*.patch"))
INSTALLED = Path(torchrl.__file__).parent


def apply(patch, folder, part="*"):
    command = ["git", "apply", f"--include={part}", str(patch)]
    environment = {**os.environ, "GIT_CEILING_DIRECTORIES": str(folder.parent)}
    subprocess.run(command, cwd=folder, check=True, env=environment)


def test_the_patches_apply_together_and_the_page_names_each(tmp_path):
    for patch in PATCHES:
        for name in re.findall(r"^--- a/torchrl/(.*)", patch.read_text(), re.MULTILINE):
            (tmp_path / "torchrl" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(INSTALLED / name, tmp_path / "torchrl" / name)
    for patch in PATCHES:
        apply(patch, tmp_path)
    links = re.findall(r"\]\((.*\.patch)\)", (FOLDER / "index.md").read_text())
    assert sorted(links) == [patch.name for patch in PATCHES]


@pytest.mark.slow
@pytest.mark.parametrize("name", [patch.stem for patch in PATCHES])
def test_the_test_of_a_patch_fails_without_it(tmp_path, name):
    patch = FOLDER / f"{name}.patch"
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(INSTALLED, tmp_path / "torchrl", ignore=ignore)
    if name == "demonstrations":  # its sampler needs trees
        apply(FOLDER / "segment_trees.patch", tmp_path, "torchrl/*")
    apply(patch, tmp_path, "test/*")
    command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", tmp_path]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    codes = []
    for part in ("nothing", "torchrl/*"):
        if part != "nothing":
            apply(patch, tmp_path, part)
        run = subprocess.run(
            [*map(str, command), "test"], cwd=tmp_path, env=environment, capture_output=True
        )
        codes.append(run.returncode)
    assert codes == [pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.OK], run.stdout.decode()
