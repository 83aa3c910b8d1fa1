"""The command ``damian``: its programs, its help, and one line for each kind of mistake."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import damian
from damian.recipes import cli
from damian.recipes.command import PROGRAMS, main
from damian.recipes.known import CONF, groups, known_settings
from damian.recipes.shared.collectors import warn_of_memory


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
        "import damian.learners.config",
        "from damian.recipes.command import main; main(['train', '--help', 'delay'])",
        "from damian.recipes.command import main; main(['train', 'agents=0'])",
    ],
)
def test_settings_help_and_wrong_words_need_neither_torch_nor_pandas(code):
    code = f"import sys\ntry:\n    {code}\nfinally:\n    assert not {{'torch', 'pandas'}} & {{*sys.modules}}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "AssertionError" not in done.stderr
    assert done.returncode == (2 if "agents=0" in code else 0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "trian: no such program; the programs are train, evaluate"),
        (["train", "agnts=3"], "agnts: unknown setting; did you mean agents?"),
        (["train", "num_envs=8"], "num_envs: unknown setting; did you mean worlds?"),
        (["train", "delay=3"], "delay: 3 is not an option of this group; write delay.obs=3"),
        (
            ["train", "region.where=name:x", "region=usecase"],
            "region.where: unknown setting for region=usecase",
        ),
        (["train", "source.speed=3"], "source.speed: unknown setting for source=static; another source="),
        (["train", "-m", "delay=none,papr"], "delay: papr is not one of"),
        (["train", "delay=-1"], "Config group override must be a string"),
        (["train", "seed=0,1"], "Ambiguous value for argument 'seed=0,1' 1. To use it as a list"),
        (["train", "agents=two"], "agents: two is not a whole number"),
        (["train", "frames=1.5e0"], "frames: 1.5 is not a whole number"),
        (["train", "agents=0"], "agents: 0 is not between 1 and 1000"),
        (["train", "clock.agents=1.5s"], "clock.agents: 1.5s is not a multiple of clock.simulation=1s"),
        (["train", "region=geojson"], "region.path: it is missing: region.kind=geojson needs it"),
        (["compare", "experiment=usecases", "agents=3"], "agents: it is a setting of the runs"),
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
        (["delay.obs={law: trace, path: nowhere.csv}"], "nowhere.csv: no such file"),
        (["checkpoint=nowhere"], "checkpoint: nowhere holds no config.yaml"),
        (["resume=nowhere", "agents=4"], "agents=4: a resumed run keeps its configuration"),
    ],
)
def test_what_only_a_program_can_tell_is_one_line_too_and_leaves_no_folder(
    capsys, tmp_path, monkeypatch, words, message
):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(capsys, "train", *words)
    assert list(tmp_path.iterdir()) == []


def test_whole_numbers_and_times_may_be_written_as_people_write_them(tmp_path, monkeypatch):
    """On the command line, in a file, in a variable of a cluster, and in Python."""
    monkeypatch.setenv("TASK", "7")
    words = (
        "frames=1e6",
        "seed=${oc.env:TASK}",
        "model.hidden=[1e2,64]",
        "delay.obs=133ms",
        "clock.simulation=50ms",
    )
    file = tmp_path / "scenario" / "mine.yaml"
    file.parent.mkdir()
    file.write_text("# @package _global_\nworlds: 2e1\nepisode: {max_steps: 3.0e+1}\n", encoding="utf-8")
    config = cli.settings("scenario=mine", *words, own_folder=str(tmp_path))
    found = [config.frames, config.seed, *config.model.hidden, config.worlds, config.episode.max_steps]
    assert found == [1_000_000, 7, 100, 64, 20, 30]
    assert {type(number) for number in found} == {int}
    assert config.delays.obs.longest == 3
    assert damian.ClockConfig(simulation="50ms").steps("agents") == 1


def test_a_refused_run_removes_only_the_folders_that_it_has_made(capsys, tmp_path):
    (tmp_path / "mine").mkdir()
    words = ("settle=true", f"hydra.run.dir={tmp_path}/mine/new/run")
    assert "settle: True means nothing" in refusal(capsys, "train", *words)
    assert list((tmp_path / "mine").iterdir()) == []


def test_a_refused_job_of_a_sweep_leaves_no_folder(capsys, tmp_path):
    words = ("-m", "settle=true", "seed=0,1", f"hydra.sweep.dir={tmp_path}")
    assert "settle: True means nothing" in refusal(capsys, "train", *words)
    assert list(tmp_path.iterdir()) == []


def test_your_own_file_is_an_option_and_a_mistake_in_it_is_one_line(capsys, tmp_path):
    file = tmp_path / "my own" / "scenario" / "mine.yaml"
    file.parent.mkdir(parents=True)
    words = "train", f"--config-dir={tmp_path / 'my own'}", "scenario=mine"
    for text, message in (
        ("agents: 2\n\tseed: 3\n", "mine.yaml"),
        ("model: {hidden: 8}\n", "model.hidden"),
        ("agnts: 8\n", "agnts: unknown setting; did you mean agents?"),
    ):
        file.write_text(f"# @package _global_\n{text}")
        assert message in refusal(capsys, *words)
    file.write_text("# @package _global_\nagents: 2\n")
    assert cli.settings("scenario=mine", own_folder=str(tmp_path / "my own")).agents == 2


def test_a_training_has_few_settings_and_each_is_documented():
    found = cli.composed("train", [])

    def count(node) -> int:
        return sum(count(node[k]) if OmegaConf.is_dict(node[k]) else 1 for k in node if k != "hydra")

    assert count(found) <= 121
    assert len([*CONF.rglob("*.yaml")]) <= 50
    undocumented = [k for k, each in known_settings("train").items() if each.default and not each.text]
    assert [k for k in undocumented if k != "learner.name"] == []


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
    assert "    paper: " in printed
    main(["train", "--cfg", "job", "agents=4"])
    assert "agents: 4" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "-m", "seed=a,b"], "seed: a is not a whole number"),
        (["train", "-m", "seed=0,b"], "seed: b is not a whole number"),
        (["train", "-m", "agents=3,0", "delay=none,paper"], "agents: 0 is not between 1 and 1000"),
        (["train", "-m", "delay.obs={law: trace, path: no.csv}", "seed=0,1"], "no.csv: no such file"),
        (["train", "logger=wandb"], "logger: wandb is not installed; pip install wandb"),
    ],
)
def test_what_is_refused_leaves_no_folder(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert message in refusal(capsys, *words)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    with pytest.raises(SystemExit):
        main(["train", "-m", "seed=0,1", "hydra.sweep.dir=file/sweep"])
    assert capsys.readouterr().err == f"error: {tmp_path}/file/sweep: Not a directory\n"
    Path("run").mkdir()
    Path("run/result.csv").write_text(
        "policy,return,success_rate,steps,perceived_return,age\nx,1,0,1,1,0\n", encoding="utf-8"
    )
    Path("results.csv.part").mkdir()
    with pytest.raises(SystemExit):
        main(["results", "."])
    assert capsys.readouterr().err.startswith("error: results.csv: it cannot be written: Is a directory")


def test_a_training_that_is_larger_than_the_machine_says_so(capsys):
    warn_of_memory(cli.settings("worlds=1000000", "agents=50"))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("worlds: the steps of 1000000 worlds of 50 UAVs take at least ")
    warn_of_memory(cli.settings("worlds=64"))
    assert not capsys.readouterr().err
