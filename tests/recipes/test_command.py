"""The command ``damian``: its programs, its help, and its quick answers to misspelt settings."""

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from hydra import initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

import damian
from damian.common.errors import InputError
from damian.learners.base import LEARNERS
from damian.recipes.command import PROGRAMS, main
from damian.recipes.compare import CompareConfig
from damian.recipes.shared.command_line import prepared
from damian.recipes.shared.known_settings import CONF, groups, known_settings
from damian.recipes.shared.launch import checked, composed_with
from damian.recipes.shared.misspelt import check_words
from damian.recipes.shared.settings import TrainConfig


def keys_of(config: DictConfig, path: str = "") -> set[str]:
    """Every dotted key of a configuration."""
    keys = set()
    for name in config:
        keys.add(f"{path}{name}")
        node = config._get_node(name)
        if isinstance(node, DictConfig) and not node._is_missing():
            keys |= keys_of(config[name], f"{path}{name}.")
    return keys


def refusal(capsys, *words: str) -> str:
    """The line with which the command refuses words."""
    with pytest.raises(SystemExit) as stop:
        main(words)
    printed = capsys.readouterr()
    assert stop.value.code == 2
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err.strip()


@pytest.mark.parametrize("program", ["train", "tune", "fly", "advise"])
def test_every_program_takes_every_learner(program):
    import_module(f"damian.recipes.{program}")  # stores its settings
    with initialize_config_dir(CONF, version_base=None):
        for name, settings in LEARNERS.items():
            config = checked(composed_with(program, [f"learner={name}"]), program)
            assert type(config.learner) is settings


def test_the_settings_read_from_the_source_are_those_of_the_dataclasses():
    configs = [
        OmegaConf.structured(TrainConfig),
        *(OmegaConf.create({"learner": make()}) for _, make in LEARNERS.items()),
    ]
    assert set(known_settings("train")) == set().union(*map(keys_of, configs))
    assert set(known_settings("compare")) > set(OmegaConf.structured(CompareConfig))
    assert known_settings("train")["agents"].default == "3"
    assert (
        known_settings("train")["learner.lr"].default
        == "0.001 (bpql, sac) or 0.0003 (mappo, predictive_mappo)"
    )
    assert all(setting.text for key, setting in known_settings("train").items() if setting.default), (
        "undocumented"
    )


def test_every_program_is_a_module_of_the_recipes_and_says_what_it_does(capsys):
    folder = Path(sys.modules["damian.recipes.command"].__file__).parent
    assert {*PROGRAMS} == {path.stem for path in folder.glob("*.py")} - {"__init__", "command"}
    main([])
    printed = capsys.readouterr().out
    assert all(f"\n  {name} " in printed and what in printed for name, what in PROGRAMS.items())
    main(["--version"])
    assert capsys.readouterr().out.strip() == damian.__version__


def test_help_explains_a_program_a_section_and_a_setting(capsys):
    main(["train", "--help"])
    page = capsys.readouterr().out
    assert all(name in page for name in groups() if name not in ("experiment", "search", "tuning"))
    assert len(page.splitlines()) < 45
    main(["evaluate", "-h"])
    assert "damian evaluate checkpoint=" in capsys.readouterr().out
    main(["train", "--help", "delay", "learner.gamma"])
    printed = capsys.readouterr().out
    assert "delay.loss: float = 0.0\n    Probability that a message" in printed
    assert "learner.gamma: float = 0.95\n    Discount factor per step." in printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "trian: no such program; the programs are train, evaluate"),
        (["train", "agnts=3"], "agnts: no such key; did you mean agents?"),
        (["train", "agents=2", "learner.lrr=1"], "learner.lrr: no such key; did you mean learner.lr?"),
        (["train", "delay=papers"], "delay: papers is not one of burst, distance, lag, none, paper"),
        (
            ["train", "-m", "delay=none,papers"],
            "delay: papers is not one of burst, distance, lag, none, paper",
        ),
        (["evaluate", "delay.obs.hgih=3s"], None),
        (["compare", "experimnt=usecase1"], "experimnt: no such key; did you mean experiment?"),
        (
            ["compare", "agents=3"],
            "agents: it is a setting of the runs; all of them get it by \"overrides=['agents=3']\"",
        ),
        (["compare", "delay=paper"], "delay: it is a setting of the runs; all of them"),
        (["train", "experiment=usecase1"], "experiment: no such key"),
        (["train", "learner.sdev=1"], "learner.sdev: no such key"),
        (["train", "--confg-dir=own"], "unrecognized arguments: --confg-dir=own"),
        (["train", "task=spotting"], "task: no such key; since damian 0.2 it is reward"),
    ],
)
def test_a_misspelt_word_is_answered_in_one_line(capsys, monkeypatch, words, message):
    if message is None:  # a quick look cannot tell: the program itself answers
        monkeypatch.setattr(f"damian.recipes.{words[0]}.run", lambda: print("runs"))
        main(words)
        assert capsys.readouterr().out == "runs\n"
    else:
        assert refusal(capsys, *words).startswith(f"error: {message}")


def test_an_option_of_ones_own_is_found_where_its_folder_was_not_named(capsys, monkeypatch, tmp_path):
    (tmp_path / "own" / "delay").mkdir(parents=True)
    (tmp_path / "own" / "delay" / "mine.yaml").write_text("delay: {obs: 3}")
    monkeypatch.chdir(tmp_path)
    hint = "; for own/delay/mine.yaml add --config-dir=own"
    assert refusal(capsys, "train", "delay=mine").endswith(hint)
    assert "add" not in refusal(capsys, "train", "delay=others")


def test_a_misspelt_word_is_answered_without_loading_torch():
    code = "import sys; from damian.recipes.command import main\n"
    code += "try: main(['train', 'agnts=3'])\nfinally: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "False"
    assert done.returncode == 2


@pytest.mark.parametrize("word", ["hydra.run.dir={}", "hydra.run.dir='{}/deeper'", "hydra.sweep.dir={}"])
def test_a_file_is_no_run_folder(tmp_path, word):
    (tmp_path / "a b").write_text("")
    key = word.partition("=")[0]
    with pytest.raises(InputError, match=rf"{key}: .*a b'? is a file: name a folder"):
        prepared([word.format(tmp_path / "a b")])


def test_words_are_prepared_for_hydra():
    words = ["agents=2", "-m", "-cd", "conf", "seed=0,1", "--cfg", "job"]
    options = {"--multirun", "--config-dir=conf", "--cfg=job"}
    assert {*prepared(words)[:3]} == options
    assert prepared(words)[3:] == ["agents=2", "seed=0,1"]
    law = "delay.obs={law: uniform}"
    assert prepared(["delay=paper", law]) == ["delay=paper", "delay.obs=0", law]


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (["agents=3", "--info"], ["--info=all"]),
        (["--info", "defaults", "agents=3"], ["--info=defaults"]),
        (["agents=3", "--config-d", "own"], ["--config-dir=own"]),
        (["-cd=own", "agents=3"], ["--config-dir=own"]),
        (["agents=3", "--experimental-re", "job.pickle"], ["--experimental-rerun=job.pickle"]),
        (["-m", "agents=3", "--resolve"], ["--resolve", "--multirun"]),
    ],
)
def test_options_keep_their_values_wherever_they_stand(words, options):
    assert prepared(words) == [*options, "agents=3"]


def value_for_hydra(word: str) -> object:
    return OverridesParser.create().parse_override(word).value()


@pytest.mark.parametrize(
    "name",
    ["täst", "a(b)", "x[1]", "p#q", "it's=1", 'say "so"', "a,b", "seed=1,a=2", "1e3", "null", "b\\", "b c"],
)
@pytest.mark.parametrize("key", ["checkpoint", "resume", "+checkpoint", "++resume"])
def test_a_folder_may_have_any_name(tmp_path, monkeypatch, name, key):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    (tmp_path / "plain").mkdir()
    (word,) = prepared([f"{key}={name}"])
    assert value_for_hydra(word) == name
    assert prepared([f"{key}=plain"]) == [f"{key}=plain"]
    if "," not in name:
        (word,) = prepared([f"{key}=plain,{name}"])
        assert [getattr(each, "text", each) for each in value_for_hydra(word).list] == ["plain", name]
    if name in ("täst", "a(b)", "x[1]", "p#q", "it's=1"):
        (word,) = prepared([f"hydra.run.dir=new/{name}"])
        assert value_for_hydra(word) == f"new/{name}"


def test_words_that_name_no_folder_and_resolvers_stay_as_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for word in (
        "checkpoint=a,b",
        "checkpoint=a(b)",
        "hydra.run.dir=runs/${now:%H}",
        "agents=a(b)",
        "checkpoint=",
    ):
        assert prepared([word]) == [word]


@pytest.mark.parametrize(
    "word",
    [
        "checkpoint=a=1",
        "checkpoint='a=1'",
        '+checkpoint="a=1"',
        "++checkpoint='a=1'",
        "checkpoint=a=1,b",
        "checkpoint='a=1','c'",
    ],
)
def test_a_policys_configuration_files_are_found_however_it_is_given(tmp_path, monkeypatch, word):
    monkeypatch.chdir(tmp_path)
    for name, used in (("a=1", "own"), ("b", None), ("c", "own"), ("other", "others")):
        (tmp_path / name).mkdir()
        own = used and str(tmp_path / used)
        (tmp_path / name / "run.json").write_text(json.dumps({"damian": "0", "config_dir": own}))
    (tmp_path / "own").mkdir()
    (tmp_path / "others").mkdir()
    assert prepared([word])[0] == f"--config-dir={tmp_path / 'own'}"
    assert prepared([word, "--config-dir=mine"])[0] == "--config-dir=mine"
    assert prepared(["checkpoint=b"]) == ["checkpoint=b"]
    with pytest.raises(InputError, match=r"others and .*own: evaluate them one after the other"):
        prepared(["-m", "checkpoint=c,other"])


def test_a_policy_brings_its_options_to_the_quick_look(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own" / "scenario").mkdir(parents=True)
    (tmp_path / "own" / "scenario" / "windy.yaml").write_text("# @package _global_")
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "run.json").write_text(
        json.dumps({"damian": "0", "config_dir": str(tmp_path / "own")})
    )
    assert check_words("train", ["scenario=windy"]) is not None
    assert check_words("train", prepared(["scenario=windy", "checkpoint=first"])) is None


@pytest.mark.parametrize(
    "words",
    [
        ["hydra.searchpath=[file://own]", "scenario=windy", "learner.mine=1"],
        ["++hydra.searchpath=[file://own]", "scenario=windy"],
        ["+hydra.searchpath=[file://own]", "scenario=windy"],
        ["--config-d=own", "scenario=windy", "learner.mine=1"],
        ["--config-dir", "own", "scenario=windy"],
        ["--config-path=own", "wind=3"],
        ["--config-name=mine", "wind=3"],
        ["observation.local_features.0=spotted"],
        ["model.hidden.0=8"],
        ["sensors.0=geiger:counts"],
        ["learner=package.module:Name", "learner.mine=1"],
        ["checkpoint=runs/first", "learner.mine=1"],
        ["--info", "agents=3"][1:],
        ["~tuning@learner", "tuning@learner=none", "hydra/launcher=basic", "+learner.x=1"],
        ["scenario='paper/usecase1'", "delay=null", "-m", "seed=range(3)", "delay=none,paper"],
        ["delay.obs.high=3s", "reward.custom=[a:b]", "logger.custom=[{logger: a:b}]"],
    ],
)
def test_a_valid_command_is_never_refused(words):
    assert check_words("train", words) is None


def test_every_option_of_a_group_says_what_it_is(capsys):
    for group in {*groups()} - {"experiment", "search", "tuning"}:
        main(["train", "--help", group])
        printed = capsys.readouterr().out
        assert all(f"\n    {option}: " in printed for option in groups()[group]), group


def test_help_for_a_reader_that_stops_early_ends_quietly():
    code = "from damian.recipes.command import main; main(['train', '--help', 'learner'])"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("chosen", [None, "7"])
def test_threads_that_wait_sleep_soon_unless_the_user_chooses(chosen, monkeypatch, capsys):
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    if chosen:
        monkeypatch.setenv("GOMP_SPINCOUNT", chosen)
    main(["--version"])
    assert os.environ["GOMP_SPINCOUNT"] == (chosen or "1000")


def test_help_may_stand_anywhere_and_explains_groups_and_experiments(capsys):
    def printed(*words: str) -> str:
        main(words)
        return capsys.readouterr().out

    page = printed("train", "--help")
    assert printed("train", "agents=3", "--help") == page
    assert printed("train", "--help", "--config-dir", "own", "-m") == page
    scenarios = printed("train", "--help", "scenario")
    assert scenarios.startswith("choose one with scenario=OPTION: coverage, ")
    assert "[spotting]" in scenarios
    assert "delaybench/tracking" in scenarios
    assert "/_" not in scenarios
    assert "\n    spotting: A static source at an unknown place;" in scenarios
    assert "\n    paper: the paper's section 5: 15 % of the messages" in printed("train", "--help", "delay")
    learner = printed("train", "--help", "learner")
    assert "choose one with learner=OPTION: bpql, [mappo], predictive_mappo, sac\n" in learner
    assert (
        "= 'bpql' (bpql) or 'mappo' (mappo) or 'predictive_mappo' (predictive_mappo) or 'sac' (sac)\n"
        in learner
    )
    assert "learner.gamma: float = 0.95\n" in learner
    experiment = printed("compare", "--help", "experiment")
    assert "choose one with experiment=OPTION: delaybench, " in experiment
    assert "experiment.arms.NAME.policy_of: str | None = None\n    Arm whose policies" in experiment
    assert "did you mean agents?" in printed("train", "--help", "agnts")
