"""SAC of TorchRL with a ``BackupdateStorage``: a late actor, and critics that learn from the true
states.

    python examples/sac_backupdating.py                   (five minutes: Pendulum, 6 steps late)
    python examples/sac_backupdating.py --late-critics    (critics read what the actor knows)

It returns -190 to -136, and with late critics -580 to -196 (last ten episodes, seeds 0 to 2).

Kim et al. (2023), BPQL: critics are needed in training only, and by then the state in which an
action was chosen has arrived. They value it as without delay, Q(state, action), with the actor's
action at what it knew.
"""

import argparse

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import CatTensors, Compose, GymEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from damian import ActionHistory, BackupdateStorage, ObservationDelay, set_seed

WARM_UP, BATCH = (
    1000,
    256,
)  # steps with random actions before the first update; transitions of an update


def make_env(delay: int) -> TransformedEnv:
    """Pendulum with late observations."""
    late = Compose(
        RewardSum(),
        StepCounter(),  # the storage reads it
        ObservationDelay(delay, ["observation"], ["received"], delay_key="delay"),
        CatTensors(
            ["received"], "state", del_keys=False
        ),  # of critics: late, until the storage corrects it
        CatTensors(["received"], "known", del_keys=False),  # of the actor:
        ActionHistory(delay, append_to="known"),  # what has arrived, and its own actions since
    )
    return TransformedEnv(GymEnv("Pendulum-v1"), late)


def recompute(steps: TensorDictBase, arrived: Tensor) -> dict[tuple[str, str], Tensor]:
    """States after steps [T, B]: the observations sent there, as far as they have arrived,
    [T, B, F]."""
    return {("next", "state"): arrived}


def make_storage(n_steps: int, delay: int) -> BackupdateStorage:
    """A storage that corrects the states of stored steps as observations arrive."""
    names = {"message_key": "observation", "received_key": "received", "delay_key": "delay"}
    return BackupdateStorage(n_steps, recompute, longest=delay, age_key="age", **names)


def draw(storage: BackupdateStorage, delay: int, n: int) -> TensorDictBase:
    """Transitions [n] from all stored steps [T, B] whose observations must have arrived."""
    arrived = storage.latest()[:-delay]
    step = torch.randint(len(arrived), (n,))
    world = torch.randint(storage.steps.shape[1], (n,))
    return storage.steps[arrived[step], world]


def make_actor_and_loss(
    env: TransformedEnv, critics_read: str
) -> tuple[ProbabilisticActor, SACLoss]:
    """TorchRL's soft actor-critic: the actor reads ``known``."""
    bounds = env.action_spec.space
    n_actions = env.action_spec.shape[-1]
    network = nn.Sequential(
        MLP(out_features=2 * n_actions, num_cells=[128, 128]), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, ["known"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": bounds.low, "high": bounds.high},
    )
    critic = ValueOperator(MLP(out_features=1, num_cells=[128, 128]), [critics_read, "action"])
    critic(actor(env.fake_tensordict()))  # the networks find their numbers of inputs
    return actor, SACLoss(actor, critic, action_spec=env.action_spec)


def train(
    delay: int = 6,
    late_critics: bool = False,
    frames: int = 20_000,
    warm_up: int = WARM_UP,
    seed: int = 0,
) -> tuple[BackupdateStorage, list[float]]:
    """Train with one update in each step; returns the storage and the returns of the episodes."""
    torch.manual_seed(seed)
    env = make_env(delay)
    storage = make_storage(frames, delay)
    set_seed(env, seed)
    buffer = ReplayBuffer(storage=storage)
    actor, loss = make_actor_and_loss(env, "known" if late_critics else "state")
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    targets = SoftUpdate(loss, tau=0.005)
    now = env.reset()
    returns = []
    for n_steps in range(frames):
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            step, now = env.step_and_maybe_reset(
                actor(now) if n_steps >= warm_up else env.rand_action(now)
            )
        buffer.extend(step.reshape(-1, 1))  # [B, 1], with or without a batch size
        if n_steps >= warm_up:
            losses = loss(draw(storage, delay, BATCH))
            optimizer.zero_grad()
            sum(losses[name] for name in ("loss_actor", "loss_qvalue", "loss_alpha")).backward()
            optimizer.step()
            targets.step()
        if step["next", "done"].item():
            returns.append(step["next", "episode_reward"].item())
            if len(returns) % 10 == 0:
                print(
                    f"{n_steps + 1:6} steps: mean return of ten episodes "
                    f"{sum(returns[-10:]) / 10:.0f}"
                )
    return storage, returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--delay", type=int, default=6)
    parser.add_argument("--late-critics", action="store_true")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args()))
