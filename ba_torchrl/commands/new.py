"""Write the module of a task, an algorithm or a network of your own, and its test.

ba-torchrl new task push_far         # push_far.py and test_push_far.py in this folder
ba-torchrl new algorithm my_method
ba-torchrl new network my_network
"""

from __future__ import annotations

import keyword
import re
from importlib.util import find_spec
from typing import Annotated, Literal

from ba_torchrl.cli import data_dir
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import check_new, check_writable_file, checked
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import write_text

TRAIN = "ba-torchrl train --config-name quickstart 'plugins=[{name}]'"
NEXT = {
    "task": (
        "ba-torchrl play 'plugins=[{name}]' task=mine/{name} video={name}.gif",
        f"{TRAIN} task=mine/{{name}}",
    ),
    "algorithm": (
        f"{TRAIN} task=close_loop/block_reaching algorithm=mine/{{name}} network=cnn_small "
        "demonstrations_noise=0",
    ),
    "network": (f"{TRAIN} network=mine/{{name}} algorithm=bc",),
}
"""What to type after the test, by kind of module."""


def check_module(name: str) -> None:
    """Check that a new module of this folder can have a name."""
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower():
        raise ConfigError(f"{name!r} is no name of a module: lower-case letters, digits and _")
    if not class_name(name).isidentifier() or keyword.iskeyword(class_name(name)):
        raise ConfigError(f"{name!r} gives no name to its class; begin with a letter, as my_task")
    for path in files(name):
        check_new(path)
        check_writable_file(path)
    if find_spec(name) is not None:
        raise ConfigError(f"another module has the name {name!r}; choose another one")


def class_name(name: str) -> str:
    """Return the name of a module's class."""
    return "".join(map(str.capitalize, name.split("_")))


def files(name: str) -> list[str]:
    """Return the names of the files of a module and of its test."""
    return [f"{name}.py", f"test_{name}.py"]


class Settings(StrictModel):
    """Settings of this command."""

    kind: Literal["task", "algorithm", "network"]
    """Of the module."""
    name: Annotated[str, checked(check_module)]
    """Of the module, such as my_task; what it registers is mine/my_task."""


def main(settings: Settings) -> None:
    """Write the files."""
    kind, name = settings.kind, settings.name
    old, camel = f"my_{kind}", class_name(name)
    old_camel = class_name(old)
    templates = [(data_dir("templates") / file).read_text(encoding="utf-8") for file in files(old)]
    if camel != old_camel and any(re.search(rf"\b{camel}\b", text) for text in templates):
        raise ConfigError(f"the module imports another {camel}; choose another name, as my_{name}")
    for path, text in zip(files(name), templates, strict=True):
        text = text.replace(old, name).replace(old_camel, camel)
        write_text(path, text)
    print(f"{' and '.join(files(name))} are written. Next:")
    for line in (f"python -m pytest test_{name}.py", *NEXT[kind]):
        print(f"  {line.format(name=name)}")


COMMAND = Command(main, Settings, positional="kind name")
