"""A trained policy with other UAVs, regions and delays: ``damian evaluate``, and
``damian.load``."""

import shutil
import sys
from pathlib import Path

import pytest
from helpers import check_refused
from omegaconf import OmegaConf

import damian
from damian import keys
from damian.common.errors import InputError
from damian.common.tables import read_csv
from damian.compare.comparison import OF_METHOD
from damian.recipes import train
from damian.runs.metrics import evaluate

TRAINED = [
    "frames=64",
    "worlds=4",
    "learner.steps=8",
    "model.hidden=[16]",
    "eval_episodes=8",
    "logger=csv",
    "episode.max_steps=10",
    "region.lattice_step=60",
    "seed=3",
    "delay.obs=1",
]
SHIPPED = sorted(Path(damian.__file__).parent.glob("data/*/"))
OUTLINES = Path(__file__).parents[1] / "data" / "regions" / "outlines.geojson"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a training run with three UAVs."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *TRAINED, f"hydra.run.dir={folder}"])
        train.main()
    return folder


@pytest.fixture
def fly(run, trained):
    """Evaluate the policy of a run in an empty folder; returns the folder with the results."""

    def start(*words, of=trained, folder="flown", program="evaluate"):
        return run(
            *words,
            *[f"checkpoint={of}"] * bool(of),
            folder=folder,
            program=program,
        )

    return start


def test_without_overrides_the_evaluation_after_the_training_is_repeated(fly, trained, capsys):
    folder = fly()
    assert {path.name for path in folder.iterdir()} == {
        "config.yaml",
        "result.csv",
        "result.md",
        "run.json",
    }
    assert (folder / "result.md").read_text().strip() in capsys.readouterr().out
    again, before = (damian.results(path).set_index("policy") for path in (folder, trained))
    assert {*again.index} == {*before.index} == {*OF_METHOD, "random", "script"}
    assert again.loc["trained, deterministic"].equals(before.loc["trained, deterministic"])
    config, other = (OmegaConf.load(path / "config.yaml") for path in (folder, trained))
    differ = {name for name in other if config[name] != other[name]}
    assert differ == {"checkpoint"}


def test_new_overrides_replace_those_of_the_run_and_the_others_apply(fly):
    folder = fly("delay.obs=4", "seed=5", "agents=10", "source=dynamic")
    config = OmegaConf.load(folder / "config.yaml")
    assert (config.delay.obs, config.seed, config.agents) == (4, 5, 10)
    assert config.source.motion == "dynamic"  # an option replaces what its group sets
    assert (config.episode.max_steps, config.eval_episodes, config.model.hidden) == (10, 8, [16])
    age = damian.results(folder).set_index("policy").at["random", "age"]
    assert age == pytest.approx((1 + 2 + 3 + 7 * 4) / 10, rel=1e-6)


def test_a_run_that_was_resumed_is_flown_and_begun_with_as_any_other(fly, trained, tmp_path):
    shutil.copytree(trained, tmp_path / "longer")
    fly("resume=longer", "frames=96", of=None, folder="unused", program="train")
    assert (fly(of="longer") / "result.csv").exists()
    begun = OmegaConf.load(
        fly("frames=32", of="longer", folder="begun", program="train") / "config.yaml"
    )
    assert (begun.resume, begun.frames, begun.seed) == (None, 32, 3)


def test_a_loaded_policy_flies_as_it_was_evaluated(trained):
    policy, env = damian.load(trained, num_worlds=8, deterministic=True)
    rollout = env.rollout(10, policy, break_when_any_done=False)
    perceived = rollout["next", *keys.REWARD].sum(1).mean().item()
    rows = damian.results(trained).set_index("policy")
    assert perceived == pytest.approx(rows.at["trained, deterministic", "perceived_return"])


def test_a_loaded_policy_flies_elsewhere_unless_it_does_not_fit(trained):
    policy, env = damian.load(
        trained / "best.pt",
        "agents=5",
        "delay.obs=3",
        num_worlds=4,
        seed=1,
    )
    one, other = (env.rollout(5, policy)[keys.ACTION] for _ in range(2))
    assert one.shape == (4, 5, 5)
    assert not one.equal(other)  # actions are drawn
    with pytest.raises(InputError, match=r"model.hidden: the policy was trained with \[16\]"):
        damian.load(trained, "model.hidden=[8]")
    with pytest.raises(InputError, match=r"checkpoint: .*nowhere holds no config.yaml"):
        damian.load(trained.parent / "nowhere")


def test_wrong_input_is_refused_in_one_line_and_leaves_no_folder(fly, capsys, tmp_path):
    message = "actions.kind: the policy was trained with 'discrete'"
    check_refused(lambda: fly("actions=continuous"), message, capsys)
    assert [*tmp_path.glob("*/*")] == []


def test_the_policies_of_the_package_are_a_megabyte_of_plain_data():
    assert len(SHIPPED) == 4
    files = [file for folder in SHIPPED for file in folder.iterdir()]
    assert {file.name for file in files} == {
        "checkpoint.pt",
        "config.yaml",
        "result.csv",
        "README.md",
    }
    assert sum(file.stat().st_size for file in files) <= 1_000_000


@pytest.mark.sample(5)
@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_policy_of_the_package_returns_what_its_card_says(folder):
    rows = read_csv(folder / "result.csv", ["outline"])
    told = rows.iloc[0]
    agents = int(told["agents"])
    words = [
        f"region={OUTLINES}",
        f"region.where=name:{told['outline']}",
        f"agents={agents}",
    ]
    policy, env = damian.load(f"damian:{folder.name}", *words, num_worlds=10, seed=20_000)
    env.set_seed(20_000)
    horizon = env.uav_env.scenario.episode.max_steps
    flown = evaluate(env, policy, horizon, sample=False)["return"]
    assert flown == pytest.approx(told["most likely"], rel=0.02)
