"""Agreement of a policy's actions with the expert's."""

import math

import pytest
import torch
from tensordict import TensorDict

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.agreement import agreement_table, agreements, check_comparable

OURS = torch.tensor([[1.0, 0.0, 0.5], [1.0, 1.0, -0.5], [1.0, 2.0, 0.5]])
EXPERT = torch.tensor([[1.0, 0.0, -0.5], [0.0, 3.0, 0.5], [1.0, 3.0, -0.5]])


def test_agreements_are_those_of_the_definitions():
    constant, middle, opposite = agreements(OURS, EXPERT)
    assert constant.correlation is None
    assert constant.difference == pytest.approx(math.sqrt(1 / 3))
    # products of deviations: (-1)(-2) + 0 + (1)(1); sums of squares: 2 and 4 + 1 + 1
    assert middle.correlation == pytest.approx(3 / math.sqrt(2 * 6))
    assert middle.difference == pytest.approx(math.sqrt((0 + 4 + 1) / 3))
    assert middle.spread == pytest.approx(math.sqrt(6 / 3))
    assert opposite.correlation == pytest.approx(-1)


def test_poses_are_not_compared():
    check_comparable("close_loop/block_stacking")
    with pytest.raises(ConfigError, match=r"expert: .* open_loop/block_stacking are poses"):
        check_comparable("open_loop/block_stacking")


def test_the_table_has_first_steps_and_all():
    episodes = [
        TensorDict({"action": OURS, "expert_action": EXPERT}, [3]),
        TensorDict({"action": OURS[1:], "expert_action": EXPERT[1:]}, [2]),
    ]
    lines = agreement_table(episodes, "pxr").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert [row[:2] for row in rows] == [[c, s] for s in ("first", "all") for c in "pxr"]
    # x of the first steps: 0 and 1, the expert's 0 and 3
    assert rows[1][2:] == ["1.00", "1.41", "1.50"]
    x = torch.tensor([0, 1, 2, 1, 2.0]), torch.tensor([0, 3, 3, 3, 3.0])
    expected = float(torch.corrcoef(torch.stack(x))[0, 1])
    assert rows[4][2] == f"{expected:.2f}"
    assert rows[0][2] == "-"
