"""Delays of real reports become the trace that made them."""

import json
import shlex

import numpy as np
import pandas as pd
import pytest

from damian import Trace
from damian.common.errors import InputError
from damian.delays.clocks import check_clocks, in_order
from damian.delays.logs import delays_of, read_log, trace_rows
from damian.recipes.cli import settings
from damian.recipes.command import main
from damian.recipes.fit import law_summary, summary

DELAYS = [0.0, 2.3, None, 0.1, 1.0, None, None, 4.0, 0.7, 0.2, 0.3]
"""Of the messages of a UAV [s]; None: lost."""


def table(numbered=True, period=1.0, uavs=2, start=1.7e9):
    """A table of reports in the order in which they came in, one of them twice."""
    rows = []
    for uav in range(uavs):
        for i, delay in enumerate(DELAYS):
            if delay is not None:
                time = start + i * period
                rows.append((time + delay, f"u{uav}", time, i if numbered else "NA"))
    rows.append(rows[3])
    lines = [
        f"{uav},{time},{received},53.1,-4.5,{number}"
        for received, uav, time, number in sorted(rows)
    ]
    return "\n".join(["ID,time,receive time,lat,lon,sequence", *lines])


def fitted_log(path):
    return delays_of(in_order(read_log(path)))


@pytest.fixture
def log(tmp_path):
    def written(text, name="reports.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


@pytest.mark.parametrize("period", [1.0, 0.25])
def test_a_trace_has_the_delays_and_the_losses_of_the_reports(log, period):
    fitted = fitted_log(log(table(period=period)))
    rows = trace_rows(fitted)
    found = [None if row == "lost" else float(row.removesuffix("s")) for row in rows]
    assert found == [None if d is None else pytest.approx(d, abs=1e-6) for d in DELAYS * 2]
    assert summary(fitted).startswith(
        f"22 messages of 2 UAVs over {10 * period:.0f} s; lost: 6 (27.3%)"
    )


def test_without_numbers_no_loss_can_be_seen(log):
    rows = trace_rows(fitted_log(log(table(numbered=False))))
    assert (len(rows), "lost" in rows) == (16, False)


def test_a_law_reads_the_trace(log, tmp_path, capsys):
    out = tmp_path / "run" / "trace.csv"
    main(["fit", f"log={log(table())}", f"hydra.run.dir={out.parent}"])
    printed = capsys.readouterr().out.splitlines()
    assert f'train with "delay.obs={{law: trace, path: {out}}}"' in printed
    sampler = Trace(str(out)).sampler()
    assert sampler.longest == 4
    assert sampler.loses


def test_a_journal_is_a_log(log):
    head = {
        "journal": "damian-advice",
        "version": 3,
        "fleet": "x",
        "uavs": ["A"],
        "about": {},
    }
    reports = [
        {
            "received": i + 0.25,
            "reports": [{"id": "A", "time": float(i), "lat": 53.1, "lon": -4.5}],
        }
        for i in range(4)
    ]
    lines = [
        head,
        *reports,
        {
            "asked": 5.0,
            "step": 5,
            "told": {},
            "advice": [],
        },
    ]
    path = log("".join(f"{json.dumps(line)}\n" for line in lines) + '{"cut', "x.jsonl")
    assert trace_rows(fitted_log(path)) == ["0.250000s"] * 4


def test_numbered_reports_of_one_second_are_different_messages_also_without_places(log):
    numbers = [n for n in range(300) if n % 50 != 7]
    lines = [f"A,{n // 5},{n // 5 + 0.9},{n}" for n in [*numbers, 100]]  # one of them twice
    fitted = fitted_log(log("\n".join(["ID,time,receive time,sequence", *lines])))
    assert summary(fitted).startswith("300 messages of 1 UAVs over 59 s; lost: 6 (2.0%)")
    assert trace_rows(fitted)[7] == "lost"


def test_who_starts_anew_counts_anew():
    numbers = np.arange(400)
    late = np.random.default_rng(0).uniform(0, 4, 400)
    log = pd.DataFrame(
        {
            "uav": "A",
            "time": 1000.0 + numbers,
            "received": 1000 + numbers + late,
            "sequence": numbers % 200.0,
        }
    ).drop(index=[3, 199, 200])  # 200: the first number, again
    messages = in_order(log.sample(frac=1, random_state=0))
    assert [*messages.index] == [*log.index]
    assert [*messages.run] == [0] * 198 + [1] * 199


@pytest.mark.parametrize(
    ("shift", "said"),
    [
        (-2.0, "1.5 s before"),
        (3600.0, "3.6e+03 s after"),
    ],
)
def test_clocks_that_differ_are_named_before_anything_is_written(
    log, tmp_path, capsys, shift, said
):
    lines = [
        f"{uav},{i},{i + 0.5 + own}" for i in range(10, 30) for uav, own in (("A", 0), ("B", shift))
    ]
    path = log("\n".join(["ID,time,receive time", *lines]))
    with pytest.raises(SystemExit):
        main(["fit", f"log={path}", f"hydra.run.dir={tmp_path / 'run'}"])
    (line,) = capsys.readouterr().err.splitlines()
    start = (
        f"error: {path}: the clocks of B and of the receiver differ: receive times are in the "
        "median"
    )
    assert line.startswith(f"{start} {said} times; correct one of them")
    assert not (tmp_path / "run" / "trace.csv").exists()


@pytest.mark.parametrize(
    ("time", "said"),
    [
        (3000025.5, "time: 3000025.5 s is 5 s after the receive time"),
        (20.0, "time: 20 s is 3e+06 s before the receive time"),
    ],
)
def test_a_message_of_a_wrong_clock_is_named(log, time, said):
    times = [time if i == 20 else 3e6 + i for i in range(40)]
    lines = [f"A,{sent},{3000000.5 + i}" for i, sent in enumerate(times)]
    messages = in_order(read_log(log("\n".join(["ID,time,receive time", *lines]))))
    with pytest.raises(InputError) as error:
        check_clocks(messages)
    remedy = "the clock of A was wrong then; correct the time, or leave such rows out"
    assert str(error.value) == f"line 22: {said}: {remedy}"


def test_a_few_messages_that_came_in_before_their_time_are_named(log):
    few = log("\n".join(["ID,time,receive time", "A,0,0.5", "A,1,0.8", "A,2,2.5"]))
    told = (
        "1 came in before their time, because clocks differ, and count as 0 s late; the earliest "
        "by 0.2 s"
    )
    assert summary(fitted_log(few)).endswith(told)


def test_the_law_of_the_delays_is_a_setting(log, tmp_path, capsys):
    lines = [
        f"A,{i},{i + (5.5 if i % 25 < 5 else 0.5)},53.1,-4.5,{i}" for i in range(500) if i % 25
    ]
    path = log("\n".join(["ID,time,receive time,lat,lon,sequence", *lines]))
    main(["fit", f"log={path}", f"hydra.run.dir={tmp_path / 'run'}"])
    *_, law, distance, _ = capsys.readouterr().out.splitlines()
    assert distance == "it gives 7.4% of all two successive messages other delays"
    delay = settings(*shlex.split(law.removeprefix("best law: "))).delay
    assert (delay.obs["law"], delay.obs["good"], delay.obs["bad"]) == ("burst", 1, 6)


def test_a_bad_fit_is_called_so():
    in_turn = np.arange(300).reshape(1, -1) % 3
    assert law_summary(in_turn, 1.0).endswith("a bad fit: take the trace")


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("A,noon,3,1", "line 3: time: 'noon' is neither a number nor a date of ISO 8601"),
        (
            "A,1.7e12,3,1",
            "line 3: time: 1.7e12: give seconds since 1970, no milliseconds or microseconds",
        ),
        ("A,1,NA,1", "line 3: it needs ID, and two of time, receive time and AoI"),
        ("NA,1,2,1", "line 3: it needs ID, and two of time, receive time and AoI"),
        ("A,1,2,one", "line 3: number: 'one' is neither a number nor a date of ISO 8601"),
    ],
)
def test_what_is_no_report_is_refused_with_its_line(log, row, said):
    path = log(f"id,Time,Receive_Time,number\nA,2026-05-01T12:00:00Z,1777636801,0\n{row}\n")
    with pytest.raises(InputError) as error:
        read_log(path)
    assert str(error.value) == f"{path}: {said}"


def test_the_age_of_a_report_tells_when_it_came_in(log):
    assert trace_rows(fitted_log(log("ID,time,AoI\nA,1,0.5\nA,2,0.25\n"))) == [
        "0.500000s",
        "0.250000s",
    ]
