"""The machine of a run: its processor, the instructions that oneDNN may use, memory and GPU."""

from __future__ import annotations

import os
import platform
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ba_torchrl.core.errors import ConfigError

INSTRUCTIONS = {"amx_bf16": "AMX", "avx512_f": "AVX-512", "avx2": "AVX2", "sve": "SVE"}
"""Names of instruction sets by PyTorch's name of the capability, widest first."""

WITH_AVX512_BF16 = ("AVX512_CORE_BF16", "AVX512_CORE_FP16", "AVX512_CORE_AMX", "AVX10")
"""Prefixes of oneDNN's instruction sets that contain AVX512-BF16."""


def onednn_max_cpu_isa() -> str | None:
    """Return the largest instruction set that oneDNN's environment variable allows.

    None is any. oneDNN reads the variable once, in the first operation of a process.
    """
    value = os.environ.get("ONEDNN_MAX_CPU_ISA", os.environ.get("DNNL_MAX_CPU_ISA", ""))
    return None if value.upper() in ("", "DEFAULT", "ALL") else value.upper()


def _capabilities() -> dict[str, Any]:
    """Return torch's flags of the processor; none before torch 2.11, which then uses float32."""
    return dict(getattr(torch.cpu, "get_capabilities", dict)())


def amx_is_used() -> bool:
    """Return whether the processor has AMX and oneDNN may use it."""
    allowed = onednn_max_cpu_isa()
    has_amx = bool(_capabilities().get("amx_bf16"))
    return has_amx and (allowed is None or "AMX" in allowed)


def bfloat16_is_fast() -> bool:
    """Return whether the processor multiplies bfloat16 faster than float32.

    Intel's AVX512-BF16 without AMX does not (docs/findings.md).
    """
    if amx_is_used():
        return True
    has, allowed = _capabilities(), onednn_max_cpu_isa()
    is_intel = str(has.get("cpu_name", "")).startswith("Intel")
    is_allowed = allowed is None or allowed.startswith(WITH_AVX512_BF16)
    return bool(has.get("avx512_bf16")) and not is_intel and is_allowed


def processor() -> str:
    """Return the name of the processor and its widest vector or matrix instructions.

    AMX is left out where oneDNN may not use it; a limit of oneDNN's instructions is named.
    """
    has, allowed = _capabilities(), onednn_max_cpu_isa()
    has["amx_bf16"] = amx_is_used()
    widest = next((name for flag, name in INSTRUCTIONS.items() if has.get(flag)), None)
    limit = None if allowed is None else f"oneDNN limited to {allowed}"
    details = ", ".join(part for part in (widest, limit) if part is not None)
    return _processor_name() + (f" ({details})" if details else "")


def hardware(device: torch.device) -> dict[str, Any]:
    """Return processor, cores, memory and GPU of a run whose learner is on ``device``."""
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    return {
        "cpu": processor(),
        "cores": os.cpu_count(),
        "memory_gb": _memory_gb(),
        "gpu": gpu,
        "threads": torch.get_num_threads(),
    }


def _processor_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return None
    return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)


def as_device(name: torch.device | str | int) -> torch.device:
    """Return a device named as in torch; "auto" for a GPU if there is one, else the CPU."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def existing_device(name: torch.device | str | int) -> torch.device:
    """Return the device of a name of `as_device` that can hold tensors; `ConfigError` if it cannot.

    The tensors of "meta" have no values.
    """
    return _checked(name, lambda device: torch.zeros(1, device=device))


def usable_device(name: torch.device | str | int) -> torch.device:
    """Return the device of a name of `as_device` that can compute; `ConfigError` if it cannot."""
    return _checked(name, lambda device: torch.zeros(1, device=device).item())


def _checked(name: torch.device | str | int, use: Callable[[torch.device], object]) -> torch.device:
    fix = "use device=cpu or device=auto"
    try:
        device = as_device(name)
    except (RuntimeError, TypeError):
        raise ConfigError(f"device: {fix}; torch knows no device {name!r}") from None
    try:
        use(device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = textwrap.shorten(re.split(r"\.\s", str(error))[0], 100)
        raise ConfigError(f"device: {fix}; {str(name)!r} cannot compute here: {reason}") from None
    return device
