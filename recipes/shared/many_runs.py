"""Carry out many runs, several at a time, each in its own folder with its output in log.txt.

Finished runs are not repeated, and interrupted ones continue from their checkpoints.
"""

import traceback
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

from damian.common.errors import InputError, RunError
from damian.runs.checkpoint import digest
from damian.runs.processes import each_in_processes
from damian.runs.run_folder import CHECKPOINT, RESULTS, read_results
from damian.runs.run_lock import locked
from damian.runs.run_record import read_record

from ..cli import Work
from ..config import TrainConfig
from .runs import POLICY, perform

LOG = "log.txt"


@dataclass(frozen=True)
class Run:
    """One seed of an arm, for one task and delay."""

    task: str
    delay: str
    arm: str
    config: TrainConfig
    folder: Path
    program: Work
    """The work to do, importable by name."""
    trains: bool = True
    """Does the program train, so that it writes checkpoints and can be resumed?"""
    needs: Path | None = None
    """Folder of the run whose policy this one flies, starts from, or imitates, if it does so."""

    @property
    def name(self) -> str:
        return "/".join(self.folder.parts[-4:])

    @property
    def stage(self) -> int:
        """Runs of stage 0 need no others, those of stage 1 learn from them, and those of stage 2 fly them."""
        return 2 if not self.trains else int(self.needs is not None)

    @property
    def finished(self) -> bool:
        """Has the run results, and if it flies another's policy, are they of that policy as it is now?"""
        has_results = (self.folder / RESULTS).exists()
        if self.needs is None or not has_results or self.config.checkpoint is None:
            return has_results
        same = read_record(self.folder).get(POLICY) == digest(self.needs / CHECKPOINT)
        return same and (self.needs / RESULTS).exists()

    def score(self, policy: str, measure: str) -> float:
        """A measure of one policy in the results of a finished run, or of its first one."""
        values = read_results(self.folder / RESULTS).set_index("policy")[measure]
        return float(values.get(policy, values.iloc[0]))


def perform_all(
    runs: Sequence[Run], processes: int, told: tuple[str, str], done: Callable[[Run], None]
) -> list[Run]:
    """Carry out the runs that are not finished, and call ``done`` after each; returns those that failed.

    The bar shows the measure ``told`` (policy and name) of the run that finished last.
    """
    todo, failed = [run for run in runs if not run.finished], []
    with tqdm(total=len(runs), initial=len(runs) - len(todo), unit=" runs", disable=not todo) as bar:
        for stage in range(3):
            for run, error in each_in_processes(
                perform_run, [r for r in todo if r.stage == stage], processes
            ):
                bar.update()
                if error:
                    failed.append(run)
                else:
                    bar.set_postfix_str(f"{run.name}: {run.score(*told):.3g}")
                    done(run)
    return failed


def perform_run(run: Run) -> None:
    """Carry out one run, resuming it if it has a checkpoint."""
    run.folder.mkdir(parents=True, exist_ok=True)
    with (
        (run.folder / LOG).open("a", encoding="utf-8", buffering=1) as log,
        redirect_stdout(log),
        redirect_stderr(log),
    ):
        try:
            if run.needs is not None and not (run.needs / RESULTS).exists():
                raise InputError(f"checkpoint: {run.needs} has no finished policy")
            with locked(run.folder):
                resumes = run.trains and (run.folder / CHECKPOINT).exists()
                config = replace(run.config, resume=str(run.folder)) if resumes else run.config
                perform(config, run.folder, run.program)
        except SystemExit:  # a signal has stopped the training
            raise KeyboardInterrupt from None
        except (InputError, RunError) as error:
            print(f"error: {error}")
            raise
        except BaseException:
            traceback.print_exc()
            raise
        finally:
            # Torch compiles a function at most eight times in a process. Policies with different observations
            # share one, so that the ninth would be slow without saying so.
            torch.compiler.reset()
