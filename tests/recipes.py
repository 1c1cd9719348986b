"""Recipes that run in the process of the test."""

import importlib.util
import sys
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import open_dict

from ba_torchrl.training import hydra_schema

ROOT = Path(__file__).parents[1]


def load_recipe(name):
    """Return the module of a recipe."""
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", ROOT / f"recipes/{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where pydantic looks up the types of models
    spec.loader.exec_module(module)
    return module


def recipe(name, *overrides, config_name=None):
    """Run a recipe in this process, with the configuration of its name or another one."""
    module = load_recipe(name)
    hydra_schema.register()
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        settings = compose(config_name or name, overrides=list(overrides), return_hydra_config=True)
        HydraConfig.instance().set_config(settings)
        with open_dict(settings):
            del settings["hydra"]
        try:
            module.main.__wrapped__(settings)
        finally:
            HydraConfig.instance().cfg = None
