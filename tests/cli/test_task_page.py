"""docs/tasks.md equals the output of `ba-torchrl tasks` and lists the conditions of success."""

from pathlib import Path

import ba_torchrl
from ba_torchrl.commands import tasks

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
OURS = [task for task in ba_torchrl.list_tasks() if not task.startswith("mine/")]


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == tasks.page(OURS), (
        "delete it and run `ba-torchrl tasks path=docs/tasks.md`"
    )


def test_a_section_has_description_conditions_and_parameters():
    page = tasks.page(["close_loop/object_grasping"])
    assert "### `close_loop/object_grasping`" in page
    assert "- success: is_grasped, is_lifted" in page
    assert "- `object_set`: 'random'. Name of the object set" in page
    assert "- `max_attempts`: None. Episodes with the same heap" in page
    assert "- `num_objects`: 5 (1 to 15)" in page
    assert "- `object_scale_range`: 1 (" in page
    assert "block_picking" not in page
