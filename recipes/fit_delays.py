"""Fit a trace law to the delays of real reports, so that simulations are as late as the links were.

    damian fit-delays journals/main.jsonl                      (a journal of damian advise)
    damian fit-delays reports.csv --out trace.csv --dt 1

The log is a journal, or a table (CSV, JSON) with the columns ID, lat, lon, time and receive time. The trace
is a CSV file with a row for each message: its delay, or lost. With --dt delays are whole steps of this length
[s], as damian advise counts them; without it they are times, which a simulation rounds up to whole steps.
"""

from collections.abc import Sequence
from pathlib import Path

from damian.advice.fitting import fit, read_log, summary, trace_rows
from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError, RunError

from .shared.command_line import Parser, exits_with_one_line


def main(words: Sequence[str] | None = None) -> None:
    """Fit, write the trace and print a summary."""
    with exits_with_one_line():
        parser = Parser(description="Fit a trace law to the delays of real reports.")
        parser.add_argument("log", type=Path, help="journal of damian advise, or table of reports")
        parser.add_argument("--out", type=Path, default=Path("trace.csv"), help="the trace")
        parser.add_argument("--dt", type=float, help="length of a step [s]: delays are whole steps")
        args = parser.parse_args(words)
        if args.dt is not None:
            checks.above("--dt", args.dt, 0.0, "s")
        if args.out.exists():
            raise InputError(f"--out: {args.out} is there already: name another file")
        fitted = fit(read_log(args.log))
        rows = trace_rows(fitted, args.dt)
        try:
            write_atomically(args.out, "\n".join(["delay", *rows, ""]))
        except RunError as error:
            raise InputError(f"--out: {error}") from None
        print(summary(fitted))
        print(f'{args.out}: train with "delay.obs={{law: trace, path: {args.out}}}"')


def run() -> None:
    """Run the program with the words of the command line."""
    main()


if __name__ == "__main__":
    run()
