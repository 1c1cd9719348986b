"""Diagnose a policy: where it fails, and what the task's expert would have done there.

ba-torchrl diagnose close_loop/block_picking episodes=50      # the policy that the package ships
ba-torchrl diagnose runs/my-run folder=my-diagnosis
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, NewPath, Seed
from ba_torchrl.commands.evaluate import PolicySettings
from ba_torchrl.core.files import atomic_output
from ba_torchrl.record.logging import progress_bar

if TYPE_CHECKING:
    from ba_torchrl.testing.diagnosis import Rounding
    from ba_torchrl.training.policy import TrainedPolicy


class Settings(PolicySettings):
    """Settings of this command."""

    episodes: Count = 50
    """Their number."""
    seed: Seed = 7_000_000
    """Of the first episode. Those of the protocol are for tests alone."""
    folder: NewPath = "diagnosis"
    """New folder of the page, the tables and the pictures."""
    pictures: int = Field(default=4, ge=0)
    """Most pictures of each kind of failure in each stage."""


def main(settings: Settings) -> None:
    """Play episodes, compare the policy with the expert where it fails, and write the page."""
    from ba_torchrl.record.diagnosis import PAGE, write_diagnosis
    from ba_torchrl.testing.diagnosis import diagnose

    policy = settings.load()
    seeds = range(settings.seed, settings.seed + settings.episodes)
    folder = Path(settings.folder)
    with atomic_output(folder) as scratch:
        with (
            closing(policy.make_env(expert=True)) as env,
            progress_bar(total=settings.episodes, unit="episode") as bar,
        ):
            found = diagnose(env, policy, seeds, grid_of(policy), bar.update)
        tables = write_diagnosis(found, scratch, str(settings.policy), settings.pictures)
    print(tables)
    print(f"\n  page    {folder / PAGE}")
    print(f"  tables  {folder / 'table.md'}; rows failures.csv, states.csv")


def grid_of(policy: TrainedPolicy) -> Rounding | None:
    """Return the rounding of actions to a policy's grid; None if it has no grid."""
    from ba_torchrl.modules.spatial.policy import SpatialValues

    values = (module for module in policy.modules() if isinstance(module, SpatialValues))
    return next((found.actions.nearest for found in values), None)


COMMAND = Command(main, Settings, positional="policy")
