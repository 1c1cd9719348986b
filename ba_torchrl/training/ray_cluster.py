"""The only file that imports Ray, an optional package."""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from types import ModuleType

from ba_torchrl.core.errors import ConfigError, install_command


def check_installed(option: str) -> None:
    """Raise `ConfigError` unless Ray is installed, which ``option`` needs."""
    if find_spec("ray") is None:
        raise ConfigError(
            f"{option}: 'ray' needs a package that is not installed: {install_command('ray')}"
        )


def connected_ray(address: str | None) -> ModuleType:
    """Return the module `ray` after a connection to a cluster; an existing connection is kept.

    Args:
        address: of the cluster; None for the default of `ray.init`, which starts a cluster of this
            machine if there is none.

    Raises:
        ConfigError: there is no cluster at the address.
    """
    ray = ray_module()
    if ray.is_initialized():
        return ray
    try:
        ray.init(address=address, include_dashboard=None if address else False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"no Ray cluster at address={address}: {reason}") from None
    return ray


def check_resources(option: str, cpus: float, gpus: float) -> None:
    """Raise `ConfigError` unless the machines of the connected cluster together have the resources
    that ``option`` needs; Ray would wait for them forever."""
    found = ray_module().cluster_resources()
    for name, needed in (("CPU", cpus), ("GPU", gpus)):
        if needed > found.get(name, 0.0):
            raise ConfigError(
                f"{option}: {needed:g} {name}s are needed, the Ray cluster has "
                f"{found.get(name, 0.0):g}"
            )


def ray_module() -> ModuleType:
    """Return the module `ray`."""
    return importlib.import_module("ray")
