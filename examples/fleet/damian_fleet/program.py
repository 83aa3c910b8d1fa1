"""The service for fleets of real UAVs: damian-fleet checkpoint=runs/first port=8000 journal=journals

Words that are no settings of the service are those of damian train, which choose the scenario (such as
region=llanbedr), or change that of the checkpoint.
"""

import gc
import logging
import os
import secrets
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
import uvicorn
import yaml

import damian
from damian import keys
from damian.baselines.script import script_policy
from damian.common import checks
from damian.common.errors import InputError, RunError
from damian.common.fields import rules, setting
from damian.field.node import Node, for_uavs, scenario_of_reports
from damian_fleet import service
from damian_fleet.clock import Clock
from damian_fleet.fleet import Fleet
from damian_fleet.rules import FieldRules
from damian_fleet.session import AdviceSession

BACKLOG = 64
"""Connections that wait to be accepted."""
HANDLES = BACKLOG + 64
"""File handles that the service keeps for itself, and for those that it turns away."""
MOST_CONNECTIONS = 4000


@dataclass
class FleetConfig(FieldRules):
    """All settings of the service, beside those of the scenario."""

    checkpoint: str | None = setting(None, "Run folder, or the best.pt in it, of the policy that advises.")
    policy: str | None = setting(
        None,
        "deterministic (default with checkpoint), sampled, or script (default without).",
        choices=("deterministic", "sampled", "script"),
    )
    port: int = setting(8000, "Port of the service over HTTP; 0: a free one.", low=0, high=65535)
    host: str = setting("127.0.0.1", "Address of the service; other machines do not reach the default one.")
    token: str | None = setting(
        None, "Password of the service; DAMIAN_TOKEN of the environment, or made and printed, if not given."
    )
    journal: str = setting("journals", "Folder of the journals.")
    seed: int = setting(0, "Seed of sampled actions and of random regions.", low=0)
    trust: bool = setting(False, "Import the components package.module:Name that the checkpoint's run names.")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_token("token", self.token)
        problem = "needs checkpoint: the run folder with the policy"
        self.refuse(self.learnt and not self.checkpoint, "policy", problem)

    @property
    def flown(self) -> str:
        """The policy that advises."""
        return self.policy or ("deterministic" if self.checkpoint else "script")

    @property
    def learnt(self) -> bool:
        """Whether it is that of the checkpoint."""
        return self.flown != "script"


def check_token(key: str, token: str | None) -> None:
    """Require a password that nobody guesses and every header can carry, if there is one."""
    good = token is None or (len(token) >= 16 and token.isascii() and token.isprintable())
    checks.require(good, key, "it", "is not a password of at least 16 printable ASCII characters")


def config_of(words: Sequence[str]) -> tuple[FleetConfig, list[str]]:
    """The settings of the service, and the words that choose the scenario."""
    own: dict[str, Any] = {}
    others = []
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        if key in rules(FleetConfig):
            own[key] = value if key == "token" else yaml.safe_load(value)
        else:
            others.append(word)
    return FleetConfig(**own), others


def make_parts(config: FleetConfig, words: Sequence[str]) -> Callable[[int], tuple[Node, torch.nn.Module]]:
    """The node and the policy for a number of UAVs."""
    if not config.learnt:
        scenario = scenario_of_reports(damian.compose_scenario(*words))
        loaded = None
    else:
        loaded = damian.load(str(config.checkpoint), *words, trust=config.trust)
        scenario = scenario_of_reports(loaded.env.uav_env.scenario)
        trained = damian.load(str(config.checkpoint), trust=config.trust)
        instant = any(each.env.uav_env.simulation.vehicles.instant for each in (trained, loaded))
        if instant and not config.instant:
            problem = "the policy's UAVs were at their targets at once: train one with motion=polynomial"
            raise InputError(f"motion: instant: {problem}, or give instant=true to have it served")
        if loaded.env.uav_env.scenario.observation.own:
            print(
                "note: the policy knew a UAV's own messages at once; the service knows them when they arrive"
            )

    @cache
    def parts(n_uavs: int) -> tuple[Node, torch.nn.Module]:
        node = Node(for_uavs(scenario, n_uavs), config.seed)
        if loaded is None:
            return node, script_policy(node.env)
        widths = [env.observation_spec[keys.OBSERVATION].shape[-1] for env in (node.env, loaded.env)]
        if widths[0] != widths[1]:
            raise InputError(
                f"uavs: the policy observes the distances of {scenario.agents} UAVs, not {n_uavs}"
            )
        return node, loaded.policy

    return parts


def make_session(config: FleetConfig, words: Sequence[str], given: Sequence[str] = ()) -> AdviceSession:
    """The session of a policy; ``given`` are all words but the token, which journals keep."""
    parts = make_parts(config, words)

    def make_fleet(uavs: list[str], mark: str) -> Fleet:
        node, policy = parts(len(uavs))
        return Fleet(node, uavs, policy, config.flown == "sampled", config.seed, config, parts, mark)

    about = {"policy": config.flown, "checkpoint": config.checkpoint, "overrides": list(given)}
    return AdviceSession(make_fleet, Path(config.journal), about)


def listening(config: FleetConfig) -> socket.socket:
    """The address of the service, which is refused before anything is written if it cannot be used."""
    check_token("DAMIAN_TOKEN", config.token or os.environ.get("DAMIAN_TOKEN"))
    try:
        return socket.create_server((config.host, config.port), backlog=BACKLOG)
    except (OSError, UnicodeError) as error:
        raise InputError(f"port: {config.host}:{config.port} cannot be used: {error}") from None


def serve(config: FleetConfig, session: AdviceSession, listener: socket.socket) -> None:
    """Answer over HTTP until the program is stopped."""
    given = config.token or os.environ.get("DAMIAN_TOKEN")
    token = given or secrets.token_urlsafe(24)
    most = most_connections()
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # or an answer in two parts takes 40 ms
    host, port = listener.getsockname()[:2]
    if given is None:
        print(f"token: {token}")
    print(f"listening on http://{host}:{port}", flush=True)
    app = service.make_app(session, token, Clock(session.latest), damian.__version__)
    for name in ("uvicorn.error", "asyncio", "damian_fleet"):
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


def help_text() -> str:
    """What the program is, and its settings."""
    default = FleetConfig()
    rows = [f"  {name}={getattr(default, name)}: {rule.meaning}" for name, rule in rules(FleetConfig).items()]
    return "\n".join([(__doc__ or "").strip(), "", *rows])


def main() -> None:
    """Serve until the program is stopped."""
    given = sys.argv[1:]
    if {"-h", "--help"} & {*given}:
        print(help_text())
        return
    torch.set_num_threads(1)
    try:
        config, words = config_of(given)
        kept = [word for word in given if word.lstrip("+").partition("=")[0] != "token"]
        with listening(config) as listener, closing(make_session(config, words, kept)) as session:
            serve(config, session, listener)
    except (InputError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(3 if isinstance(error, RunError) else 2)
