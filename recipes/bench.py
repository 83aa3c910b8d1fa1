"""Measure the speed of the environment and of training beside VMAS, the cost of delays, scaling, and memory.

    damian bench            (a few minutes)
    damian bench --quick    (seconds; only checks that everything runs)

Everything runs on one CPU thread. Environments take random actions in TorchRL's ``rollout``; training is
measured by ``bench_training.py``. The measured environments take turns, so that a busy machine slows all of
them, and medians are reported. The tables are printed and written to runs/bench.md; there is no run folder.
"""

import importlib.util
import statistics
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.libs.vmas import VmasEnv
from tqdm import tqdm

from damian.common.markdown import markdown_table
from damian.delays.config import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import EXTRAS, UavEnv
from damian.server.features import GLOBAL, LOCAL, ObservationConfig
from damian.server.rewards import INDIVIDUAL, SYSTEM, RewardConfig
from damian.server.termination import EpisodeConfig
from damian.world.battery import BatteryConfig
from damian.world.motion import MotionConfig

from .bench_training import HEADER, training
from .shared.command_line import Parser, exits_with_one_line
from .shared.known_settings import CONF
from .shared.settings import TrainConfig

RIVAL, BARE = "VMAS discovery", "bare"
COMPILED_TOO = (BARE, "whole chain", "every transform")
"""Names in ``delays()`` that are also measured compiled; compiling takes ten seconds each."""

Scenarios = dict[str, ScenarioConfig]


@dataclass(frozen=True)
class Sizes:
    """Numbers of worlds, UAVs, steps and repetitions of the measurements."""

    worlds: int = 1024
    """Worlds in the comparison with VMAS, in the cost of delays, and in the growth with UAVs."""
    steps: int = 50
    """Steps of a rollout."""
    repeats: int = 5
    """Measured rollouts of each environment, and measured iterations of each training."""
    many_worlds: tuple[int, ...] = (1, 8, 64, 512, 1024, 2048, 4096, 8192)
    """Numbers of worlds in the growth with worlds."""
    many_uavs: tuple[int, ...] = (1, 2, 3, 5, 10, 20, 50)
    """Numbers of UAVs in the growth with UAVs."""
    growth_steps: int = 15
    """Steps of a rollout in the measurements of growth."""
    modes: tuple[str, ...] = ("eager", "compiled")
    training_worlds: int = 256
    """Worlds of a training batch."""
    training_steps: int = 32
    """Steps of every world in a training batch."""


QUICK = Sizes(
    16, 4, 2, many_worlds=(1, 8), many_uavs=(1, 3), growth_steps=4, modes=("eager",), training_worlds=4
)


def scenarios() -> Scenarios:
    """The paper's use case 2 (section 5.2), and the same region with every feature, reward and model on."""
    with initialize_config_dir(CONF, version_base=None):
        composed = compose("train", overrides=["scenario=paper/usecase2"])
    paper = cast(TrainConfig, OmegaConf.to_object(composed))
    full = replace(
        paper,
        region=replace(paper.region, start_positions=None, start_together=False, initial_conditions=1024),
        motion=MotionConfig(kind="polynomial"),
        battery=BatteryConfig(enabled=True),
        actions=replace(paper.actions, mask=True),
        observation=ObservationConfig(list(LOCAL), list(GLOBAL), ctde=True),
        reward=RewardConfig(**dict.fromkeys((*INDIVIDUAL, *SYSTEM), 1.0)),
        episode=EpisodeConfig(max_steps=100),
    )
    return {"use case 2": paper, "everything": full}


def fleet(scenario: ScenarioConfig, agents: int) -> ScenarioConfig:
    """The scenario with another number of UAVs, which start at random landing points."""
    return replace(
        scenario,
        agents=agents,
        region=replace(scenario.region, start_positions=None, start_together=False, initial_conditions=1024),
        motion=replace(scenario.motion, max_level=30.0),  # room for 50 flight levels
    )


def step_times(envs: Mapping[str, EnvBase], steps: int, repeats: int) -> dict[str, float]:
    """Median time per step of each environment [ms]; the environments take turns."""
    times: dict[str, list[float]] = {name: [] for name in envs}
    for env in tqdm(envs.values(), "warming up", leave=False):  # the first rollout also compiles
        env.rollout(steps, break_when_any_done=False)
    for _ in tqdm(range(repeats), "measuring", leave=False):
        for name, env in envs.items():
            begin = time.perf_counter()
            env.rollout(steps, break_when_any_done=False)
            times[name].append(1e3 * (time.perf_counter() - begin) / steps)
    return {name: statistics.median(measured) for name, measured in times.items()}


def comparison(presets: Scenarios, sizes: Sizes) -> str:
    """Environment steps per second, beside VMAS if it is installed."""
    envs = rival(sizes)
    for name, scenario in presets.items():
        for outputs, extras in (("bare", ()), ("all extras", EXTRAS)):
            for mode in sizes.modes:
                env = UavEnv(scenario, sizes.worlds, extras=extras)
                envs[f"{name}, {outputs}, {mode}"] = env.compile() if mode == "compiled" else env
    times = step_times(envs, sizes.steps, sizes.repeats)
    rows = [
        (name, f"{ms:.2f}", f"{sizes.worlds / ms * 1e3:,.0f}", ratio(times, ms)) for name, ms in times.items()
    ]
    return table(
        f"{sizes.worlds} worlds, 3 UAVs; median of {sizes.repeats} rollouts of {sizes.steps} steps",
        ("environment", "ms/step", "environment steps/s", "times VMAS"),
        rows,
    )


def rival(sizes: Sizes) -> dict[str, EnvBase]:
    """VMAS's discovery task with as many worlds and three agents; nothing if VMAS is not installed."""
    if not importlib.util.find_spec("vmas"):
        print("VMAS is not installed, so there are no ratios: pip install -e '.[bench]'")
        return {}
    env = VmasEnv("discovery", num_envs=sizes.worlds, n_agents=3, device="cpu", continuous_actions=True)
    return {RIVAL: env}


def ratio(times: Mapping[str, float], ms: float) -> str:
    """How many times as fast as VMAS a step of ``ms`` milliseconds is."""
    return f"{times[RIVAL] / ms:.1f}" if RIVAL in times else "-"


def cost_of_delays(presets: Scenarios, sizes: Sizes) -> str:
    """Time of a step with each kind of delay, beside the bare environment and VMAS."""
    rows = []
    for name, scenario in presets.items():
        for mode in sizes.modes:
            times = step_times(rival(sizes) | delayed(scenario, mode, sizes), sizes.steps, sizes.repeats)
            rows += [
                (f"{name}, {mode}: {delay}", f"{ms:.2f}", f"{ms / times[BARE]:.2f}", ratio(times, ms))
                for delay, ms in times.items()
                if delay != RIVAL
            ]
    return table(
        f"What delays cost: {sizes.worlds} worlds, 3 UAVs",
        ("environment", "ms/step", "times bare", "times VMAS"),
        rows,
    )


def delayed(scenario: ScenarioConfig, mode: str, sizes: Sizes) -> dict[str, EnvBase]:
    """Environments of the scenario with each kind of delay, by name."""
    envs: dict[str, EnvBase] = {}
    for name, changes in delays().items():
        if mode == "compiled" and name not in COMPILED_TOO:
            continue
        pipeline = make_env(replace(scenario, **changes), sizes.worlds)
        env = pipeline if changes else pipeline.uav_env  # the bare environment has no transforms
        envs[name] = env.compile() if mode == "compiled" else env
    return envs


def delays() -> dict[str, dict[str, Any]]:
    """Changes to a scenario by name; "whole chain" is the paper's delay with an action history of four."""
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
        "whole chain": {"delay": DelayConfig(obs=paper, history=4)},
        "every transform": {"delay": everything, "clock": slow},
    }


def growth_with_worlds(presets: Scenarios, sizes: Sizes) -> str:
    """Time of a step for each number of worlds, with 3 UAVs, not compiled."""
    rows = []
    for worlds in tqdm(sizes.many_worlds, "worlds"):
        envs = {name: UavEnv(scenario, worlds, extras=()) for name, scenario in presets.items()}
        rows.append((worlds, *_costs(envs, worlds, sizes)))
    return table("Growth with worlds: 3 UAVs, eager", _cost_header("worlds", presets), rows)


def growth_with_uavs(presets: Scenarios, sizes: Sizes) -> str:
    """Time of a step for each number of UAVs, not compiled."""
    rows = []
    for agents in tqdm(sizes.many_uavs, "UAVs"):
        fleets = {name: fleet(scenario, agents) for name, scenario in presets.items()}
        envs = {name: UavEnv(s, sizes.worlds, extras=()) for name, s in fleets.items()}
        rows.append((agents, *_costs(envs, sizes.worlds, sizes)))
    title = f"Growth with UAVs: {sizes.worlds} worlds, eager, starting anywhere"
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
    times = step_times(envs, sizes.growth_steps, sizes.repeats)
    return [text for ms in times.values() for text in (f"{ms:.2f}", f"{worlds / ms * 1e3:,.0f}")]


def _cost_header(first: str, presets: Scenarios) -> tuple[str, ...]:
    costs = [f"{name}: {cost}" for name in presets for cost in ("ms/step", "environment steps/s")]
    return (first, *costs)


def main() -> None:
    """Measure everything, print the tables and write them to runs/bench.md."""
    parser = Parser(description="Measure the speed of the environment and of training.")
    parser.add_argument("--quick", action="store_true", help="small sizes, only to check that it runs")
    with exits_with_one_line():
        sizes = QUICK if parser.parse_args().quick else Sizes()
    torch.set_num_threads(1)
    presets = scenarios()
    report = [f"# Benchmark: CPU, one thread, torch {torch.__version__}\n"]
    for part in (
        comparison(presets, sizes),
        cost_of_delays(presets, sizes),
        growth_with_worlds(presets, sizes),
        growth_with_uavs(presets, sizes),
        memory(presets),
        training_speed(sizes),
    ):
        print(part)
        report.append(part)
    target = Path("runs/bench.md")
    target.parent.mkdir(exist_ok=True)
    target.write_text("\n".join(report))
    print(f"results: {target}")


def run() -> None:
    """Run the program with the words of the command line."""
    main()


if __name__ == "__main__":
    run()
