"""Numbers that the documents print follow from stored rows: each cell of a table, and each number
of a sentence.

tests/data/published_numbers.yaml says what words and sentences ask for, and which command prints
what is not stored.
"""

import re
from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from leaderboard import delaybench
from pretrained import POLICIES, differences, written
from sites import DOCS, ROOT

from damian.common.tables import read_csv
from damian.compare.comparison import (
    CORRECTED,
    ENDS,
    NOT_LATE,
    RUN,
    Comparison,
    means_over_seeds,
)
from damian.compare.statistics import normalised
from damian.runs.run_folder import DETERMINISTIC, RANDOM, TRAINED, Interval, read_results

KNOWN = yaml.safe_load((ROOT / "tests" / "data" / "published_numbers.yaml").read_text("utf-8"))
WORDS, TABLES, CLAIMS, NOT_STORED = (
    KNOWN[name] for name in ("words", "tables", "sentences", "not stored")
)
FILES = ("README.md", "RESULTS.md", "docs/report.md", "docs/tasks.md", "docs/policies.md")
FOLDERS = ("delaybench", "commands", "converged", "delays", "tasks")
PLACE = ["folder", "task", "delay", "method", "policy"]
USUAL = {"folder": "delaybench", "task": "crowded", "policy": TRAINED}
PACKAGED = "docs/policies.md: Policies to start with"
COUNTS = ["zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"]
INTERVAL = r" \[-?[\d.]+, -?[\d.]+\]"
MEAN = rf"(?:-?\d+\.\d+(?:{INTERVAL})?|-?\d+{INTERVAL}|(?<!\w)-\d{{3,}})"
"""A mean, perhaps with its interval."""
SAID = re.compile(
    r"(?:\*([\w+]+)\*|(?<!trained )\b(script|[Uu]ndelayed|untrained|random|jitter buffer)\b(?!,))"
    rf"[^\d*.;:]{{0,30}}?({MEAN}(?:(?:,| and)? \(?{MEAN}\)?)*)(?![\d%]| \[| for)"
)
"""The name of a method or of a policy that is not trained, and the means that follow it."""


def documents():
    """The sentences of each section, by its file and heading; and its tables, each with what stands
    above it."""
    sentences, tables = {}, {}
    for file in FILES:
        text = (ROOT / file).read_text("utf-8")
        text = re.sub(r"^```.*?^```|(?<=\])\([^)]*\)", "", text, flags=re.DOTALL | re.MULTILINE)
        for part in re.split(r"^#+ ", text, flags=re.MULTILINE)[1:]:
            heading, body = part.split("\n", 1)
            section = f"{file}: {heading}"
            parts = re.split(r"((?:^\|.*\n)+)", body, flags=re.MULTILINE)
            sentences[section] = " ".join(" ".join(parts[::2]).split())
            for number, table in enumerate(parts[1::2]):
                name = f"{section} ({number + 1})" if number else section
                tables[name] = parts[2 * number], table
    return sentences, tables


SENTENCES, PUBLISHED = documents()


@cache
def stored():
    """Stored evaluations by ``PLACE``, with a row for each seed."""
    rows = {name: read_results(DOCS / "results" / name / "results.csv") for name in FOLDERS}
    names = {"sampled": TRAINED, "deterministic": TRAINED + DETERMINISTIC}
    spread = read_csv(DOCS / "results" / "spread" / "results.csv", text=["method", "delay"])
    spread = spread.rename(columns=names).rename(columns={"frames": "task"})
    spread = spread.melt([*PLACE[1:4], "seed"], var_name="policy", value_name="return")
    rows["spread"] = spread.dropna()
    return pd.concat(rows, names=["folder", None]).reset_index("folder").groupby(PLACE)


@cache
def means():
    """Stored mean returns, by ``PLACE``."""
    return stored()["return"].mean()


@cache
def estimated(place, measure="return", first=None):
    """The mean of a measure and the ends of its interval, and the number of seeds (the first ones)."""
    runs = stored().get_group(place)
    runs = runs.nsmallest(first, "seed") if first else runs
    line = means_over_seeds(runs[[measure]])
    return np.array([line[measure + end] for end in ENDS]), len(runs)


@cache
def recoveries(delay):
    """Recovery of the methods of delaybench and the ends of its interval, by task, delay and
    method."""
    experiment = delaybench()
    rows = stored().obj[["folder", *RUN, "policy", CORRECTED, "episodes", "return"]]
    rows = rows[(rows["folder"] == "delaybench") & rows["task"].isin([*experiment.tasks])]
    rows = rows[rows["delay"].isin([NOT_LATE, delay]) & rows["policy"].isin([TRAINED, RANDOM])]
    table = Comparison(rows, pd.DataFrame(), experiment.methods).table
    return table.set_index(PLACE[1:4])[["recovery" + end for end in ENDS]]


@cache
def packaged(script):
    """What each packaged policy returns over outlines, and how much more than a script, by name and
    number of UAVs."""
    paths = {name: ROOT / "damian" / "data" / name / "result.csv" for name in POLICIES}
    rows = {name: read_csv(path, text=["outline"]) for name, path in paths.items()}
    return {name: differences(each.assign(script=each[script])) for name, each in rows.items()}


def like(text, values):
    """A mean and the ends of its interval, written as a text writes them."""
    decimals = len(text.partition(" ")[0].partition(".")[2])
    mean, low, high = (f"{value:.{decimals}f}" for value in values)
    return f"{mean} [{low}, {high}]" if "[" in text else mean


def mean_of(asked):
    """The stored mean return that is asked for."""
    return means()[tuple(asked[name] for name in PLACE)]


def recomputed(text, asked):
    """A text as it follows from the stored rows that are asked for, and how many seeds they have."""
    if "packaged" in asked:
        line = packaged("script+forward")[asked["packaged"]].loc[asked["agents"]]
        return like(text, line[["difference", "low", "high"]]), 1
    place = tuple(asked[name] for name in PLACE)
    if place not in means():
        return f"nothing ({', '.join(place)} is not stored)", 0
    values, n = estimated(place, asked.get("measure", "return"), asked.get("first"))
    if "beside" in asked:  # paired by seed
        runs, others = (
            stored().get_group(tuple(each[name] for name in PLACE)).set_index("seed")["return"]
            for each in (asked, asked | asked["beside"])
        )
        gain = (runs - others).dropna()
        return like(text, Interval.of(torch.tensor(gain.to_numpy()))), len(gain)
    if "minus" in asked:
        values = values - mean_of(asked | asked["minus"])
    if "from" in asked:  # as a share of the way from one mean to another
        values = normalised(values, *(mean_of(asked | asked[end]) for end in ("to", "from")))
    if asked.get("statistic") == "recovery":
        values = recoveries(asked["delay"]).loc[place[1:4]]
    return like(text, values), n


def asked_by(label, words):
    """The stored rows that the label of a row or a column names, one for each number of a cell; empty
    if it names none."""
    plain = re.sub(r"[*`\[\]]", "", label)
    if plain in words:
        return words[plain] if isinstance(words[plain], list) else [words[plain]]
    names = re.findall(r"\*([\w+]+)\*", label)
    return [words.get(name, {"method": name}) for name in names if name in means().index.levels[3]]


def seeds_said(text):
    """Numbers of seeds that a text allows last: "five seeds", "three to ten seeds", "seeds=5"."""
    count = rf"(\d+|{'|'.join(COUNTS)})"
    *_, found = re.findall(rf"seeds=(\d+)|(?:{count} (?:to|or) )?{count} seeds", text)
    ends = [COUNTS.index(word) if word in COUNTS else int(word) for word in found if word]
    return [*map(str, range(min(ends), max(ends) + 1))]


def numbers(name):
    """The numbers of a table: the place of each, its text, the stored rows from which it must follow,
    and the numbers of seeds that the table allows."""
    above, table = PUBLISHED[name]
    words = WORDS | TABLES[name].get("words", {})
    header, _, *rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()
    ]
    if "" in header[1:]:  # two halves beside each other
        half = header.index("", 1)
        header, rows = header[:half], [part for row in rows for part in (row[:half], row[half:])]
    for row in rows:
        cells = dict(zip(header, row, strict=True))
        counts = cells.pop("n", "").split("/")
        columns = {column: asked_by(column, words) for column in cells}
        label = ", ".join(cell for column, cell in cells.items() if cell and not columns[column])
        assert not re.search(r"\d\.\d", label), f"{name}: no words tell what {label} is"
        asked = asked_by(label, words)
        for number, column in enumerate(each for each in cells if columns[each]):
            seeds = [counts[number % len(counts)]] if "n" in header else seeds_said(above)
            cell, of_column = cells[column], columns[column][0]
            texts = re.findall(rf"{MEAN}|\d+", cell)
            wanted = [each | WORDS["most likely actions"] for each in asked] if "(" in cell else []
            wanted = [*asked, *wanted]
            where = f"{name}, {label} / {column}"
            assert len(texts) in (0, len(wanted)), f"{where}: no words tell all numbers of {cell}"
            for text, of_row in zip(texts, wanted, strict=False):
                instead = of_column.get("instead", {})
                yield where, text, USUAL | TABLES[name] | of_column | of_row | instead, seeds


@pytest.mark.parametrize("name", [name for name in PUBLISHED if name != PACKAGED])
def test_each_cell_of_a_table_follows_from_stored_rows(name):
    if name in NOT_STORED:
        pytest.skip(f"printed by {NOT_STORED[name]}")
    assert name in TABLES, "no words tell what this table asks for, and no command what prints it"
    wrong = []
    for where, text, asked, seeds in numbers(name):
        found, n = recomputed(text, asked)
        if found != text or str(n) not in seeds:
            wrong.append(
                f"{where}: printed {text} (n {' or '.join(seeds)}), recomputed {found} (n {n})"
            )
    assert not wrong, "\n".join(wrong)


def test_the_table_of_packaged_policies_follows_from_their_rows():
    printed = [line.split(" | ", 1)[1] for line in PUBLISHED[PACKAGED][1].splitlines()[2:]]
    assert printed == [
        f"{agents:.0f} | {line['most likely']:.1f} | {line['script']:.1f} | {line['difference']:.1f} "
        f"[{line['low']:.1f}, {line['high']:.1f}] | {line['script+forward']:.1f} | "
        f"{written(line['planner'])} |"
        for lines in packaged("script").values()
        for agents, line in lines.iterrows()
    ]


def stored_means(section, name, text):
    """Means near that of a text which its section's folders store of a method, as the text writes
    them."""
    folders = re.findall(r"docs/results/(\w+)", SENTENCES[section])
    folders += [TABLES[section]["folder"]] if section in TABLES else FOLDERS
    name = {"jitter buffer": "backupdate+gru+hold"}.get(name, name.lower())
    for place in means().index[(means() - float(text.split()[0])).abs() < 0.1]:
        own = place[4].startswith(TRAINED) and place[3].removesuffix("+forward")
        if place[0] in folders and name in ("", own, place[4]):
            yield like(text, estimated(place)[0])


def test_nothing_is_told_of_sections_that_are_gone():
    told = [*TABLES, *CLAIMS, *NOT_STORED, *KNOWN["numbers that are not stored"]]
    assert {*told} <= SENTENCES.keys() | PUBLISHED.keys()


@pytest.mark.parametrize("section", [name for name in SENTENCES if name not in NOT_STORED])
def test_each_number_of_a_sentence_follows_from_stored_rows(section):
    sentences, wrong = SENTENCES[section], []
    for words, asked in CLAIMS.get(section, {}).items():
        found = re.search(re.escape(words).replace(r"\#", f"({MEAN})"), sentences)
        assert found, f"no sentence says: {words}"
        sentences = sentences.replace(found[0], "")
        for text, each in zip(found.groups(), asked, strict=True):
            value, _ = recomputed(text, USUAL | TABLES.get(section, {}) | each)
            wrong += [f"{found[0]}: printed {text}, recomputed {value}"] * (value != text)
    for text, command in KNOWN["numbers that are not stored"].get(section, {}).items():
        assert text in sentences, f"no longer printed: {text}, by {command}"
        sentences = sentences.replace(text, "")
    for method, word, texts in SAID.findall(sentences):
        for text in re.findall(MEAN, texts):
            if text not in stored_means(section, method or word, text):
                wrong.append(f"{method or word} {text}: no stored mean of this name")
    wrong += [f"{text}: of what?" for text in re.findall(MEAN, SAID.sub("", sentences))]
    assert not wrong, "\n".join(wrong)
