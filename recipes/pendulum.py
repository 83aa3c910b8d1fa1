"""Apply the delay transforms to another environment: SAC on Gymnasium's Pendulum-v1 with late observations.

    damian pendulum --jobs 2                  (half an hour on two free cores)
    damian pendulum --arms history,bpql       (these arms only)
    damian pendulum --seeds 0 --steps 10000 --delay 3 --out runs/pendulum3

Four arms are trained for each seed: undelayed; naive, whose observations are late; history, which also
observes the agent's latest actions; and bpql, whose actor is that of history, but whose critics read only
the state, once it has arrived (``BackupdateStorage``). The undelayed policy is also evaluated under several
delays. The run folder (runs/pendulum, unless --out names another one) gets the table of mean returns as
results.md and results.csv, and a JSON file for each arm and seed; an arm and seed that has its file is not
trained again.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
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
from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.csv_table import csv_table
from damian.common.markdown import markdown_table
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.bpql import BpqlConfig
from damian.learners.networks import ModelConfig
from damian.learners.sac import Sac, SacConfig
from damian.replay.backupdate import BackupdateStorage
from damian.replay.time_storage import TimeStorage
from damian.transforms import ActionHistory, ObservationDelay

from .shared.command_line import Parser, exits_with_one_line
from .shared.outside_runs import (
    add_options,
    chosen_runs,
    read_result,
    run_all,
    save_result,
)

ARMS = ("undelayed", "naive", "history", "bpql")
AUGMENTED = ("history", "bpql")  # arms whose actor observes its latest actions
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
STORED = [*OBSERVED, "step_count", keys.ACTION]
STORED += map(next_key, (*OUTPUTS, *keys.ENDS))


class Run(NamedTuple):
    """One arm with one seed."""

    arm: str
    seed: int
    steps: int
    delay: int
    episodes: int
    hidden: int


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


def make_learner(env: EnvBase, run: Run) -> Sac:
    """The learner that also trains UAVs: SAC, or BPQL with a storage that learns of states as they arrive."""
    kind = BpqlConfig if run.arm == "bpql" else SacConfig
    config = kind(lr=LR, alpha_lr=LR, gamma=GAMMA, tau=TAU, alpha_init=1.0)
    model = ModelConfig(hidden=[run.hidden, run.hidden], activation="relu")
    setup = LearningSetup(model, 1, 1, 1, critic_key=keys.OBSERVATION)
    if run.arm != "bpql":
        return config.make(env, setup, ReplayBuffer(storage=TimeStorage(run.steps)))
    storage = BackupdateStorage(
        run.steps,
        arrived_states,
        longest=run.delay,
        env=env,
        message_key="observation",
        received_key="received",
        delay_key="delay",
        age_key="age",
    )
    setup = setup._replace(longest_delay=run.delay, critic_key=keys.GLOBAL_OBSERVATION)
    return config.make(env, setup, ReplayBuffer(storage=storage))


def train(env: EnvBase, learner: Sac, steps: int, bar: tqdm) -> None:
    """Train for ``steps`` environment steps, with one update after each."""
    td = env.reset()
    for step in range(steps):
        # Outside of such a context TorchRL's actor takes the mode of its distribution, and explores nothing.
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
    """Mean return of the policy's mode over episodes that have the same initial conditions at every call."""
    env = make_env(delay, history, episodes)
    env.set_seed(EVALUATION_SEED)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(HORIZON, actor, break_when_any_done=False)
    env.close()
    return rollout[next_key(keys.REWARD)].sum(1).mean().item()


def run_arm(run: Run, folder: Path, place: int) -> None:
    """Train, evaluate and write the result; ``place`` is the line of the progress bar."""
    torch.set_num_threads(1)
    torch.manual_seed(run.seed)
    delay = 0 if run.arm == "undelayed" else run.delay
    history = run.delay if run.arm in AUGMENTED else 0
    env = make_env(delay, history)
    env.set_seed(run.seed)
    learner = make_learner(env, run)
    with tqdm(total=run.steps, desc=f"seed {run.seed} {run.arm}", position=place) as bar:
        train(env, learner, run.steps, bar)
    delays = sorted({*DEPLOYED, run.delay}) if run.arm == "undelayed" else [delay]
    returns = {str(d): evaluate_under(d, history, learner.actor, run.episodes) for d in delays}
    save_result(run, folder, returns)


def is_good(returns: Any) -> bool:
    """Whether something can be mean returns by the delay of the evaluation."""
    return isinstance(returns, dict) and all(isinstance(each, int | float) for each in returns.values())


def table(runs: Sequence[Run], folder: Path) -> str:
    """Write the results as results.csv and results.md; returns the latter's text."""
    arms, seeds = (
        list(dict.fromkeys(each)) for each in zip(*((run.arm, run.seed) for run in runs), strict=True)
    )
    rows = [["arm", "delay", "mean", *(f"seed {seed}" for seed in seeds), "reference"]]
    for arm in arms:
        results = [read_result(run, folder, is_good)["returns"] for run in runs if run.arm == arm]
        for delay in results[0]:
            values = [result[delay] for result in results]
            numbers = [f"{value:.0f}" for value in (statistics.mean(values), *values)]
            rows.append([arm, delay, *numbers, str(REFERENCE.get((arm, int(delay)), ""))])
    write_atomically(folder / "results.csv", csv_table(rows))
    title = f"# Pendulum-v1, SAC, {runs[0].steps} steps: return, mean of {runs[0].episodes} episodes"
    text = f"{title}\n\n{markdown_table(rows[0], rows[1:])}\n"
    write_atomically(folder / "results.md", text)
    return text


def parse(words: Sequence[str] | None) -> tuple[list[Run], Path, int]:
    """The runs that the command line asks for, their folder, and the number of processes.

    Raises:
        InputError: an option is unknown, or its value is impossible.
    """
    parser = Parser(description="SAC on Pendulum-v1 with late observations.")
    add_options(parser, ARMS, "runs/pendulum")
    parser.add_argument("--steps", type=int, default=20_000, help="training steps of each arm")
    parser.add_argument("--delay", type=int, default=6, help="delay of the observations [steps]")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of each evaluation")
    parser.add_argument("--hidden", type=int, default=128, help="units in each of two hidden layers")
    args = parser.parse_args(words)
    checks.in_range("--steps", args.steps, RANDOM_STEPS + 1, 100_000_000)
    checks.in_range("--delay", args.delay, 1, HORIZON, "steps")
    for name, most in (("episodes", 10_000), ("hidden", 16_384)):
        checks.in_range(f"--{name}", getattr(args, name), 1, most)
    settings = args.steps, args.delay, args.episodes, args.hidden
    runs = [Run(arm, seed, *settings) for arm, seed in chosen_runs(args, ARMS)]
    return runs, args.out, args.jobs


def main(words: Sequence[str] | None = None) -> None:
    """Train, evaluate and print the table; wrong input ends with one line on stderr and exit code 2."""
    with exits_with_one_line():
        runs, folder, jobs = parse(words)
        run_all(runs, folder, jobs, run_arm, is_good)
        print(f"{table(runs, folder)}\nresults: {folder}")


def run() -> None:
    """Run the program with the words of the command line."""
    main()


if __name__ == "__main__":
    run()
