"""PPO of TorchRL on a Gymnasium environment whose observations and actions are late: one file, to
be copied.

    python examples/ppo_gymnasium.py                 (two minutes: CartPole, 1 to 3 steps late)
    python examples/ppo_gymnasium.py --no-history    (without past actions in the observation)
    python examples/ppo_gymnasium.py --delay 0       (without delay)

They return 325 to 396, 224 to 261, and 352 to 444 (last ten batches, seeds 0 to 2).
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import Compose, GymEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from damian import ActionDelay, ActionHistory, ObservationDelay, Uniform, set_seed

BATCH, MINIBATCH, EPOCHS = 1000, 100, 8  # steps


def make_env(delay: int, history: bool) -> TransformedEnv:
    """CartPole with late observations and actions; the policy also sees what it has done since."""
    delays = [
        ActionDelay(1 if delay else 0),
        ObservationDelay(
            Uniform(min(1, delay), delay)
        ),  # each draws its delay; slow ones are overtaken
        *([ActionHistory(delay + 1, append_to="observation")] if history else []),
    ]
    return TransformedEnv(GymEnv("CartPole-v1"), Compose(*delays, StepCounter(), RewardSum()))


def train(delay: int = 3, history: bool = True, frames: int = 60_000, seed: int = 0) -> list[float]:
    """Train; returns the mean return of the episodes that end in each batch."""
    torch.manual_seed(seed)
    env = make_env(delay, history)
    set_seed(env, seed)
    network = MLP(
        out_features=env.action_spec.shape[-1], num_cells=[64, 64], activation_class=nn.Tanh
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["logits"]),
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=torch.distributions.OneHotCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(out_features=1, num_cells=[64, 64], activation_class=nn.Tanh))
    fake = env.fake_tensordict()
    actor(fake)  # the networks find their numbers of inputs
    critic(fake)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(BATCH), sampler=SamplerWithoutReplacement(), batch_size=MINIBATCH
    )
    collector = Collector(
        env,
        actor,
        frames_per_batch=BATCH,
        total_frames=frames,
        auto_register_policy_transforms=False,
    )
    means = []
    for number, batch in enumerate(collector):
        for _ in range(EPOCHS):
            advantage(batch)
            buffer.extend(batch.reshape(-1))
            for _ in range(BATCH // MINIBATCH):
                losses = loss(buffer.sample())
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
                optimizer.zero_grad()
        done = batch["next", "done"]
        if done.any():
            means.append(batch["next", "episode_reward"][done].mean().item())
        if number % 10 == 9:
            age = batch["age"].mean().item()
            print(
                f"{(number + 1) * BATCH:7} steps: return {means[-1]:6.1f}, mean age {age:.2f} steps"
            )
    return means


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--delay", type=int, default=3)
    parser.add_argument("--history", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--frames", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args()))
