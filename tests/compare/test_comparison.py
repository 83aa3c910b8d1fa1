"""Comparisons of methods: pairs of seeds, J_norm, recovery, and the tables of them."""

import itertools

import numpy as np
import pandas as pd
import pytest

from damian.common.errors import InputError
from damian.common.tables import write_csv
from damian.compare.comparison import RANDOM, TRAINED, UNTRAINED, Comparison, Method, shown
from damian.compare.paired import means
from damian.compare.report import markdown
from damian.runs.measures import BUILT_IN
from damian.runs.run_folder import read_results

LIKELIEST = f"{TRAINED}, deterministic"
METHODS = {
    "best": Method(delayed=False),
    "blind": Method(naive=True),
    "flown": Method(naive=True, policy_of="best", simulator=False),
    "aware": Method(),
}


def row(task, delay, method, seed, value, policy=TRAINED):
    """A row of results in which every measure has the same value."""
    labels = {"task": task, "delay": delay, "method": method, "regime": "late data"}
    labels |= {"seed": seed, "policy": policy}
    return (
        labels
        | {"frames": 400, "seconds": 36.0}
        | dict.fromkeys(("backupdated", "episodes", *BUILT_IN), value)
    )


def rows_of(task, delay, scores, random=0.0):
    """Rows of every method, seed and policy, from the values of the methods by seed."""
    return [
        row(task, "none" if method == "best" else delay, method, seed, x, policy)
        for method, values in scores.items()
        for seed, value in enumerate(values)
        for policy, x in ((TRAINED, value), (LIKELIEST, value), (RANDOM, random))
    ]


def comparison(rows, methods=METHODS, curves=()):
    columns = [
        "task",
        "delay",
        "method",
        "seed",
        "frames",
        "hindsight_return",
        "perceived_success_rate",
    ]
    return Comparison(pd.DataFrame(rows), pd.DataFrame(curves, columns=columns), methods)


def compared(found):
    """Lines of the delayed methods of a table by method."""
    table = found.table
    lines = table[
        (table["delay"] != "none") & (table["policy"] == TRAINED) | (table["method"] == "prior")
    ]
    return {line["method"]: line for line in lines.to_dict("records")}


THREE = {
    "best": [9.0, 11, 10],
    "blind": [1.0, 5, 3],
    "flown": [5.0, 3, 4],
    "aware": [6.0, 9, 7],
}


def test_a_table_from_before_a_metric_existed_has_an_empty_column(tmp_path):
    stored = pd.DataFrame(rows_of("t", "late", THREE)).drop(columns="lost")
    write_csv(tmp_path / "results.csv", stored)
    rows = read_results(tmp_path / "results.csv").assign(**{"lab:other": 2.0})
    assert rows["lost"].isna().all()
    (line,) = [
        line for line in comparison(rows).table.to_dict("records") if line["policy"] == RANDOM
    ][:1]
    assert (line["return"], line["lab:other"]) == (0.0, 2.0)
    assert np.isnan(line["lost"])
    lines = means(rows, [], "perceived_steps")
    assert {"lab:other", "perceived_steps"} <= {*lines}
    with pytest.raises(
        InputError, match="score: lab:unknown is not stored, only success_rate, steps"
    ):
        means(rows, [], "lab:unknown")


SCORES = {
    "best": [9.0, 11.0],
    "blind": [1.0, 5.0],
    "flown": [5.0, 3.0],
    "aware": [6.0, 9.0],
}


def test_recovery_counts_from_the_stronger_naive_method_by_means_over_seeds():
    lines = compared(comparison(rows_of("t", "late", SCORES)))
    aware = lines["aware"]
    assert aware["compared_seeds"] == 2
    assert aware["J_norm"] == 7.5 / 10
    assert aware["recovery"] == (7.5 - 4) / (10 - 4)
    assert aware["improvement"] == 1
    assert np.isnan(
        [aware["J_norm_low"], aware["recovery_high"]]
    ).all()  # two seeds give no interval
    assert lines["blind"]["J_norm"] == 3 / 10
    assert np.isnan(
        [lines[naive][name] for naive in ("blind", "flown") for name in ("recovery", "improvement")]
    ).all()


def test_a_method_is_compared_over_the_seeds_that_it_and_what_it_is_compared_with_have_finished():
    rows = rows_of("t", "late", THREE)
    alone = compared(comparison(rows))
    lines = compared(
        comparison([row for row in rows if (row["method"], row["seed"]) != ("aware", 2)])
    )
    assert lines["aware"]["compared_seeds"] == 2
    assert str(lines["blind"]) == str(alone["blind"])  # an unfinished method changes no other one
    lines = compared(
        comparison([row for row in rows if (row["method"], row["seed"]) != ("blind", 0)])
    )
    assert [lines[method]["compared_seeds"] for method in ("blind", "flown", "aware")] == [2] * 3


def test_a_recovery_is_from_the_naive_method_of_the_same_track_if_the_delay_costs_something():
    scores = SCORES | {"flown": [9.0, 9.5]}  # as good as undelayed
    lines = compared(comparison(rows_of("t", "late", scores)))
    assert shown(lines["aware"], "recovery") == "-"
    methods = METHODS | {
        "flown": Method(naive=True, policy_of="best")
    }  # not the reference of late data
    lines = compared(comparison(rows_of("t", "late", scores), methods))
    assert lines["aware"]["recovery"] == pytest.approx((7.5 - 3) / (10 - 3))
    assert np.isnan(lines["flown"]["recovery"])  # the strongest naive method of its track


def test_an_untrained_network_stands_beside_the_trained_one_and_as_a_method_of_its_own():
    methods = METHODS | {"prior": Method(flies="untrained")}
    rows = rows_of("t", "late", SCORES)
    prior = itertools.product(("aware", "prior"), (0, 1))
    rows += [row("t", "late", method, seed, 2.0 + seed, UNTRAINED) for method, seed in prior]
    table = comparison(rows, methods).table
    lines = table[table["policy"] == UNTRAINED]
    assert [*lines["method"]] == ["aware", "prior"]
    assert (lines["return"] == 2.5).all()
    aware, prior = lines.to_dict("records")
    assert (
        aware["compared_seeds"] == 0
    )  # only the trained policy of a method is compared with others
    assert prior["J_norm"] == pytest.approx(2.5 / 10)
    assert prior["recovery"] == pytest.approx((2.5 - 4) / 6)


def test_a_script_that_flies_forward_is_a_method_with_a_model_of_the_world():
    words = ["observation.own=true", "observation.forward=script"]
    methods = METHODS | {"forward": Method(flies="script", overrides=words)}
    rows = rows_of("t", "late", SCORES)
    rows += [row("t", "late", "forward", seed, 8.0, "script") for seed in (0, 1)]
    rows += [row("t", "late", "blind", seed, 2.0, "script") for seed in (0, 1)]
    table = comparison(rows, methods).table
    lines = table[table["policy"] == "script"].set_index("method")
    assert lines.loc["forward", "regime"] == "world model"
    assert lines.loc["forward", "J_norm"] == pytest.approx(0.8)
    assert lines.loc["script", "return"] == 2.0
    alone = comparison(rows[-4:-2], {"best": METHODS["best"], "forward": methods["forward"]})
    assert (alone.table["policy"] == "script").sum() == 1


def test_steps_are_counted_to_the_final_training_return_of_the_best_naive_method():
    # Straight learning curves over 100 steps: the mean of the naive one ends with 4, of the aware
    # one with 8. The mean over the last tenth of the steps lags a straight curve by a twentieth of
    # them, 5 steps.
    ends = {
        ("t", "late", "blind"): [3.0, 5.0],
        ("t", "late", "aware"): [3.0, 13.0],
        ("t", "none", "best"): [40.0],
    }
    points = [
        (*run, seed, x, end * x / 100, np.nan)
        for run, of_seeds in ends.items()
        for seed, end in enumerate(of_seeds)
        for x in (0, 100)
    ]
    lines = markdown(comparison(rows_of("t", "late", SCORES), METHODS, points), []).splitlines()
    table = lines[next(i for i, line in enumerate(lines) if line.endswith("of *blind*, 3.8:")) :]
    rows = {
        method: numbers
        for method, *numbers in (line.strip("| ").split(" | ") for line in table[4:7])
    }
    assert rows["best"] == ["15", "15", "15"]
    assert rows["aware"] == ["53", "34", "never"]
    assert rows["blind"] == ["100", "81", "never"]
