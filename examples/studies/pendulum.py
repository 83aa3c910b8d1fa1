"""Apply the delay transforms to another environment: SAC on Gymnasium's Pendulum-v1 with late observations.

    python examples/studies/pendulum.py --jobs 2                  (half an hour on two free cores)
    python examples/studies/pendulum.py --arms history bpql       (these arms only)
    python examples/studies/pendulum.py --seeds 0 --steps 10000 --delay 3 --out runs/pendulum3

Four arms are trained for each seed: undelayed; naive, whose observations are late; history, which also
observes the agent's latest actions; and bpql, whose actor is that of history, but whose critics read only
the state, once it has arrived (``BackupdateStorage``). The undelayed policy is also evaluated under several
delays. The folder gets the mean returns as results.md and results.csv, and a JSON file for each arm and seed.
"""

import csv
import statistics
from argparse import Namespace
from typing import cast

import torch
from study import Results, carried_out, parser
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import (
    CatTensors,
    Compose,
    EnvBase,
    GymEnv,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian import keys
from damian.common.tables import markdown_table
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.networks import ModelConfig
from damian.learners.sac import Sac, SacConfig
from damian.replay.backupdate import BackupdateStorage
from damian.replay.time_storage import TimeStorage
from damian.settings import BpqlConfig
from damian.transforms import ActionHistory, ObservationDelay, set_seed

ARMS = ("undelayed", "naive", "history", "bpql")
DEPLOYED = {0: -145, 2: -153, 3: -324, 4: -757, 6: -777, 8: -977}
REFERENCE = {("undelayed", d): r for d, r in DEPLOYED.items()}
REFERENCE |= {("naive", 6): -1154, ("history", 6): -155, ("bpql", 6): -144}
"""Returns by arm and delay: one seed of an independent implementation, 20 000 steps; for orientation only."""

HORIZON = 200  # steps of an episode
RANDOM_STEPS = 1000  # steps with random actions before the first update
EVALUATION_SEED = 1000  # of the initial conditions in every evaluation
BATCH, LR, GAMMA, TAU = 256, 1e-3, 0.99, 0.005
OBSERVED = (keys.OBSERVATION, keys.GLOBAL_OBSERVATION)  # of the actor, and the state for critics
OUTPUTS = (*OBSERVED, "observation", "received", "age", "delay", "step_count", keys.REWARD)
STORED = [*OBSERVED, "step_count", keys.ACTION, *map(next_key, (*OUTPUTS, *keys.ENDS))]


def make_env(delay: int, history: int, worlds: int | None = None) -> EnvBase:
    """Pendulum-v1 with delayed observations and an action history.

    Args:
        delay: of the observations [steps].
        history: number of latest actions that are appended to the actor's observation.
        worlds: batch size of a ``SerialEnv``; a single environment without a batch size if not given.

    Returns:
        The environment. Its entry ``observation`` is sent in each step, and ``received`` is what has arrived;
        a learner reads only what follows from the latter.
    """

    def pendulum() -> EnvBase:
        return GymEnv("Pendulum-v1")

    transforms: list[Transform] = [
        RewardSum(),
        StepCounter(),
        ObservationDelay(delay, ["observation"], ["received"], delay_key="delay"),
        CatTensors(["received"], "state", del_keys=False),
        CatTensors(["received"], "observed", del_keys=False),
    ]
    if history:
        transforms.append(ActionHistory(history, append_to="observed"))
    # The learner expects these keys; a single agent needs no agent dimension.
    outputs = {"observed": keys.OBSERVATION, "state": keys.GLOBAL_OBSERVATION, "reward": keys.REWARD}
    transforms.append(RenameTransform([*outputs], [*outputs.values()], ["action"], [keys.ACTION]))
    return TransformedEnv(SerialEnv(worlds, pendulum) if worlds else pendulum(), Compose(transforms))


def arrived_states(steps: TensorDictBase, observations: Tensor) -> dict[NestedKey, Tensor]:
    """The states after steps [T, B]: what was observed then, as far as it has arrived, [T, B, 3]."""
    return {next_key(keys.GLOBAL_OBSERVATION): observations}


def make_learner(env: EnvBase, arm: str, steps: int, delay: int, hidden: int) -> Sac:
    """The learner that also trains UAVs: SAC, or BPQL with a storage that learns of states as they arrive."""
    kind = BpqlConfig if arm == "bpql" else SacConfig
    config = kind(lr=LR, alpha_lr=LR, gamma=GAMMA, tau=TAU, alpha_init=1.0)
    model = ModelConfig(hidden=[hidden, hidden], activation="relu")
    setup = LearningSetup(model, 1, 1, 1, critic_key=keys.OBSERVATION)
    if arm != "bpql":
        return config.make(env, setup, ReplayBuffer(storage=TimeStorage(steps)))
    names = {"message_key": "observation", "received_key": "received", "delay_key": "delay", "age_key": "age"}
    storage = BackupdateStorage(steps, arrived_states, longest=delay, **names)
    setup = setup._replace(longest_delay=delay, critic_key=keys.GLOBAL_OBSERVATION)
    return config.make(env, setup, ReplayBuffer(storage=storage))


def train(env: EnvBase, learner: Sac, steps: int, bar: tqdm) -> None:
    """Train for ``steps`` environment steps, with one update after each."""
    td = env.reset()
    for step in range(steps):
        # Outside of such a context TorchRL's actor takes the most likely action, and explores nothing.
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            td = env.rand_action(td) if step < RANDOM_STEPS else learner.actor(td)
            transition, td = env.step_and_maybe_reset(td)
        learner.buffer.extend(transition.select(*STORED).view(1, 1))  # one world, one step
        if step >= RANDOM_STEPS:
            learner.update(draw(learner))
        bar.update()
        if transition["next", "done"].item():
            bar.set_postfix({"return": f"{transition['next', 'episode_reward'].item():.0f}"})


def draw(learner: Sac) -> TensorDictBase:
    """Transitions [BATCH] from all steps whose observations have arrived, if the learner waits for these."""
    storage = cast(TimeStorage, learner.buffer.storage)
    order = storage.latest()
    settled = order[: len(order) - learner.setup.settle_steps]
    return storage.steps[settled[torch.randint(len(settled), (BATCH,))], 0]


@torch.no_grad()
def evaluate_under(delay: int, history: int, actor: nn.Module, episodes: int) -> float:
    """Mean return of the most likely actions, in episodes with the same initial conditions at every call."""
    env = make_env(delay, history, episodes)
    set_seed(env, EVALUATION_SEED)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(HORIZON, actor, break_when_any_done=False)
    env.close()
    return rollout[next_key(keys.REWARD)].sum(1).mean().item()


def run_arm(arm: str, seed: int, args: Namespace) -> dict[str, float]:
    """Train and evaluate an arm; returns its mean returns by the delay of the evaluation."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    delay = 0 if arm == "undelayed" else args.delay
    history = args.delay if arm in ("history", "bpql") else 0
    env = make_env(delay, history)
    set_seed(env, seed)
    learner = make_learner(env, arm, args.steps, args.delay, args.hidden)
    with tqdm(total=args.steps, desc=f"seed {seed} {arm}") as bar:
        train(env, learner, args.steps, bar)
    delays = sorted({*DEPLOYED, args.delay}) if arm == "undelayed" else [delay]
    return {str(d): evaluate_under(d, history, learner.actor, args.episodes) for d in delays}


def table(results: Results, args: Namespace) -> str:
    """Write the results as results.csv and results.md; returns the latter's text."""
    rows = [["arm", "delay", "mean", *(f"seed {seed}" for seed in args.seeds), "reference"]]
    for arm in args.arms:
        found = [results[arm, seed] for seed in args.seeds]
        for delay in found[0]:
            values = [returns[delay] for returns in found]
            numbers = [f"{value:.0f}" for value in (statistics.mean(values), *values)]
            rows.append([arm, delay, *numbers, str(REFERENCE.get((arm, int(delay)), ""))])
    with (args.out / "results.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    title = f"# Pendulum-v1, SAC, {args.steps} steps: return, mean of {args.episodes} episodes"
    text = f"{title}\n\n{markdown_table(rows[0], rows[1:])}\n"
    (args.out / "results.md").write_text(text)
    return text


def main(words: list[str] | None = None) -> None:
    """Train, evaluate and print the table."""
    options = parser("SAC on Pendulum-v1 with late observations.", ARMS, "runs/pendulum")
    options.add_argument("--steps", type=int, default=20_000, help="training steps of each arm")
    options.add_argument("--delay", type=int, default=6, help="delay of the observations [steps]")
    options.add_argument("--episodes", type=int, default=20, help="episodes of each evaluation")
    options.add_argument("--hidden", type=int, default=128, help="units in each of two hidden layers")
    args = options.parse_args(words)
    print(table(carried_out(args, run_arm), args))


if __name__ == "__main__":
    main()
