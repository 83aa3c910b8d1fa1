"""Measure the speed of the environment and of training beside VMAS, the cost of delays, scaling, and memory.

    damian bench            (a quarter of an hour)
    damian bench --quick    (a minute: the whole chain beside VMAS, for before and after a change)

Everything runs on one CPU thread. The measured environments take turns, episodes end at different times
(``bench_timing.py``), and medians with the lowest and the highest time are reported; training is measured by
``bench_training.py``. The tables are printed and written to runs/bench.md, with a figure in runs/bench.png;
there is no run folder.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase
from tqdm import tqdm

from damian.common.markdown import markdown_table
from damian.envs.uav_env import EXTRAS, UavEnv

from .bench_arms import (
    BARE,
    NO_BELIEF,
    RIVAL,
    WHOLE,
    Scenarios,
    arms,
    believing,
    delayed,
    delays,
    fleet,
    policy_for,
    rivals,
    scenarios,
)
from .bench_figure import plot_ratios
from .bench_timing import Measured, collector_times, rollout_times
from .bench_training import HEADER, training
from .shared.command_line import Parser, exits_with_one_line


@dataclass(frozen=True)
class Sizes:
    """Numbers of worlds, UAVs, steps and repetitions of the measurements."""

    worlds: int = 1024
    """Worlds in the comparison with VMAS, in the cost of delays, and in the growth with UAVs."""
    steps: int = 50
    """Steps of a rollout."""
    batch: int = 10
    """Steps of a collector's batch."""
    repeats: int = 7
    """Measured rollouts or batches of each environment, and measured iterations of each training."""
    many_worlds: tuple[int, ...] = (1, 8, 64, 512, 1024, 4096, 16384)
    """Numbers of worlds in the growth with worlds."""
    many_uavs: tuple[int, ...] = (1, 3, 5, 10, 20, 50, 100)
    """Numbers of UAVs in the growth with UAVs."""
    growth_steps: int = 10
    """Steps of a rollout in the measurements of growth."""
    modes: tuple[str, ...] = ("eager", "compiled")
    training_worlds: int = 256
    """Worlds of a training batch."""
    training_steps: int = 32
    """Steps of every world in a training batch."""


def comparison(presets: Scenarios, sizes: Sizes, kinds: tuple[str, ...] = (BARE, WHOLE)) -> str:
    """Speed beside VMAS, through rollouts and collectors; the figure is written to runs/bench.png."""
    envs = rivals(sizes.worlds) | arms(presets, sizes.worlds, kinds, sizes.modes)
    rolled = rollout_times(envs, sizes.steps, sizes.repeats)
    pairs: dict[str, tuple[EnvBase, nn.Module]] = {name: (env, policy_for(env)) for name, env in envs.items()}
    collected = collector_times(pairs, sizes.batch, sizes.repeats)
    plot_ratios({name: _ratios(rolled, collected, name) for name in envs}, Path("runs/bench.png"))
    rows = [
        (
            name,
            *_time_and_ratio(rolled, name),
            *_time_and_ratio(collected, name),
            f"{rolled[name].first:.0f}" if "compiled" in name else "",
        )
        for name in envs
    ]
    title = f"{sizes.worlds} worlds, 3 UAVs, episodes end at different times; {sizes.repeats} repetitions"
    header = ("ms/step", "lowest to highest", "times VMAS")
    columns = (*(f"rollout: {name}" for name in header), *(f"collector: {name}" for name in header))
    return table(title, ("environment", *columns, "compile [s]"), rows)


def _time_and_ratio(times: Mapping[str, Measured], name: str) -> tuple[str, str, str]:
    measured = times[name]
    return f"{measured.median:.2f}", measured.spread, ratio(times, measured.median)


def _ratios(
    rolled: Mapping[str, Measured], collected: Mapping[str, Measured], name: str
) -> tuple[float, float]:
    """How many times as fast as VMAS a step is in rollouts and in collectors; 0 without VMAS."""
    pairs = [
        (times[RIVAL].median if RIVAL in times else 0, times[name].median) for times in (rolled, collected)
    ]
    return tuple(rival / own for rival, own in pairs)  # type: ignore[return-value]


def ratio(times: Mapping[str, Measured], ms: float) -> str:
    """How many times as fast as VMAS a step of ``ms`` milliseconds is."""
    return f"{times[RIVAL].median / ms:.1f}" if RIVAL in times else "-"


def cost_of_delays(presets: Scenarios, sizes: Sizes) -> str:
    """Time of a step with each kind of delay beside the bare environment, not compiled."""
    rows = []
    for name, scenario in presets.items():
        envs = {kind: delayed(scenario, changes, sizes.worlds) for kind, changes in delays().items()}
        times = rollout_times(envs, sizes.steps, sizes.repeats)
        rows += [
            (f"{name}: {kind}", f"{measured.median:.2f}", f"{measured.median / times[BARE].median:.2f}")
            for kind, measured in times.items()
        ]
    title = f"What delays cost: {sizes.worlds} worlds, 3 UAVs, eager"
    return table(title, ("environment", "ms/step", "times bare"), rows)


def cost_of_belief(sizes: Sizes) -> str:
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
    return table(title, ("environment", "ms/step", "times without"), rows)


def growth_with_worlds(presets: Scenarios, sizes: Sizes) -> str:
    """Time of a step for each number of worlds, with 3 UAVs and the whole chain, not compiled."""
    rows = []
    for worlds in tqdm(sizes.many_worlds, "worlds"):
        envs = {name: delayed(scenario, delays()[WHOLE], worlds) for name, scenario in presets.items()}
        rows.append((worlds, *_costs(envs, worlds, sizes)))
    return table("Growth with worlds: 3 UAVs, whole chain, eager", _cost_header("worlds", presets), rows)


def growth_with_uavs(presets: Scenarios, sizes: Sizes) -> str:
    """Time of a step for each number of UAVs, with the whole chain, not compiled."""
    rows = []
    for agents in tqdm(sizes.many_uavs, "UAVs"):
        fleets = {name: fleet(scenario, agents) for name, scenario in presets.items()}
        envs = {name: delayed(s, delays()[WHOLE], sizes.worlds) for name, s in fleets.items()}
        rows.append((agents, *_costs(envs, sizes.worlds, sizes)))
    title = f"Growth with UAVs: {sizes.worlds} worlds, whole chain, eager, starting anywhere"
    return table(title, _cost_header("UAVs", presets), rows)


def memory(presets: Scenarios) -> str:
    """Bytes of the state and of a step's output for each world, and of the tables that all worlds share."""
    rows = []
    for name, scenario in presets.items():
        env = UavEnv(scenario, 2, extras=EXTRAS)
        bare = UavEnv(scenario, 2, extras=())
        state = sum(x.nbytes for x in tensors(env.state)) // 2
        outputs = [
            sum(x.nbytes for x in tensors(e.rand_step(e.reset()).select("next").to_dict())) // 2
            for e in (bare, env)
        ]
        shared = {x.data_ptr(): x.nbytes for x in tensors([vars(bare.simulation), vars(bare.server)])}
        rows.append((name, state, *outputs, f"{sum(shared.values()) / 2**20:.1f} MiB"))
    return table(
        "Memory: bytes of a world with 3 UAVs",
        ("scenario", "state", "output, bare", "output, all extras", "shared tables"),
        rows,
    )


def training_speed(sizes: Sizes) -> str:
    """Environment steps per second of training, and the time that each part of it takes."""
    worlds, steps = sizes.training_worlds, sizes.training_steps
    title = f"Training: {worlds} worlds, 3 UAVs, {steps} steps; median of {sizes.repeats} iterations"
    return table(title, HEADER, training(worlds, steps, sizes.repeats))


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


def table(title: str, header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    """A Markdown table under a heading."""
    return f"## {title}\n\n{markdown_table(header, rows)}\n"


def _costs(envs: Mapping[str, EnvBase], worlds: int, sizes: Sizes) -> list[str]:
    times = rollout_times(envs, sizes.growth_steps, sizes.repeats).values()
    return [text for t in times for text in (f"{t.median:.2f}", f"{worlds / t.median * 1e3:,.0f}")]


def _cost_header(first: str, presets: Scenarios) -> tuple[str, ...]:
    costs = [f"{name}: {cost}" for name in presets for cost in ("ms/step", "environment steps/s")]
    return (first, *costs)


def measure(quick: bool) -> None:
    """Measure everything or, if quick, the whole chain; print the tables and write them to runs/bench.md."""
    torch.set_num_threads(1)
    Path("runs").mkdir(exist_ok=True)
    presets, sizes = scenarios(), Sizes()
    report = [f"# Benchmark: CPU, one thread, torch {torch.__version__}\n"]
    parts = (
        lambda: comparison(presets, sizes),
        lambda: cost_of_delays(presets, sizes),
        lambda: cost_of_belief(sizes),
        lambda: growth_with_worlds(presets, sizes),
        lambda: growth_with_uavs(presets, sizes),
        lambda: memory(presets),
        lambda: training_speed(sizes),
    )
    if quick:
        parts = (lambda: comparison(presets, replace(sizes, steps=25, repeats=3), (WHOLE,)),)
    for part in parts:
        report.append(part())
        print(report[-1])
    target = Path("runs/bench.md")
    target.write_text("\n".join(report))
    print(f"results: {target}, figure: {target.with_suffix('.png')}")


def main() -> None:
    """Read the command line, and measure."""
    parser = Parser(description="Measure the speed of the environment and of training.")
    parser.add_argument("--quick", action="store_true", help="only the whole chain beside VMAS; a minute")
    with exits_with_one_line():
        quick = parser.parse_args().quick
    measure(quick)


def run() -> None:
    """Run the program with the words of the command line."""
    main()


if __name__ == "__main__":
    run()
