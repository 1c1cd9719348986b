"""docs/architecture.md: its picture is that of the present imports, and it names every folder."""

import re
from pathlib import Path

from docs import architecture, private_names, results

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_the_picture_is_drawn_from_the_imports():
    assert architecture.page_with_picture(PAGE) == PAGE, "run `python -m docs.architecture`"


def test_the_page_of_results_has_the_present_results():
    page = results.PAGE.read_text(encoding="utf-8")
    assert results.page_with_results(page) == page, "run `python -m docs.results`"


def test_every_private_name_of_another_library_has_its_reason():
    assert private_names.found() == {*private_names.REASONS, *private_names.OTHERS}


def test_every_folder_has_a_line():
    folders = {path.parent.name for path in (ROOT / "ba_torchrl").glob("*/__init__.py")}
    named = set(re.findall(r"^\| `(\w+)/`", PAGE, flags=re.MULTILINE))
    assert named == folders


def test_examples_and_files_exist():
    paths = re.findall(r"`((?:tests|docs|ba_torchrl)/[\w/.]+)`", PAGE)
    paths += [
        f"ba_torchrl/{path}"
        for path in re.findall(r"`((?:envs|sim|tasks|data|training)/\w+\.py)`", PAGE)
    ]
    assert [path for path in paths if not (ROOT / path).exists()] == []
    assert len(paths) > 8
