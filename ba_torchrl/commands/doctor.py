"""Print what this machine has and what is missing, each with the command that mends it.

ba-torchrl doctor
"""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

from ba_torchrl import __version__
from ba_torchrl.cli import EXIT_CODE, OF_TRAINING, config_dir
from ba_torchrl.core.errors import MissingPackageError, install_command
from ba_torchrl.core.malloc import tune_malloc

NEEDED = (
    "torch",
    "torchrl",
    "tensordict",
    "pybullet",
    "gymnasium",
    "numpy",
    "numba",
    "scipy",
    "trimesh",
    "pydantic",
    "safetensors",
)
OPTIONAL = ("tensorboard", "wandb", "ray", "stable-baselines3")
SHARED_MEMORY = "/dev/shm"


class Finding(NamedTuple):
    """One line of the output."""

    name: str
    state: str
    fix: str = ""
    """What to do about it; empty if nothing is missing."""


class Doctor:
    """The command. It needs no package that it reports as missing, and imports them at the end."""

    def run(self, words: Sequence[str]) -> None:
        """Print the findings; the exit code is 1 if something that is needed is missing."""
        if words:
            if words[0] in ("--help", "-h"):
                print(__doc__)
                return
            sys.stderr.write("error: doctor has no settings\n")
            sys.exit(EXIT_CODE)
        main()


def main() -> None:
    """Print the findings; the exit code is 1 if something that is needed is missing."""
    is_complete = True
    for finding in find():
        print(f"{finding.name:22} {finding.state}", flush=True)
        if finding.fix:
            print(f"{'':22}   -> {finding.fix}")
        is_complete = is_complete and not finding.state.startswith(("missing", "not known"))
    if not is_complete:
        sys.exit(1)


def find() -> Iterator[Finding]:
    """Yield what this machine has."""
    yield Finding("ba-torchrl", f"{__version__}, configurations in {config_dir()}")
    yield Finding("python", f"{platform.python_version()} on {platform.platform(terse=True)}")
    for name in (*NEEDED, *OF_TRAINING):
        found = _version(name)
        yield Finding(name, found or "missing", "" if found else install_command(name))
    for name in OPTIONAL:
        yield Finding(name, _version(name) or "not installed (optional)")
    is_tuned = tune_malloc()
    yield Finding("memory allocator", "tuned glibc" if is_tuned else "of the system")
    yield _shared_memory()
    yield _display()
    for check in (_escnn, _cpu, _cpu_path, _gpu, _native_trees, _policies):
        try:
            yield check()
        except ModuleNotFoundError as error:
            yield Finding(check.__name__.strip("_"), f"not known without {error.name}")
        except (ImportError, OSError) as error:  # of a package that is damaged
            yield Finding(check.__name__.strip("_"), f"not known: {' '.join(str(error).split())}")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _escnn() -> Finding:
    from ba_torchrl.modules.steerable.planar_escnn import import_escnn

    try:
        import_escnn()
    except MissingPackageError as error:
        return Finding("escnn", f"the package's own kernels, as {error.what} (optional)")
    return Finding("escnn", _version("escnn") or "without version")


def _cpu() -> Finding:
    import torch

    from ba_torchrl.core.hardware import hardware

    found = hardware(torch.device("cpu"))
    return Finding("cpu", f"{found['cpu']}, {found['cores']} cores, {found['memory_gb']} GB")


def _cpu_path() -> Finding:
    import torch

    from ba_torchrl.modules.layers import compute_dtype

    dtype = compute_dtype("auto", torch.device("cpu"))
    kind = str(dtype).removeprefix("torch.")
    return Finding("networks on the cpu", f"{kind} ({torch.backends.cpu.get_cpu_capability()})")


def _gpu() -> Finding:
    import torch

    if not torch.cuda.is_available():
        return Finding("gpu", "none that torch can use")
    return Finding("gpu", f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}")


def _native_trees() -> Finding:
    """Whether TorchRL's compiled sum trees of prioritised replay can be imported."""
    try:
        importlib.import_module("torchrl._torchrl")
    except ImportError:
        return Finding("prioritised replay", "trees in Python: TorchRL's do not fit this torch")
    return Finding("prioritised replay", "TorchRL's native trees")


def _policies() -> Finding:
    from ba_torchrl.training.policy import shipped_policies

    return Finding("trained policies", ", ".join(shipped_policies()) or "none")


def _shared_memory() -> Finding:
    if not os.path.isdir(SHARED_MEMORY):
        return Finding("shared memory", "no /dev/shm")
    free = shutil.disk_usage(SHARED_MEMORY).free / 1e6
    fix = "docker run --shm-size=2g" if free < 256 else ""
    return Finding("shared memory", f"{free:.0f} MB free", fix)


def _display() -> Finding:
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if shown or sys.platform in ("darwin", "win32"):
        return Finding("display", shown or "of the system")
    return Finding("display", "none: env.render=true needs one; videos and pictures do not")


COMMAND = Doctor()
