"""Check that a GPU computes what the CPU computes, then measure worlds of one device
(``make bench-gpu``).

    python examples/benchmarks/bench_gpu.py    (on a GPU: eight minutes at most, then long trainings)
    python examples/benchmarks/bench_gpu.py --device cpu --worlds 64 256 --trainings 64 --frames 1e5
                                               (the same at small sizes)

The tables are printed as they come and written to runs/bench_gpu.md. No row of speed begins after
``--minutes``. Trainings of ``--frames`` steps leave their run folders in runs/bench_gpu.
"""

import subprocess
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, pairwise
from pathlib import Path

import pandas as pd
import torch
from bench import BARE, WHOLE, Table, delays, policy_for, scenarios, steps_of
from bench_timing import staggered
from bench_training import damian
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.libs.vmas import VmasEnv

from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.recipes.cli import settings as composed_config

KINDS = {
    "plain world": ("use case 2", BARE),
    "whole chain": ("use case 2", WHOLE),
    "everything": ("everything", WHOLE),
}
MODES = {"CUDA graph": True, "compiled": False}
RIVALS = {"simple_spread": 1 << 20, "navigation": 1 << 20, "discovery": 1 << 16}
"""Tasks of VMAS, and the most worlds that are measured: with more, discovery takes half a second a
step."""
LONG = {
    "timeline": ["scenario=delaybench/crowded", "aware=timeline"],
    "sets": ["scenario=tasks/crowded_five", "aware=timeline", "model=sets_large"],
}
"""Words of ``damian train`` for long trainings, by name."""
STEPS = 20
REPEATS = 3


def make(kind: str, worlds: int, device: str) -> DelayedEnv:
    """One of ``KINDS`` on a device."""
    scenario, changes = KINDS[kind]
    return make_env(
        replace(scenarios()[scenario], **delays()[changes]), worlds, device=torch.device(device)
    )


def differences(
    kind: str, device: str, mode: str, worlds: int = 64, steps: int = 50
) -> tuple[str, ...]:
    """Share of the numbers that differ from the CPU's, and the largest difference, after the same
    actions."""
    ours = make(kind, worlds, "cpu")
    theirs = make(kind, worlds, device)
    if mode != "eager":
        theirs.compile()
    ours.set_seed(0), theirs.set_seed(0)
    rollout = ours.rollout(steps, break_when_any_done=False)
    actions = iter(rollout["agents", "action"].unbind(1))
    again = theirs.rollout(
        steps,
        lambda td: td.set(("agents", "action"), next(actions).to(device)),
        break_when_any_done=False,
    )
    n = 0
    n_different = 0
    largest = 0.0
    for key, value in rollout["next"].items(True, True):
        a = value.double()
        b = again["next", key].cpu().double()
        apart = (a - b).abs().nan_to_num() / (1 + a.abs().nan_to_num(posinf=0))
        n = n + apart.numel()
        n_different = n_different + int((apart > 1e-4).sum())
        largest = max(largest, float(apart.max()))
    return f"{kind}, {mode}", f"{n_different / n:.2e}", f"{largest:.1e}"


def waits(kind: str, worlds: int) -> str:
    """Whether a step on the GPU waits for the host, as torch's debug mode tells."""
    env = make(kind, worlds, "cuda")
    following = env.rand_action(env.reset())
    torch.cuda.set_sync_debug_mode("error")
    try:
        env.step_and_maybe_reset(following)
    except RuntimeError as error:
        return str(error).splitlines()[0]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return "never"


def per_second(chunk: Callable[[], object], frames: int, device: str) -> str:
    """World steps a second [millions], the median of ``REPEATS`` calls after two that do not
    count."""
    ends = []
    for _ in range(2 + REPEATS + 1):
        chunk()
        if device != "cpu":
            torch.cuda.synchronize()
        ends.append(time.perf_counter())
    spent = sorted(b - a for a, b in pairwise(ends[2:]))
    return f"{frames / spent[len(spent) // 2] / 1e6:.3f}"


def environments(mode: str, worlds: int, device: str) -> dict[str, Callable[[], EnvBase]]:
    """Ours, compiled, by kind."""
    return {
        f"{kind}, {mode}": lambda k=kind: make(k, worlds, device).compile(cuda_graph=MODES[mode])
        for kind in KINDS
    }


def rivals(worlds: int, device: str) -> dict[str, Callable[[], EnvBase]]:
    """Tasks of VMAS."""
    options = {"num_envs": worlds, "n_agents": 3, "device": device, "continuous_actions": True}
    tasks = [task for task, most in RIVALS.items() if worlds <= most]
    return {f"VMAS {task}": partial(VmasEnv, task, **options) for task in tasks}


def measured(
    name: str, make_env: Callable[[], EnvBase], worlds: int, device: str
) -> tuple[str, ...]:
    """A row: steps with random actions, and with a policy in TorchRL's ``Collector``."""
    env = make_env()
    following = staggered(env, groups=10)
    stepped = per_second(lambda: steps_of(env, following, STEPS), worlds * STEPS, device)
    policy = policy_for(env).to(device)
    collector = Collector(env, policy, frames_per_batch=worlds * STEPS, total_frames=-1)
    return (
        name,
        f"{worlds:,}",
        stepped,
        per_second(iter(collector).__next__, worlds * STEPS, device),
    )


def trained(worlds: int, device: str) -> tuple[str, ...]:
    """A row: iterations of ``damian train`` with the words of the README, compiled."""
    words = ["scenario=delaybench/crowded", "delay.obs=1..7", "aware=timeline", "compile=true"]
    config = composed_config(*words, f"worlds={worlds}", f"device={device}")
    frames = worlds * config.update_steps
    iterations = damian(config)
    begin = time.perf_counter()
    next(iterations)
    first = f"training, first update {time.perf_counter() - begin:.0f} s"
    return first, f"{worlds:,}", "-", per_second(iterations.__next__, frames, device)


def long_training(name: str, worlds: int, options: Namespace) -> tuple[str, ...]:
    """A row: ``damian train`` from the start of the program to its last evaluation."""
    folder = Path("runs/bench_gpu") / name
    words = [*LONG[name], f"worlds={worlds}", f"frames={int(options.frames)}", "compile=true"]
    words += [f"device={options.device}", "learner.anneal=true", "delay.obs=1..7", "logger=csv"]
    begin = time.perf_counter()
    subprocess.run(
        [Path(sys.executable).with_name("damian"), "train", *words, f"hydra.run.dir={folder}"],
        check=True,
    )
    seconds = f"{time.perf_counter() - begin:.0f}"
    results = pd.read_csv(folder / "result.csv").set_index("policy")["return"]
    returns = (f"{results[policy]:.2f}" for policy in ("trained", "script", "untrained"))
    return name, f"{worlds:,}", f"{int(options.frames):,}", seconds, *returns


def jobs(options: Namespace) -> Iterator[tuple[str, int, Callable[[], tuple[str, ...]]]]:
    """What makes each row, the most important first: its name, its number of worlds, and a
    function."""
    device = options.device
    modes = list(MODES)[options.device == "cpu" :]
    kinds: list[Callable[[int, str], dict[str, Callable[[], EnvBase]]]]
    kinds = [
        partial(environments, modes[0]),
        rivals,
        *(partial(environments, mode) for mode in modes[1:]),
    ]
    rows = [
        [
            (name, worlds, partial(measured, name, make_one, worlds, device))
            for worlds in options.worlds
            for name, make_one in kind(worlds, device).items()
        ]
        for kind in kinds
    ]
    trainings = [
        ("training", worlds, partial(trained, worlds, device)) for worlds in options.trainings
    ]
    yield from [*rows[0], *trainings, *chain(*rows[1:])]


def measure(options: Namespace) -> Iterator[str]:
    """The tables, one after the other."""
    device = options.device
    until = time.monotonic() + 60 * options.minutes
    name = (
        torch.cuda.get_device_name()
        if device != "cpu"
        else f"CPU, {torch.get_num_threads()} threads"
    )
    yield f"# {name}, torch {torch.__version__}\n"
    n_modes = 1 if device == "cpu" else 2
    header = ("environment", "share of numbers apart by 1e-4", "largest difference")
    rows = [
        differences(kind, device, mode)
        for kind in KINDS
        for mode in ("eager", "CUDA graph")[:n_modes]
    ]
    yield Table("The same as on the CPU?", header, rows).markdown()
    if device != "cpu":
        rows = [(kind, waits(kind, options.worlds[0])) for kind in KINDS]
        yield Table("Does a step wait for the host?", ("environment", "waits"), rows).markdown()
    rows = []
    for name, worlds, job in jobs(options):
        try:
            row = job() if time.monotonic() < until else (name, f"{worlds:,}", "no time left", "")
        except RuntimeError as error:  # of memory
            row = (name, f"{worlds:,}", str(error).splitlines()[0][:80], "")
        rows.append(row)
        print(*row, sep="  ", flush=True)
        torch.compiler.reset()  # frees what the row has compiled
    header = (
        "environment",
        "worlds",
        "random actions [million world steps/s]",
        "a policy in a collector",
    )
    yield Table("World steps a second", header, rows).markdown()
    rows = [long_training(name, max(options.trainings), options) for name in LONG]
    header = ("training", "worlds", "steps", "seconds", "trained", "script", "untrained")
    yield Table("Long trainings, one to seven steps late: true returns", header, rows).markdown()


if __name__ == "__main__":
    parser = ArgumentParser(description="Compare a GPU with the CPU, and measure it.")
    parser.add_argument("--device", default="cuda", help="cuda, or cpu for a trial")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 16384, 65536, 262144])
    parser.add_argument(
        "--trainings", type=int, nargs="+", default=[2048, 16384], help="worlds of trainings"
    )
    parser.add_argument("--frames", type=float, default=1e8, help="steps of long trainings")
    parser.add_argument("--minutes", type=float, default=8.0, help="no row begins later")
    Path("runs").mkdir(exist_ok=True)
    with Path("runs/bench_gpu.md").open("w", encoding="utf-8") as report:
        for part in measure(parser.parse_args()):
            print(part, flush=True)
            report.write(part + "\n")
