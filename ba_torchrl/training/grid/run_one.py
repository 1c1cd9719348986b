"""One run of a benchmark; the process reads its configuration as JSON from the standard input.

Environments in processes of their own import this module again, so everything else is imported
where it is needed.
"""

from ba_torchrl.core.malloc import tune_malloc


def main() -> None:
    """Run the experiment."""
    tune_malloc()  # before torch allocates anything

    import sys

    run_experiment(sys.stdin.read())


def run_experiment(values: str) -> None:
    """Run an experiment in this process."""
    import json
    import logging

    from ba_torchrl.record.logging import limit_library_logs
    from ba_torchrl.training.config import ExperimentConfig
    from ba_torchrl.training.experiment import Experiment
    from ba_torchrl.training.interruption import RunStopped

    logging.basicConfig(level=logging.INFO)
    limit_library_logs()
    try:
        Experiment(ExperimentConfig.parse(json.loads(values)), progress=False).run()
    except RunStopped as stopped:
        logging.getLogger(__name__).warning("%s", stopped)
        raise


if __name__ == "__main__":
    main()
