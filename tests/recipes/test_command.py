"""The command ``damian``: its programs, its help, and one line for each kind of mistake."""

import runpy
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from itertools import zip_longest
from pathlib import Path

import pytest
import yaml

import damian
from damian.common.errors import InputError
from damian.delays.laws import sampler_of
from damian.learners.config import LEARNERS, MappoConfig
from damian.recipes import cli
from damian.recipes.cli import settings
from damian.recipes.command import PROGRAMS, main
from damian.recipes.known import CONF, check_words, groups, known_settings
from damian.recipes.shared.settings import check_learning


@pytest.mark.parametrize(
    "code",
    [
        "import damian.learners.config",
        "from damian.recipes.command import main; main(['train', '--help', 'delay'])",
        "from damian.recipes.command import main; main(['train', 'agnts=3'])",
    ],
)
def test_settings_help_and_misspelt_words_need_neither_torch_nor_pandas(code):
    code = (
        f"import sys\ntry:\n    {code}\nfinally:\n    assert not {{'torch', 'pandas'}} & "
        f"{{*sys.modules}}"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "AssertionError" not in done.stderr
    assert done.returncode == (2 if "agnts=3" in code else 0)


FILES = "is not one of damian:fir.csv, damian:queue_trace.csv"
POLICIES = "is not one of damian:convoy, damian:crowded, damian:flights, damian:tracking"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "trian: no such program; the programs are train, evaluate"),
        (["train", "agents"], "agents: this word is not of the form KEY=VALUE"),
        (["train", "+delay.obz=1"], "delay.obz: unknown setting; did you mean delay.obs?"),
        (["train", "num_envs=8"], "num_envs: unknown setting; did you mean worlds?"),
        (["train", "delay=3"], "delay: 3 is not an option of this group; write delay.obs=3"),
        (["train", "-m", "delay=none,papr"], "delay: papr is not one of"),
        (["train", "source.speed=3"], "source.speed: 3.0 means nothing with source=static"),
        (["train", "seed=0,1"], "Ambiguous value for argument 'seed=0,1' 1. To use it as a list"),
        (["train", "agents=two"], "agents: two is not a whole number"),
        (["train", "region=geojson"], "region.path: it is missing: region.kind=geojson needs it"),
        (
            ["train", "delay.obs={law: trace, path: damian:x.csv}"],
            f"delay.obs.path: damian:x.csv {FILES}",
        ),
        (
            ["train", "checkpoint=nowhere"],
            f"checkpoint: nowhere holds no config.yaml: damian:nowhere {POLICIES}",
        ),
        (["fly", "policy=deterministic"], "policy: deterministic needs checkpoint"),
        (["fly", "checkpoint=damian:covered"], f"checkpoint: damian:covered {POLICIES}"),
        (["fly", "agents=3", "shown=[0,3]"], "shown: ['0', '3'] is not a list of UAVs from 0 to 2"),
        (
            ["train", "resume=nowhere", "agents=4"],
            "agents=4: a resumed run keeps its configuration",
        ),
        (["compare", "experiment=usecases", "agents=3"], "agents: it is a setting of the runs"),
        (
            ["compare", "-m", "experiment=usecases"],
            "-m: not with damian compare, which has many runs anyway",
        ),
        (["results"], "folders: it is not one folder, or two to compare"),
    ],
    ids=lambda part: part[-1] if isinstance(part, list) else "",
)
def test_a_mistake_is_one_line_and_leaves_no_folder(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(words)
    printed = capsys.readouterr()
    assert (stop.value.code, printed.out) == (2, "")
    assert printed.err.count("\n") == 1
    assert printed.err.startswith(f"error: {message}")
    assert (tmp_path.exists(), [*tmp_path.glob("*/*")]) == (True, [])


def test_whole_numbers_and_times_may_be_written_as_people_write_them(tmp_path, monkeypatch):
    """On the command line, in a file, in a variable of a cluster, and in Python."""
    monkeypatch.setenv("TASK", "7")
    words = ["frames=1e6", "seed=${oc.env:TASK}", "model.hidden=[1e2,64]", "delay.obs=133ms"]
    config = cli.settings(*words, "clock.simulation=50ms", "worlds=2e1", "episode.max_steps=3.0e+1")
    found = [
        config.frames,
        config.seed,
        *config.model.hidden,
        config.worlds,
        config.episode.max_steps,
    ]
    assert found == [1_000_000, 7, 100, 64, 20, 30]
    assert {type(number) for number in found} == {int}
    assert config.make_delays().obs.longest == 3
    assert damian.ClockConfig(simulation="50ms").steps("agents") == 1


UNIFORM = "{law: uniform, low: 1, high: 7}"


RISEN = {"law": "uniform", "low": "3s", "high": "9s", "probability": 0.15}


@pytest.mark.parametrize(
    ("words", "law"),
    [
        (["delay=paper", f"+delay.obs={UNIFORM}"], yaml.safe_load(UNIFORM)),
        (["links=updown", "delay.obs={law: geometric}", "delay.obs=1..7"], "1..7"),
        (
            ["delay=paper", f"delay.obs={UNIFORM}", "delay.obs.high=9"],
            yaml.safe_load(UNIFORM) | {"high": 9},
        ),
        (["delay=paper", "delay.obs.high=9s"], RISEN),
    ],
)
def test_a_law_replaces_the_one_before_it_whole_and_its_fields_change_it(words, law):
    assert cli.settings(*words).delay.obs == law


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """The file of a scenario of one's own, ``--config-dir=own scenario=mine`` in the current
    folder."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "own" / "scenario" / "mine.yaml"
    file.parent.mkdir(parents=True)
    return file


OWN = ["train", "--config-dir", "own", "scenario=mine"]


def test_a_law_of_a_scenario_is_not_mixed_with_that_of_a_delay(capsys, mine):
    law = f"delay: {{obs: {UNIFORM}}}"
    mine.write_text(f"# @package _global_\nepisode: {{max_steps: 9}}\n{law}\n")
    mixed = "mixes laws of several files; write the one that you mean as a whole"
    accepted = "model.hidden: 8 is not a list"
    for more, message in (
        ([], accepted),
        (["delay=paper"], mixed),
        (["delay=paper", f"delay.obs={UNIFORM}"], accepted),
    ):
        with pytest.raises(SystemExit):
            main([*OWN, "model.hidden=8", *more])
        assert message in capsys.readouterr().err


def test_a_range_is_uniform_over_whole_steps():
    by_steps, by_time = (sampler_of(law, dt=1.0).chances[0].tolist() for law in ("1..3", "2s..4s"))
    assert by_steps == pytest.approx([0, 1 / 3, 1 / 3, 1 / 3, 0])
    assert by_time == pytest.approx([0, 0, 1 / 3, 1 / 3, 1 / 3, 0])


def test_your_own_file_is_an_option_and_a_mistake_in_it_is_one_line(capsys, mine):
    for text, message in (
        ("agents: 2\n\tseed: 3\n", "mine.yaml"),
        ("model: 8\n", "error: model: 8 is not a section; write model=OPTION, or model.KEY=VALUE"),
        ("agnts: 8\n", "error: agnts: unknown setting; did you mean agents?"),
    ):
        mine.write_text(f"# @package _global_\n{text}")
        with pytest.raises(SystemExit):
            main(OWN)
        assert message in capsys.readouterr().err
    mine.write_text("# @package _global_\nagents: 2e0\n")
    main([*OWN, "--cfg", "job"])
    assert "agents: 2.0" in capsys.readouterr().out


def test_every_option_is_a_file_that_begins_with_its_launch_line():
    for group, options in groups().items():
        for option in options:
            lines = (CONF / group / f"{option}.yaml").read_text("utf-8").splitlines()
            (first, *_) = [line for line in lines if not line.startswith("# @package")]
            assert first.startswith("# damian "), (group, option)


TOGETHER = {group: options for group, options in groups().items() if group != "experiment"}


@pytest.mark.sample(3)
@pytest.mark.parametrize("options", [*zip_longest(*TOGETHER.values())])
def test_options_one_of_each_group_at_a_time_compose(options):
    pairs = zip(TOGETHER, options, strict=True)
    cli.composed(*[f"{group}={option}" for group, option in pairs if option])


def test_what_a_scenario_says_of_the_learner_gives_way_to_the_command_line():
    tracking = "scenario=delaybench/tracking"
    assert cli.settings(tracking).learner.lr == 1e-3
    assert cli.settings(tracking, "learner.lr=3e-4").learner.lr == 3e-4
    assert cli.settings(tracking, "learner=sac").learner.target_entropy == 0.3
    assert cli.settings("scenario=delaybench/flights").learner.gamma == 0.95
    assert cli.settings("scenario=paper/usecase1_far").learner.lmbda == 0.9


def test_every_program_is_a_module_and_says_what_it_does(capsys):
    for name in PROGRAMS:
        assert import_module(f"damian.recipes.{name}").main
    main([])
    printed = capsys.readouterr().out
    assert all(f"\n  {name} " in printed and what in printed for name, what in PROGRAMS.items())
    main(["--version"])
    assert capsys.readouterr().out.strip() == damian.__version__


def test_help_explains_a_program_a_section_and_a_setting(capsys):
    assert [
        key for key, each in known_settings("train").items() if not (each.is_section or each.text)
    ] == []
    main(["train", "--help"])
    page = capsys.readouterr().out
    assert all(name in page for name in {*groups()} - {"experiment"})
    main(["train", "--help", "delay", "learner.gamma"])
    printed = capsys.readouterr().out
    assert "delay.loss: float = 0.0\n    Probability that a message" in printed
    assert "learner.gamma: float = 0.95\n    Discount factor per step." in printed
    assert "    paper: " in printed
    main(["train", "--cfg", "job", "agents=4"])
    assert "agents: 4" in capsys.readouterr().out


def test_a_program_is_a_script_too(tmp_path, monkeypatch, capsys):
    script = CONF.parent / "recipes" / "train.py"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), "agents=1", "--cfg", "job"])
    monkeypatch.syspath_prepend(script.parent)  # as Python does
    runpy.run_path(str(script), run_name="__main__")
    assert "agents: 1" in capsys.readouterr().out


def test_a_folder_that_cannot_be_written_is_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    with pytest.raises(SystemExit):
        main(["train", "-m", "seed=0,1", "hydra.sweep.dir=file/sweep"])
    assert capsys.readouterr().err == "error: file/sweep: Not a directory\n"


def test_a_belief_by_which_nothing_is_won_is_left_out_and_said():
    with pytest.warns(
        UserWarning, match="observation.belief and model.prior: left out, because nothing"
    ):
        config = settings("scenario=patrol", "aware=belief")
    assert (config.observation.belief, config.model.prior) == ([], False)


@pytest.mark.parametrize("path", ["park.kml", "maps/park.geojson", "/maps/park.gpkg"])
def test_a_region_may_be_a_map(path):
    check_words("train", [f"region={path}"])
    region = settings("scenario=patrol", f"region={path}").region
    assert (region.kind, region.path) == ("geojson", path)


def test_a_learner_is_judged_by_what_it_reads_not_by_the_shape_of_its_name():
    read = {"reads": ("timeline",), "__doc__": "A learner of a plug-in.", "__module__": "lab"}
    lab = LEARNERS.register("lab")(dataclass(type("Lab", (MappoConfig,), read)))
    try:
        assert (
            type(settings("learner=mappo", "learner.name=lab", "delay.messages=2").learner) is lab
        )
        check_learning(settings("learner=mappo", "learner.name=lab", "delay.messages=2"))
    finally:
        del LEARNERS._components["lab"]
    with pytest.raises(InputError, match=r"delay.messages: 2 is not read by learner=mappo"):
        check_learning(settings("delay.messages=2"))
