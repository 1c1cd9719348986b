"""Print times of steps, images and updates, frames per second, and the replay's memory, as a table.

python recipes/measure.py
python recipes/measure.py which=simulation repeats=50 output=before.json
python recipes/measure.py which=simulation repeats=50 compare=before.json
python recipes/measure.py which=learning/equi_sdqfd_update profile=true
python recipes/measure.py which=learning device=cuda
"""

from ba_torchrl.core.malloc import tune_malloc

tune_malloc()  # before torch allocates anything: halves the time of an update on a CPU

from functools import partial  # noqa: E402
from typing import Annotated  # noqa: E402

from ba_torchrl.cli.command import Command  # noqa: E402
from ba_torchrl.cli.types import Count, PluginSettings, Text, check_writable_file, checked  # noqa: E402
from ba_torchrl.core.config import LocalPath  # noqa: E402
from ba_torchrl.core.hardware import usable_device  # noqa: E402
from profiling.comparison import columns_of_changes  # noqa: E402
from profiling.speed_file import (  # noqa: E402
    Machine,
    SpeedFile,
    read_speed_file,
    write_speed_file,
)
from profiling.table import COLUMNS, CompileMode, Precision, as_markdown, measure  # noqa: E402

JsonFile = Annotated[LocalPath, checked(partial(check_writable_file, suffixes=(".json",)))]


class Settings(PluginSettings):
    """Settings of this command."""

    which: Text = "all"
    """simulation, learning, throughput, memory, or one of their measurements."""
    repeats: Count = 20
    """Rounds: episodes of each task, updates of each learner, batches of each collector."""
    device: Text = "cpu"
    """Of the learners."""
    precision: Precision = "auto"
    """Of the learners' networks."""
    compile_mode: CompileMode | None = None
    """`torch.compile` of the learners' losses."""
    output: JsonFile | None = None
    """Write all values, machine, versions and commit to this file."""
    compare: LocalPath | None = None
    """Print ratios to the rows of this file."""
    profile: bool = False
    """Print a profile of each timed call."""


def main(settings: Settings) -> None:
    """Measure, print a table, and write or compare it."""
    device = usable_device(settings.device)
    old = None if settings.compare is None else read_speed_file(settings.compare)
    where = Machine.here(device)  # includes the load before the measurement
    profiles: dict[str, str] | None = {} if settings.profile else None
    learners = {"precision": settings.precision, "compile_mode": settings.compile_mode}
    rows = measure(settings.which, settings.repeats, profiles=profiles, device=device, **learners)
    content = SpeedFile(machine=where, rows=rows, **learners)
    if settings.output is not None:
        write_speed_file(settings.output, content)
    for work, operations in (profiles or {}).items():
        print(f"{work}\n{operations}")
    changes = {} if old is None else columns_of_changes(old.rows, rows)
    print(as_markdown(rows, {**COLUMNS, **changes}))
    print(f"\n{content}")
    if old is not None:
        print(f"old: {old}")


COMMAND = Command(main, Settings, positional="which")

if __name__ == "__main__":
    COMMAND.run()
