"""Commands and recipes that run in the process of the test."""

import importlib
import importlib.util
import sys
from pathlib import Path

from ba_torchrl.cli import command_names

ROOT = Path(__file__).parents[1]


def load_recipe(name):
    """Return the module of a command or of a recipe."""
    if name in command_names():
        return importlib.import_module(f"ba_torchrl.commands.{name}")
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", ROOT / f"recipes/{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where pydantic looks up the types of models
    spec.loader.exec_module(module)
    return module


def recipe(name, *words, config_name=None):
    """Run a command or a recipe in this process, with the configuration of its name or another."""
    chosen = [] if config_name is None else ["--config-name", config_name]
    load_recipe(name).COMMAND.run([*chosen, *words])
