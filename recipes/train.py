"""Train a policy.

python recipes/train.py task=close_loop/block_picking algorithm=sacfd rotation=none network=equi
python recipes/train.py --config-name quickstart
python recipes/train.py task=close_loop/block_picking run_dir=runs/mine resume=true
python recipes/train.py plugins=[my_tasks] task=mine/push_far
python recipes/train.py num_envs=8 collector=multi_async collector.workers=4
"""

from ba_torchrl._malloc import tune_malloc

tune_malloc()  # before torch allocates anything: halves the time of an update on a CPU

import sys  # noqa: E402

import hydra  # noqa: E402
from omegaconf import DictConfig, OmegaConf  # noqa: E402

from ba_torchrl.record.logging import limit_library_logs  # noqa: E402
from ba_torchrl.training.command_line import (  # noqa: E402
    check_writable_folder,
    plain_errors,
    register_schemas,
)
from ba_torchrl.training.config import ExperimentConfig  # noqa: E402
from ba_torchrl.training.experiment import Experiment  # noqa: E402
from ba_torchrl.training.interruption import RunStopped  # noqa: E402

register_schemas()


@hydra.main(config_path="../configs", config_name="train", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Run or resume the experiment of the configuration."""
    limit_library_logs()
    config = ExperimentConfig.parse(OmegaConf.to_container(settings, resolve=True))
    check_writable_folder(config.run_dir)
    try:
        result = Experiment(config).run()
    except RunStopped as stopped:
        print(stopped, file=sys.stderr)
        raise
    evaluation = result.evaluation
    print(f"success_rate {evaluation.success_rate:.2f} over {evaluation.episodes} episodes")
    print(
        f"  {config.report} policy, of update {result.updates}; "
        f"{evaluation.mean_length:.1f} steps per episode; {result.seconds / 60:.1f} minutes"
    )
    print(f"  curve       {result.curve}")
    if result.video is not None:
        print(f"  video       {result.video}")
    print(f"  checkpoint  {result.checkpoint}")
    print(f"  result      {result.record}")


if __name__ == "__main__":
    main()
