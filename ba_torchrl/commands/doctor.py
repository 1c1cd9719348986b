"""Print what this machine has and what is missing, each with the command that mends it.

ba-torchrl doctor
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec, module_from_spec

from ba_torchrl import __version__
from ba_torchrl.cli import EXIT_CODE, OF_TRAINING, config_dir
from ba_torchrl.core.errors import install_command
from ba_torchrl.core.malloc import tune_malloc

NEEDED = ("torch", "torchrl", "tensordict", "pybullet", "gymnasium", "numpy", "numba", "scipy")
NEEDED += ("trimesh", "pydantic", "safetensors", *OF_TRAINING)
OPTIONAL = ("tensorboard", "wandb", "ray", "stable-baselines3")
SHARED_MEMORY, LEAST_MB = "/dev/shm", 256


class Doctor:
    """The command. It needs no package that it reports as missing, and imports them at the end."""

    def run(self, words: Sequence[str]) -> None:
        """Print the findings; the exit code is 1 if something that is needed is missing."""
        if words and words[0] in ("--help", "-h"):
            print(__doc__)
        elif words:
            sys.stderr.write("error: doctor has no settings\n")
            sys.exit(EXIT_CODE)
        else:
            main()


def main() -> None:
    """Print the findings; the exit code is 1 if something that is needed is missing."""
    is_complete = True
    for name, state, fix in find():
        print(f"{name:22} {state}", flush=True)
        if fix:
            print(f"{'':22}   -> {fix}")
        is_complete = is_complete and not state.startswith(("missing", "not known"))
    if not is_complete:
        sys.exit(1)


def find() -> Iterator[tuple[str, str, str]]:
    """Yield what this machine has: a name, its state, and what to do if something is missing."""
    yield "ba-torchrl", f"{__version__}, configurations in {config_dir()}", ""
    yield "python", f"{platform.python_version()} on {platform.platform(terse=True)}", ""
    for name in NEEDED:
        found = _version(name)
        yield name, found or "missing", "" if found else install_command(name)
    for name in OPTIONAL:
        yield name, _version(name) or "not installed (optional)", ""
    yield "memory allocator", "tuned glibc" if tune_malloc() else "of the system", ""
    is_mounted = os.path.isdir(SHARED_MEMORY)
    free = shutil.disk_usage(SHARED_MEMORY).free / 1e6 if is_mounted else LEAST_MB
    fix = "docker run --shm-size=2g" if free < LEAST_MB else ""
    yield "shared memory", f"{free:.0f} MB free" if is_mounted else f"no {SHARED_MEMORY}", fix
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform in ("darwin", "win32"):
        shown = shown or "of the system"
    yield "display", shown or "none: env.render=true needs one; videos and pictures do not", ""
    for name, check in CHECKS.items():
        try:
            yield name, check(), ""
        except ModuleNotFoundError as error:
            yield name, f"not known without {error.name}", ""
        except (ImportError, OSError) as error:  # of a package that is damaged
            yield name, f"not known: {' '.join(str(error).split())}", ""


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    import torch

    from ba_torchrl.core.hardware import hardware

    found = hardware(torch.device("cpu"))
    return f"{found['cpu']}, {found['cores']} cores, {found['memory_gb']} GB"


def _cpu_path() -> str:
    import torch

    from ba_torchrl.core.hardware import bfloat16_is_fast

    kind = "bfloat16" if bfloat16_is_fast() else "float32"
    return f"{kind} ({torch.backends.cpu.get_cpu_capability()})"


def _gpu() -> str:
    import torch

    if not torch.cuda.is_available():
        return "none that torch can use"
    return f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"


def _native_trees() -> str:
    import torch  # noqa: F401 -- the library that the trees are linked to

    name, package = "torchrl._torchrl", find_spec("torchrl")
    if package is None:
        raise ModuleNotFoundError("No module named 'torchrl'", name="torchrl")
    try:
        if name not in sys.modules:  # the file alone: TorchRL's own import takes seconds
            spec = PathFinder.find_spec(name, package.submodule_search_locations)
            if spec is None:
                raise ImportError
            module_from_spec(spec)
    except ImportError:
        return "trees in Python: TorchRL's do not fit this torch"
    return "TorchRL's native trees"


def _policies() -> str:
    from ba_torchrl.record.results import shipped_policies

    return ", ".join(shipped_policies()) or "none"


CHECKS = {
    "cpu": _cpu,
    "networks on the cpu": _cpu_path,
    "gpu": _gpu,
    "prioritised replay": _native_trees,
    "trained policies": _policies,
}
"""What can be said only after the import of packages, in this order."""

COMMAND = Doctor()
