"""Fit a law to recorded delays: how late the messages of a log were, as a trace to train with, and
as a law.

damian fit log=reports.csv                                          (a table with times and receive times)
damian fit log=journals/north.jsonl clock.simulation=0.5s           (the journal of a service for fleets)
"""

from pathlib import Path

import numpy as np
import pandas as pd
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from damian.common.atomic_files import write_atomically
from damian.common.text_files import named
from damian.delays.clocks import check_clocks, in_order
from damian.delays.law_fit import Integers, fit_laws
from damian.delays.logs import delays_of, read_log, steps_of, trace_rows

from . import cli
from .config import FitConfig

BAD_FIT = 0.1
"""Distance of a law from what was recorded above which its fit is called bad."""


def fit(config: FitConfig, folder: Path) -> None:
    """Write the delays of a log of reports as a trace, and tell which law fits them best."""
    log = Path(config.log)
    dt = config.clock.dt
    messages = in_order(read_log(log))
    with named(log):
        check_clocks(messages)
    delays = delays_of(messages)
    trace = folder / "trace.csv"
    write_atomically(trace, "\n".join(["delay", *trace_rows(delays), ""]))
    print(summary(delays))
    print(f'train with "delay.obs={{law: trace, path: {trace}}}"')
    print(law_summary(steps_of(delays, dt), dt))
    print(f"results: {folder}")


def summary(messages: pd.DataFrame) -> str:
    """The fitted delays and losses as text, with a line about those that came in before their
    time."""
    delays = messages.delay.dropna()
    n = len(messages)
    time = messages.time
    n_lost = n - len(delays)
    early = (time - messages.received)[messages.received < time]
    median, most, nearly_all = np.quantile(delays, [0.5, 0.9, 0.99])
    problem = (
        "came in before their time, because clocks differ, and count as 0 s late; the earliest by"
    )
    clocks = f"\n{len(early)} {problem} {early.max():.3g} s" if len(early) else ""
    return (
        f"{n} messages of {messages.uav.nunique()} UAVs over {time.max() - time.min():.0f} s; "
        f"lost: {n_lost} "
        f"({n_lost / n:.1%})\n"
        f"delay [s]: mean {delays.mean():.3f}, median {median:.3f}, 90 % {most:.3f}, 99 % "
        f"{nearly_all:.3f}, "
        f"longest {delays.max():.3f}{clocks}"
    )


def law_summary(steps: Integers, dt: float) -> str:
    """The best law for delays, as of ``fit_laws``, as settings, and how well it repeats them."""
    best, distance = fit_laws(steps)
    law = str(best.written).replace("'", "")
    loss = f" delay.loss={best.loss}" * (best.loss > 0)
    text = f'best law: "delay.obs={law}"{loss} clock.simulation={dt:g}s\n'
    text += f"it gives {distance:.1%} of all two successive messages other delays"
    if distance > BAD_FIT:
        text += "\na bad fit: take the trace"
    return text


@cli.program("fit")
@cli.one_line_errors("fit")
def main(given: DictConfig) -> None:
    fit(cli.checked(given, [], "fit"), cli.short(Path(HydraConfig.get().runtime.output_dir)))
