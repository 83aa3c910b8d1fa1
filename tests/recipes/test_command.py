"""The command ``damian``: its programs, its help, and its quick answers to misspelt settings."""

import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

import damian
from damian.learners.base import LEARNERS
from damian.recipes.command import PROGRAMS, main
from damian.recipes.compare import CompareConfig
from damian.recipes.shared.command_line import prepared
from damian.recipes.shared.known_settings import groups, known_settings
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


def test_the_settings_read_from_the_source_are_those_of_the_dataclasses():
    configs = [
        OmegaConf.structured(TrainConfig),
        *(OmegaConf.create({"learner": make()}) for _, make in LEARNERS.items()),
    ]
    assert set(known_settings("train")) == set().union(*map(keys_of, configs))
    assert set(known_settings("compare")) > set(OmegaConf.structured(CompareConfig))
    assert known_settings("train")["agents"].default == "3"
    assert known_settings("train")["learner.lr"].default == "0.0003 or 0.001"
    assert all(setting.text for key, setting in known_settings("train").items() if setting.default), (
        "undocumented"
    )


def test_every_program_is_a_module_of_the_recipes_and_says_what_it_does(capsys):
    folder = Path(sys.modules["damian.recipes.command"].__file__).parent
    helpers = {"__init__", "command", "bench_training"}
    assert set(PROGRAMS) == {path.stem for path in folder.glob("*.py")} - helpers
    main([])
    printed = capsys.readouterr().out
    assert all(f"\n  {name} " in printed and what in printed for name, what in PROGRAMS.items())
    main(["--version"])
    assert capsys.readouterr().out.strip() == damian.__version__


def test_help_explains_a_program_a_section_and_a_setting(capsys):
    main(["train", "--help"])
    page = capsys.readouterr().out
    assert all(name in page for name in groups() if name not in ("experiment", "tuning"))
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
        (["train", "delay=papers"], "delay: papers is not one of burst, none, paper"),
        (["train", "-m", "delay=none,papers"], "delay: papers is not one of burst, none, paper"),
        (["evaluate", "delay.obs.hgih=3s"], None),
        (["compare", "experimnt=usecase1"], "experimnt: no such key; did you mean experiment?"),
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


def test_a_misspelt_word_is_answered_without_loading_torch():
    code = "import sys; from damian.recipes.command import main\n"
    code += "try: main(['train', 'agnts=3'])\nfinally: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "False"
    assert done.returncode == 2


def test_words_are_prepared_for_hydra(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "seed=1,agents=2").mkdir()
    words = ["agents=2", "-m", "checkpoint=seed=1,agents=2", "-cd", "conf", "seed=0,1", "--cfg", "job"]
    options = ["-m", "-cd", "conf", "--cfg", "job"]
    assert prepared(words) == [*options, "agents=2", "checkpoint='seed=1,agents=2'", "seed=0,1"]
    assert prepared(["checkpoint=a,b"]) == ["checkpoint=a,b"]  # a sweep over two policies
    law = "delay.obs={law: uniform}"
    assert prepared(["delay=paper", law]) == ["delay=paper", "delay.obs=0", law]
