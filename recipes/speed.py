"""Print times of steps, images and updates, frames per second, and the replay's memory, as a table.

python recipes/speed.py
python recipes/speed.py which=simulation repeats=50 output=before.json
python recipes/speed.py which=simulation repeats=50 compare=before.json
python recipes/speed.py which=learning/equi_sdqfd_update profile=true
python recipes/speed.py which=learning device=cuda
"""

from ba_torchrl._malloc import tune_malloc

tune_malloc()  # before torch allocates anything: halves the time of an update on a CPU

from functools import partial  # noqa: E402
from typing import Annotated  # noqa: E402

import hydra  # noqa: E402

from ba_torchrl.config import StrictModel  # noqa: E402
from ba_torchrl.training.command_line import (  # noqa: E402
    Count,
    Plugins,
    Text,
    check_writable_file,
    checked,
    command,
)
from ba_torchrl.training.config import usable_device  # noqa: E402
from profiling.comparison import columns_of_changes  # noqa: E402
from profiling.speed_file import (  # noqa: E402
    Machine,
    SpeedFile,
    read_speed_file,
    write_speed_file,
)
from profiling.table import COLUMNS, CompileMode, Precision, as_markdown, measure  # noqa: E402

JsonFile = Annotated[Text, checked(partial(check_writable_file, suffixes=(".json",)))]


class Settings(StrictModel):
    """Settings of this command."""

    plugins: Plugins
    which: Text
    repeats: Count
    device: Text
    precision: Precision
    compile_mode: CompileMode | None
    output: JsonFile | None
    compare: Text | None
    profile: bool


@hydra.main(config_path="../configs", config_name="speed", version_base="1.3")
@command(Settings)
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


if __name__ == "__main__":
    main()
