"""Settings of the site, and the pages that each build makes from the classes.

make docs
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util import logging

from ba_torchrl import __version__, list_tasks
from ba_torchrl.algorithms.base import ALGORITHMS
from ba_torchrl.core.config import descriptions
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.envs.description import describe, expert_scores, summary, tasks_by_heading
from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.record.results import read_result, shipped_file, shipped_policies
from ba_torchrl.record.statistics import wilson
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.policy import evaluate_command
from docs.notebook import markdown, notebook

project, author, release = "BA-TorchRL", "The BA-TorchRL authors", __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinxcontrib.mermaid",
]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
myst_fence_as_directive = ["mermaid"]
viewcode_follow_imported_members = False  # with it, the sources link back to wrong names
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
mermaid_width, mermaid_height, mermaid_fullscreen = "min(100%, 34rem)", "auto", False
default_role = "py:obj"
python_maximum_signature_line_length = 80
python_use_unqualified_type_names = True
autodoc_default_options = {"exclude-members": "model_config"}
html_theme = "furo"
html_title = "BA-TorchRL"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_copyright = False
exclude_patterns = ["_build", "results/**", "tasks.md"]

NAMES = re.compile(r'(?<=<span class="pre">)[^<]{12,}|(?<=<h1>)[^<]+')
logger = logging.getLogger(__name__)
FOLDER = Path(__file__).parent
GENERATED = FOLDER / "generated"
"""Pages of `write_pages`, which are not tracked."""


def setup(app: Sphinx) -> None:
    """Make the generated pages before Sphinx looks for its sources; check what it has built."""
    app.connect("config-inited", lambda *_: write_pages())
    app.connect("autodoc-process-signature", without_fields)
    app.connect("autodoc-process-docstring", keep_colons, priority=100)
    app.connect("html-page-context", break_names)
    app.connect("build-finished", check_site)


def without_fields(
    app: Sphinx, what: str, name: str, obj: object, options: object, *texts: str | None
) -> tuple[str, None] | None:
    """Leave the fields of a pydantic model out of its signature: each is described below it."""
    if isinstance(obj, type) and issubclass(obj, BaseModel):
        return "", None
    return None


def keep_colons(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Break the first line of an attribute's text at a colon, else what precedes it is its type."""
    if what in ("attribute", "data", "property") and lines:
        first, colon, rest = lines[0].partition(": ")
        lines[:1] = [first + colon.strip(), rest] if colon else [first]


def break_names(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object
) -> None:
    """Let names in code and headings break after their punctuation, where a line is too short."""
    if "body" in context:
        context["body"] = NAMES.sub(
            lambda found: re.sub(r"([_/=.,([])(?=[^\d\s])", r"\1<wbr>", found[0]), context["body"]
        )


class _Page(HTMLParser):
    """The ids of a page, and the targets of links and images in its article."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.targets: list[str] = []
        self._is_article = False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self._is_article |= tag == "article"
        if "id" in found:
            self.ids.add(found["id"])
        target = found.get("href", found.get("src"))
        if self._is_article and target is not None:
            self.targets.append(target)

    def handle_endtag(self, tag: str) -> None:
        self._is_article &= tag != "article"


def check_site(app: Sphinx, exception: Exception | None) -> None:
    """Warn of each link and image of a built page whose target is missing.

    Args:
        app: whose pages are HTML.
        exception: of the build.
    """
    if exception is not None or app.builder.format != "html":
        return
    pages = {path: _Page(path) for path in sorted(Path(app.outdir).resolve().rglob("*.html"))}
    for path, page in pages.items():
        for target in page.targets:
            url = urlsplit(target)
            there = path if not url.path else (path.parent / unquote(url.path)).resolve()
            is_page = there in pages and bool(url.fragment or not url.path)
            known = unquote(url.fragment) in pages[there].ids if is_page else there.exists()
            if not url.scheme and not known:
                logger.warning("%s: %s does not exist", path.name, target)


def write_pages() -> None:
    """Write one page per task, an index of them, and the fields of all configurations."""
    shutil.rmtree(GENERATED, ignore_errors=True)
    (GENERATED / "tasks").mkdir(parents=True)
    groups = tasks_by_heading(list_tasks())
    for task in list_tasks():
        page = GENERATED / "tasks" / f"{_slug(task)}.md"
        page.write_text(task_page(task), encoding="utf-8")
    lines = [
        "# Tasks",
        "",
        "[Controls](../environments.md#controls) says what close loop and open loop are. The last",
        "column has the success rates of the expert on four robots.",
        "",
    ]
    for heading, tasks in groups.items():
        lines += [f"## {heading}", "", "| | task and goal | expert |", "|---|---|---|"]
        for task in tasks:
            rates = [score.success_rate for score in expert_scores()[task].values()]
            span = dict.fromkeys(f"{rate:.3f}" for rate in (min(rates), max(rates)))
            page, picture = f"tasks/{_slug(task)}.md", f"![](../gallery/{_slug(task)}.png)"
            goal = summary(task)
            text = f"[`{task}`]({page})<br>{goal[:1].upper()}{goal[1:]}"
            lines.append(f"| {picture} | {text} | {' to '.join(span)} |")
        pages = (f"tasks/{_slug(task)}" for task in tasks)
        lines += ["", "```{toctree}", ":hidden:", *pages, "```", ""]
    (GENERATED / "tasks.md").write_text("\n".join(lines), encoding="utf-8")
    (GENERATED / "fields.md").write_text(fields_page(), encoding="utf-8")
    script = (FOLDER / "tutorials" / "sac.py").read_text(encoding="utf-8")
    (GENERATED / "sac.inc").write_text(markdown(script), encoding="utf-8")
    (GENERATED / "sac.ipynb").write_text(json.dumps(notebook(script), indent=1), encoding="utf-8")


def task_page(task: str) -> str:
    """Return the page of a task: film, description, expert and trained policy."""
    found, slug = describe(task), _slug(task)
    pictures = {
        f"{slug}.webp": "Film: the policy that the package ships.",
        f"{slug}_expert.webp": "Film: the expert.",
        f"{slug}.png": "Picture: the last scene of an episode of the expert.",
    }
    name = next(name for name in pictures if (FOLDER / "gallery" / name).exists())
    lines = [f"# {task}", "", f"![{task}](../../gallery/{name})", "", pictures[name], ""]
    lines += [found.text, ""]
    lines += [
        "An episode succeeds when all conditions of the row `success` hold. The row `expert` has",
        "success rates. Keys and units: [environments](../../environments.md#keys).",
        "",
    ]
    lines += ["| | value (allowed values) |", "|---|---|"]
    keywords = {"max_steps", "object_scale_range", "num_objects", *found.parameters}
    for name, value in found.rows().items():
        lines.append(f"| {f'`{name}`' if name in keywords else name} | {_cell(value)} |")
    if task in shipped_policies():
        result = read_result(shipped_file(task))
        rate, low, high = wilson(result.last.success_rate, result.last.episodes)
        lines += [
            f"| trained policy | {rate:.2f} ({low:.2f} to {high:.2f}) over "
            f"{result.last.episodes} episodes, {result.label} |",
            f"| check it | `{evaluate_command(task, result)}` |",
            f"| watch it | `ba-torchrl play {task} policy=trained video=film.gif` |",
        ]
    lines += [f"| watch the expert | `ba-torchrl play {task} video=film.gif` |"]
    lines += ["", "```python", "import ba_torchrl", "", f'env = ba_torchrl.make("{task}")', "```"]
    return "\n".join(lines) + "\n"


def fields_page() -> str:
    """Return the page of the fields of the command line's and the library's configurations."""
    lines = [
        "# Configuration fields",
        "",
        "Paths are those of the command line: `env.obs_size=64`.",
    ]
    sections: Mapping[str, Iterable[tuple[str, type[BaseModel]]]] = {
        "Training": [("`ba-torchrl train`", ExperimentConfig)],
        "Environments": [("`env`, the keywords of `ba_torchrl.make`", EnvConfig)],
        "Algorithms": [(f"`algorithm={name}`", ALGORITHMS[name]) for name in ALGORITHMS],
        "Networks": [(f"`network={name}`", NETWORKS[name]) for name in NETWORKS],
    }
    for heading, models in sections.items():
        lines += ["", f"## {heading}"]
        for title, model in models:
            lines += ["", f"### {title}", "", "| field | default | meaning |", "|---|---|---|"]
            lines += _rows(model)
    return "\n".join(lines) + "\n"


def _rows(model: type[BaseModel]) -> Iterable[str]:
    """Yield a row of a table for each field."""
    texts = descriptions(model)
    for name, field in model.model_fields.items():
        default: Any = (
            "required"
            if field.is_required()
            else f"`{field.get_default(call_default_factory=True)!r}`"
        )
        yield f"| `{name}` | {_cell(default)} | {_cell(texts.get(name, ''))} |"


def _slug(task: str) -> str:
    return task.replace("/", "_")


def _cell(text: str) -> str:
    """Return a text without line breaks and column marks."""
    return " ".join(text.split()).replace("|", "\\|")
