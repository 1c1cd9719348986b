"""The diagnosis of policies, and label jumps of experts."""

import csv
import math
import re
from contextlib import closing

import numpy as np
import pytest
import torch
from scipy import ndimage

from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.record.diagnosis import write_diagnosis
from ba_torchrl.tasks.close_loop.block_picking import BlockPicking
from ba_torchrl.testing import diagnosis
from ba_torchrl.testing.diagnosis import diagnose
from ba_torchrl.testing.episodes import make_small
from ba_torchrl.testing.labels import label_jump_share, offset_of
from tests.recipes import recipe

PICK, STACK = "close_loop/block_picking", "open_loop/block_stacking"
BOUNDS = ((0.0, 1.0), (0.0, 1.0), (0.0, 0.4))


@pytest.mark.parametrize(
    ("actions", "action", "label", "offset"),
    [
        (OpenLoopActions("pxyr", BOUNDS), [0, 0.2, 0.3, 0.1], [0, 0.23, 0.26, 3.1], (50, 8.1)),
        (OpenLoopActions("pxyr", BOUNDS, False), [0, 0, 0, 0.1], [0, 0, 0, 3.1], (0, 171.9)),
        # half a turn about the tool's own axis swaps the fingers, also of a tilted tool
        (
            OpenLoopActions("pxyzrrr", BOUNDS),
            [0, 0, 0, 0.10, 0.0, 0.3, -0.2],
            [0, 0, 0, 0.13, math.pi, -0.3, 0.2],
            (30, 0),
        ),
        (CloseLoopActions(), [1, 0.6, 0, 0.8, 0.5], [1, 0, 0, 0, -0.5], (50, 45)),
        (OpenLoopActions("xyp", BOUNDS), [0, 0, 1], [0, 0, 0], None),
        (CloseLoopActions("pxyz"), [-1, 0, 0, 0], [1, 0, 0, 0], None),
    ],
)
def test_offsets_are_in_millimetres_and_degrees(actions, action, label, offset):
    found = offset_of(actions, np.float32(action), np.float32(label))
    assert found.is_other_primitive is (offset is None)
    assert (found.distance_mm, found.rotation_deg) == pytest.approx(offset or (0, 0), abs=0.06)
    assert found.is_jump


def test_labels_that_depend_on_the_last_bits_jump(monkeypatch):
    assert label_jump_share(PICK, episodes=1) == 0.0
    right = BlockPicking.expert_command

    def by_last_bits(task):
        is_odd = task.block.position[0] * 1e9 // 1 % 2
        command = right(task)
        return command._replace(dx_m=command.dx_m + 0.02) if is_odd else command

    monkeypatch.setattr(BlockPicking, "expert_command", by_last_bits)
    with closing(make_small(PICK, expert=True)) as env:
        before = env.reset()
        state = env.get_state()
        assert diagnosis.label_jumps(env, state, np.random.default_rng(0), asks=20)
        after = env.step(before.set(keys.ACTION, before[keys.EXPERT_ACTION]))
        env.reset(state, set_state=True)  # as it was before the expert was asked again
        again = env.step(before)
    assert torch.equal(after["next", keys.DEPTH], again["next", keys.DEPTH])


def policy_of(first=None, then=None):
    """Return a policy that is the expert, but for its first two actions or those that follow."""

    def act(state):
        expert, number = state[keys.EXPERT_ACTION].clone(), int(state[keys.STEP_COUNT])
        changed = first if number < 2 else then
        return state.set(keys.ACTION, changed(state, expert, number) if changed else expert)

    return act


def still(state, expert, number):
    return torch.tensor([1.0, 0, 0, 0, 0])


def closed(state, expert, number):
    return torch.tensor([-1.0, 0, 0.1 * number, 0, 0])


def beside(state, expert, number):
    """Places some centimetres off."""
    expert[1] += (0.06 + 0.01 * number) * expert[0] * (1 if expert[1] < 0.45 else -1)
    return expert


def outside(state, expert, number):
    """Places at the border of the workspace, which ends the episode."""
    expert[1] = torch.where(expert[0] > 0, 0.65, expert[1])
    return expert


def nowhere(state, expert, number):
    """Picks where no object is near."""
    far = ndimage.distance_transform_edt(state[keys.HEIGHTMAP][0].numpy() < 0.005)
    row, column = np.unravel_index(far.argmax(), far.shape)
    x, y = 0.25 + 0.4 * row / 128, -0.2 + 0.4 * column / 128
    return torch.tensor([0, x, y, 0.1 * number], dtype=torch.float32)


@pytest.mark.parametrize(
    ("task", "policy", "limit", "kind", "stage"),
    [
        (PICK, policy_of(first=still), 8, diagnosis.OUT_OF_STEPS, "holding"),
        (PICK, policy_of(then=still), 9, diagnosis.REPEATS, "empty"),
        (PICK, policy_of(then=closed), 12, diagnosis.CLOSES_EARLY, "empty"),
        (PICK, policy_of(), 3, diagnosis.EXPERT_FAILS, "empty"),
        (STACK, policy_of(then=beside), 6, diagnosis.PLACES_OFF, "place 2 of 3"),
        (STACK, policy_of(then=nowhere), 6, diagnosis.MISSES, "pick 2 of 3"),
    ],
)
def test_kinds_of_failures(task, policy, limit, kind, stage, tmp_path):
    with closing(make_small(task, expert=True, max_steps=limit)) as env:
        found = diagnose(env, policy, [0], None if task == PICK else lambda action: action.round())
    (failure,) = found.failures
    assert (failure.kind, str(failure.stage)) == (kind, stage)
    reached = kind != diagnosis.EXPERT_FAILS
    assert failure.successes["expert"] is reached
    assert (failure.to_go is not None) is reached
    assert len(found.states) == failure.steps == limit
    assert [row.policy.distance_mm > 1 for row in found.states[:2]] == [
        kind == diagnosis.OUT_OF_STEPS
    ] * 2
    if kind == diagnosis.PLACES_OFF:
        assert failure.step == 3
        assert failure.to_go == 3
        assert abs(failure.policy.x_mm) == pytest.approx(90, abs=0.01)
        assert failure.successes["policy, then expert"] is True  # it loses two steps only
        assert failure.rounded.y_mm != 0
    text = write_diagnosis(found, tmp_path / "new", "mine", 1)
    assert f"0 of 1 episodes of {task} are solved" in text
    assert f"| {kind} | {stage} | 1 |" in text
    page = (tmp_path / "new/diagnosis.html").read_text()
    assert f"<h2>{kind}: {diagnosis.KINDS[kind]}</h2>" in page
    assert (tmp_path / "new" / re.search(r'img .*src="(.*)"', page)[1]).read_bytes()[1:4] == b"PNG"
    (row,) = csv.DictReader((tmp_path / "new/failures.csv").open())
    assert (row["kind"], row["expert succeeds"]) == (kind, str(reached))


def test_an_invalid_scene_is_no_lack_of_steps():
    config = {"expert": True, "max_steps": 6, "workspace_check": "bounding_box"}
    with closing(make_small(STACK, **config)) as env:
        (failure,) = diagnose(env, policy_of(then=outside), [0]).failures
    assert (failure.kind, failure.step, failure.steps) == (diagnosis.PLACES_OFF, 3, 4)
    assert failure.to_go > failure.steps - failure.step
    assert failure.successes["policy, then expert"] is False


@pytest.mark.parametrize("task", [PICK, STACK])
def test_a_shipped_policy_is_diagnosed_in_a_new_folder(task, tmp_path, capsys):
    words = (task, "episodes=1", f"folder={tmp_path / 'new'}")
    recipe("diagnose", *words)
    assert f"1 of 1 episodes of {task} are solved" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "new").iterdir()} == {
        *("diagnosis.html", "table.md", "failures.csv", "states.csv")
    }
    rows = list(csv.DictReader((tmp_path / "new/states.csv").open()))
    assert {row["stage"] for row in rows} == {
        *(("pick", "place") if task == STACK else ("empty", "holding"))
    }
    assert ("rounded_x_mm" in rows[0]) is (task == STACK)
    assert max(float(row["policy_x_mm"]) for row in rows) < 100
    with pytest.raises(SystemExit):
        recipe("diagnose", *words)
    assert "exists already; choose another path" in capsys.readouterr().err
