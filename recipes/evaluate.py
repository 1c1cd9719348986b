"""Evaluate a trained policy.

python recipes/evaluate.py checkpoint=runs/my-run episodes=100 video=my-run.mp4
python recipes/evaluate.py checkpoint=runs/my-run which=latest
python recipes/evaluate.py checkpoint=runs/my-run expert=true  # close loop: compare the actions
"""

from ba_torchrl._malloc import tune_malloc

tune_malloc()  # before torch allocates anything

from typing import Literal  # noqa: E402

import hydra  # noqa: E402
from tensordict import TensorDict  # noqa: E402

from ba_torchrl import make_vector_env  # noqa: E402
from ba_torchrl.algorithms.base import SeedUse  # noqa: E402
from ba_torchrl.config import StrictModel  # noqa: E402
from ba_torchrl.record.logging import progress_bar  # noqa: E402
from ba_torchrl.record.video import write_video  # noqa: E402
from ba_torchrl.training.agreement import agreement_table, check_comparable  # noqa: E402
from ba_torchrl.training.checkpoint import find_checkpoint, load  # noqa: E402
from ba_torchrl.training.command_line import (  # noqa: E402
    Count,
    NumEnvs,
    Plugins,
    Seed,
    Text,
    VideoFile,
    command,
)
from ba_torchrl.training.evaluation import acting_on, evaluate, record_episodes  # noqa: E402

FPS = 5


class Settings(StrictModel):
    """Settings of this command."""

    plugins: Plugins
    checkpoint: Text
    which: Literal["best", "latest"]
    device: Text
    episodes: Count
    num_envs: NumEnvs
    expert: bool
    parallel: bool | None
    seed: Seed | None
    video: VideoFile | None
    video_episodes: Count


@hydra.main(config_path="../configs", config_name="evaluate", version_base="1.3")
@command(Settings)
def main(settings: Settings) -> None:
    """Play greedy episodes with the policy of a checkpoint."""
    checkpoint = find_checkpoint(settings.checkpoint, settings.which)
    config, algorithm = load(checkpoint, device=settings.device)
    if settings.expert:
        check_comparable(config.task)
    policy = acting_on(algorithm.policy, config.torch_device)
    seed, chosen = settings.seed, ""
    if seed is None:
        chosen = ", none of which training used"
        seed = config.derived_seed(SeedUse.TEST)
    env = make_vector_env(
        config.resolved_env,
        settings.num_envs,
        parallel=settings.parallel,
        register_modules=settings.plugins,
        seed=seed,
        expert=settings.expert,
    )
    episodes: list[TensorDict] = []

    def on_episode(episode: TensorDict) -> None:
        episodes.append(episode)
        bar.update()

    try:
        with progress_bar(total=settings.episodes, unit="episode") as bar:
            evaluation = evaluate(env, policy, settings.episodes, seed, on_episode)
    finally:
        env.close()
    print(
        f"success_rate {evaluation.success_rate:.2f} "
        f"(standard error {evaluation.standard_error:.3f}) over {evaluation.episodes} episodes "
        f"of {config.task}, {evaluation.mean_length:.1f} steps each"
    )
    print(f"  policy    update {algorithm.updates}, {checkpoint}")
    print(f"  episodes  seed {seed}{chosen}")
    if settings.expert:
        print(f"\n{agreement_table(episodes, config.resolved_env.actions.sequence)}")
    if settings.video is not None:
        frames = record_episodes(config.resolved_env, policy, settings.video_episodes, seed)
        print(f"  video     {write_video(settings.video, frames, fps=FPS)}")


if __name__ == "__main__":
    main()
