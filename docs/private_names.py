"""The names of other libraries that begin with an underscore, each with the reason why it is used.

A library may change them in any release. `python -m docs.layout` prints the list, and
`tests/test_architecture.py` fails if it is not that of the sources. What TorchRL tells subclasses
to write, such as ``EnvBase._step``, is no private name.
"""

from __future__ import annotations

import ast
import dis
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from functools import cache

from docs.sources import PACKAGE, imports, sources

REASONS = {
    "LossModule._make_vmap": "the loss computes all critics by one function, made once",
    "IQLLoss._vmap_qvalue_networkN0": "that function, which targets call with other networks",
    "LossModule._reduce_loss": "how TorchRL's losses apply masks and importance weights",
    "Module._apply": "torch moves and converts parameters by it, and shared ones stay shared",
    "MultiCollector._queue_len": "a batch is discarded if the only place of the queue is taken",
    "PrioritizedSampler._init": "makes NumPy's trees where the native ones do not load",
    "PrioritizedSampler._min_tree": "TorchRL's methods use the trees by this name",
    "PrioritizedSampler._sum_tree": "TorchRL's methods use the trees by this name",
    "RoundRobinWriter._cursor": "the next place, which skips demonstrations",
    "Sampler._rng": "where a buffer puts its generator",
    "SharedMemWeightSyncScheme._ack_queues": "what `_wait_for_ack` waits for",
    "TargetNetUpdater._sources": "what an updater copies; buffers are added",
    "TargetNetUpdater._targets": "where to; buffers are added",
    "WeightSyncScheme._wait_for_ack": "TorchRL waits forever for a worker that has ended",
    "torch._C._are_functorch_transforms_active": "NumPy cannot compute inside `torch.func`",
    "torch._C._functorch.is_functorch_wrapped_tensor": "such a tensor cannot be kept",
    "torch._C._len_torch_dispatch_stack": "modes such as FlopCounterMode see one thread only",
    "torch.autograd.forward_ad._current_level": "NumPy has no forward-mode derivatives",
}
"""Of names of torch and TorchRL. An attribute follows its class, a module its package."""

OTHERS = {
    "_chunk_key": "zarr 2 has no other way from a chunk's index to its file",
    "_download": "LeRobot would load from the Hub what a folder lacks",
    "_pull_from_repo": "LeRobot would load from the Hub what a folder lacks",
}
"""Of names of other libraries."""

HOOKS = {
    "EnvBase._supports_set_state",
    "LossModule._AcceptedKeys",
    "LossModule._forward_value_estimator_keys",
    "Transform._apply_transform",
    "Transform._call",
    "Transform._inv_call",
    "Transform._reset",
}
"""What TorchRL's documentation tells subclasses to write, besides abstract methods."""
_DOCUMENTED = {"_asdict", "_make", "_replace"}
"""Of named tuples."""
_PRIVATE = re.compile(r"_[A-Za-z]\w*")
_OWN_OBJECTS = {"self", "cls", "super()"}


def found() -> set[str]:
    """Return the private names of other libraries that the package uses."""
    names = set()
    for module, tree in sources().items():
        if module.split(".")[0] == PACKAGE and not module.endswith("__main__"):
            names |= {*_imported(tree), *_of_objects(module, tree), *_of_bases(module, tree)}
    of_classes = {name.rpartition(".")[2] for name in names if "." in name}
    return names - HOOKS - of_classes


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] != PACKAGE:
            dotted = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from filter(_is_private, dotted)


def _of_objects(module: str, tree: ast.Module) -> Iterator[str]:
    """Yield what is read from modules and from objects of other classes, also as text."""
    nodes = [*ast.walk(tree)]
    chained = {id(node.value) for node in nodes if isinstance(node, ast.Attribute)}
    texts = [part for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values]
    parts = {*map(id, texts)}
    for node in nodes:
        if isinstance(node, ast.Constant) and id(node) not in parts:
            if isinstance(node.value, str) and _PRIVATE.fullmatch(node.value):
                yield from {node.value} - _own_names()
        elif isinstance(node, ast.Attribute) and id(node) not in chained:
            root, *names = ast.unparse(node).split(".")
            if not all(map(str.isidentifier, [root, *names])):  # of a call's result
                root, names = "", [node.attr]
            if root in imports(module):
                dotted = ".".join([imports(module)[root], *names])
                is_foreign = dotted.split(".")[0] not in {PACKAGE, *sys.stdlib_module_names}
                if is_foreign and _is_private(dotted):
                    yield dotted
            elif root not in _OWN_OBJECTS:
                private = {name for name in names if _PRIVATE.fullmatch(name)}
                yield from private - _own_names() - _DOCUMENTED


def _of_bases(module: str, tree: ast.Module) -> Iterator[str]:
    """Yield what classes use or override of their bases in other libraries."""
    for node in tree.body:
        if not isinstance(node, ast.ClassDef) or not node.bases:
            continue
        bases = _foreign_bases(getattr(importlib.import_module(module), node.name))
        for part in ast.walk(node):
            name = getattr(part, "name", "") or ""
            if isinstance(part, ast.Attribute) and ast.unparse(part.value) in _OWN_OBJECTS:
                name = part.attr
            if _PRIVATE.fullmatch(str(name)):
                owners = [base for base in bases if name in _attributes(base)]
                if owners and not any(_is_abstract(base, name) for base in owners):
                    yield f"{owners[-1].__name__}.{name}"


def _is_private(dotted: str) -> bool:
    return any(_PRIVATE.fullmatch(name) for name in dotted.split("."))


@cache
def _own_names() -> set[str]:
    """Return what the package itself defines: functions, classes, variables and attributes."""
    names = set()
    for tree in sources().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
            elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                names |= {node.attr} if ast.unparse(node.value) == "self" else set()
    return names


def _foreign_bases(cls: type) -> list[type]:
    own = {PACKAGE, "builtins", "pydantic", *sys.stdlib_module_names}
    return [base for base in cls.__mro__ if base.__module__.split(".")[0] not in own]


@cache
def _attributes(base: type) -> set[str]:
    """Return the attributes of a class, and those that its methods set."""
    names = {*vars(base)}
    for value in vars(base).values():
        for method in (value, *(getattr(value, part, None) for part in ("fget", "fset"))):
            code = getattr(inspect.unwrap(method), "__code__", None) if callable(method) else None
            steps = dis.get_instructions(code) if code else ()
            names |= {step.argval for step in steps if step.opname == "STORE_ATTR"}
    return names


def _is_abstract(base: type, name: str) -> bool:
    return getattr(vars(base).get(name), "__isabstractmethod__", False)


if __name__ == "__main__":
    print("\n".join(sorted(found())))
