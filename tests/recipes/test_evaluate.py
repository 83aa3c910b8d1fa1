"""The evaluation recipe, run by its command line: a trained policy with other UAVs, regions and delays."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import check_refused
from omegaconf import OmegaConf

import damian
from damian.compare.comparison import OF_METHOD
from damian.recipes import train

TRAINED = ["frames=64", "worlds=4", "learner.steps=8", "model.hidden=[16]", "eval_episodes=8", "logger=csv"]
TRAINED += ["episode.max_steps=10", "region.lattice_step=60", "seed=3", "delay.obs=1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """The folder of a training run with three UAVs."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *TRAINED, f"hydra.run.dir={folder}"])
        train.main()
    return folder


@pytest.fixture
def fly(run, trained) -> Callable[..., Path]:
    """Evaluate the policy of a run in an empty folder; returns the folder with the results."""

    def start(*words: str, of=trained, folder: str = "flown", program="evaluate") -> Path:
        return run(*words, *[f"checkpoint={of}"] * bool(of), folder=folder, program=program)

    return start


def test_without_overrides_the_evaluation_after_the_training_is_repeated(fly, trained, capsys):
    folder = fly()
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "result.csv", "result.md", "run.json"}
    assert (folder / "result.md").read_text().strip() in capsys.readouterr().out
    again, before = (damian.results(path).set_index("policy") for path in (folder, trained))
    assert {*again.index} == {*before.index} == {*OF_METHOD, "random", "script"}
    assert again.loc["trained, deterministic"].equals(before.loc["trained, deterministic"])
    config, other = (OmegaConf.load(path / "config.yaml") for path in (folder, trained))
    differ = {name for name in other if config[name] != other[name]}
    assert differ == {"checkpoint"}


def test_new_overrides_replace_those_of_the_run_and_the_others_apply(fly):
    folder = fly("delay.obs=4", "seed=5", "agents=10")
    config = OmegaConf.load(folder / "config.yaml")
    assert (config.delay.obs, config.seed, config.agents) == (4, 5, 10)
    assert (config.episode.max_steps, config.eval_episodes, config.model.hidden) == (10, 8, [16])
    flown = (damian.results(path).set_index("policy") for path in (folder, fly(folder="trained")))
    longer, shorter = (rows.at["random", "age"] for rows in flown)
    assert longer == pytest.approx((1 + 2 + 3 + 7 * 4) / 10, rel=1e-6)
    assert shorter == 1


def test_a_run_that_was_resumed_is_flown_and_begun_with_as_any_other(fly, trained, tmp_path):
    shutil.copytree(trained, tmp_path / "longer")
    fly("resume=longer", "frames=96", of=None, folder="unused", program="train")
    assert (fly(of="longer") / "result.csv").exists()
    begun = OmegaConf.load(fly("frames=32", of="longer", folder="begun", program="train") / "config.yaml")
    assert (begun.resume, begun.frames, begun.seed) == (None, 32, 3)


def test_an_option_replaces_what_its_group_sets_and_all_else_stays(fly):
    config = OmegaConf.load(fly("delay=paper", "source=dynamic", "aware=none") / "config.yaml")
    assert (config.delay.obs.law, config.delay.loss, config.source.motion) == ("uniform", 0.0, "dynamic")
    assert (config.episode.max_steps, config.region.lattice_step, config.seed) == (10, 60, 3)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["model.hidden=[8]"], "model.hidden: the policy was trained with [16], so it cannot fly with [8]"),
        (["actions=continuous"], "actions.kind: the policy was trained with 'discrete'"),
    ],
)
def test_wrong_input_is_refused_in_one_line_and_leaves_no_folder(fly, capsys, tmp_path, overrides, message):
    check_refused(lambda: fly(*overrides), message, capsys)
    assert [*tmp_path.glob("*/*")] == []
