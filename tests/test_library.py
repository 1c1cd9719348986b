"""What users see of the package: names and help."""

import ast
import importlib
import inspect
import pydoc
import re
from pathlib import Path

import pytest
import torchrl

import ba_torchrl
from ba_torchrl import data, demonstrations, envs, modules, objectives
from ba_torchrl.core.errors import install_command
from docs.sources import definitions, sources

DOCS = Path(__file__).resolve().parents[1] / "docs"
PACKAGES = [ba_torchrl, data, demonstrations, envs, modules, objectives]


def test_the_help_of_the_package_shows_its_functions():
    text = pydoc.plain(pydoc.render_doc(ba_torchrl))
    for name in ("make", "make_vector_env", "list_tasks", "list_robots", "describe", "load_policy"):
        assert f"    {name}(" in text
        assert getattr(ba_torchrl, name).__doc__.strip().splitlines()[0] in text


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_described(package):
    for name in set(package.__all__) - {"__version__", "NETWORKS"}:
        assert (getattr(package, name).__doc__ or "").strip(), name
        assert name in dir(package)


def test_every_public_method_is_described_or_inherits_its_description():
    def lacks_text(cls, name):
        own = (vars(base)[name] for base in cls.__mro__ if name in vars(base))
        return not any(map(inspect.getdoc, own))

    found = [
        f"{module}.{node.name}.{method.name}"
        for module in sources()
        for node in definitions(module).values()
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
        if module.startswith("ba_torchrl.")
        for method in node.body
        if isinstance(method, ast.FunctionDef) and not method.name.startswith("_")
        if lacks_text(getattr(importlib.import_module(module), node.name), method.name)
    ]
    assert found == []


def test_the_page_on_torchrl_names_what_is_exported_and_in_the_reference():
    page, reference = ((DOCS / name).read_text() for name in ("torchrl.md", "api.md"))
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"(?ms)^```.*?^```", "", page))
    named = {name for span in spans for name in re.findall(r"(?<![\w./])[A-Za-z_][\w.]+", span)}
    exported = {name: package.__name__ for package in PACKAGES for name in package.__all__}
    ours = {
        name
        for module in sources()
        for name, node in definitions(module).items()
        if module.startswith("ba_torchrl") and isinstance(node, ast.ClassDef)
    }
    of_torchrl = {*dir(torchrl.data), *dir(torchrl.envs)}
    assert {"FrameStorage", "ExpertKeepingWriter", "StoredCopies"} <= named
    assert named & ours - of_torchrl <= exported.keys()
    for path in (name for name in named if name.startswith("ba_torchrl.")):
        package, _, name = path.rpartition(".")
        assert hasattr(importlib.import_module(package), name), path
        assert exported.get(name) == package or f":: {path}\n" in reference, path
    for package in set(exported.values()) - {"ba_torchrl", "ba_torchrl.envs"}:
        assert f".. automodule:: {package}\n" in reference
    for name in set(ba_torchrl.__all__) - {"__version__"}:
        assert re.search(rf"auto\w+:: {name}\n", reference), name


def test_the_command_that_installs_a_package_has_its_bounds(monkeypatch):
    monkeypatch.setattr(
        "ba_torchrl.core.errors.requires", lambda _: ['hydra-core<1.4,>=1.3.2; extra == "train"']
    )
    found = install_command("hydra-core", "other")
    assert found == "pip install 'hydra-core<1.4,>=1.3.2' other"
