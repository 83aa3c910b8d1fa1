"""``damian.load`` reads trained policies, ``damian.results`` the results of runs, sweeps and comparisons."""

import csv
import os
import subprocess
import sys
from pathlib import Path
from statistics import fmean

import pytest
from test_evaluate import TRAINED

import damian
from damian import keys
from damian.common.errors import InputError
from damian.recipes.command import main

SWEEP = [*(word for word in TRAINED if word.partition("=")[0] not in ("seed", "delay.obs")), "worlds=2"]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory) -> Path:
    """The folder of a sweep over two delays and three seeds."""
    folder = tmp_path_factory.mktemp("sweep")
    main(["train", "-m", *SWEEP, "delay.obs=1,2", "seed=0,1,2", f"hydra.sweep.dir={folder}"])
    return folder


@pytest.fixture(scope="module", params=["mlp", "gru"])
def trained(request, tmp_path_factory) -> Path:
    """The folder of a training run of three UAVs."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    main(["train", *TRAINED, f"model={request.param}", f"hydra.run.dir={folder}"])
    return folder


def stored(run: Path, policy: str) -> dict[str, float]:
    """The measures of one policy in ``result.csv``."""
    with (run / "result.csv").open(newline="") as file:
        rows = {row.pop("policy"): row for row in csv.DictReader(file)}
    return {name: float(x) for name, x in rows[policy].items()}


def test_a_loaded_policy_flies_as_it_was_evaluated(trained):
    policy, env = damian.load(trained, worlds=8, deterministic=True)
    env.set_seed(3 + 10_000)
    rollout = env.rollout(10, policy, break_when_any_done=False)
    perceived = rollout["next", *keys.REWARD].sum(1).mean().item()
    assert perceived == pytest.approx(stored(trained, "trained, deterministic")["perceived_return"])


def test_a_loaded_policy_flies_elsewhere_unless_it_does_not_fit(trained):
    policy, env = damian.load(trained / "best.pt", "agents=5", "delay.obs=3", worlds=4, seed=1)
    one, other = (env.rollout(5, policy)[keys.ACTION] for _ in range(2))
    assert one.shape == (4, 5, 5)
    assert not one.equal(other)  # actions are drawn
    with pytest.raises(InputError, match=r"model.hidden: the policy was trained with \[16\]"):
        damian.load(trained, "model.hidden=[8]")
    with pytest.raises(InputError, match=r"checkpoint: .*nowhere holds no config.yaml"):
        damian.load(trained.parent / "nowhere")


def test_a_sweep_ends_with_a_table_of_means_over_seeds(sweep, capsys):
    rows = damian.results(sweep)
    rows = rows[rows["policy"] == "trained"].to_dict("records")
    assert [(row["delay.obs"], row["seed"]) for row in rows] == [(d, s) for d in (1, 2) for s in (0, 1, 2)]
    for row in rows:
        assert stored(sweep / row["folder"], "trained")["return"] == row["return"]
    table = (sweep / "table.md").read_text()
    for delay in (1, 2):
        mean = fmean(row["return"] for row in rows if row["delay.obs"] == delay)
        (line,) = [line for line in table.splitlines() if line.startswith(f"| {delay} | trained |")]
        _, _, n_runs, shown, *_ = line.split(" | ")
        assert n_runs == "3"
        assert float(shown.split()[0]) == pytest.approx(mean, abs=6e-4)
    assert (sweep / "figure.png").stat().st_size > 1000
    before = {path.name: path.read_bytes() for path in sweep.glob("*.csv")}
    main(["results", str(sweep)])
    assert capsys.readouterr().out.startswith("| delay.obs |")
    assert {path.name: path.read_bytes() for path in sweep.glob("*.csv")} == before


def test_results_are_utf_8_whatever_the_locale_and_shown_also_where_it_lacks_a_letter(tmp_path):
    text = "policy,episodes,return\nŁąka,4,1.5\n"
    (tmp_path / "result.csv").write_text(text, encoding="utf-8")
    ascii_only = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    command = [sys.executable, "-c", "from damian.recipes.command import main; main()"]
    done = subprocess.run(
        [*command, "results", str(tmp_path)],
        env=os.environ | ascii_only,
        capture_output=True,
        encoding="ascii",
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "| \\u0141\\u0105ka |" in done.stdout


def test_results_of_a_run_and_of_a_comparison_are_rows_too(sweep):
    run = next(path.parent for path in sweep.rglob("result.csv"))
    assert [*damian.results(run)["policy"]][:2] == ["untrained", "untrained, deterministic"]
    folder = Path(__file__).parents[2] / "docs" / "results" / "delaybench"
    assert {*damian.results(folder)["arm"]} >= {"undelayed", "backupdate"}
    with pytest.raises(InputError, match="no run has finished there"):
        damian.results(folder.parent / "none")
