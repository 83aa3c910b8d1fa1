"""Multi-agent PPO of TorchRL on a VMAS task whose observations are late: one file, to be copied.

    pip install vmas
    python examples/ppo_vmas.py                 (a few minutes: navigation, 3 steps late)
    python examples/ppo_vmas.py --no-history    (without past actions in the observation)
    python examples/ppo_vmas.py --delay 0       (without delay)

The first and the last return 3.1.
"""

import argparse

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import Compose, RewardSum, TransformedEnv, VmasEnv
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from damian import ActionHistory, ObservationDelay, set_seed

AGENTS = 3
WORLDS = 64
STEPS = 100
EPOCHS = 10
OBSERVATION = ("agents", "observation")
ACTION = ("agents", "action")
REWARD = ("agents", "reward")
RETURN = ("agents", "episode_reward")
ENDS = ("done", "terminated")


def make_env(delay: int, history: bool) -> TransformedEnv:
    """Agents that find their goals, each with late observations; entries lie under "agents"."""
    env = VmasEnv("navigation", num_envs=WORLDS, n_agents=AGENTS, max_steps=STEPS, collisions=False)
    transforms = [
        ObservationDelay(delay, OBSERVATION),  # under a nested key: a delay for each agent
        *([ActionHistory(delay, ACTION, append_to=OBSERVATION)] if history and delay else []),
        RewardSum([REWARD], [RETURN]),
    ]
    return TransformedEnv(env, Compose(*transforms))


def make_networks(env: TransformedEnv) -> tuple[ProbabilisticActor, TensorDictModule]:
    """An actor and a critic, each shared by the agents; the critic reads what all observe."""
    n_inputs = env.observation_spec[OBSERVATION].shape[-1]
    spec = env.full_action_spec[ACTION]

    def network(outputs: int, centralized: bool) -> MultiAgentMLP:
        return MultiAgentMLP(
            n_inputs,
            outputs,
            AGENTS,
            centralized=centralized,
            share_params=True,
            num_cells=[128, 128],
        )

    policy = nn.Sequential(network(2 * spec.shape[-1], False), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, [OBSERVATION], [("agents", "loc"), ("agents", "scale")]),
        in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[ACTION],
        spec=env.full_action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low[0], "high": spec.space.high[0]},
        return_log_prob=True,
    )
    return actor, TensorDictModule(network(1, True), [OBSERVATION], [("agents", "state_value")])


def train(delay: int = 3, history: bool = True, batches: int = 40, seed: int = 0) -> list[float]:
    """Train; returns the mean return of the episodes of each batch."""
    torch.manual_seed(seed)
    env = make_env(delay, history)
    set_seed(env, seed)
    actor, critic = make_networks(env)
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=0.2, entropy_coeff=1e-3, normalize_advantage=False
    )
    loss.set_keys(reward=REWARD, action=ACTION, value=("agents", "state_value"))
    loss.set_keys(done=("agents", "done"), terminated=("agents", "terminated"))
    loss.make_value_estimator(gamma=0.95, lmbda=0.9)
    advantage: GAE = loss.value_estimator
    optimizer = torch.optim.Adam(loss.parameters(), 5e-4)
    frames = WORLDS * STEPS
    sampler = SamplerWithoutReplacement()
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=sampler, batch_size=frames // 8
    )
    means = []
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=batches * frames,
        auto_register_policy_transforms=False,
    )
    for number, batch in enumerate(collector):
        for end in ENDS:  # of a world; the loss wants them for each agent
            flag = batch["next", end].unsqueeze(-2).expand(batch["next", *REWARD].shape)
            batch.set(("next", "agents", end), flag)
        with torch.no_grad():
            advantage(
                batch,
                params=loss.critic_network_params,
                target_params=loss.target_critic_network_params,
            )
        for _ in range(EPOCHS):
            buffer.extend(batch.reshape(-1))
            for _ in range(8):
                losses = loss(buffer.sample())
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()
        means.append(batch["next", *RETURN][batch["next", "agents", "done"]].mean().item())
        if number % 10 == 9:
            print(f"{(number + 1) * frames:7} steps: mean return {means[-1]:.2f}")
    return means


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--delay", type=int, default=3)
    parser.add_argument("--history", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--batches", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args()))
