"""Measure the speed of the environment and of training beside VMAS, the cost of delays, scaling,
and memory.

    python examples/benchmarks/bench.py            (make bench: a quarter of an hour)
    python examples/benchmarks/bench.py --quick    (make bench-quick: a minute, the whole chain
    beside VMAS)

Everything runs on one CPU thread. The measured environments take turns, episodes end at different
times (``bench_timing.py``), and medians with the lowest and the highest time are reported. The
tables are printed and written to runs/bench.md, with a figure in runs/bench.png. Ratios stand
beside those that were stored before, in docs/results/bench.csv, which ``--store`` renews.
"""

import importlib.util
import statistics
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from bench_timing import Measured, collector_times, in_turn, rollout_times, rollouts, staggered
from bench_training import HEADER, WARM_UP, damian, method_config, training, vmas_actor
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.libs.vmas import VmasEnv
from tqdm import tqdm

from damian.common.tables import markdown_table, read_csv, write_csv
from damian.delays.config import DelayConfig
from damian.envs.config import ClockConfig, ScenarioConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS, UavEnv
from damian.models.actor import make_actor
from damian.models.config import MlpConfig
from damian.recipes.cli import settings as composed_config
from damian.server.config import BUILT_IN, ObservationConfig
from damian.server.rewards import RewardConfig
from damian.server.termination import EpisodeConfig
from damian.world.battery import BatteryConfig
from damian.world.motion import MotionConfig

RIVAL_TASKS = ("discovery", "navigation", "simple_spread")
RIVAL_LIMIT = 100
JAXMARL = "JaxMARL simple_spread, one graph"
JAXMARL_PYTHON = Path("build/jaxmarl-venv/bin/python")
BARE = "bare"
WHOLE = "whole chain"
NO_BELIEF = "no belief"

TABLE_2 = [
    "source_distance",
    "source_bearing",
    "source_drift",
    "source_time",
    "agent_distances",
    "coverage",
]
TABLE_2 += [
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
    "spotting_agents",
]
"""Global features of the paper."""

Scenarios = dict[str, ScenarioConfig]
STORED = Path(__file__).parents[2] / "docs" / "results" / "bench.csv"
"""Ratios of an earlier run: table, row, column, ratio."""


class Table(NamedTuple):
    """A table of measurements. Each row begins with its name; columns whose name contains "times"
    hold ratios."""

    title: str
    header: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    def ratios(self) -> pd.DataFrame:
        """The ratios of this table, a line for each."""
        lines = [
            (self.title, row[0], column, cell)
            for row in self.rows
            for column, cell in zip(self.header, row, strict=True)
            if "times" in column
        ]
        return pd.DataFrame(lines, columns=["table", "row", "column", "ratio"])

    def markdown(self, stored: pd.DataFrame | None = None) -> str:
        """This table in Markdown, with the stored ratios in brackets."""
        lines = [] if stored is None else stored.itertuples(index=False)
        known = {tuple(line[:3]): line[3] for line in lines}
        rows = [
            [
                f"{cell} ({before})"
                if (before := known.get((self.title, row[0], column)))
                else cell
                for column, cell in zip(self.header, row, strict=True)
            ]
            for row in self.rows
        ]
        return f"## {self.title}\n\n{markdown_table(self.header, rows)}\n"


@dataclass(frozen=True)
class Sizes:
    """Numbers of worlds, UAVs, steps and repetitions of the measurements."""

    worlds: int = 1024  # beside VMAS, in the cost of delays, and in the growth with UAVs
    steps: int = 50  # of a rollout
    batch: int = 10  # steps of a collector's batch
    repeats: int = (
        7  # measured rollouts or batches of each environment, and iterations of each training
    )
    many_worlds: tuple[int, ...] = (1, 8, 64, 512, 1024, 4096, 16384)
    many_uavs: tuple[int, ...] = (1, 3, 5, 10, 20, 50, 100)
    growth_steps: int = 10  # of a rollout in the measurements of growth
    modes: tuple[str, ...] = ("eager", "compiled")
    training: tuple[int, int] = (256, 32)  # worlds and steps of a training batch


def scenarios() -> Scenarios:
    """The paper's use case 2 (section 5.2), and the same region with every feature, reward and
    model on."""
    paper = composed_config("scenario=paper/usecase2")
    full = replace(
        paper,
        region=replace(
            paper.region, start_positions=None, start_together=False, initial_conditions=1024
        ),
        motion=MotionConfig(kind="polynomial"),
        battery=BatteryConfig(enabled=True),
        actions=replace(paper.actions, mask=True),
        observation=ObservationConfig(["battery", "spotted"], TABLE_2, ctde=True),
        reward=RewardConfig(**dict.fromkeys(BUILT_IN, 1.0) | {"served": 0.0}),
        episode=EpisodeConfig(max_steps=100),
    )
    return {"use case 2": paper, "everything": full}


def believing() -> Scenarios:
    """The tracking task of delaybench without a belief, with the server's, and with that of each
    UAV too."""
    plain = composed_config("scenario=delaybench/tracking")
    features = {"belief": ["belief_gain", "belief_moments"]}
    changes = {
        NO_BELIEF: {},
        "the server's belief": features,
        "that of each UAV too": features | {"own": True},
    }
    return {
        name: replace(plain, observation=replace(plain.observation, **changed))
        for name, changed in changes.items()
    }


def fleet(scenario: ScenarioConfig, agents: int) -> ScenarioConfig:
    """The scenario with another number of UAVs, which start at random ones of 372 landing
    points."""
    start = {"start_positions": None, "start_together": False, "initial_conditions": 1024}
    return replace(
        scenario,
        agents=agents,
        region=replace(scenario.region, lattice_step=15.0, **start),
        motion=replace(
            scenario.motion, max_level=30.0, level_separation=0.2
        ),  # room for 100 flight levels
    )


def delays() -> dict[str, dict[str, Any]]:
    """Changes to a scenario by name; "whole chain" is the paper's delay with an action history of
    four."""
    paper = {"law": "uniform", "low": "3s", "high": "7s", "probability": 0.15}
    everything = DelayConfig(obs=paper, act=1, rew=2, history=4, loss=0.1, reward_window=3)
    slow = ClockConfig(agents="2s", server="4s")
    return {
        BARE: {},
        "ObservationDelay, ServerNode": {"delay": DelayConfig(obs=paper)},
        "ActionDelay": {"delay": DelayConfig(act=2)},
        "RewardDelay": {"delay": DelayConfig(rew=2)},
        "CumulativeReward": {"delay": DelayConfig(reward_window=3)},
        "Clock (agents, server)": {"clock": slow},
        "ActionHistory": {"delay": DelayConfig(history=4)},
        WHOLE: {"delay": DelayConfig(obs=paper, history=4)},
        "every transform": {"delay": everything, "clock": slow},
    }


def delayed(
    scenario: ScenarioConfig, changes: dict[str, Any], worlds: int, mode: str = "eager"
) -> DelayedEnv:
    """An environment of a scenario with some changes, eager or compiled."""
    env = make_env(replace(scenario, **changes), worlds)
    return env.compile() if mode == "compiled" else env


def methods(
    presets: Scenarios, worlds: int, kinds: tuple[str, ...], modes: tuple[str, ...]
) -> dict[str, EnvBase]:
    """Environments of each scenario with each kind of delay, in each mode."""
    return {
        f"{name}, {kind}, {mode}": delayed(scenario, delays()[kind], worlds, mode)
        for name, scenario in presets.items()
        for kind in kinds
        for mode in modes
    }


def rivals(worlds: int) -> dict[str, EnvBase]:
    """Tasks of VMAS with three agents, without and with ends; nothing if VMAS is not installed."""
    if not importlib.util.find_spec("vmas"):
        print("VMAS is not installed, so there are no ratios: pip install -e '.[bench]'")
        return {}
    options = {"num_envs": worlds, "n_agents": 3, "device": "cpu", "continuous_actions": True}
    return {
        rival(task, limit): VmasEnv(task, max_steps=limit, **options)
        for task in RIVAL_TASKS
        for limit in (None, RIVAL_LIMIT)
    }


def rival(task: str, limit: int | None = None) -> str:
    """Name of a task of VMAS in the tables."""
    return f"VMAS {task}, " + (f"episodes of {limit} steps" if limit else "episodes never end")


def policy_for(env: EnvBase) -> torch.nn.Module:
    """A policy with two layers of 64 for an environment of ours, or of VMAS."""
    if isinstance(env, DelayedEnv):
        return make_actor(env, MlpConfig(hidden=[64, 64]))
    return vmas_actor(env, 3, [64, 64])


def comparison(presets: Scenarios, sizes: Sizes, kinds: tuple[str, ...] = (BARE, WHOLE)) -> Table:
    """Speed beside VMAS, through rollouts and collectors; the figure is written to
    runs/bench.png."""
    others = rivals(sizes.worlds)
    envs = others | methods(presets, sizes.worlds, kinds, sizes.modes)
    rolled = rollout_times(envs, sizes.steps, sizes.repeats)
    pairs = {name: (env, policy_for(env)) for name, env in envs.items()}
    collected = collector_times(pairs, sizes.batch, sizes.repeats)
    both = (rolled, collected)
    plot_ratios(
        {name: [min(ratios(t, name), default=0) for t in both] for name in envs},
        Path("runs/bench.png"),
    )
    rows = []
    for name in envs:
        cells = [(f"{t[name].median:.2f}", t[name].spread, _listed(ratios(t, name))) for t in both]
        rows.append(
            (name, *cells[0], *cells[1], f"{rolled[name].first:.0f}" if "compiled" in name else "")
        )
    if (ms := jaxmarl_ms(sizes.worlds)) is not None:
        rows.insert(len(others), (JAXMARL, f"{ms:.2f}", *[""] * 6))
    title = (
        f"{sizes.worlds} worlds, 3 UAVs, episodes end at different times; {sizes.repeats} "
        "repetitions"
    )
    header = ("ms/step", "lowest to highest", f"times VMAS {', '.join(RIVAL_TASKS)}")
    columns = (*(f"rollout: {name}" for name in header), *(f"collector: {name}" for name in header))
    return Table(title, ("environment", *columns, "compile [s]"), rows)


def jaxmarl_ms(worlds: int) -> float | None:
    """Time of a step of JaxMARL's task, in its own environment and process; None if it is not
    installed."""
    if not JAXMARL_PYTHON.exists():
        return None
    words = [str(JAXMARL_PYTHON), str(Path(__file__).with_name("bench_jaxmarl.py")), str(worlds)]
    return float(
        subprocess.run(words, capture_output=True, encoding="utf-8", check=True).stdout.split()[-1]
    )


def ratios(times: Mapping[str, Measured], name: str) -> list[float]:
    """How many times as fast as each task of VMAS, without ends, an environment is."""
    without_ends = [times[rival(task)] for task in RIVAL_TASKS if rival(task) in times]
    return [measured.median / times[name].median for measured in without_ends]


def _listed(numbers: list[float]) -> str:
    return ", ".join(f"{number:.1f}" for number in numbers) or "-"


def beside_first(scenario: str, times: Mapping[str, Measured]) -> list[tuple[str, str, str]]:
    """A row for each of the measured times: its median, and how many times that of the first one it
    is."""
    medians = {what: measured.median for what, measured in times.items()}
    first = next(iter(medians.values()))
    return [
        (f"{scenario}: {what}", f"{ms:.2f}", f"{ms / first:.2f}") for what, ms in medians.items()
    ]


def limit_of_speed(presets: Scenarios, sizes: Sizes) -> Table:
    """Time of a compiled step of the whole chain with ever less of TorchRL around it."""
    rows = []
    for name, scenario in presets.items():
        env = delayed(scenario, delays()[WHOLE], sizes.worlds, "compiled")
        following = staggered(env, groups=25)
        chunks = {
            "rollout": rollouts(env, following.clone(), sizes.steps).__next__,
            "step_and_maybe_reset": partial(steps_of, env, following, sizes.steps),
            "the graph alone": partial(graphs_of, env, following, sizes.steps),
        }
        for chunk in chunks.values():
            chunk()
        times = in_turn(chunks, sizes.steps, sizes.repeats)
        rows += beside_first(name, times)
    title = f"The limit: {sizes.worlds} worlds, 3 UAVs, whole chain, compiled"
    return Table(title, ("what is timed", "ms/step", "times the rollout"), rows)


def steps_of(env: DelayedEnv, following: TensorDictBase, steps: int) -> None:
    """Take steps that are not kept."""
    for _ in range(steps):
        _, following = env.step_and_maybe_reset(env.rand_action(following))


def graphs_of(env: DelayedEnv, following: TensorDictBase, steps: int) -> None:
    """Call the compiled graph of a step with the same actions again and again, without any
    TensorDict."""
    memories, entries = env._step_inputs(env._fused(), env.rand_action(following))
    step = env._compiled_fn("step_and_reset_fn", *entries)
    worlds = env.uav_env.worlds
    with torch.no_grad():
        for _ in range(steps):
            worlds, memories, _, _ = step(worlds, memories, entries)


def cost_of_delays(presets: Scenarios, sizes: Sizes) -> Table:
    """Time of a step with each kind of delay beside the bare environment, not compiled."""
    rows = []
    for name, scenario in presets.items():
        envs = {
            kind: delayed(scenario, changes, sizes.worlds) for kind, changes in delays().items()
        }
        times = rollout_times(envs, sizes.steps, sizes.repeats)
        rows += beside_first(name, times)
    title = f"What delays cost: {sizes.worlds} worlds, 3 UAVs, eager"
    return Table(title, ("environment", "ms/step", "times bare"), rows)


def cost_of_belief(sizes: Sizes) -> Table:
    """Time of a step of a tracking task under the paper's delay, without and with a belief."""
    envs = {
        f"{name}, {mode}": delayed(scenario, delays()[WHOLE], sizes.worlds, mode)
        for name, scenario in believing().items()
        for mode in sizes.modes
    }
    times = rollout_times(envs, sizes.steps, sizes.repeats)
    rows = []
    for name, measured in times.items():
        without = times[f"{NO_BELIEF}, {name.rpartition(', ')[2]}"].median
        rows.append((name, f"{measured.median:.2f}", f"{measured.median / without:.2f}"))
    title = f"What a belief costs: delaybench/tracking, {sizes.worlds} worlds, 3 UAVs, whole chain"
    return Table(title, ("environment", "ms/step", "times without"), rows)


def growth(presets: Scenarios, sizes: Sizes, what: str, numbers: tuple[int, ...]) -> Table:
    """Time of a step for each number of worlds (with 3 UAVs) or of UAVs, whole chain, not
    compiled."""
    rows = []
    for number in tqdm(numbers, what):
        worlds = number if what == "worlds" else sizes.worlds
        flown = (
            presets if what == "worlds" else {name: fleet(s, number) for name, s in presets.items()}
        )
        envs = {
            name: delayed(scenario, delays()[WHOLE], worlds) for name, scenario in flown.items()
        }
        times = rollout_times(envs, sizes.growth_steps, sizes.repeats).values()
        costs = [
            text for t in times for text in (f"{t.median:.2f}", f"{worlds / t.median * 1e3:,.0f}")
        ]
        rows.append((number, *costs))
    fixed = "3 UAVs" if what == "worlds" else f"{sizes.worlds} worlds, starting anywhere"
    header = [f"{name}: {cost}" for name in presets for cost in ("ms/step", "environment steps/s")]
    return Table(f"Growth with {what}: {fixed}, whole chain, eager", (what, *header), rows)


def many_beside_few(presets: Scenarios, sizes: Sizes) -> Table:
    """Time of a step with 20 UAVs over that with 3, whole chain, in turns."""
    envs = {
        (name, mode, number): delayed(fleet(scenario, number), delays()[WHOLE], sizes.worlds, mode)
        for name, scenario in presets.items()
        for mode in sizes.modes
        for number in (3, 20)
    }
    named = {" ".join(map(str, key)): env for key, env in envs.items()}
    found = dict(
        zip(envs, rollout_times(named, sizes.growth_steps, sizes.repeats).values(), strict=True)
    )
    pairs = [
        (key[:2], found[key].median, found[*key[:2], 3].median) for key in envs if key[2] == 20
    ]
    rows = [
        (", ".join(key), f"{few:.2f}", f"{many:.2f}", f"{many / few:.2f}")
        for key, many, few in pairs
    ]
    header = ("scenario", "3 UAVs [ms/step]", "20 UAVs", "times")
    return Table(f"20 UAVs beside 3: {sizes.worlds} worlds, whole chain", header, rows)


def memory(presets: Scenarios) -> Table:
    """Bytes of the state and of a step's output for each world, and of the tables that all worlds
    share."""
    rows = []
    for name, scenario in presets.items():
        env = UavEnv(scenario, 2, extras=EXTRAS)
        bare = UavEnv(scenario, 2, extras=())
        state = sum(x.nbytes for x in tensors(env.state)) // 2
        outputs = [
            sum(x.nbytes for x in tensors(e.rand_step(e.reset()).select("next").to_dict())) // 2
            for e in (bare, env)
        ]
        shared = {
            x.data_ptr(): x.nbytes for x in tensors([vars(bare.simulation), vars(bare.server)])
        }
        rows.append((name, state, *outputs, f"{sum(shared.values()) / 2**20:.1f} MiB"))
    return Table(
        "Memory: bytes of a world with 3 UAVs",
        ("scenario", "state", "output, bare", "output, all extras", "shared tables"),
        rows,
    )


def cost_of_forward(sizes: Sizes) -> Table:
    """Time of a training iteration whose late messages are flown forward, over that without."""
    worlds, steps = sizes.training
    words = "scenario=delaybench/crowded aware=timeline compile=true"
    trainings = {
        f"{delay} steps late{told}": damian(
            method_config(f"{words} delay.obs={delay} {forward}", [64, 64], worlds, steps)
        )
        for delay in (1, 4, 7)
        for told, forward in (("", ""), (", flown forward", "observation.forward=script"))
    }
    measured: dict[str, list[float]] = {name: [] for name in trainings}
    for _ in tqdm(range(WARM_UP + sizes.repeats), "forward", leave=False):
        for name, iterations in trainings.items():
            measured[name].append(1e3 * sum(next(iterations)))
    ms = {name: statistics.median(each[WARM_UP:]) for name, each in measured.items()}
    rows = [
        (name, f"{ms[name]:.0f}", f"{ms[name] / ms[name.partition(',')[0]]:.2f}") for name in ms
    ]
    title = f"What flying forward costs a compiled training: {worlds} worlds, 3 UAVs, {steps} steps"
    return Table(title, ("training", "an iteration [ms]", "times without"), rows)


def training_speed(sizes: Sizes) -> Table:
    """Environment steps per second of training, and the time that each part of it takes."""
    worlds, steps = sizes.training
    title = (
        f"Training: {worlds} worlds, 3 UAVs, {steps} steps; median of {sizes.repeats} iterations"
    )
    return Table(title, HEADER, training(worlds, steps, sizes.repeats))


def tensors(tree: Any) -> Iterator[Tensor]:
    """Every tensor in nested containers and objects."""
    if isinstance(tree, Tensor):
        yield tree
        return
    if isinstance(tree, dict):
        branches = tree.values()
    elif isinstance(tree, list | tuple):
        branches = tree
    else:
        branches = getattr(tree, "__dict__", {}).values()
    for branch in branches:
        yield from tensors(branch)


def plot_ratios(ratios: Mapping[str, list[float]], path: Path) -> None:
    """Draw a pair of bars for each environment: how many times as fast as the fastest task of VMAS
    it is."""
    labels = ("in rollouts, random actions", "in a collector, with a policy")
    figure = Figure(figsize=(8, 0.45 * len(ratios) + 1), layout="constrained")
    axis = figure.subplots()
    for shift, label, column in zip(
        (0.2, -0.2), labels, zip(*ratios.values(), strict=True), strict=True
    ):
        bars = axis.barh(
            [row + shift for row in range(len(ratios))], column, height=0.38, label=label
        )
        axis.bar_label(bars, fmt="%.1f", padding=3)
    axis.set_yticks(range(len(ratios)), list(ratios))
    axis.invert_yaxis()
    axis.axvline(1, color="0.4", linewidth=0.8)
    axis.set(xlabel="times as fast as the fastest of the tasks of VMAS that never end")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="lower right", frameon=False)
    figure.savefig(path, dpi=150)


def measure(names: Sequence[str], store: bool) -> None:
    """Measure the parts of these names, print their tables, and write them to runs/bench.md; with
    ``store`` their ratios stand for those of the same tables that were stored before."""
    torch.set_num_threads(1)
    Path("runs").mkdir(exist_ok=True)
    presets = scenarios()
    sizes = Sizes()
    parts = {
        "rivals": lambda: comparison(presets, sizes),
        "quick": lambda: comparison(presets, replace(sizes, steps=25, repeats=3), (WHOLE,)),
        "limit": lambda: limit_of_speed(presets, sizes),
        "delays": lambda: cost_of_delays(presets, sizes),
        "belief": lambda: cost_of_belief(sizes),
        "worlds": lambda: growth(presets, sizes, "worlds", sizes.many_worlds),
        "uavs": lambda: growth(presets, sizes, "UAVs", sizes.many_uavs),
        "twenty": lambda: many_beside_few(presets, sizes),
        "memory": lambda: memory(presets),
        "training": lambda: training_speed(sizes),
        "forward": lambda: cost_of_forward(sizes),
    }
    if unknown := [name for name in names if name not in parts]:
        sys.exit(f"{unknown[0]} is none of the parts {', '.join(parts)}")
    report = [f"# Benchmark: CPU, one thread, torch {torch.__version__}\n"]
    stored = read_csv(STORED, text=["table", "row", "column", "ratio"])
    for name in names or [name for name in parts if name != "quick"]:
        table = parts[name]()
        report.append(table.markdown(stored))
        print(report[-1])
        if store:
            others = stored[stored["table"] != table.title]
            stored = pd.concat([others, table.ratios()])
            write_csv(STORED, stored)
    target = Path("runs/bench.md")
    target.write_text("\n".join(report), encoding="utf-8")
    print(f"results: {target}, figure: {target.with_suffix('.png')}")


if __name__ == "__main__":
    options = ArgumentParser(description="Measure the speed of the environment and of training.")
    options.add_argument("parts", nargs="*", help="quick, rivals, limit, delays, ...: see measure")
    options.add_argument("--store", action="store_true", help="keep the ratios to compare with")
    chosen = options.parse_args()
    measure(chosen.parts, chosen.store)
