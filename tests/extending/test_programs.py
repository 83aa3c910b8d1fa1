"""Your own learners, loggers and configuration files: trained with, resumed, evaluated,
compared."""

import csv
import re
import textwrap
from pathlib import Path

import pytest
from extensions import TINY
from helpers import check_refused
from omegaconf import OmegaConf

import damian

OWN = ["--config-dir=conf", "scenario=windy"]
READER = """
from dataclasses import dataclass
from typing import ClassVar

from damian import keys
from learner import Reinforce, ReinforceConfig

@dataclass
class ReaderConfig(ReinforceConfig):
    reads: ClassVar = ("state", "hindsight")

    def buffer_size(self, setup):
        return setup.least_buffer

    def make(self, env, setup, buffer):
        return Reader(env, self, setup, buffer)

class Reader(Reinforce):
    def __init__(self, env, config, setup, buffer):
        super().__init__(env, config, setup)
        self.buffer = buffer

    def learn(self, batch):
        self.buffer.extend(batch)
        storage = self.buffer.storage
        steps = storage.steps[storage.latest(batch.shape[1])]
        held, now = (steps["next"][key] for key in (keys.RECEIVED, keys.HINDSIGHT))
        late = (held != now).any(-1).float().mean().item()
        collected = batch["next", "agents", "reward"].transpose(0, 1)
        changed = (steps["next", "agents", "reward"] != collected).float().mean().item()
        marked = steps[keys.BACKUPDATED].float().mean().item()
        state = float(keys.STATE in batch.keys())
        return super().learn(batch) | {"late": late, "changed": changed, "marked": marked, "state": state}

"""


def last_metrics(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))[-1]


def test_a_scenario_of_ones_own_is_trained_with_a_learner_and_a_logger_of_ones_own(run, folder):
    first = run(*OWN, *TINY, "logger.custom=[{logger: logger:Progress, every: 1, goal: 2}]")
    metrics = last_metrics(first)
    assert {"loss", "baseline", "reward/together"} <= metrics.keys()
    config = OmegaConf.load(first / "config.yaml")
    assert config.learner.name == "learner:ReinforceConfig"
    assert (config.agents, config.delay.obs.law) == (2, "law:Distance")
    *_, progress = (first / "progress.txt").read_text().splitlines()
    assert progress == f"128 steps: {float(metrics['hindsight_return']) / 2:.0%}"
    # The policy keeps its action history, which a file of the scenario has chosen.
    words = [OWN[0], "checkpoint=run", "trust=true", "agents=3", "delay=paper"]
    evaluated = run(*words, program="evaluate", name="evaluated")
    config = OmegaConf.load(evaluated / "config.yaml")
    assert config.learner.name == "learner:ReinforceConfig"
    assert (config.delay.obs.law, config.delay.history) == ("uniform", 2)
    run("resume=run", "trust=true", "frames=256", name="unused")
    assert last_metrics(first)["frames"] == "256.0"


def test_a_learner_gets_what_it_reads_and_what_was_held_before_and_after_back_updating(run, folder):
    (folder / "reader.py").write_text(READER)
    words = ["scenario=tracking", "learner=reader:ReaderConfig", "delay.obs=3", "aware=backupdate"]
    metrics = last_metrics(run(*TINY, *words))
    assert float(metrics["state"]) == 1
    assert 0 < float(metrics["changed"]) == float(metrics["marked"]) < float(metrics["late"])


@pytest.mark.slow
def test_every_run_of_the_experiment_in_the_document_is_accepted(run, folder, capsys):
    text = (Path(damian.__file__).parents[1] / "docs" / "extending.md").read_text()
    (shown,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (folder / "conf" / "experiment").mkdir()
    (folder / "conf" / "experiment" / "mine.yaml").write_text(textwrap.dedent(shown))
    words = ["--config-dir=conf", "experiment=mine", "seeds=1", "report_only=true"]
    accepted = "experiment: no run of it is finished"
    check_refused(lambda: run(*words, program="compare", name="compared"), accepted, capsys)


@pytest.mark.slow
def test_worker_processes_of_a_comparison_find_the_extensions(run, folder):
    (folder / "conf" / "experiment").mkdir()
    (folder / "conf" / "experiment" / "mine.yaml").write_text(
        "tasks: {windy: [scenario=windy]}\n"
        "delays: {late: ['delay.obs={law: law:Satellite, hop: 2}']}\n"
        "methods:\n"
        "  undelayed: {delayed: false, overrides: [delay.obs=0]}\n"
        "  naive: {naive: true}\n"
    )
    tiny = ",".join(f"'{word}'" for word in TINY if word != "logger=csv")
    words = [
        "--config-dir=conf",
        "experiment=mine",
        "seeds=1",
        "processes=2",
        f"overrides=[{tiny}]",
    ]
    compared = run(*words, program="compare", name="compared")
    assert "| naive | late data |" in (compared / "table.md").read_text()


@pytest.mark.parametrize(
    ("word", "message"),
    [
        (
            "learner=reader:ReaderConfig",
            "learner: reader:ReaderConfig reads hindsight, which needs aware=",
        ),
        (
            "logger.custom=[law:Satellite]",
            "law:Satellite is not a function (folder) -> logger, nor a class",
        ),
    ],
)
def test_a_mistake_is_one_clear_line(run, folder, capsys, word, message):
    (folder / "reader.py").write_text(READER)
    check_refused(lambda: run(*TINY, word), message, capsys)
    assert not (folder / "run").exists()


def test_an_error_in_the_first_update_is_one_line_after_the_progress_bar(run, folder, capsys):
    (folder / "faulty.py").write_text(
        READER.replace('batch["next", "agents", "reward"]', 'batch["nothing"]')
    )
    words = ["learner=faulty:ReaderConfig", "delay.obs=3", "aware=backupdate"]
    with pytest.raises(SystemExit) as stopped:
        run(*TINY, *words)
    assert stopped.value.code == 2
    *_, last = capsys.readouterr().err.strip().splitlines()
    assert last.startswith("error: faulty:ReaderConfig: KeyError: ")
