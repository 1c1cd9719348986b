"""Who may import whom, read off the sources and off what an import pulls in."""

import ast
import io
import re
import subprocess
import sys
from pathlib import Path

import tomllib

from ba_torchrl import sim

ROOT = Path(__file__).parents[1]
PACKAGE = "ba_torchrl"

# Each part may import itself, what comes before it, and what EXTRA names. `__init__` is the
# package itself, whose functions make environments.
CHAIN = ["core", "sim", "tasks", "envs", "demonstrations", "algorithms", "training", "cli"]
CHAIN += ["commands", "recipes"]
EXTRA = {
    "demonstrations": {"__init__"},
    "algorithms": {"__init__", "data", "modules", "objectives"},
    "training": {"__init__", "data", "record"},
    "cli": {"__init__", "record"},
    "commands": {"__init__", "data", "record", "modules", "testing"},
    "__main__": {"cli"},
    "recipes": {"__init__", "record"},
}
APART = {
    "__init__": {"core", "sim", "tasks", "envs", "training.policy"},
    "__main__": {"cli"},
    "testing": {"core", "testing", "sim", "tasks", "envs", "__init__"},
    "data": {"core", "data"},
    "modules": {"core", "modules"},
    "objectives": {"core", "objectives"},
    "record": {"core", "record", "sim", "tasks", "envs", "demonstrations", "testing"}
    | {"__init__"},
    # measurements, which read every part
    "recipes.profiling": {"core", "__init__", "sim", "tasks", "envs", "demonstrations", "data"}
    | {"modules", "objectives", "algorithms", "training", "record"},
    # other libraries beside the environments
    "recipes.clients": {"core", "envs", "__init__"},
    # whole algorithms as scripts: no learner and no experiment
    "recipes.torchrl": {"core", "envs", "demonstrations", "data", "modules", "objectives"}
    | {"__init__"},
}
LEARNING = {"torch", "tensordict", "torchrl"}
FORBIDDEN_PACKAGES = dict.fromkeys(("sim", "tasks"), LEARNING)


def allowed_parts(part):
    if part in APART:
        return APART[part]
    return set(CHAIN[: CHAIN.index(part) + 1]) | EXTRA.get(part, set())


def part_of(module):
    """Return the part a dotted module name belongs to: 'ba_torchrl.sim.world' -> 'sim'."""
    names = module.split(".")
    if names[0] != PACKAGE:
        return ".".join(names[:2]) if len(names) > 2 else names[0]
    return names[1] if len(names) > 1 else "__init__"


def imported_modules(source, module, is_package, known):
    """Yield (line, dotted name) of every import in ``source``, those for type checkers included.

    ``from package import name`` counts as the module ``package.name`` if that is in ``known``.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = node.module or ""
            if node.level:
                parents = module.split(".")
                parents = parents[: len(parents) - node.level + is_package]
                origin = ".".join([*parents, *([origin] if origin else [])])
            for alias in node.names:
                name = f"{origin}.{alias.name}"
                yield node.lineno, name if name in known else origin


def violations(source, module, known=(), is_package=False):
    """Return what ``source``, as the text of ``module``, imports against the rules."""
    part = part_of(module)
    allowed = allowed_parts(part)
    found = []
    for line, name in imported_modules(source, module, is_package, set(known)):
        if name.split(".")[0] == PACKAGE:
            target = part_of(name)
            inside = name.removeprefix(f"{PACKAGE}.")
            if target not in allowed and inside not in allowed:
                found.append(f"{module}:{line} {part} imports {target} ({name})")
        elif name.split(".")[0] in FORBIDDEN_PACKAGES.get(part, ()):
            found.append(f"{module}:{line} {part} imports {name}")
    return found


def modules_below(folder):
    """Return {dotted name: path} of every module below ``folder``, itself in the repository."""
    found = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        names = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(names[:-1] if names[-1] == "__init__" else names)] = path
    return found


MODULES = modules_below(PACKAGE)
RECIPES = modules_below("recipes")


def test_imports_go_one_way():
    for module, path in {**MODULES, **RECIPES}.items():
        source = path.read_text(encoding="utf-8")
        assert violations(source, module, MODULES, path.name == "__init__.py") == []


SIM = (
    {"geometry"},
    {"contacts", "meshes"},
    {"shapes"},
    {"assets", "bodies"},
    {"articulated"},
    {"world"},
    {"robots", "vision"},
    {"control"},
)
"""Layers of the simulator: each imports those before it."""


def imports_of(module):
    """Return the names that a module of the package imports."""
    path = MODULES[module]
    source, is_package = path.read_text(encoding="utf-8"), path.name == "__init__.py"
    return {name for _, name in imported_modules(source, module, is_package, set(MODULES))}


def test_imports_inside_the_simulator_go_one_way():
    def layer(name):
        part = name.split(".")[2]
        return next(i for i, parts in enumerate(SIM) if part in parts), part

    for module in filter(lambda name: name.startswith("ba_torchrl.sim."), MODULES):
        own, part = layer(module)
        inside = filter(lambda name: name.startswith("ba_torchrl.sim."), imports_of(module))
        later = [name for name in inside if layer(name)[0] >= own and layer(name)[1] != part]
        assert later == [], module


EAGER = {"ba_torchrl.envs.registration"}


def circles(imports):
    """Return the sets of modules that import each other, directly or through others.

    Args:
        imports: from each module to those it imports.
    """
    reached = {module: set(targets) for module, targets in imports.items()}
    grows = True
    while grows:
        grows = False
        for targets in reached.values():
            more = set().union(*(reached.get(target, ()) for target in targets)) - targets
            targets |= more
            grows = grows or bool(more)
    members = {module for module, targets in reached.items() if module in targets}
    return {frozenset({module} | (reached[module] & members)) for module in members}


def test_no_two_files_import_each_other():
    imports = {module: imports_of(module) & {*MODULES} - {module} for module in MODULES}
    imports[PACKAGE] &= EAGER  # it imports what its names refer to at their first use
    assert sum(map(len, imports.values())) > len(imports)
    assert circles(imports) == set()


LIGHT = (
    ((), LEARNING | {"pybullet", "numba", "gymnasium", "pydantic"}),
    (("sim", "tasks"), LEARNING),
    (("envs",), {"matplotlib", "hydra", "omegaconf", "imageio_ffmpeg"}),  # of workers
)
"""Parts, and the packages that an interpreter has not loaded after it imported the package, then
all modules of these parts and of those above them."""


def test_the_package_and_its_workers_stay_light():
    stages = []
    for parts, heavy in LIGHT:
        names = [name for part in parts for name in modules_below(f"{PACKAGE}/{part}")]
        assert len(names) > 10 or not parts
        stages.append((names or [PACKAGE], heavy))
    code = (
        f"import importlib, sys\nfor names, heavy in {stages!r}:\n"
        "    for name in names: importlib.import_module(name)\n"
        "    loaded = {name.split('.')[0] for name in sys.modules}\n"
        "    assert not loaded & heavy, (names[0], loaded & heavy)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_requirements_fit_the_package():
    pins = {}
    for name in ("requirements.txt", "requirements-no-deps.txt"):
        for line in (ROOT / name).read_text(encoding="utf-8").splitlines():
            if line and not line.startswith("#"):
                package, version = line.split("==")
                pins[package.lower().replace("_", "-")] = version
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["train"], *extras["dev"]]
    for requirement in wanted:
        package, bounds = re.fullmatch(r"([\w.-]+?)\s*((?:[<>=!~].*)?)", requirement).groups()
        pinned = pins[package.lower().replace("_", "-")]
        for bound in filter(None, bounds.split(",")):
            operator, version = re.fullmatch(r"(==|>=|<)(.+)", bound).groups()
            left, right = ([int(n) for n in text.split(".")] for text in (pinned, version))
            holds = {"==": left == right, ">=": left >= right, "<": left < right}[operator]
            assert holds, f"{package} is pinned to {pinned}, but pyproject.toml says {bound}"


def test_a_closed_output_does_not_keep_pybullet_from_its_import(monkeypatch):
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(sys, "stdout", closed)
    with sim._silent():
        pass
