# %% [markdown]
# # SAC with TorchRL's parts
#
# Soft Actor-Critic moves the gripper to a block (`close_loop/block_reaching`), without
# demonstrations. It observes poses, or depth images with `python sac.py images`: in a notebook, set
# `IMAGES = True`.

# %%
import sys
import time

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

import ba_torchrl
from ba_torchrl.modules import ActionValue, ActorCriticSpec, EquivariantConfig

IMAGES = "images" in sys.argv[1:]
STEPS, RANDOM_STEPS, EVERY, EPISODES = 12_000, 500, 1000, 50
UPDATES, BATCH, ALPHA = (2, 32, 0.01) if IMAGES else (10, 128, 0.1)  # updates per ten steps
torch.manual_seed(0)

# %% [markdown]
# ## Environment
#
# The reward of a step is the progress towards the goal that it makes, and 1 at the goal. With the
# learner's discount, optimal policies are those of the sparse reward.

# %%
GAMMA = 0.95
values = {"obs_size": 64} if IMAGES else {"obs_type": "vec"}
values |= {"reward": "difference", "reward_discount": GAMMA}
values |= {"action_sequence": "pxyz", "random_orientation": False}  # without yaw
env = ba_torchrl.make("close_loop/block_reaching", seed=0, **values)
observation = ["depth", "holding"] if IMAGES else ["observation"]
action_size = env.action_spec.shape[-1]

# %% [markdown]
# ## Networks
#
# A policy and two critics. They take any leading batch shape: the collector calls the policy on
# single states, the loss on batches. From poses they are perceptrons; from images, networks of this
# package, which are equivariant to rotations and reflections of the scene (`CNNConfig` has plain
# ones).


# %%
class Perceptron(nn.Module):
    """Two hidden layers on all inputs together."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.layers = MLP(inputs, outputs, num_cells=[128, 128])

    def forward(self, *inputs):
        return self.layers(torch.cat(inputs, -1))


if IMAGES:
    size = {"n_hidden": 8, "group_order": 4, "reflections": True}
    config = EquivariantConfig(**size, depth_center_m=0.2, depth_scale_m=0.1)  # of images in metres
    spec = ActorCriticSpec(env.images, env.actions.sequence)
    actor = config.build(spec).actor
    networks = [config.build(spec) for _ in range(2)]
    critics = [ActionValue(network.encoder, network.critic) for network in networks]
else:
    inputs = env.observation_spec["observation"].shape[-1]
    actor = nn.Sequential(Perceptron(inputs, 2 * action_size), NormalParamExtractor())
    critics = [Perceptron(inputs + action_size, 1) for _ in range(2)]
policy = ProbabilisticActor(
    TensorDictModule(actor, observation, ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
)
critics = [
    TensorDictModule(critic, [*observation, "action"], ["state_action_value"]) for critic in critics
]

# %% [markdown]
# ## Loss, replay, collector
#
# The loss makes targets of the critics. It reads `terminated`, so that targets bootstrap at the
# step limit.

# %%
loss = SACLoss(policy, critics, alpha_init=ALPHA, target_entropy=-2.0, deactivate_vmap=True)
loss.make_value_estimator(gamma=GAMMA)
targets = SoftUpdate(loss, tau=0.02)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
replay = TensorDictReplayBuffer(storage=LazyTensorStorage(STEPS), batch_size=BATCH)
collector = Collector(
    env,
    policy,
    frames_per_batch=10,
    total_frames=STEPS,
    init_random_frames=RANDOM_STEPS,
    auto_register_policy_transforms=False,  # of recurrent policies
)


# %% [markdown]
# ## Training
#
# Training ends when the greedy policy solves all episodes of an
# evaluation; then it plays episodes that no evaluation had.


# %%
def success_rate(seed, episodes):
    env = ba_torchrl.make("close_loop/block_reaching", seed=seed, **values)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        played = [env.rollout(env.max_steps, policy) for _ in range(episodes)]
    env.close()
    return sum(episode["next", "success"].any().item() for episode in played) / episodes


start, steps, rate = time.process_time(), 0, 0.0
for batch in collector:
    replay.extend(batch)
    steps += len(batch)
    if steps < RANDOM_STEPS:
        continue
    for _ in range(UPDATES):
        losses = loss(replay.sample())
        optimizer.zero_grad()
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        optimizer.step()
        targets.step()
    if steps % EVERY == 0:
        rate, minutes = success_rate(10_000, EPISODES), (time.process_time() - start) / 60
        print(f"{steps} steps, {minutes:.1f} minutes of CPU time: success rate {rate:.2f}")
    if rate == 1:
        break
collector.shutdown()
print(f"test: success rate {success_rate(20_000, 2 * EPISODES):.2f}")
