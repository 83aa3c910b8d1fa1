"""The command ``damian``: its programs, its help, and one line for each kind of mistake."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import damian
from damian.common.errors import InputError
from damian.recipes import cli
from damian.recipes.command import PROGRAMS, main
from damian.recipes.known import CONF, groups, known_settings
from damian.recipes.words import parsed
from damian.settings import LEARNERS, TrainConfig
from damian.settings.fields import leaves, rules
from damian.settings.programs import SEARCHES


def refusal(capsys, *words: str) -> str:
    """The line with which the command refuses words."""
    with pytest.raises(SystemExit) as stop:
        main(words)
    printed = capsys.readouterr()
    assert stop.value.code == 2
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err.removeprefix("error: ").strip()


@pytest.mark.parametrize(
    "code",
    [
        "import damian.settings",
        "from damian.recipes.command import main; main(['--help'])",
        "from damian.recipes.command import main; main(['train', '--help'])",
        "from damian.recipes.command import main; main(['compare', '--help', 'experiment'])",
        "from damian.recipes.command import main; main(['train', 'agnts=3'])",
        "from damian.recipes.command import main; main(['train', 'agents=0'])",
    ],
)
def test_settings_help_and_wrong_words_need_no_torch(code):
    code = f"import sys\ntry:\n    {code}\nfinally:\n    assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "AssertionError" not in done.stderr
    assert done.returncode == (2 if "agnts" in code or "agents=0" in code else 0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "trian: no such program; the programs are train, evaluate"),
        (["train", "agnts=3"], "agnts: no such key; did you mean agents?"),
        (["train", "learner.lrr=1"], "learner.lrr: no such key; did you mean learner.lr?"),
        (["train", "+agents.x=1"], "agents"),
        (["train", "+motion.foo=1"], "motion.foo: no such key"),
        (["train", "lr=1"], "lr: no such key; did you mean learner.lr?"),
        (["train", "belief=true"], "belief: no such key; did you mean aware=belief?"),
        (["train", "num_envs=8"], "num_envs: no such key; did you mean worlds?"),
        (["train", "total_frames=8"], "total_frames: no such key; did you mean frames?"),
        (["train", "delay=3"], "delay: 3 is no option of this group; write delay.obs=3"),
        (["train", "delay=papers"], "delay: papers is not one of burst, distance, lag, paper, none"),
        (["train", "-m", "seed=0,x"], "seed: Value 'x'"),
        (["train", "seed=0,1"], "seed: several values need -m"),
        (["train", "--confg-dir=own"], "unrecognized arguments: --confg-dir=own"),
        (["train", "--experimental-rerun=x.pickle"], "unrecognized arguments: --experimental-rerun"),
        (["train", "--config-dir=nowhere"], "--config-dir: 'nowhere' is no folder"),
        (["train", "agents"], "'agents': this word is not of the form KEY=VALUE"),
        (["train", "delay.obs={law: uniform"], "delay.obs: '{law: uniform' cannot be read"),
        (["train", "agents=two"], "agents: Value 'two' of type 'str' could not be converted to Integer"),
        (["train", "model.hidden=8"], "model.hidden: Invalid value assigned"),
        (["train", "agents=0"], "agents: 0 is not between 1 and 1000"),
        (["train", "region.lattice_angle=100"], "region.lattice_angle: 100.0 deg is not between"),
        (["train", "clock.agents=1.5s"], "clock.agents: 1.5s is not a multiple of clock.simulation=1s"),
        (["train", "collector=threads"], "collector: threads is not one of sync, process, ray"),
        (["train", "region.pool=64"], "region.pool: no such key of the chosen region"),
        (["train", "links.delay=3"], "links.delay: no such key of the chosen links"),
        (["train", "learner.tau=0.1"], "learner.tau: no such key of the chosen learner"),
        (["train", "region=geojson"], "region.path: it is missing: region.kind=geojson needs it"),
        (["train", "observation.own=true", "links=updown"], "observation.own: True does not go with links"),
        (["train", "learner=nowhere:Config"], "learner: nowhere:Config: No module named 'nowhere'"),
        (["compare", "experiment=usecase2", "agents=3"], "agents: it is a setting of the runs"),
        (["compare", "experiment=usecase2", "arms=[nope]"], "arms: nope is not one of undelayed, unaware"),
        (["compare", "-m", "experiment=usecase2"], "-m: not with"),
        (["fly", "resume=x"], "resume: nothing is trained"),
        (["fly", "policy=sampled"], "policy: sampled needs checkpoint"),
        (["advise", "token=short"], "token: it is not a password"),
        (["tune", "score=success_rate", "scenario=delaybench/tracking"], "score: success_rate is the same"),
    ],
    ids=lambda part: part[-1] if isinstance(part, list) else "",
)
def test_a_mistake_is_answered_in_one_line(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert refusal(capsys, *words).startswith(message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["delay.obs={law: poisson}"], "delay.obs.law: poisson is not one of constant, uniform"),
        (["delay.obs={law: trace, path: nowhere.csv}"], "nowhere.csv: no such file"),
        (["checkpoint=nowhere"], "checkpoint: 'nowhere': there is no such folder"),
        (["resume=nowhere", "agents=4"], "agents=4: a resumed run keeps its configuration"),
        (["device=abacus"], "device: abacus is not one of the devices here"),
        (["region=fir", "region.path=no.csv", "region.id=X"], "no.csv: no such file"),
        (["learner=sac", "model=gru"], "model.rnn: gru is for learner=mappo only"),
    ],
)
def test_what_only_a_program_can_tell_is_one_line_too_and_leaves_no_folder(
    capsys, tmp_path, monkeypatch, words, message
):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(capsys, "train", *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# @package _global_\nagents: 2\n\tseed: 3\n", "mine.yaml"),
        ("# @package _global_\nmodel: {hidden: 8}\n", "model.hidden"),
        ("# @package _global_\nagnts: 8\n", "agnts: no such key; did you mean agents?"),
    ],
)
def test_a_mistake_in_your_own_file_is_one_line(capsys, tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own" / "scenario").mkdir(parents=True)
    (tmp_path / "own" / "scenario" / "mine.yaml").write_text(text)
    assert message in refusal(capsys, "train", "--config-dir=own", "scenario=mine")


def test_your_own_file_is_an_option(tmp_path):
    (tmp_path / "scenario").mkdir()
    (tmp_path / "scenario" / "mine.yaml").write_text("# @package _global_\nagents: 2\n")
    assert cli.settings("scenario=mine", own_folder=str(tmp_path)).agents == 2


@pytest.mark.parametrize("program", ["train", "tune", "fly", "advise"])
def test_every_program_takes_every_learner(program):
    for name, settings in LEARNERS.items():
        assert type(cli.settings(f"learner={name}", program=program).learner) is settings
    assert set(SEARCHES) == set(LEARNERS)


def test_a_training_has_few_settings_and_each_is_documented():
    found = cli.composed("train", [])

    def count(node) -> int:
        return sum(count(node[k]) if OmegaConf.is_dict(node[k]) else 1 for k in node if k != "hydra")

    assert count(found) <= 120
    assert len([*CONF.rglob("*.yaml")]) <= 50
    undocumented = [k for k, each in known_settings("train").items() if each.default and not each.text]
    assert [k for k in undocumented if k != "learner.name"] == []


def test_every_number_of_a_training_has_bounds_or_a_largest_value():
    with pytest.raises(InputError, match=r"reward\.bonus: 1e\+30 is not between"):
        cli.settings("reward.bonus=1e30")
    with pytest.raises(InputError, match=r"source\.speed: 1e\+300 m/s is not between"):
        cli.settings("source=dynamic", "source.speed=1e300")


def test_a_configuration_is_what_the_python_dataclasses_say():
    config = cli.settings()
    assert isinstance(config, TrainConfig)
    stored = dict(leaves(config))
    assert "region.vertices" not in stored, "only the kind vertices reads it"
    assert "overrides" not in stored, "a constant"
    assert rules(TrainConfig)["agents"].meaning == "Number of UAVs."


def test_what_a_scenario_says_of_the_learner_gives_way_to_the_command_line():
    tracking = "scenario=delaybench/tracking"
    assert cli.settings(tracking).learner.lr == 1e-3
    assert cli.settings(tracking, "learner.lr=3e-4").learner.lr == 3e-4
    assert cli.settings(tracking, "learner=sac").learner.target_entropy == 0.3
    assert cli.settings("scenario=delaybench/flights").learner.gamma == 0.95
    assert cli.settings("scenario=paper/usecase1_far").learner.lmbda == 0.9


def test_every_program_is_a_module_and_says_what_it_does(capsys):
    for name in PROGRAMS:
        assert import_module(f"damian.recipes.{name.replace('-', '_')}").run
    main([])
    printed = capsys.readouterr().out
    assert all(f"\n  {name} " in printed and what in printed for name, what in PROGRAMS.items())
    main(["--version"])
    assert capsys.readouterr().out.strip() == damian.__version__


def test_help_explains_a_program_a_section_and_a_setting(capsys):
    main(["train", "--help"])
    page = capsys.readouterr().out
    assert all(name in page for name in groups() if name != "experiment")
    main(["train", "--help", "delay", "learner.gamma"])
    printed = capsys.readouterr().out
    assert "delay.loss: float = 0.0\n    Probability that a message" in printed
    assert "learner.gamma: float = 0.95\n    Discount factor per step." in printed
    assert "paper: damian train delay=paper" in printed
    main(["train", "--cfg", "job", "agents=4"])
    assert "agents: 4" in capsys.readouterr().out


def test_folders_of_any_name_are_quoted_for_hydra(tmp_path):
    words = parsed(["checkpoint=runs/it's 1,2", "agents=2", "-m", "hydra.run.dir=null"]).overrides
    assert words == ["checkpoint='runs/it\\'s 1','2'", "agents=2", "hydra.run.dir='null'"]
    odd = tmp_path / "a, b=[c]"
    found = cli.composed("train", parsed([f"hydra.run.dir={odd}"]).overrides)
    assert Path(found.hydra.run.dir) == odd


def test_a_law_replaces_the_law_of_a_group():
    config = cli.settings("delay=paper", "delay.obs={law: uniform, low: 1, high: 2}")
    assert dict(config.delay.obs) == {"law": "uniform", "low": 1, "high": 2}
