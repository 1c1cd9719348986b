"""Print times of steps, images and updates and the replay's memory, as a table in Markdown.

python recipes/speed.py
python recipes/speed.py which=simulation repeats=50
python recipes/speed.py which=learning/equi_sdqfd_update profile=true
"""

from ba_torchrl._malloc import tune_malloc

tune_malloc()  # before torch allocates anything: halves the time of an update on a CPU

import hydra  # noqa: E402
from omegaconf import DictConfig  # noqa: E402

from ba_torchrl.plugins import load_plugins  # noqa: E402
from ba_torchrl.profiling.table import as_markdown, machine, measure  # noqa: E402
from ba_torchrl.record.logging import limit_library_logs  # noqa: E402
from ba_torchrl.training.command_line import plain_errors  # noqa: E402


@hydra.main(config_path="../configs", config_name="speed", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Measure, and print a table with the budgets."""
    limit_library_logs()
    load_plugins(settings.plugins)
    where = machine()  # includes the load before the measurement
    profiles: dict[str, str] | None = {} if settings.profile else None
    rows = measure(settings.which, settings.repeats, profiles=profiles)
    for work, operations in (profiles or {}).items():
        print(f"{work}\n{operations}")
    print(as_markdown(rows))
    print(f"\n{where}")


if __name__ == "__main__":
    main()
