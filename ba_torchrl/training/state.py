"""State of a run beside its algorithm and replay: learning curve, counters and times."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, get_args

from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.record.results import CurvePoint, Phase

RECENT_EPISODES = 100


@dataclass
class RunState:
    """What a run has done: learning curve, counters and times. A saved state contains it."""

    curve: list[CurvePoint] = field(default_factory=list)
    recent: deque[bool] = field(default_factory=lambda: deque(maxlen=RECENT_EPISODES))
    """Whether each of the latest training episodes reached the goal."""
    env_steps: int = 0
    faults: int = 0
    demonstrations: int = 0
    """Episodes of demonstrations."""
    demonstration_steps: int = 0
    expert_version: int | None = None
    """Of the expert that played demonstrations or labels states; None of no or an unknown one."""
    expert_labels: int = 0
    """States of the collection that the expert labelled and the replay stored."""
    phase_seconds: dict[Phase, float] = field(
        default_factory=lambda: dict.fromkeys(get_args(Phase), 0.0)
    )
    """Wall time by phase."""
    precisions: list[str] = field(default_factory=list)
    """Number formats in which the networks computed; several after a move to another machine."""
    resumed_at: list[int] = field(default_factory=list)
    """Updates after which the run was resumed."""
    pending_updates: int = 0
    """Updates still to be taken for the last step of collection."""
    positions: list[EpisodePosition] | None = None
    """Position of each environment in its episodes; None before the collection starts."""
    last_time: float = field(default_factory=time.perf_counter)
    """Until which the wall time is counted; it is not saved."""

    @contextmanager
    def timed(self, phase: Phase) -> Iterator[None]:
        """Context whose time counts for a phase; the time between such contexts is "other"."""
        self.add_time("other")
        try:
            yield
        finally:
            self.add_time(phase)

    def add_time(self, phase: Phase) -> None:
        """Add the time since the last call to a phase."""
        last, self.last_time = self.last_time, time.perf_counter()
        self.phase_seconds[phase] += self.last_time - last

    def total_seconds(self) -> float:
        """Return the time of all phases until now."""
        self.add_time("other")
        return sum(self.phase_seconds.values())

    def state_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        curve = [point.model_dump() for point in self.curve]
        values = {**vars(self), "recent": list(self.recent), "curve": curve}
        del values["last_time"]
        return values

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        vars(self).update(state)
        self.recent = deque(state["recent"], maxlen=RECENT_EPISODES)
        self.curve = [CurvePoint(**point) for point in state["curve"]]
