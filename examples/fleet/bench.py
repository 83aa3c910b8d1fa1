"""Measure ``damian-fleet`` over loopback: requests per second, and how long each takes.

    python bench.py
    python bench.py --rate 500 --seconds 20 --fleets 5
    python bench.py --restart 1000 --rate 100

The service runs in a process of its own, on one core if the system lets it. Connections that stay open send
the reports of 10 UAVs and a question for their advice, in turn; first at a fixed rate, then as fast as it
goes. With ``--restart`` it starts with this number of fleets of 3 UAVs, each with an hour of flight in its
journal: how long it takes until it listens, and until it has answered a first question of every fleet,
and how long questions take from then on. Where other programs use the cores too, the processor time of a
request tells more than the latencies.
"""

import http.client
import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from damian.common.tables import markdown_table
from damian.field.rows import Report
from damian_fleet.answers import Acknowledgement
from damian_fleet.program import config_of, make_session

TOKEN = "a-token-for-the-bench"
N_UAVS = 10
CONNECTIONS = 4
PLACE, SPREAD = (52.8128, -4.1288), 0.0015
"""Middle of the UAVs' places in the region of the bench, and their distance from each other [deg]."""
HEADER = ("requests of 10 UAVs", "answered [1/s]", "p50 [ms]", "p99 [ms]", "longest [ms]", "CPU each [ms]")
HEADER += ("status 200",)


class Sample(NamedTuple):
    """A request: when it was due [s], how long its answer took from then on [s], its status, and its kind."""

    due: float
    took: float
    status: int
    asks: bool


def start(folder: Path, words: Sequence[str]) -> tuple[subprocess.Popen, int]:
    """Start the service; returns its process and port."""
    code = "from damian_fleet.program import main; main()"
    given = [f"journal={folder}/journals", *words, "port=0", f"token={TOKEN}"]
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code, *given],
        stdout=subprocess.PIPE,
        encoding="utf-8",
    )
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, {sorted(os.sched_getaffinity(0))[0]})
    assert process.stdout is not None
    line = next((line for line in process.stdout if line.startswith("listening")), None)
    if line is None:
        sys.exit(process.wait())
    return process, int(line.rpartition(":")[2])


class Connection:
    """A connection that stays open, for some fleets."""

    def __init__(self, port: int, fleets: Sequence[int], n_uavs: int = N_UAVS) -> None:
        self.http = http.client.HTTPConnection("127.0.0.1", port)
        self.fleets, self.n, self.n_uavs = fleets, 0, n_uavs
        self.headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}

    def request(self, method: str, path: str, body: object = None) -> int:
        """Send a request; returns the status of its answer."""
        self.http.request(method, path, None if body is None else json.dumps(body), self.headers)
        answer = self.http.getresponse()
        text = answer.read()
        if answer.status >= 500:
            print(answer.status, text.decode())
        return answer.status

    def next(self) -> int:
        """Send the next request: reports, then a question for advice, of one fleet after the other."""
        fleet = self.fleets[self.n // 2 % len(self.fleets)]
        self.n += 1
        if self.n % 2:
            return self.request(
                "POST", f"/fleets/f{fleet}/reports", reports(time.time(), self.n)[: self.n_uavs]
            )
        return self.request("GET", f"/fleets/f{fleet}/advice")


def reports(now: float, number: int) -> list[dict]:
    """What 10 UAVs say."""
    shift = SPREAD * 0.1 * (number % 7)
    return [
        {
            "ID": f"uav{i}",
            "time": now - 0.01 * i,
            "lat": PLACE[0] + SPREAD * (i % 3 - 1) + shift,
            "lon": PLACE[1] + SPREAD * (i // 3 - 1.5),
            "source spotted": 0,
            "track": 36.0 * i,
            "battery": 80.0,
            "sequence": number,
        }
        for i in range(N_UAVS)
    ]


def load(connections: Sequence[Connection], seconds: float, rate: float | None) -> list[Sample]:
    """Send requests for some time, at a rate [1/s] or as fast as it goes."""
    samples: list[Sample] = []

    def work(connection: Connection, phase: int) -> None:
        period = len(connections) / rate if rate else 0.0
        first, end = time.perf_counter() + 0.1, time.perf_counter() + 0.1 + seconds
        due = first + period * phase / len(connections)
        while due < end:
            time.sleep(max(due - time.perf_counter(), 0.0))
            status = connection.next()
            done = time.perf_counter()
            samples.append(Sample(due - first, done - due, status, connection.n % 2 == 0))
            due = due + period if rate else done

    with ThreadPoolExecutor(len(connections)) as pool:
        list(pool.map(work, connections, range(len(connections))))
    return samples


def processor_time(process: subprocess.Popen) -> float:
    """Processor time that a process has used [s]."""
    fields = Path(f"/proc/{process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def row(name: str, samples: Sequence[Sample], seconds: float, used: float) -> list[str]:
    """A row of the table."""
    took = np.array([sample.took for sample in samples]) * 1000
    p50, p99 = np.quantile(took, [0.5, 0.99])
    good = sum(sample.status == 200 for sample in samples)
    answered = max([seconds, *(sample.due + sample.took for sample in samples)])
    times = [f"{p50:.1f}", f"{p99:.1f}", f"{took.max():.1f}", f"{1000 * used / len(samples):.2f}"]
    return [name, f"{len(samples) / answered:.0f}", *times, f"{good} of {len(samples)}"]


def fly_an_hour(folder: Path, words: Sequence[str], n_fleets: int) -> None:
    """Journals and snapshots of fleets of 3 UAVs that have flown for an hour until now, and were killed.

    Each UAV reports every 5 s, and is sent somewhere every 30 s. One fleet, f10000, flies; the others are
    copies.
    """
    config, others = config_of([*words, "port=0", f"journal={folder}"])
    session, begin = make_session(config, others, words), time.time() - 3600
    uavs = [f"uav{i}" for i in range(3)]
    session.create("f10000", uavs)
    for second in range(0, 3600, 5):
        now = begin + second
        rows = [("", Report.model_validate(row)) for row in reports(now, second // 5)[:3]]
        session.report("f10000", rows, now + 0.5)
        if second % 30 == 0:
            for each in session.advise("f10000", now + 1):
                for status in ("accepted", "landed"):
                    said = Acknowledgement(id=each.ID, answer=each.answer or "", status=status)
                    session.acknowledge("f10000", [said], now + 2)
        if second == 3500:
            session._save("f10000")
    session._unsaved.clear()  # it was killed: nothing is stored at its end
    session.close()
    journal, snapshot = folder / "f10000.jsonl", folder / "f10000.snapshot"
    text = journal.read_text(encoding="utf-8")
    sizes = [each.stat().st_size / 1e6 for each in (journal, snapshot)]
    print(f"a journal has {sizes[0]:.2f} MB and", text.count("\n"), f"lines, a snapshot {sizes[1]:.2f} MB")
    for fleet in range(10_001, 10_000 + n_fleets):
        (folder / f"f{fleet}.jsonl").write_text(text.replace("f10000", f"f{fleet}", 1), encoding="utf-8")
        (folder / f"f{fleet}.snapshot").write_bytes(snapshot.read_bytes())


def measure_restart(n_fleets: int, rate: float, seconds: float, words: Sequence[str]) -> None:
    """Print how long a restart takes, and questions after it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fly_an_hour(folder / "journals", words, n_fleets)
        began = time.perf_counter()
        process, port = start(folder, words)
        print(f"listens after {time.perf_counter() - began:.1f} s")
        try:
            one = Connection(port, [])
            took = []
            for fleet in range(10_000, 10_000 + n_fleets):
                asked = time.perf_counter()
                assert one.request("GET", f"/fleets/f{fleet}/advice") == 200
                took.append(1000 * (time.perf_counter() - asked))
            p50, p99 = np.quantile(took, [0.5, 0.99])
            print(f"first questions: p50 {p50:.1f} ms, p99 {p99:.1f} ms, longest {max(took):.1f} ms")
            print(f"all fleets answered after {time.perf_counter() - began:.1f} s")
            own = [range(10_000 + i, 10_000 + n_fleets, CONNECTIONS) for i in range(CONNECTIONS)]
            connections, before = [Connection(port, fleets, 3) for fleets in own], processor_time(process)
            samples = load(connections, seconds, rate)
            used = processor_time(process) - before
            asks, others = ([each for each in samples if each.asks is kind] for kind in (True, False))
            rows = [row(kind, each, seconds, used / 2) for kind, each in (("GET", asks), ("POST", others))]
            print(markdown_table(HEADER, rows))
        finally:
            process.kill()
            process.wait()


def main() -> None:
    """Measure and print the table."""
    options = ArgumentParser(description="Speed of damian-fleet over loopback.")
    options.add_argument("--rate", type=float, default=500.0, help="requests per second")
    options.add_argument("--seconds", type=float, default=10.0, help="time of each measurement")
    options.add_argument("--fleets", type=int, default=4, help="number of fleets of 10 UAVs")
    options.add_argument(
        "settings",
        nargs="*",
        default=["policy=script", "delay=paper", "region=llanbedr"],
        help="of damian-fleet",
    )
    options.add_argument("--restart", type=int, metavar="N", help="restart with N fleets instead")
    args = options.parse_args()
    if args.restart:
        measure_restart(args.restart, args.rate, args.seconds, args.settings)
        return
    with tempfile.TemporaryDirectory() as folder:
        process, port = start(Path(folder), args.settings)
        try:
            own = [range(i % args.fleets, args.fleets, CONNECTIONS) for i in range(CONNECTIONS)]
            connections = [Connection(port, fleets) for fleets in own]
            uavs = {"uavs": [f"uav{i}" for i in range(N_UAVS)]}
            for fleet in range(args.fleets):  # the steps of real fleets do not begin all at once either
                connections[0].request("PUT", f"/fleets/f{fleet}", uavs)
                connections[0].request("POST", f"/fleets/f{fleet}/reports", reports(time.time(), 0))
                time.sleep(1 / args.fleets)
            load(connections, 1.0, 50.0)  # warms up
            rows = []
            for name, rate in ((f"{args.rate:g} per second", args.rate), ("as fast as it goes", None)):
                before = processor_time(process)
                samples = load(connections, args.seconds, rate)
                rows.append(row(name, samples, args.seconds, processor_time(process) - before))
        finally:
            process.terminate()
            process.wait()
    print(markdown_table(HEADER, rows))


if __name__ == "__main__":
    main()
