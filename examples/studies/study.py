"""What the studies of this folder share: their options, and runs by method and seed, each made
once."""

import json
import multiprocessing
import sys
from argparse import ArgumentDefaultsHelpFormatter, ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

Results = dict[tuple[str, int], dict[str, Any]]
"""What a study has measured, by method and seed."""


def parser(description: str, methods: Sequence[str], folder: str) -> ArgumentParser:
    """The command line of a study, with the options that all of them have."""
    found = ArgumentParser(description=description, formatter_class=ArgumentDefaultsHelpFormatter)
    found.add_argument(
        "--methods", nargs="+", choices=methods, default=list(methods), help="ways to learn"
    )
    found.add_argument(
        "--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds of each method"
    )
    found.add_argument("--out", type=Path, default=Path(folder), help="folder of the results")
    found.add_argument(
        "--jobs", type=int, default=1, help="number of processes, each with one thread"
    )
    return found


def carried_out(
    args: Namespace, run_method: Callable[[str, int, Namespace], dict[str, Any]]
) -> Results:
    """Carry out every method with every seed, and keep each result in a file; one that has its file
    is read.

    Args:
        args: of the command line.
        run_method: trains and evaluates a method with a seed; importable by name.
    """
    settings = {k: v for k, v in vars(args).items() if k not in ("methods", "seeds", "out", "jobs")}
    files = {
        (method, seed): args.out / f"seed{seed}_{method}.json"
        for seed in args.seeds
        for method in args.methods
    }
    args.out.mkdir(parents=True, exist_ok=True)
    stored = {
        run: json.loads(file.read_text(encoding="utf-8"))
        for run, file in files.items()
        if file.exists()
    }
    for run, found in stored.items():
        if found["settings"] != settings:
            sys.exit(
                f"{files[run]} has other settings, {found['settings']}: choose another folder with "
                "--out"
            )
    todo = [run for run in files if run not in stored]

    def keep(run: tuple[str, int], returns: dict[str, Any]) -> None:
        stored[run] = {"settings": settings, "returns": returns}
        files[run].write_text(json.dumps(stored[run]), encoding="utf-8")

    if args.jobs == 1:
        for run in todo:
            keep(run, run_method(*run, args))
    else:
        with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
            futures = {pool.submit(run_method, *run, args): run for run in todo}
            for future in as_completed(futures):
                keep(futures[future], future.result())
    return {run: stored[run]["returns"] for run in files}
