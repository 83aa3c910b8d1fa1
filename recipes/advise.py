"""Advise real UAVs: from what they report, where each should land next, by a trained policy or the script.

damian advise checkpoint=runs/first reports=table.csv            (one table, one answer; docs/advise.md)
damian advise checkpoint=runs/first port=8000 journal=journals   (several fleets over HTTP)
"""

import copy
import gc
import json
import logging
import os
import secrets
import socket
import time
from contextlib import closing
from functools import cache
from importlib import import_module
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

import damian
from damian.advice.clock import Clock
from damian.advice.fitting import (
    check_clocks,
    fit,
    law_summary,
    plot_delays,
    read_log,
    steps_of,
    summary,
    trace_rows,
)
from damian.advice.fleet import Fleet, Waiting
from damian.advice.node import Node, for_uavs, scenario_of_service
from damian.advice.rows import as_csv, as_rows, read_file
from damian.advice.session import AdviceSession
from damian.baselines.greedy import greedy_policy
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.text_files import named
from damian.delays.law_fit import fit_laws
from damian.world.vehicles import MOTION_MODELS

from . import cli
from .config import AdviseConfig, check_token
from .evaluate import stored_actor
from .known import key_of
from .shared.runs import run_folder, save_config, stored_values

BACKLOG = 64
"""Connections that wait to be accepted."""
HANDLES = BACKLOG + 64
"""File handles that the service keeps for itself, and for those that it turns away."""
MOST_CONNECTIONS = 4000
FLEET = "main"
"""Name of the only fleet of a table."""


def without_token(config: AdviseConfig) -> AdviseConfig:
    """The settings, as files may keep them."""
    kept = copy.copy(config)
    kept.token, kept.overrides = None, [word for word in config.overrides if key_of(word) != cli.SECRET]
    return kept


def make_session(config: AdviseConfig, folder: Path | None) -> AdviceSession:
    """The session of the policy that the settings name; journals lie in a folder, if there is one."""

    @cache
    def parts(n_uavs: int) -> tuple[Node, TensorDictModuleBase]:
        node = Node(for_uavs(config.eval_scenario, n_uavs), config.seed)
        return node, stored_actor(config, node.env) if config.learnt else greedy_policy(node.env)

    def make_fleet(uavs: list[str], mark: str) -> Fleet:
        node, policy = parts(len(uavs))
        drawn = config.flown == "sampled"
        return Fleet(node, uavs, policy, drawn, config.seed, config, parts, mark)

    overrides = without_token(config).overrides
    about = {"policy": config.flown, "checkpoint": config.checkpoint, "overrides": overrides}
    return AdviceSession(make_fleet, folder, about)


def check_motion(config: AdviseConfig) -> None:
    """Refuse a policy whose UAVs flew in no time in its training, unless it is asked for."""
    if not config.learnt or config.instant:
        return
    trained = stored_values(run_folder(Path(str(config.checkpoint))), "checkpoint")["motion"]["kind"]
    for kind in (trained, config.motion.kind):
        if MOTION_MODELS.get(kind, "motion.kind").instant:
            problem = "the policy's UAVs were at their targets at once: train one with motion=polynomial"
            raise InputError(f"motion: {kind}: {problem}, or give instant=true to have it served")


def answer_table(config: AdviseConfig, folder: Path) -> None:
    """Answer one table of reports: print the advice, and write it into the run folder."""
    path, now = Path(str(config.reports)), time.time()
    session = make_session(config, None)
    with named(path):
        rows = read_file(path)
        session.create(FLEET, config.uavs or list(dict.fromkeys(report.id for _, report in rows)))
        session.report(FLEET, rows, now, file=True)
        try:
            answer = session.advise(FLEET, session.fleet(FLEET).clock)
        except Waiting as error:
            raise InputError(str(error)) from None
    save_config(without_token(config), folder)
    write_atomically(folder / "advice.json", json.dumps(as_rows(answer), indent=1))
    write_atomically(folder / "advice.csv", table := as_csv(answer))
    print(table, end="")


def fit_delays(config: AdviseConfig, folder: Path) -> None:
    """Write the delays of a log of reports as a trace, draw them, and print which law fits them best."""
    log = Path(str(config.fit))
    check_clocks(fitted := fit(read_log(log)), log)
    save_config(without_token(config), folder)
    trace = folder / "trace.csv"
    write_atomically(trace, "\n".join(["delay", *trace_rows(fitted), ""]))
    print(summary(fitted))
    print(f'train with "delay.obs={{law: trace, path: {trace}}}"')
    steps = steps_of(fitted, config.clock.dt)
    laws = fit_laws(steps)
    print(law_summary(*laws, steps, config.clock.dt))
    plot_delays(fitted, *laws, folder / "delays.png")


def advise(config: AdviseConfig, folder: Path) -> None:
    """Answer reports from where the settings say."""
    config.check_source()
    if config.fit is not None:
        fit_delays(config, folder)
        return
    scenario_of_service(config.eval_scenario)
    check_motion(config)
    if config.observation.own and config.learnt:
        print("note: the policy knew a UAV's own messages at once; the service knows them when they arrive")
    if config.reports is not None:
        answer_table(config, folder)
        return
    journals = Path(config.journal) if config.journal else folder / "journals"
    with listening(config) as listener, closing(make_session(config, journals)) as session:
        save_config(without_token(config), folder)
        serve(config, session, listener)


def listening(config: AdviseConfig) -> socket.socket:
    """The address of the service, which is refused before anything is written if it cannot be used."""
    check_token("DAMIAN_TOKEN", config.token or os.environ.get("DAMIAN_TOKEN"))
    try:
        return socket.create_server((config.host, config.port or 0), backlog=BACKLOG)
    except (OSError, UnicodeError) as error:
        raise InputError(f"port: {config.host}:{config.port} cannot be used: {error}") from None


def serve(config: AdviseConfig, session: AdviceSession, listener: socket.socket) -> None:
    """Answer over HTTP until the program is stopped."""
    try:
        uvicorn, service = import_module("uvicorn"), import_module("damian.advice.service")
    except ImportError as error:
        missing = f"needs {error.name}, which is not installed: pip install 'damian[advise]'"
        raise InputError(f"port: {config.port} {missing}") from None
    given = config.token or os.environ.get("DAMIAN_TOKEN")
    token = given or secrets.token_urlsafe(24)
    most = most_connections()
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # or an answer in two parts takes 40 ms
    host, port = listener.getsockname()[:2]
    if given is None:
        print(f"token: {token}")
    print(f"listening on http://{host}:{port}", flush=True)
    app = service.make_app(session, token, Clock(session.latest), damian.__version__)
    for name in ("uvicorn.error", "asyncio", "damian.advice"):
        logging.getLogger(name).addFilter(service.Sparse())
    options = uvicorn.Config(
        app,
        http=service.limited(most),
        backlog=BACKLOG,
        log_level="warning",
        access_log=False,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=2,
        ws="none",
    )
    gc.collect()
    gc.freeze()  # else every full collection looks through all of torch, for a tenth of a second
    uvicorn.Server(options).run(sockets=[listener])


def most_connections() -> int:
    """How many connections the limit of file handles allows; the limit is raised if it can be."""
    try:
        import resource  # noqa: PLC0415 (Windows has none, and no such limit)
    except ImportError:
        return MOST_CONNECTIONS
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_CONNECTIONS + HANDLES
    if soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft < HANDLES + 16:
        raise InputError(f"port: {soft} file handles are too few: allow {HANDLES + 16} at least (ulimit -n)")
    return min(soft - HANDLES, MOST_CONNECTIONS)


def run() -> None:
    cli.run(advise, "advise")
