"""Arms x seeds, over tasks and delays, by one command: who copes with late messages, and how well.

    python recipes/compare.py experiment=usecase2 seeds=10 processes=2
    python recipes/compare.py experiment=delaybench "tasks=[tracking]" "arms=[undelayed,naive,both]"
    python recipes/compare.py experiment=usecase2 seeds=2 "overrides=['frames=1000','eval_episodes=8']"
    python recipes/compare.py experiment=usecase2 report_only=true

conf/experiment says what is compared. Runs lie in runs/EXPERIMENT/TASK/DELAY/ARM/seed_N and print into
log.txt there; what is finished is not run again, so that the same command goes on after Ctrl-C. Beside them:
results.csv (every run), table.md and table.csv (means with 95 % intervals, J_norm, recovery), figure.png.
"""

import csv
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import hydra
from evaluate import fly
from hydra import compose
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import MISSING, DictConfig
from shared.composition_errors import COMPOSITION_ERRORS, one_line
from shared.launch import checked, launch, reported
from shared.parallel import LOG, Run, check_stored, perform_all
from shared.settings import CONF
from train import train

from damian.common import checks
from damian.common.errors import InputError
from damian.evaluation.comparison import MODE, NOT_LATE, SAMPLED, SCORES, SCRIPTED, Arm, Comparison
from damian.evaluation.report import LABELS, markdown, plot_curves, plot_norms
from damian.evaluation.run_folder import read_metrics

ALL_RESULTS, TABLE, MARKDOWN, FIGURE = "results.csv", "table.csv", "table.md", "figure.png"
SEEDS, EPISODES = 10, 100
"""At least so many for a number to be published (per seed and evaluation)."""
POLICIES = {"sampled": SAMPLED, "mode": MODE}


@dataclass
class Experiment:
    """What is compared: a file of conf/experiment. The lists are overrides of ``recipes/train.py``."""

    tasks: dict[str, list[str]] = field(default_factory=dict)
    delays: dict[str, list[str]] = field(default_factory=dict)
    arms: dict[str, Arm] = field(default_factory=dict)
    first_seed: int = 0
    best: dict[str, float] = field(default_factory=dict)
    """Dashed in the learning curves, by measure."""

    def __post_init__(self) -> None:
        for kind in ("tasks", "delays", "arms"):
            for name in getattr(self, kind):
                good = re.fullmatch(r"[\w.-]+", name) and name not in (NOT_LATE, *SCRIPTED)
                checks.require(bool(good), f"experiment.{kind}", name, "is no name for a folder")
        undelayed = [name for name, arm in self.arms.items() if not arm.delayed]
        should = "are not delayed: it must be one"
        checks.require(len(undelayed) == 1, "experiment.arms", undelayed, should)
        for name, arm in self.arms.items():
            checks.one_of(f"experiment.arms.{name}.regime", arm.regime, ("R0", "R1", "R2", "R3"))
        for name in self.best:
            checks.one_of("experiment.best", name, LABELS)


@dataclass
class CompareConfig:
    """Everything that ``recipes/compare.py`` can be told."""

    experiment: Experiment = MISSING
    seeds: int = SEEDS
    """How many, from ``experiment.first_seed`` on."""
    processes: int = 1
    """Runs at the same time, each with one thread if not said otherwise."""
    tasks: list[str] | None = None
    """Only these."""
    delays: list[str] | None = None
    """Only these."""
    arms: list[str] | None = None
    """Only these."""
    overrides: list[str] = field(default_factory=list)
    """Of ``recipes/train.py``, for every run."""
    score: str = "true_return"
    """The J of J_norm and recovery."""
    policy: str = "sampled"
    """Whose score: sampled or mode."""
    report_only: bool = False
    """Run nothing: tables and figure of what is there."""

    def __post_init__(self) -> None:
        checks.whole("seeds", self.seeds, 1, 10_000)
        checks.whole("processes", self.processes, 1, 1024)
        checks.one_of("score", self.score, SCORES)
        checks.one_of("policy", self.policy, POLICIES)
        for word in self.overrides:
            ours = re.match(r"\+*(seed|resume|checkpoint|logger)\b", word)
            checks.require(not ours, "overrides", word, "is not for all runs alike: the comparison sets it")
        for kind in ("tasks", "delays", "arms"):
            for name in getattr(self, kind) or ():
                checks.one_of(kind, name, getattr(self.experiment, kind))
        for name, arm in self.chosen("arms").items():
            if arm.policy_of is not None:
                sources = [name for name, arm in self.chosen("arms").items() if arm.policy_of is None]
                checks.one_of(f"experiment.arms.{name}.policy_of", arm.policy_of, sources)

    def chosen(self, kind: str) -> dict[str, Any]:
        """What the experiment names, or the part of it that is asked for."""
        known, only = getattr(self.experiment, kind), getattr(self, kind)
        return {name: known[name] for name in known if only is None or name in only}


ConfigStore.instance().store(name="compare_schema", node=CompareConfig)


def plan(config: CompareConfig, folder: Path) -> list[Run]:
    """Every run, with its checked configuration; those that fly what others have learnt come last."""
    delays = {NOT_LATE: [], **config.chosen("delays")}
    runs = [
        run
        for task, words in config.chosen("tasks").items()
        for delay, late in delays.items()
        for arm, how in config.chosen("arms").items()
        if how.delayed == (delay != NOT_LATE)
        for run in _seeds(config, folder / task / delay / arm, [*words, *late])
    ]
    return sorted(runs, key=lambda run: not run.trains)


def _seeds(config: CompareConfig, folder: Path, words: list[str]) -> Iterator[Run]:
    """The runs of one task, delay and arm."""
    task, delay, arm = folder.parts[-3:]
    how = config.experiment.arms[arm]
    words = ["logger=csv", *words, *how.overrides, *config.overrides]
    try:
        first = checked(compose("train", words))
        if how.policy_of is None:
            first.check_learning()
    except COMPOSITION_ERRORS as error:
        raise InputError(f"{task}/{delay}/{arm}: {one_line(error)}") from error
    for seed in range(config.experiment.first_seed, config.experiment.first_seed + config.seeds):
        last = f"seed_{seed}"
        made = replace(first, seed=seed, overrides=[*words, f"seed={seed}"])
        if how.policy_of:
            source = config.experiment.arms[how.policy_of]
            from_ = folder.parents[1] / (delay if source.delayed else NOT_LATE) / how.policy_of / last
            made = replace(made, checkpoint=str(from_))
        trains = how.policy_of is None
        yield Run(task, delay, arm, made, folder / last, train if trains else fly, trains)


def report(config: CompareConfig, runs: Sequence[Run], folder: Path) -> None:
    """Write the tables and the figure of what is finished."""
    done = [run for run in runs if run.finished]
    if not done:
        raise InputError(f"experiment: nothing of it is finished in {folder}")
    arms = config.chosen("arms")
    rows = [
        {
            "task": run.task,
            "delay": run.delay,
            "arm": run.arm,
            "regime": arms[run.arm].regime,
            "seed": run.config.seed,
            **row,
        }
        for run in done
        for row in run.results()
    ]
    comparison = Comparison(rows, arms, config.score, POLICIES[config.policy])
    _write(folder / ALL_RESULTS, rows)
    _write(folder / TABLE, [line.cells() for line in comparison.lines])
    never = {run.task for run in runs if run.config.episode.success_share is None}
    lasted = {run.task: _lasted(run) for run in done}
    (folder / MARKDOWN).write_text(markdown(comparison, _notes(config, runs, rows), lasted, never))
    if len(comparison.tasks()) > 1:
        plot_norms(comparison, folder / FIGURE)
    else:
        curves: dict[tuple[str, str, str], list[list[dict[str, float]]]] = {}
        for run in done:
            if run.trains:
                curves.setdefault((run.task, run.delay, run.arm), []).append(read_metrics(run.folder))
        plot_curves(comparison, curves, config.experiment.best, never, folder / FIGURE)


def _write(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _lasted(run: Run) -> str:
    """How long the runs of a task have learnt."""
    limit = f" or {run.config.episodes} episodes, whatever comes first" if run.config.episodes else ""
    return f"Trained for {run.config.frames} frames{limit}."


def _notes(config: CompareConfig, runs: Sequence[Run], rows: Sequence[dict[str, Any]]) -> list[str]:
    """How the numbers were made."""
    seeds, episodes = sorted({row["seed"] for row in rows}), int(min(row["episodes"] for row in rows))
    words = [word for word in HydraConfig.get().overrides.task if not word.startswith("report_only")]
    words = [f'"{word}"' if re.search(r"[^\w=.,+/-]", word) else word for word in words]
    missing = [run.name for run in runs if not run.finished]
    notes = [
        f"`{' '.join(['python recipes/compare.py', *words])}`",
        f"{len(seeds)} seeds ({seeds[0]} to {seeds[-1]}), {episodes} episodes per evaluation",
        f"Mean over seeds [95 % interval: stratified bootstrap over seeds]; J: {config.score} of the "
        f"{config.policy} policy; seen: as the server perceived it, else as it was; age in steps",
        "J_norm: 0 random, 1 undelayed; recovery: 0 the stronger naive arm, 1 undelayed; not shown where "
        "the delay costs less than a tenth of undelayed - random",
    ]
    if len(seeds) < SEEDS or episodes < EPISODES:
        notes.insert(0, f"**developing**: fewer than {SEEDS} seeds or {EPISODES} episodes")
    return notes + ([f"missing: {', '.join(missing)}"] if missing else [])


@hydra.main(version_base=None, config_path=CONF, config_name="compare")
@reported
def main(composed: DictConfig) -> None:
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise InputError("-m: a comparison runs all its arms and seeds by itself; leave it out")
    config: CompareConfig = checked(composed)
    folder = Path(HydraConfig.get().runtime.output_dir)
    runs = plan(config, folder)
    for run in runs:
        check_stored(run)
    failed: list[Run] = []
    try:
        if not config.report_only:
            failed = perform_all(runs, config.processes, (POLICIES[config.policy], config.score))
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command goes on")
    for run in failed:
        print(f"failed: {run.name}; see {run.folder / LOG}", file=sys.stderr)
    if failed and not any(run.finished for run in runs):
        sys.exit(1)
    report(config, runs, folder)
    print((folder / MARKDOWN).read_text())
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    launch(main, CompareConfig)
