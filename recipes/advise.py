"""Advise real UAVs: from a table of their reports, where each should land next, by a policy or the script.

damian advise checkpoint=runs/first table=reports.csv     (one table, one answer; docs/advise.md)
"""

import time
from pathlib import Path

from omegaconf import DictConfig

from damian.baselines.script import script_policy
from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.tables import write_csv
from damian.common.text_files import named
from damian.field.advice import next_landings
from damian.field.node import Node, for_uavs, scenario_of_reports
from damian.field.rows import read_file
from damian.world.vehicles import MOTION_MODELS

from . import cli
from .config import AdviseConfig
from .evaluate import stored_actor
from .shared.runs import run_folder, save_config, start, stored_values


def advise(config: AdviseConfig, folder: Path) -> None:
    """Print where each UAV of a table should land next, and write it into the run folder."""
    checks.require(config.table is not None, "table", "it", "is missing: give table=FILE")
    scenario_of_reports(config)
    check_motion(config)
    if config.observation.own and config.learnt:
        print("note: the policy knew a UAV's own messages at once; here they are known when they arrive")
    with named(path := Path(str(config.table))):
        rows = read_file(path)
        n_uavs = len({report.id for _, report in rows})
        node = Node(for_uavs(config, n_uavs), config.seed)
        policy = stored_actor(config, node.env) if config.learnt else script_policy(node.env)
        answers = next_landings(rows, node, policy, time.time(), config.flown == "sampled")
    save_config(config, folder)
    write_atomically(folder / "advice.json", answers.to_json(orient="records", indent=1, double_precision=15))
    write_csv(folder / "advice.csv", answers, unknown="NA")
    print((folder / "advice.csv").read_text(encoding="utf-8"), end="")


def check_motion(config: AdviseConfig) -> None:
    """Refuse a policy whose UAVs flew in no time in its training, unless it is asked for."""
    if not config.learnt or config.instant:
        return
    trained = stored_values(run_folder(Path(str(config.checkpoint))), "checkpoint")["motion"]["kind"]
    for kind in (trained, config.motion.kind):
        if MOTION_MODELS.get(kind, "motion.kind").instant:
            problem = "the policy's UAVs were at their targets at once: train one with motion=polynomial"
            raise InputError(f"motion: {kind}: {problem}, or give instant=true to have it advise")


@cli.program("advise")
def main(given: DictConfig) -> None:
    start(advise, given, "advise")
