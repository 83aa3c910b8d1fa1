"""BPQL: the actor observes what has arrived and its own actions since; critics learn from the true states.

    python examples/transforms/late_critic.py        (some seconds)
    python examples/studies/pendulum.py --arms bpql     (a training)

Kim et al. (2023): critics are needed in training only, and by then the state in which an action was chosen
has arrived. They value it as without delay, Q(state, action), with the actor's action at what it observed.
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import CatTensors, Compose, GymEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from damian import ActionHistory, BackupdateStorage, ObservationDelay

DELAY, STEPS, WARM_UP = 6, 150, 120  # so few steps show how it works; 20 000 swing the pendulum up

late = Compose(
    StepCounter(),  # the storage reads it
    ObservationDelay(DELAY, ["observation"], ["received"], delay_key="delay"),
    CatTensors(["received"], "state", del_keys=False),  # of the critics: late, until the storage corrects it
    CatTensors(["received"], "known", del_keys=False),  # of the actor:
    ActionHistory(DELAY, append_to="known"),  # what has arrived, and its own actions since
)
env = TransformedEnv(GymEnv("Pendulum-v1"), late)


def recompute(steps: TensorDictBase, arrived: Tensor) -> dict[tuple[str, str], Tensor]:
    """States after steps [T, B]: the observations sent there, as far as they have arrived, [T, B, F]."""
    return {("next", "state"): arrived}


names = {"message_key": "observation", "received_key": "received", "delay_key": "delay", "age_key": "age"}
storage = BackupdateStorage(STEPS, recompute, longest=DELAY, **names)
buffer = ReplayBuffer(storage=storage)


def draw(n: int) -> TensorDictBase:
    """Transitions [n] from all stored steps [T, B] whose observations must have arrived."""
    arrived = storage.latest()[:-DELAY]
    step, world = torch.randint(len(arrived), (n,)), torch.randint(storage.steps.shape[1], (n,))
    return storage.steps[arrived[step], world]


def make_actor_and_loss() -> tuple[ProbabilisticActor, SACLoss]:
    """TorchRL's soft actor-critic: the actor reads ``known``, the critics ``state``."""
    bounds, n_actions = env.action_spec.space, env.action_spec.shape[-1]
    network = nn.Sequential(MLP(out_features=2 * n_actions, num_cells=[64, 64]), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["known"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": bounds.low, "high": bounds.high},
    )
    critic = ValueOperator(MLP(out_features=1, num_cells=[64, 64]), ["state", "action"])
    critic(actor(env.fake_tensordict()))  # the networks find their numbers of inputs
    return actor, SACLoss(actor, critic, action_spec=env.action_spec)


torch.manual_seed(0)
env.set_seed(0)
actor, loss = make_actor_and_loss()
optimizer, targets = torch.optim.Adam(loss.parameters(), 1e-3), SoftUpdate(loss, tau=0.005)
now = env.reset()
for n_steps in range(STEPS):
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        step, now = env.step_and_maybe_reset(actor(now) if n_steps >= WARM_UP else env.rand_action(now))
    buffer.extend(step.reshape(-1, 1))  # [B, 1], with or without a batch size
    if n_steps >= WARM_UP:
        losses = loss(draw(128))
        optimizer.zero_grad()
        sum(losses[name] for name in ("loss_actor", "loss_qvalue", "loss_alpha")).backward()
        optimizer.step()
        targets.step()

learnt = storage.steps[storage.latest()[:-DELAY]]
error = (learnt["next", "state"] - learnt["next", "observation"]).abs().max()
print(f"largest error of a state that critics learn from: {error:.1f}")
