"""Write demonstrations in another library's format, with a card of their task and their entries.

ba-torchrl convert demos/picking format=lerobot path=exports/picking
ba-torchrl convert demos/picking format=lerobot path=exports/seen 'cameras=[rgb,wrist_rgb]'
ba-torchrl convert demos/picking format=minari path=exports/picking-v0    # an id of Minari
ba-torchrl convert demos/picking format=hdf5 path=exports/picking.hdf5    # robomimic
ba-torchrl convert demos/picking format=zarr path=exports/picking.zarr    # Diffusion Policy
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import NewPath, PluginSettings, Text, checked
from ba_torchrl.core.config import LocalPath
from ba_torchrl.demonstrations.formats.base import FORMATS, card_file


class Settings(PluginSettings):
    """Settings of this command."""

    demos: LocalPath
    """A folder that collect wrote."""
    format: Annotated[Text, checked(FORMATS.__getitem__)]
    """Of the library."""
    path: NewPath
    """New file or folder."""
    keys: list[Text] | None = None
    """Observations that are written; null for all of them."""
    cameras: list[Text] | None = None
    """Of LeRobot's format: images that policies see as pictures; null for all of one size."""


def main(settings: Settings) -> None:
    """Read the demonstrations and write them anew."""
    from ba_torchrl.demonstrations.demo_files import read_demonstrations
    from ba_torchrl.demonstrations.exchange import export_demonstrations

    episodes, metadata = read_demonstrations(settings.demos)
    export_demonstrations(
        settings.path,
        episodes,
        format=settings.format,
        task=metadata["task"],
        env=metadata["env"],
        seed=metadata["seed"],
        source=metadata["source"],
        policy=metadata.get("policy", ""),
        expert_version=metadata["expert_version"],
        observed=settings.keys,
        cameras=settings.cameras,
    )
    path = Path(settings.path)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files) / 1e6
    print(f"{len(episodes)} episodes of {metadata['task']} in {path}, {size:.2f} MB")
    print(f"  card    {card_file(path)}")


COMMAND = Command(main, Settings, positional="demos")
