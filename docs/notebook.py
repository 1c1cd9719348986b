"""The notebook and the page of a script whose cells begin with ``# %%``."""

from __future__ import annotations

import re
from typing import Any


def notebook(script: str) -> dict[str, Any]:
    """Return the notebook of a script, in Jupyter's format 4.5."""
    cells = []
    for number, found in enumerate(re.split(r"^# %%", script, flags=re.MULTILINE)[1:]):
        head, _, source = found.partition("\n")
        cell = {"id": f"cell-{number}", "metadata": {}, "source": source.strip()}
        if "[markdown]" in head:
            cell["source"] = re.sub(r"^# ?", "", cell["source"], flags=re.MULTILINE)
            cells.append({"cell_type": "markdown", **cell})
        else:
            cells.append({"cell_type": "code", "outputs": [], "execution_count": None, **cell})
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {
        "cells": cells,
        "metadata": {"kernelspec": kernel},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def markdown(script: str) -> str:
    """Return the cells after the first, which has the title and the purpose, as Markdown."""
    cells = notebook(script)["cells"][1:]
    fences = {"markdown": "{}\n", "code": "```python\n{}\n```\n"}
    return "\n".join(fences[cell["cell_type"]].format(cell["source"]) for cell in cells)
