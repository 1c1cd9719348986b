"""One run of a benchmark; the process reads its pickled configuration from the standard input.

Its arguments are the run's folder, so that lists of processes name it, and the process id of the
grid, with which the run ends. Environments in processes of their own import this module again, so
everything else is imported where it is needed.
"""

import signal
import sys

from ba_torchrl.core.malloc import tune_malloc
from ba_torchrl.core.processes import end_with


def main() -> None:
    """Run the experiment."""
    end_with(int(sys.argv[2]), signal.SIGTERM)  # so that it saves its state
    tune_malloc()  # before torch allocates anything
    run_experiment(sys.stdin.buffer.read())


def run_experiment(pickled: bytes) -> None:
    """Run an experiment, an `ExperimentConfig`, in this process."""
    import logging
    import pickle

    from ba_torchrl.record.logging import limit_library_logs
    from ba_torchrl.training.experiment import Experiment
    from ba_torchrl.training.interruption import RunStopped

    logging.basicConfig(level=logging.INFO)
    limit_library_logs()
    try:
        Experiment(pickle.loads(pickled), progress=False).run()
    except RunStopped as stopped:
        logging.getLogger(__name__).warning("%s", stopped)
        raise


if __name__ == "__main__":
    main()
