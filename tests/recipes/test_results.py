"""``damian.load`` reads trained policies, ``damian.results`` the results of runs, sweeps and comparisons."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_evaluate import TRAINED

import damian
from damian import keys
from damian.common.errors import InputError
from damian.recipes.command import main


@pytest.fixture(scope="module", params=["mlp", "gru"])
def trained(request, tmp_path_factory) -> Path:
    """The folder of a training run of three UAVs."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    main(["train", *TRAINED, f"model={request.param}", f"hydra.run.dir={folder}"])
    return folder


def test_a_loaded_policy_flies_as_it_was_evaluated(trained):
    policy, env = damian.load(trained, worlds=8, deterministic=True)
    env.set_seed(3 + 10_000)
    rollout = env.rollout(10, policy, break_when_any_done=False)
    perceived = rollout["next", *keys.REWARD].sum(1).mean().item()
    rows = damian.results(trained).set_index("policy")
    assert perceived == pytest.approx(rows.at["trained, deterministic", "perceived_return"])


def test_a_loaded_policy_flies_elsewhere_unless_it_does_not_fit(trained):
    policy, env = damian.load(trained / "best.pt", "agents=5", "delay.obs=3", worlds=4, seed=1)
    one, other = (env.rollout(5, policy)[keys.ACTION] for _ in range(2))
    assert one.shape == (4, 5, 5)
    assert not one.equal(other)  # actions are drawn
    with pytest.raises(InputError, match=r"model.hidden: the policy was trained with \[16\]"):
        damian.load(trained, "model.hidden=[8]")
    with pytest.raises(InputError, match=r"checkpoint: .*nowhere holds no config.yaml"):
        damian.load(trained.parent / "nowhere")


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


def test_results_of_a_run_and_of_a_comparison_are_rows(trained):
    assert [*damian.results(trained)["policy"]][:2] == ["untrained", "untrained, deterministic"]
    folder = Path(__file__).parents[2] / "docs" / "results" / "delaybench"
    assert {*damian.results(folder)["method"]} >= {"undelayed", "backupdate"}
    with pytest.raises(InputError, match="no run has finished there"):
        damian.results(folder.parent / "none")
