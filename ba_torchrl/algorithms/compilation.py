"""Losses compiled by `torch.compile`."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule

from ba_torchrl.core import keys
from ba_torchrl.core.config import CompileMode
from ba_torchrl.core.errors import ConfigError


def check_compiler(device: torch.device) -> None:
    """Raise `ConfigError` unless the system has the compiler of `torch.compile`'s code for a
    device."""
    if device.type == "cuda":  # Triton compiles the code that starts its kernels
        language, package = "C", "gcc"
        is_found = bool(os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang"))
    else:
        language, package = "C++", "g++"
        found = os.environ.get("CXX") or ("clang++" if sys.platform == "darwin" else "g++")
        is_found = shutil.which(found) is not None
    if not is_found:
        raise ConfigError(
            f"compile_mode: this needs a {language} compiler (Debian: apt install {package}); "
            "install one, or leave compile_mode out"
        )


class CompiledLoss:
    """A loss whose forward and backward pass are compiled at the first call.

    Compilation is for the shapes of this call. Before it, a forward pass that is not compiled fills
    the networks' caches of constants. A graph that needs another constant is compiled twice. The
    results are copies, since a CUDA graph writes those of the next call to the same memory.

    Args:
        loss: the loss module.
        mode: of `torch.compile`.
        function: the loss of a batch: a method of the module, or by default the module itself,
            which is then compiled in place.
    """

    def __init__(
        self,
        loss: LossModule,
        mode: CompileMode,
        function: Callable[[TensorDictBase], TensorDictBase] | None = None,
    ) -> None:
        check_compiler(next(loss.parameters()).device)
        self.loss = loss
        self.mode = mode
        self.function = loss if function is None else function
        self._is_compiled = False

    def __call__(self, batch: TensorDictBase) -> TensorDict:
        """Return the losses and diagnostics of a batch, into which the loss writes priorities."""
        if not self._is_compiled:
            self._is_compiled = True
            device = next(self.loss.parameters()).device
            buffers = [(buffer, buffer.clone()) for buffer in self.loss.buffers()]
            with torch.random.fork_rng([device] if device.type == "cuda" else []):
                self.function(batch.copy())
            for buffer, before in buffers:  # such as the statistics of a batch norm
                buffer.copy_(before)
            if self.function is self.loss:
                self.loss.compile(mode=self.mode, dynamic=False)
            else:
                self.function = torch.compile(self.function, mode=self.mode, dynamic=False)
        torch.compiler.cudagraph_mark_step_begin()
        # the compiled loss sets both modes, and does not reset them
        with set_exploration_type(self.loss.deterministic_sampling_mode), set_recurrent_mode(True):
            scalars = self.function(batch).clone()
        if keys.TD_ERROR in batch:
            batch[keys.TD_ERROR] = batch[keys.TD_ERROR].clone()
        return scalars
