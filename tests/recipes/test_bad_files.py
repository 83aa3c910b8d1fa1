"""Files of any content, and whole programs on bad input: one line, exit code 2 and nothing left behind.

The programs really start, compose and check; only the training, the flights and the reports are cut off.
"""

import io
import json
import math
import os
from contextlib import ExitStack, chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import pytest
from episodes import flight
from fuzzing import LONGEST_LINE, NUMBERS, SMALL, WORDS, examples, fly, refusal, words
from helpers import SQUARE
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from damian.advice.rows import read_file
from damian.common.errors import InputError
from damian.recipes import advise as advise_program
from damian.recipes import compare, evaluate, oracle, train
from damian.recipes import fly as fly_program
from damian.recipes.command import main
from damian.recipes.shared.settings import TrainConfig
from damian.world.regions.config import RegionConfig

CORNERS = [[8.0, 45.0], [8.004, 45.0], [8.004, 45.003], [8.0, 45.003]]
POLYGON = {"type": "Polygon", "coordinates": [[*CORNERS, CORNERS[0]]]}
ROWS = "".join(f"A,0,100,{i},{corner[1]},{corner[0]}\n" for i, corner in enumerate(CORNERS))
HEADER = "Airspace ID,Min Flight Level,Max Flight Level,Sequence Number,Latitude,Longitude\n"
REGION = RegionConfig(kind="vertices", vertices=SQUARE, lattice_step=40.0, initial_conditions=4)
RUN = TrainConfig(agents=2, worlds=2, eval_episodes=2, region=REGION)
VALID = {
    "fir.csv": HEADER + ROWS,
    "trace.csv": "when,delay\n1,2\n2,3s\n3,lost\n4,0\n",
    "zones.geojson": json.dumps(
        {
            "type": "FeatureCollection",
            "features": [{"type": "Feature", "properties": {"name": "park"}, "geometry": POLYGON}],
        }
    ),
    "own/scenario/mine.yaml": "# @package _global_\nagents: 2\nreward:\n  spotted: 0.5\nregion: {pool: 1}\n",
    "run/config.yaml": OmegaConf.to_yaml(OmegaConf.structured(RUN)),
    "reports.csv": "ID,time,receive time,lat,lon,battery,source spotted,previous,sequence\n"
    + "".join(f"A,{i},{i + 0.5},53.1,-4.5,NA,1,53.1 -4.5; 53.2 -4.5,{i}\n" for i in range(4)),
    "journal.jsonl": '{"journal":"damian-advice","version":1,"fleet":"x","uavs":["A"],"about":{}}\n'
    + "".join(
        f'{{"received":{i + 0.5},"reports":[{{"id":"A","time":{i}.0,"lat":53.1,"lon":-4.5}}]}}\n'
        for i in range(4)
    ),
    "episode.json": json.dumps(flight().document()),
}
"""A valid file for each reader."""
LOGS = ["reports.csv", "journal.jsonl"]
READERS = {
    "fir.csv": ["region.kind=fir", "region.path=fir.csv", "region.id=A", "region.vertices=[]"],
    "trace.csv": ["delay.obs={law: trace, path: trace.csv}"],
    "zones.geojson": ["region.kind=geojson", "region.path=zones.geojson", "region.vertices=[]"],
}
"""Words that read the files of settings."""
PARTS = [
    *NUMBERS,
    *WORDS,
    "\0",
    "\r",
    "\r\n",
    "\n\n",
    ",,,",
    ";",
    '"' * 3,
    "\ufeff",
    "\u2028",
    "1" * 200_000,
    "[" * 5000,
    "{" * 5000,
    "lost",
    "- ",
    "? ",
    "!!python/object/apply:os.getcwd []",
    "!!binary x",
    "&a [*a]",
    "<<: *a",
    "---\n",
]


@st.composite
def contents(draw, file):
    """The bytes of a valid file after some accidents, or of none."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=200))
    text = VALID[file]
    for _ in range(draw(st.integers(0, 3))):
        at, length = draw(st.integers(0, len(text))), draw(st.integers(0, 12))
        lines, kind = text.splitlines(keepends=True) or [""], draw(st.integers(0, 4))
        line = draw(st.integers(0, len(lines) - 1))
        if kind == 0:
            text = text[:at] + draw(st.sampled_from(PARTS)) + text[at + length :]
        elif kind == 1:
            text = text[:at] + draw(st.text(max_size=5)) + text[at:]
        elif kind == 2:
            text = text[:at]
        elif kind == 3:
            text = "".join([*lines[:line], lines[line], *lines[line:]])
        else:
            cells = lines[line].rstrip("\n").split(",")
            cells[draw(st.integers(0, len(cells) - 1))] = draw(st.sampled_from(PARTS))
            text = "".join([*lines[:line], ",".join(cells) + "\n", *lines[line + 1 :]])
    encoding = draw(st.sampled_from(["utf-8"] * 6 + ["utf-8-sig", "utf-16", "latin-1", "utf-32"]))
    return text.encode(encoding, errors="replace")


def nothing(*_, **__):
    return None


def build(config, folder):
    """Stands for the training: only its checks."""
    config.check_learning()


def answer(name, given_words, made=nothing):
    """Exit code and error line of a program that starts in a folder of its own, which ``made`` fills."""
    errors = io.StringIO()
    with TemporaryDirectory() as folder, chdir(folder), ExitStack() as stack:
        made(Path(folder))
        before = sorted(Path(folder).rglob("*"))
        cut_off = [
            (train, "train", build),
            (fly_program, "show", nothing),
            (advise_program, "advise", nothing),
            (evaluate, "report", nothing),
            (oracle, "evaluate", nothing),
            (compare, "perform_all", lambda *_: []),
        ]
        for module, function, stand_in in cut_off:
            stack.enter_context(patch.object(module, function, stand_in))
        stack.enter_context(patch("sys.argv", ["damian"]))
        stack.enter_context(redirect_stdout(io.StringIO()))
        stack.enter_context(redirect_stderr(errors))
        code = 0
        try:
            main([name, *given_words])
        except SystemExit as end:
            code = end.code or 0
        line = errors.getvalue()
        if code:
            check_answer(code, line)
            assert sorted(Path(folder).rglob("*")) == before
    return code, line


def check_answer(code, line):
    """Exit code 2 and one printable line that is not too long."""
    assert code == 2, line
    assert line.startswith("error: "), line
    assert line[-1:] == "\n", line
    assert line[:-1].isprintable(), repr(line)
    assert len(line) <= LONGEST_LINE, len(line)


def write(file, content):
    def made(folder):
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    return made


@pytest.mark.parametrize("file", READERS)
def test_a_valid_file_is_read(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(file, VALID[file].encode())(tmp_path)
    assert refusal(READERS[file], fly) is None


def refuse_to_read(file: Path, path: Path, read=Path.read_bytes) -> bytes:
    """Read a file unless it is this one, which not even a superuser may read."""
    if path == file:
        raise PermissionError(13, "Permission denied")
    return read(path)


@pytest.mark.parametrize("file", READERS)
@pytest.mark.parametrize("kind", ["missing", "folder", "empty", "pipe", "loop", "not readable"])
def test_what_is_no_file_is_named(file, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given_words, path = READERS[file], Path(file)
    if kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.write_text(" \n")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "not readable":
        path.write_text(VALID[file])
        monkeypatch.setattr(Path, "read_bytes", lambda other: refuse_to_read(path, other))
    line = refusal(given_words, fly)
    assert line is not None


@examples(12, 1000)
@given(st.sampled_from([*READERS]).flatmap(lambda file: st.tuples(st.just(file), contents(file))))
@example(("zones.geojson", b"1" * 5000))
def test_files_of_any_content_are_refused_in_one_line_or_read(case):
    file, content = case
    with TemporaryDirectory() as folder, chdir(folder):
        write(file, content)(Path(folder))
        line = refusal(READERS[file], fly)
    assert line is None or file in line or "motion.min_level" in line or "agents" in line or "lattice" in line


@examples(5, 700)
@given(contents("own/scenario/mine.yaml"))
@example(b"1" * 5000)
def test_a_configuration_file_of_any_content_is_refused_in_one_line_or_used(content):
    answer("train", ["--config-dir=own", "scenario=mine"], write("own/scenario/mine.yaml", content))


@examples(4, 500)
@given(st.sampled_from(["evaluate", "oracle", "train"]), contents("run/config.yaml"))
def test_a_run_folder_of_any_content_is_refused_in_one_line(name, content):
    key = "resume" if name == "train" else "checkpoint"
    code, _ = answer(name, [f"{key}=run", *SMALL * (name != "train")], write("run/config.yaml", content))
    assert code == 2


@examples(8, 1000)
@given(contents("episode.json"))
def test_an_episode_of_any_content_is_refused_in_one_line_or_shown(content):
    answer("fly", ["replay=[episode.json]", *SMALL], write("episode.json", content))


@examples(20, 3000)
@given(st.sampled_from(LOGS).flatmap(contents), st.sampled_from(["csv", "json", "jsonl"]))
def test_reports_of_any_content_are_refused_in_one_line_or_read(content, kind):
    with TemporaryDirectory() as folder:
        path = Path(folder, f"reports.{kind}")
        path.write_bytes(content)
        line, reports = None, []
        try:
            reports = [report for _, report in read_file(path)]
            for report in reports:
                report.stamp(1e9, file=True)
        except InputError as error:
            line = str(error)
    assert reports or (line and len(line) <= LONGEST_LINE)
    assert all(math.isfinite(number) for report in reports for number in (report.time, *report.place))


@examples(8, 500)
@given(st.sampled_from(["train", "train", "fly", "advise", "evaluate", "oracle"]), words("train"))
def test_any_words_end_a_program_in_one_line_or_start_it(name, given_words):
    answer(name, given_words)


@examples(2, 100)
@given(words("compare"))
def test_any_words_end_a_comparison_in_one_line_or_start_it(given_words):
    few = ["experiment=usecase2", "tasks=[usecase2]", "arms=[undelayed]", "seeds=1"]
    with patch.object(compare, "report", nothing), patch.object(compare, "MARKDOWN", os.devnull):
        answer("compare", [*few, *given_words])


SWEEPS = [
    ("train", ["-m", "agnts=1,2"]),
    ("train", ["-m", "+agnts=1,2"]),
    ("train", ["-m", "delay=none,papers"]),
    ("train", ["-m", "agents=1,x"]),
    ("train", ["-m", "agents=0,1"]),
    ("train", ["-m", "agents=0,1", "hydra.sweep.dir=a/b"]),
    ("train", ["-m", "scenario=nope,spotting", "hydra.sweep.dir=a/b/c"]),
    ("train", ["-m", "delay.obs={law: x},3"]),
    ("train", ["-m", "region.path=x", "region=vertices"]),
    ("train", ["-m", "seed=0,1", "hydra.sweep.dir="]),
    ("train", ["hydra.mode=MULTIRUN", "agents=0,1"]),
    ("compare", ["-m", "experiment=usecase2"]),
    ("compare", ["-m", "experiment=usecase2,delaybench"]),
    ("compare", ["hydra.mode=MULTIRUN", "experiment=usecase2"]),
    ("compare", ["-m", "experiment=nope"]),
    ("evaluate", ["-m", "delay.obs=0,2"]),
    ("oracle", ["-m", "delay.obs=0,2"]),
    ("fly", ["-m", "resume=x,y"]),
]


QUICK = [SWEEPS[i] for i in (0, 2, 4, 11)]
SLOW = [pytest.param(*each, marks=pytest.mark.slow) for each in SWEEPS if each not in QUICK]


@pytest.mark.parametrize(("name", "given_words"), [*QUICK, *SLOW], ids=lambda part: str(part)[:40])
def test_a_refused_sweep_leaves_no_folder(name, given_words):
    code, _ = answer(name, given_words)
    assert code == 2


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("name", "given_words", "message"),
    [
        ("fly", ["resume=x"], "resume: nothing is trained"),
        ("advise", ["resume=x"], "resume: nothing is trained"),
        ("advise", ["policy=random"], "policy: random is not one of deterministic, sampled, script"),
        ("advise", ["token=short"], "token: it is not a password"),
        ("advise", ["fit=nothing.csv"], "nothing.csv: no such file"),
        ("advise", ["fit=x", "fit_dt=0"], "fit_dt: 0.0 s is not above 0 s"),
        ("oracle", ["delay=none"], "delay.obs: no message is late or lost"),
        ("oracle", ["scenario=coverage", "delay=paper"], "reward: nothing is won by finding the source"),
        ("oracle", ["links=matrix", "delay=paper"], "links: matrix is not supported"),
        ("evaluate", [], "checkpoint: it is missing"),
        (
            "compare",
            ["experiment=usecase2", "overrides=['hydra.run.dir=x']"],
            "overrides: hydra.run.dir=x cannot be the same",
        ),
        (
            "compare",
            ["experiment=usecase2", "overrides=['++seed=3']"],
            "overrides: ++seed=3 cannot be the same",
        ),
        ("fly", ["replay=[x.json]"], "x.json: it is no episode of version 2: no such file"),
        ("fly", ["replay=[x.json]", "journal=x"], "replay: ['x.json'] does not go with journal"),
        ("train", ["hydra.run.dir="], "hydra.run.dir: it is empty"),
        ("train", ["resume=" + "x" * 5000], "resume: "),
        ("train", ["checkpoint=" + "x" * 5000], "checkpoint: "),
    ],
    ids=lambda part: str(part)[:40],
)
def test_a_program_refuses_what_it_would_ignore(name, given_words, message):
    code, line = answer(name, given_words)
    assert code == 2
    assert message in line
