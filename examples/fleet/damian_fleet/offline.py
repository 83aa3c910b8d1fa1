"""Two programs without a service: one answer to a table of reports, and the flight that a journal
tells.

damian-advise checkpoint=runs/FOLDER table=reports.csv instant=true
damian-playback region=llanbedr journal=north.jsonl "formats=[html,gif]" folder=north

Words that are no settings of the program are those of damian train, which choose the scenario
(such as region=llanbedr), or change that of the checkpoint.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
import yaml

import damian
from damian.common.errors import InputError, RunError
from damian.common.fields import Settings, rules, setting
from damian.common.tables import write_csv
from damian.common.text_files import named
from damian.envs.config import ScenarioConfig
from damian.show.files import save_episode, summary
from damian_fleet.advice import next_landings
from damian_fleet.node import Node, for_uavs
from damian_fleet.playback import episodes_of
from damian_fleet.program import make_parts
from damian_fleet.reports import read_file


@dataclass
class OfflineConfig(Settings):
    """Where the scenario and the policy come from."""

    checkpoint: str | None = setting(
        None,
        "Run folder, its best.pt, or damian:NAME: the policy and its scenario; the script if not "
        "given.",
    )
    instant: bool = setting(
        False, "Whether a policy may advise whose UAVs were at their targets at once."
    )
    seed: int = setting(0, "Seed of random regions, and of sampled actions.", low=0)
    trust: bool = setting(
        False, "Import the components package.module:Name that the checkpoint's run names."
    )


@dataclass
class AdviceConfig(OfflineConfig):
    """The settings of damian-advise."""

    table: str = setting("", "Table of reports, CSV or JSON: where should each UAV land next?")
    sampled: bool = setting(
        False, "Draw the actions of the policy, instead of taking the likeliest ones."
    )
    answer: str = setting("advice.csv", "File for the answer, which is printed too.")


@dataclass
class PlaybackConfig(OfflineConfig):
    """The settings of damian-playback."""

    journal: str = setting("", "Journal of a fleet, whose flight to show.")
    folder: str = setting("playback", "Folder for the episodes.")
    formats: list[str] = setting(["html"], "What to make of each.", choices=("gif", "png", "html"))
    shown: list[str] = setting(
        [], "IDs of UAVs that films tell apart; if none, all of up to 6, 3 of more."
    )


def answer_table(config: AdviceConfig, words: Sequence[str]) -> None:
    """Print, and write, where each UAV of a table should land next."""
    torch.manual_seed(config.seed)
    parts = make_parts(config, words)
    with named(config.table):
        rows = read_file(Path(config.table))
        node, policy = parts(len({report.id for _, report in rows}))
        answers = next_landings(rows, node, policy, time.time(), config.sampled)
    write_csv(Path(config.answer), answers, unknown="NA")
    print(Path(config.answer).read_text(encoding="utf-8"), end="")


def play_back(config: PlaybackConfig, words: Sequence[str]) -> None:
    """Write the flight of a journal as episodes, and what people look at."""
    scenario = scenario_of(config, words)

    @cache
    def node_of(n_uavs: int) -> Node:
        return Node(for_uavs(scenario, n_uavs), config.seed, reward_terms=True)

    episodes = episodes_of(Path(config.journal), node_of, {"overrides": [*words]})
    folder = Path(config.folder)
    folder.mkdir(parents=True, exist_ok=True)
    for number, episode in enumerate(episodes):
        name = f"episode_{number}"
        save_episode(episode, folder / name, config.formats, config.shown)
        print(summary(name, episode))


def scenario_of(config: OfflineConfig, words: Sequence[str]) -> ScenarioConfig:
    if config.checkpoint is None:
        return damian.compose_scenario(*words)
    return damian.load(config.checkpoint, *words, trust=config.trust).env.uav_env.scenario


def advise() -> None:
    _run(answer_table, AdviceConfig, "table")


def playback() -> None:
    _run(play_back, PlaybackConfig, "journal")


def _run(
    work: Callable[[Any, Sequence[str]], None], kind: type[OfflineConfig], needed: str
) -> None:
    """Do the work of a program with the settings of the command line; wrong ones end it with one
    line."""
    given = sys.argv[1:]
    known = rules(kind)
    own = dict[str, Any]()
    words = list[str]()
    if {"-h", "--help"} & {*given}:
        settings = (f"  {name}: {rule.meaning}" for name, rule in known.items())
        print((__doc__ or "").strip(), "", *settings, sep="\n")
        return
    torch.set_num_threads(1)
    for word in given:
        key, _, value = word.lstrip("+").partition("=")
        if key in known:
            own[key] = yaml.safe_load(value)
        else:
            words.append(word)
    try:
        if needed not in own:
            raise InputError(f"{needed}: it is missing: give {needed}=FILE")
        work(kind(**own), words)
    except (InputError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(3 if isinstance(error, RunError) else 2)
