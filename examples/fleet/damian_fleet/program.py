"""The service for fleets of real UAVs: damian-fleet checkpoint=runs/first port=8000
database=fleets.db

Words that are no settings of the service are those of damian train, which choose the scenario
(such as region=llanbedr), or change that of the checkpoint.
"""

import gc
import os
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import cache
from typing import Any

import torch
import uvicorn
import yaml

import damian
from damian import keys
from damian.baselines.script import script_policy
from damian.common.errors import InputError, RunError
from damian.common.fields import rules
from damian_fleet.door import MOST_STRANGERS, door
from damian_fleet.fleet import MOST_STEPS, Fleet
from damian_fleet.node import Node, for_uavs, scenario_of_reports
from damian_fleet.service import make_app
from damian_fleet.settings import FleetConfig
from damian_fleet.store import Fleets

LIMITS = {"backlog": 64, "limit_concurrency": 500 + MOST_STRANGERS}
LIMITS |= {"timeout_keep_alive": 30, "timeout_graceful_shutdown": 2}
"""Connections that wait, and those that are served at a time (others are answered 503); times
[s]."""


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


def make_parts(
    config: FleetConfig, words: Sequence[str]
) -> Callable[[int], tuple[Node, torch.nn.Module]]:
    """The node and the policy for a number of UAVs."""
    loaded = None
    if config.checkpoint is None:
        scenario = scenario_of_reports(damian.compose_scenario(*words))
    else:
        loaded = damian.load(config.checkpoint, *words, trust=config.trust)
        scenario = scenario_of_reports(loaded.env.uav_env.scenario)
        trained = damian.load(config.checkpoint, trust=config.trust)
        instant = any(each.env.uav_env.simulation.vehicles.instant for each in (trained, loaded))
        if instant and not config.instant:
            problem = (
                "the policy's UAVs were at their targets at once: train one with motion=polynomial"
            )
            raise InputError(f"motion: instant: {problem}, or give instant=true to have it served")
        if loaded.env.uav_env.scenario.observation.own:
            print(
                "note: the policy knew its own messages at once; the service knows them when they "
                "arrive"
            )

    @cache
    def parts(n_uavs: int) -> tuple[Node, torch.nn.Module]:
        node = Node(for_uavs(scenario, n_uavs), config.seed)
        if loaded is None:
            return node, script_policy(node.env)
        widths = [
            env.observation_spec[keys.OBSERVATION].shape[-1] for env in (node.env, loaded.env)
        ]
        if widths[0] != widths[1]:
            raise InputError(
                f"uavs: the policy observes the distances of {scenario.agents} UAVs, not {n_uavs}"
            )
        return node, loaded.policy

    return parts


def make_fleets(config: FleetConfig, words: Sequence[str]) -> Fleets:
    """The fleets of a policy; ``words`` choose the scenario."""
    parts = make_parts(config, words)

    def make(uavs: list[str], mark: str, latest: float) -> Fleet:
        seconds = MOST_STEPS * parts(len(uavs))[0].dt
        return Fleet(parts, uavs, config, mark, latest - seconds)

    scenario = dict(word.lstrip("+").partition("=")[::2] for word in words)
    policy = "deterministic" if config.checkpoint else "script"
    about = {"policy": policy, "checkpoint": config.checkpoint, "seed": config.seed, **scenario}
    return Fleets(make, config.database, about)


def main() -> None:
    """Serve until the program is stopped."""
    given = sys.argv[1:]
    if {"-h", "--help"} & {*given}:
        rows = (f"  {name}: {rule.meaning}" for name, rule in rules(FleetConfig).items())
        print((__doc__ or "").strip(), "", *rows, sep="\n")
        return
    torch.set_num_threads(1)
    os.umask(0o077)  # others need not read where UAVs are
    try:
        config, words = config_of(given)
        try:
            listener = socket.create_server((config.host, config.port), backlog=LIMITS["backlog"])
        except (OSError, UnicodeError) as error:
            raise InputError(f"port: {config.host}:{config.port} cannot be used: {error}") from None
        with listener, closing(make_fleets(config, words)) as fleets:
            no_delay = (
                socket.IPPROTO_TCP,
                socket.TCP_NODELAY,
                1,
            )  # or an answer in two parts takes 40 ms
            listener.setsockopt(*no_delay)
            print(*[f"token: {config.token}\n"] * config.is_made, end="")
            print("listening on http://{}:{}".format(*listener.getsockname()[:2]), flush=True)
            app = make_app(fleets, str(config.token))
            quiet = {"log_level": "warning", "access_log": False}
            gc.collect()
            gc.freeze()  # else every full collection looks through all of torch, for a tenth of a second
            served = uvicorn.Config(app, http=door(str(config.token)), ws="none", **quiet, **LIMITS)
            uvicorn.Server(served).run(sockets=[listener])
    except (InputError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(3 if isinstance(error, RunError) else 2)
