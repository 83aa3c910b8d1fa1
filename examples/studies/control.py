"""Apply the delay transforms to other environments: SAC on a control task of Gymnasium, observed
late.

Pendulum-v1; an hour, two free cores::

    python examples/studies/control.py --jobs 2
    python examples/studies/control.py --methods history bpql

Delays that are drawn from 1 to 7 steps; two hours::

    python examples/studies/control.py --jobs 2 --shortest 1 --delay 7 --out runs/control_random

Actions that are executed one to three steps late, too, as they arrive or held for three steps::

    python examples/studies/control.py --shortest 1 --delay 3 --act 3 \
        --methods history history+held bpql bpql+held --out runs/control_actions

HalfCheetah (``pip install "gymnasium[mujoco]"``); 50 minutes, with ``--shortest 1`` drawn delays::

    python examples/studies/control.py --jobs 2 --env HalfCheetah-v5 --steps 30000 --delay 9 \\
        --hidden 256 --lr 3e-4 --episodes 10 --out runs/cheetah

These methods are trained for each seed: undelayed; naive, whose observations are late; history,
which also observes the agent's latest actions, with the age of the observation if that varies
(an augmented state); and bpql, whose actor is the same, but whose critics read only the state, as
it is known once it has arrived (``BackupdateStorage``). Where delays vary, there are two more ways
to observe for each of the last two: timeline, all that has arrived, by when it was true
(``ObservationTimeline``); and hold, a jitter buffer, in which observations wait until they are as
old as the oldest may be. The undelayed policy is also evaluated under the delay, and in Pendulum
flown forward, by a copy of the environment (``forward_pendulum.py``). The folder gets the mean
returns as results.md and results.csv, and a JSON file for each method and seed.
"""

import csv
import statistics
from argparse import Namespace
from typing import NamedTuple, cast

import gymnasium
import torch
from forward_pendulum import FlownForward
from study import Results, carried_out, parser
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    EnvBase,
    FlattenObservation,
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
from damian.delays.laws import Uniform
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.config import BpqlConfig
from damian.learners.sac import Sac, SacConfig
from damian.models.config import MlpConfig
from damian.replay.backupdate import BackupdateStorage
from damian.replay.time_storage import TimeStorage
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    ObservationDelay,
    ObservationTimeline,
    set_seed,
)

CONSTANT = ("undelayed", "naive", "history", "bpql")
METHODS = (*CONSTANT, "timeline", "bpql+timeline", "hold", "bpql+hold")
LATE_ACTIONS = ("history+held", "bpql+held")
RANDOM_STEPS = 1000  # steps with random actions before the first update
EVALUATION_SEED = 1000  # of the initial conditions in every evaluation
BATCH = 256
GAMMA = 0.99
TAU = 0.005
OBSERVED = (keys.OBSERVATION, keys.GLOBAL_OBSERVATION)  # of the actor, and the state for critics
SENT = ("observation", "delay")  # in each step, and how late
OUTPUTS = (*OBSERVED, *SENT, "received", "age", "step_count", keys.REWARD)
STORED = [*OBSERVED, *SENT, "step_count", keys.ACTION, *map(next_key, (*OUTPUTS, *keys.ENDS))]


class Task(NamedTuple):
    """An environment of Gymnasium, and how late it is observed."""

    name: str = "Pendulum-v1"
    shortest: int = 0
    """Shortest delay [steps]; delays are drawn for each observation."""
    longest: int = 0
    """Longest delay [steps]."""
    history: int = 0
    """Number of latest actions that are appended to the actor's observation."""
    timeline: bool = False
    """Does the actor observe all that has arrived of the latest steps, instead of the newest
    message?"""
    act: int = 0
    """Longest delay of an action, drawn from one step on [steps]; 0 for none."""
    held: bool = False
    """Is each action executed when it is as old as the oldest may be?"""
    forward: bool = False
    """Does a copy of the environment fly the newest message forward?"""

    @property
    def horizon(self) -> int:
        """Steps of an episode."""
        return gymnasium.spec(self.name).max_episode_steps or 0


def make_env(task: Task, worlds: int | None = None) -> TransformedEnv:
    """A control task with delayed observations and an action history.

    Args:
        task: the environment, its delays, and what is observed.
        worlds: batch size of a ``SerialEnv``; a single environment without a batch size if not
            given.

    Returns:
        The environment. Its entry ``observation`` is sent in each step, and ``received`` is what
        has arrived; a learner reads only what follows from the latter.
    """

    def control() -> EnvBase:
        return TransformedEnv(GymEnv(task.name), DoubleToFloat())

    varies = task.shortest < task.longest
    law = Uniform(task.shortest, task.longest) if varies else task.longest
    transforms: list[Transform] = [
        RewardSum(),
        StepCounter(),
        ObservationDelay(law, ["observation"], ["received"], delay_key="delay"),
    ]
    ages = ["age"] * (varies and task.history > 0)
    if task.act:
        transforms.append(ActionDelay(Uniform(1, task.act), hold=task.held))
    transforms.append(CatTensors(["received"], "state", del_keys=False))
    read = ["received", *ages]
    if task.timeline:
        transforms.append(ObservationTimeline(task.longest + 1, delay_key="delay"))
        transforms.append(FlattenObservation(-2, -1, ["timeline"]))
        read = ["timeline"]
    if task.forward:
        transforms.append(FlownForward(task.longest))
        read = ["predicted"]
    transforms.append(CatTensors(read, "observed", del_keys=False))
    if task.history:
        transforms.append(ActionHistory(task.history, append_to="observed"))
    # The learner expects these keys; a single agent needs no agent dimension.
    outputs = {
        "observed": keys.OBSERVATION,
        "state": keys.GLOBAL_OBSERVATION,
        "reward": keys.REWARD,
    }
    transforms.append(RenameTransform([*outputs], [*outputs.values()], ["action"], [keys.ACTION]))
    return TransformedEnv(SerialEnv(worlds, control) if worlds else control(), Compose(transforms))


def arrived_states(steps: TensorDictBase, observations: Tensor) -> dict[NestedKey, Tensor]:
    """The states after steps [T, B]: what was observed then, as far as it has arrived,
    [T, B, D]."""
    return {next_key(keys.GLOBAL_OBSERVATION): observations}


def make_learner(
    env: TransformedEnv, bpql: bool, steps: int, delay: int, hidden: int, lr: float = 1e-3
) -> Sac:
    """The learner that also trains UAVs: SAC, or BPQL with a storage that learns of states as they
    arrive."""
    kind = BpqlConfig if bpql else SacConfig
    config = kind(lr=lr, alpha_lr=lr, gamma=GAMMA, tau=TAU, alpha_init=1.0)
    model = MlpConfig(hidden=[hidden, hidden], activation="relu")
    setup = LearningSetup(model, 1, 1, 1, critic_key=keys.OBSERVATION)
    if not bpql:
        return config.make(env, setup, ReplayBuffer(storage=TimeStorage(steps)))
    names = {
        "message_key": "observation",
        "received_key": "received",
        "delay_key": "delay",
        "age_key": "age",
    }
    storage = BackupdateStorage(steps, arrived_states, longest=delay, **names)
    setup = setup._replace(longest_delay=delay, critic_key=keys.GLOBAL_OBSERVATION)
    return config.make(env, setup, ReplayBuffer(storage=storage))


def train(env: EnvBase, learner: Sac, steps: int, bar: tqdm) -> None:
    """Train for ``steps`` environment steps, with one update after each."""
    td = env.reset()
    for step in range(steps):
        # Outside of such a context TorchRL's actor takes the most likely action, and explores
        # nothing.
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            td = env.rand_action(td) if step < RANDOM_STEPS else learner.actor(td)
            transition, td = env.step_and_maybe_reset(td)
        learner.buffer.extend(
            transition.select(*STORED, strict=False).view(1, 1)
        )  # one world, one step
        if step >= RANDOM_STEPS:
            learner.update(draw(learner))
        bar.update()
        if transition["next", "done"].item():
            bar.set_postfix({"return": f"{transition['next', 'episode_reward'].item():.0f}"})


def draw(learner: Sac) -> TensorDictBase:
    """Transitions [BATCH] from all steps whose observations have arrived, if the learner waits for
    these."""
    storage = cast(TimeStorage, learner.buffer.storage)
    order = storage.latest()
    settled = order[: len(order) - learner.setup.settle_steps]
    return storage.steps[settled[torch.randint(len(settled), (BATCH,))], 0]


@torch.no_grad()
def evaluate_under(task: Task, actor: nn.Module, episodes: int) -> float:
    """Mean return of the most likely actions, in episodes with the same initial conditions at every
    call."""
    env = make_env(task, episodes)
    set_seed(env, EVALUATION_SEED)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(task.horizon, actor, break_when_any_done=False)
    env.close()
    ended = rollout[next_key(keys.DONE)].long().cumsum(1) - rollout[next_key(keys.DONE)].long()
    return (rollout[next_key(keys.REWARD)] * (ended == 0)).sum(1).mean().item()


def run_method(method: str, seed: int, args: Namespace) -> dict[str, float]:
    """Train and evaluate a method; returns its mean returns by the delay of the evaluation."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    shortest = args.delay if args.shortest is None else args.shortest
    history = (args.delay + args.act) * (method not in ("undelayed", "naive"))
    words = method.split("+")
    sent = args.delay if "hold" in words else shortest
    late = Task(args.env, sent, args.delay, history, "timeline" in method, args.act)
    late = late._replace(held="held" in method)
    task = Task(args.env) if method == "undelayed" else late
    env = make_env(task)
    set_seed(env, seed)
    learner = make_learner(env, "bpql" in method, args.steps, args.delay, args.hidden, args.lr)
    with tqdm(total=args.steps, desc=f"seed {seed} {method}") as bar:
        train(env, learner, args.steps, bar)
    name = f"{shortest} to {args.delay}" if shortest < args.delay else str(args.delay)
    flown = {name: late}
    if method == "undelayed":
        flown = {"0": task, name: late}
        if args.env == Task().name and not args.act:
            flown[f"{name}, flown forward"] = late._replace(forward=True)
    return {
        name: evaluate_under(each, learner.actor, args.episodes) for name, each in flown.items()
    }


def table(results: Results, args: Namespace) -> str:
    """Write the results as results.csv and results.md; returns the latter's text."""
    rows = [["method", "delay", "mean", *(f"seed {seed}" for seed in args.seeds)]]
    for method in args.methods:
        found = [results[method, seed] for seed in args.seeds]
        for name in found[0]:
            values = [returns[name] for returns in found]
            rows.append(
                [method, name, *(f"{value:.0f}" for value in (statistics.mean(values), *values))]
            )
    with (args.out / "results.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(rows)
    title = f"# {args.env}, SAC, {args.steps} steps: return, mean of {args.episodes} episodes"
    text = f"{title}\n\n{markdown_table(rows[0], rows[1:])}\n"
    (args.out / "results.md").write_text(text, encoding="utf-8")
    return text


def main(words: list[str] | None = None) -> None:
    """Train, evaluate and print the table."""
    options = parser(
        "SAC on a control task with late observations.", (*METHODS, *LATE_ACTIONS), "runs/control"
    )
    options.add_argument(
        "--env", default="Pendulum-v1", help="task of Gymnasium with continuous actions"
    )
    options.add_argument("--steps", type=int, default=20_000, help="training steps of each method")
    options.add_argument("--delay", type=int, default=6, help="delay of the observations [steps]")
    options.add_argument(
        "--shortest", type=int, help="delays are drawn, from this to --delay [steps]"
    )
    options.add_argument(
        "--act", type=int, default=0, help="longest delay of the actions, drawn from 1 on [steps]"
    )
    options.add_argument("--episodes", type=int, default=20, help="episodes of each evaluation")
    options.add_argument(
        "--hidden", type=int, default=128, help="units in each of two hidden layers"
    )
    options.add_argument("--lr", type=float, default=1e-3, help="learning rate of Adam")
    options.set_defaults(methods=None)  # which ones depends on the delays
    args = options.parse_args(words)
    args.methods = args.methods or list(CONSTANT if args.shortest is None else METHODS)
    print(table(carried_out(args, run_method), args))


if __name__ == "__main__":
    main()
