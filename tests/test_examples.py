"""The examples of docstrings, which run; and the public names that have one."""

import doctest
import importlib
import inspect

import pytest

import ba_torchrl
from ba_torchrl import data, demonstrations, modules, objectives

PACKAGES = (ba_torchrl, data, demonstrations, modules, objectives)
WITH_EXAMPLE = [
    *((ba_torchrl, name) for name in ("BulletArmEnv", "load_policy", "make", "make_vector_env")),
    (demonstrations, "BulletArmExperienceReplay"),
    *((package, name) for package in (data, objectives) for name in package.__all__),
]
WITHOUT_EXAMPLE = {"as_transitions", "make_replay", "use_python_segment_trees"}
"""Functions whose arguments say how they are called."""
EXAMPLES = {
    f"{package.__name__}.{name}": getattr(package, name)
    for package in PACKAGES
    for name in package.__all__
    if ">>>" in (inspect.getdoc(getattr(package, name)) or "")
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name):
    found = EXAMPLES[name]
    module = importlib.import_module(found.__module__)
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    (test,) = doctest.DocTestFinder(recurse=False).find(found, name, module=module, globs={})
    report = []
    doctest.DocTestRunner(optionflags=flags).run(test, out=report.append)
    assert not report, "".join(report)


def test_public_parts_of_torchrl_have_an_example():
    names = {f"{package.__name__}.{name}" for package, name in WITH_EXAMPLE}
    missing = {name for name in names if name.rpartition(".")[2] not in WITHOUT_EXAMPLE}
    assert missing <= EXAMPLES.keys()
