"""The comparison recipe, run by its command line: its runs, and its refusals of wrong input."""

import csv
import re
import shlex
import shutil
from pathlib import Path

import pandas as pd
import pytest
from helpers import check_refused

from damian.compare.comparison import TRAINED, Method
from damian.compare.config import CompareConfig, Experiment, HeldOut
from damian.recipes.compare import includes, plan
from damian.recipes.shared.runs import POLICY
from damian.recipes.train import train
from damian.runs.checkpoint import digest
from damian.runs.run_record import read_record

ROOT = Path(__file__).parents[2]
SMALL = [
    "frames=16",
    "worlds=2",
    "learner.steps=4",
    "learner.epochs=1",
    "eval_episodes=3",
    "model.hidden=[4]",
    "episode.max_steps=8",
]


def listed(*words):
    """The setting ``overrides`` of the comparison: overrides for every run."""
    return f"overrides={list(words)}"


ONE = ["experiment=usecases", "tasks=[usecase2]"]
TWO = [*ONE, "seeds=2", "methods=[undelayed,naive]", listed(*SMALL)]


@pytest.fixture
def compare(run):
    """Run the program with words in an empty folder; returns the folder of the use cases."""
    return lambda *words: run(*words, program="compare", folder="") / "runs" / "usecases"


def table(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def measured(folder):
    """The results of a comparison without the times that they took."""
    return [{**row, "seconds": ""} for row in table(folder / "results.csv")]


def stamps(folder):
    """Time of the last change of every file in the folders of the runs."""
    return {
        str(path): path.stat().st_mtime_ns
        for path in sorted(folder.rglob("seed_*/*"))
        if path.is_file()
    }


def test_each_method_and_seed_is_run_once_and_an_interrupted_run_is_resumed(
    compare, capsys, tmp_path
):
    (tmp_path / "my files").mkdir()
    folder = compare("--config-dir", "my files", *TWO)
    printed = capsys.readouterr().out
    runs = [f"none/undelayed/seed_{n}" for n in (8, 9)] + [f"paper/naive/seed_{n}" for n in (8, 9)]
    found = sorted(
        path.parent.relative_to(folder / "usecase2") for path in folder.rglob("result.csv")
    )
    assert [str(path) for path in found] == runs
    assert "| random |" in (folder / "usecase2" / runs[0] / "log.txt").read_text()
    text = (folder / "table.md").read_text()
    assert text.strip() in printed
    for part in (
        "**developing**",
        "2 seeds (8 to 9), 3 episodes",
        "Trained for 16 environment steps",
    ):
        assert part in text
    typed = re.search(r"^- `damian compare (.*)`$", text, re.MULTILINE)[1]
    assert shlex.split(typed) == ["--config-dir", "my files", *TWO]
    rows = table(folder / "results.csv")
    assert len(rows) == 4 * 6
    naive = [
        r for r in rows if (r["method"], r["policy"], r["delay"]) == ("naive", TRAINED, "paper")
    ]
    assert [r["seed"] for r in naive] == ["8", "9"]
    stored = [table(folder / "usecase2" / name / "result.csv")[2]["return"] for name in runs[2:]]
    assert [float(r["return"]) for r in naive] == [float(number) for number in stored]

    before = stamps(folder)
    (folder / "usecase2" / runs[3] / "result.csv").unlink()  # as after Ctrl-C during the evaluation
    compare(*TWO[:3], "methods=[undelayed,naive,deployed]", TWO[4])
    after = stamps(folder)
    rewritten = {path for path in before if before[path] != after[path]}
    assert rewritten
    assert all(runs[3] in path for path in rewritten)
    assert {Path(path).parent.parent.name for path in after.keys() - before.keys()} == {"deployed"}
    resumed = [
        name for name in runs if "resumed" in (folder / "usecase2" / name / "run.json").read_text()
    ]
    assert resumed == runs[3:]

    capsys.readouterr()
    compare(*TWO[:2], "seeds=3", *TWO[3:], "report_only=true")
    text = (folder / "table.md").read_text()
    assert "missing: usecase2/none/undelayed/seed_10, usecase2/paper/naive/seed_10" in text
    compare(*TWO[:2], *TWO[3:], "report_only=true")
    assert not re.search("missing|seed_10| to 10", (folder / "table.md").read_text())
    assert stamps(folder) == after

    with pytest.raises(SystemExit) as stopped:
        compare(*TWO, "experiment.delays.paper=['delay=paper','delay.loss=0.5']")
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert f"{runs[2]}: delay.loss is 0.0 in this stored run, and 0.5 is asked for" in error
    assert error.count("\n") == 1
    assert stamps(folder) == after


LEARNING_FROM_OTHERS = """\
tasks: {tracking: [scenario=tracking]}
delays: {paper: [delay=paper]}
methods:
  undelayed: {delayed: false}
  naive: {naive: true}
  finetuned: {starts_from: undelayed}
  student: {teacher: undelayed, overrides: [learner=distillation:DistillationConfig]}
"""


@pytest.mark.slow
def test_a_method_starts_from_another_or_imitates_it_and_stored_rows_are_kept(compare, tmp_path):
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    (tmp_path / "conf" / "experiment" / "others.yaml").write_text(LEARNING_FROM_OTHERS)
    shutil.copy(ROOT / "examples" / "extending" / "distillation.py", tmp_path)
    small = listed(*(word for word in SMALL if "learner" not in word), "region.lattice_step=90")
    words = [
        "--config-dir",
        "conf",
        "experiment=others",
        "seeds=1",
        "experiment.first_seed=3",
        small,
    ]
    compare(*words)
    folder = tmp_path / "runs" / "others"
    place = folder / "tracking"
    policy = digest(place / "none" / "undelayed" / "seed_3" / "checkpoint.pt")
    assert read_record(place / "paper" / "finetuned" / "seed_3")[POLICY] == policy
    rows = measured(folder)
    regimes = {row["method"]: row["regime"] for row in rows}
    others = dict.fromkeys(("finetuned", "student"), "simulator")
    assert regimes == {"undelayed": "no delay", "naive": "late data", **others}

    shutil.rmtree(place)
    compare(*words, "keep=true")
    assert not place.exists()
    assert measured(folder) == rows

    stored = pd.read_csv(folder / "results.csv")
    stored[stored["method"] != "student"].to_csv(
        folder / "results.csv",
        index=False,
        na_rep="nan",
    )
    compare(*words, "keep=true")
    assert {path.parent.name for path in place.rglob("seed_3")} == {"undelayed", "student"}
    found = measured(folder)
    assert sorted(map(str, found)) == sorted(map(str, rows))


@pytest.mark.slow
def test_several_processes_give_the_same_results_as_one_and_a_failed_run_is_named(compare, capsys):
    words = [*TWO[:3], "methods=[undelayed,naive,deployed]", TWO[4]]
    folder = compare(*words)
    expected = measured(folder)
    compare(*words, "processes=2", "hydra.run.dir=runs/usecases/other")
    assert measured(folder / "other") == expected
    broken = folder / "other" / "usecase2" / "none" / "undelayed" / "seed_8"
    (broken / "result.csv").unlink()
    (broken / "checkpoint.pt").write_text("nonsense")
    with pytest.raises(SystemExit) as stopped:
        compare(*words, "processes=2", "hydra.run.dir=runs/usecases/other")
    assert stopped.value.code == 1
    assert "failed: usecase2/none/undelayed/seed_8; see " in capsys.readouterr().err
    assert (broken / "failed.json").exists()
    assert "missing: usecase2/none/undelayed/seed_8" in (folder / "other" / "table.md").read_text()


FITS_NOT = """\
tasks: {spotting: []}
delays: {late: [delay.obs=2]}
methods:
  undelayed: {delayed: false}
  both: {overrides: [aware=backupdate+history]}
  flown: {policy_of: both}
"""


@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        ("", [listed("framess=3")], "usecase2/none/undelayed: framess: unknown setting"),
        (
            "",
            ["methods=[deployed]"],
            "experiment.methods.deployed.policy_of: undelayed is not known",
        ),
        (
            "tasks: {spotting: []}",
            ["experiment=mine"],
            "experiment.methods: it is missing or empty",
        ),
        (FITS_NOT, ["experiment=mine"], "flown: observation.age: the policy was trained with True"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_folder(
    compare, capsys, tmp_path, text, words, message
):
    (tmp_path / "own" / "experiment").mkdir(parents=True)
    (tmp_path / "own" / "experiment" / "mine.yaml").write_text(text)
    words = words if text else [*TWO[:3], *words]
    check_refused(lambda: compare("--config-dir=own", *words), message, capsys)
    assert [*tmp_path.glob("runs/*")] == []


def test_runs_go_seed_by_seed_and_a_held_out_delay_replaces_the_one_of_the_training():
    methods = {
        "best": Method(delayed=False),
        "naive": Method(naive=True, tasks=["a"], delays=["late"]),
    }
    methods["flown"] = Method(policy_of="best", tasks=["b"], delays=["late"])
    tasks = {task: ["scenario=delaybench/tracking"] for task in ("a", "b")}
    held_out = {
        "six": HeldOut(["delay.obs=6"], ["a"]),
        "burst": HeldOut(["delay=burst"], ["a"]),
    }
    delays = {"late": ["delay.obs=2"], "later": ["delay.obs=4"]}
    experiment = Experiment(tasks, delays, methods, held_out, first_seed=3)
    config = CompareConfig(experiment, seeds=2)
    runs = plan(config, Path("runs"))
    trains = [run for run in runs if run.work is train]
    trained = [
        f"{name}/seed_{seed}"
        for seed in (3, 4)
        for name in ("a/none/best", "a/late/naive", "b/none/best")
    ]
    assert [run.name for run in trains] == trained
    flown = {run.folder.parts[1:-1:2]: run.config.delay.obs for run in runs if run not in trains}
    assert flown.keys() == {("b", "flown"), ("a@six", "naive"), ("a@burst", "naive")}
    assert (flown["a@six", "naive"], flown["a@burst", "naive"]["law"]) == (6, "burst")
    stored = pd.DataFrame(
        {"task": ["a@six", "a@seven"], "delay": "late", "method": "naive", "seed": 3}
    )
    assert includes(config, stored).tolist() == [
        True,
        False,
    ]  # of an experiment that had another one
