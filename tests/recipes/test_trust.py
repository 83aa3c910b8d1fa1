"""Nothing that a run folder names is imported, unless the person who starts the program says so."""

import pytest
from helpers import check_refused
from omegaconf import OmegaConf

from damian.recipes.command import main

TINY = ["frames=64", "worlds=2", "learner.steps=16", "eval_episodes=2", "model.hidden=[4]", "logger=csv"]
TINY += ["region.lattice_step=90", "episode.max_steps=8", "learner.minibatches=1"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of a run, in the current one, beside a module that nobody has asked for."""
    monkeypatch.chdir(tmp_path)
    main(["train", *TINY, "hydra.run.dir=run"])
    (tmp_path / "evil.py").write_text("from pathlib import Path\nPath('imported').touch()\n")
    return tmp_path / "run"


NAMED = {"learner.name": "evil:Config", "sensors": [{"sensor": "evil:sensor"}], "motion.kind": "evil:Model"}


def test_a_stored_run_names_no_code_that_is_run(folder, tmp_path, capsys):
    good = (folder / "config.yaml").read_text()
    for key, value in NAMED.items():
        config = OmegaConf.create(good)
        OmegaConf.update(config, key, value, force_add=True)
        (folder / "config.yaml").write_text(OmegaConf.to_yaml(config))
        for words in (["train", "resume=run"], ["evaluate", "checkpoint=run", "hydra.run.dir=flown"]):
            check_refused(lambda words=words: main(words), "trust=true imports its code", capsys)
    record = folder / "run.json"
    (folder / "config.yaml").write_text(good)
    record.write_text(record.read_text().replace('"worlds=2"', '"learner=evil:Config"'))
    check_refused(lambda: main(["evaluate", "checkpoint=run"]), "evil:Config", capsys)
    assert not (tmp_path / "imported").exists()
