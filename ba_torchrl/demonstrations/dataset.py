"""Demonstrations as a data set of TorchRL."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.collectors.utils import split_trajectories
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay

from ba_torchrl.core.files import read_json
from ba_torchrl.demonstrations.demo_files import METADATA_FILE, load_demonstrations


class BulletArmExperienceReplay(BaseDatasetExperienceReplay):
    """Demonstrations as an immutable data set of TorchRL, in memory.

    Transitions are in the order of their episodes, with the entries of the environment, those after
    the step under "next", and ``episode``, the number of the episode, by which `SliceSampler` finds
    trajectories. Images are float32, as the environment returns them.

    Args:
        dataset_id: path of demonstrations below ``root``, as `load_demonstrations` takes it; of
            graded sets, such as ``close_loop/block_picking/expert``.
        batch_size: of a sample; None if each call of ``sample`` passes it.
        root: folder of data sets, such as that of ``ba-torchrl graded``; by default
            the present one.
        task, env, mapping: as for `load_demonstrations`.
        split_trajs: items are episodes, padded to the longest, with ``mask``; else transitions.
        options: as for `TensorDictReplayBuffer`, such as ``sampler`` or ``transform``; the writer
            refuses to write by default.

    Examples:
        >>> import tempfile
        >>> from ba_torchrl.demonstrations import BulletArmExperienceReplay, save_demonstrations
        >>> from ba_torchrl import make
        >>> task, settings = "close_loop/block_reaching", {"obs_size": 64, "max_steps": 4}
        >>> env = make(task, **settings)
        >>> episodes, root = [env.rollout(4), env.rollout(4)], tempfile.mkdtemp()
        >>> save_demonstrations(f"{root}/demos", episodes, task=task, env=settings, seed=0)
        >>> replay = BulletArmExperienceReplay("demos", batch_size=16, root=root)
        >>> len(replay), replay.sample()["next", "depth"].shape
        (8, torch.Size([16, 1, 64, 64]))
        >>> env.close()
    """

    def __init__(
        self,
        dataset_id: str | Path,
        batch_size: int | None = None,
        *,
        root: str | Path | None = None,
        task: str | None = None,
        env: dict[str, Any] | None = None,
        mapping: str | Path | Mapping[str, Any] | None = None,
        split_trajs: bool = False,
        **options: Any,
    ) -> None:
        self.dataset_id, self.root = str(dataset_id), root or "."
        episodes = load_demonstrations(self.data_path, task=task, env=env, mapping=mapping)
        is_own = self.data_path.joinpath(METADATA_FILE).exists()
        self.metadata: dict[str, Any] = read_json(self.data_path / METADATA_FILE) if is_own else {}
        """Task, parameters, source and scores, of a folder of ``ba-torchrl collect``."""
        for number, episode in enumerate(episodes):
            episode["episode"] = torch.full((len(episode),), number, device="cpu")
        steps = torch.cat(episodes)
        if split_trajs:
            steps = split_trajectories(steps, trajectory_key="episode")
        options = {"writer": ImmutableDatasetWriter(), **options}
        super().__init__(storage=TensorStorage(steps), batch_size=batch_size, **options)

    @staticmethod
    def available_datasets(root: str | Path = ".") -> list[str]:
        """Return the ids of the demonstrations that lie below a folder."""
        found = (path.parent.relative_to(root) for path in Path(root).rglob(METADATA_FILE))
        hidden = (".",)  # those that are being written
        return sorted(
            path.as_posix() for path in found if not any(p.startswith(hidden) for p in path.parts)
        )

    @property
    def data_path(self) -> Path:
        """Path of the demonstrations; `delete` removes it."""
        return self.root / self.dataset_id

    @property
    def data_path_root(self) -> Path:
        """The folder of data sets."""
        return self.root

    def _is_downloaded(self) -> bool:
        return self.data_path.exists()
