"""Nothing that a run or a journal names is imported, unless the person who starts the program says so."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import damian
from damian.common.errors import InputError
from damian.recipes import cli
from damian.recipes.command import main
from damian.recipes.shared.runs import stored_config
from damian.runs.loggers import LOGGERS

TINY = ["frames=64", "worlds=2", "learner.steps=16", "eval_episodes=2", "model.hidden=[4]", "logger=csv"]
TINY += ["region.lattice_step=90", "episode.max_steps=8", "learner.minibatches=1"]
MODULE = """
from pathlib import Path
Path(r'{}').touch()

class X:
    def __init__(self, folder):
        pass

    def log_scalar(self, name, value, step):
        pass
"""
SPELLINGS = ["evilmod:X", "'evilmod:X'", r"evilmod\:X", "[evilmod:X]", "' evilmod:X'", "str(evilmod:X)"]
SPELLINGS += ["evil-mod:X", "evilmod:", "evil${oc.env:NOWHERE,mod}:X", r"evil$\{oc.env:NOWHERE,mod\}:X"]
WORDS = [
    "learner={}",
    "learner.name={}",
    "+delay.obs={{law: {}}}",
    "delay.act={{law: lag, lag: {{law: {}}}}}",
]
WORDS += ["logger.custom=[{}]", "reward.custom=[{{term: {}}}]", "sensors=[{}]", "motion={}", "motion.kind={}"]
WORDS += ["sensors=[{{sensor: {}, name: y}}]", "region={}", "observation.local_features=[{}]"]
EVIL = "evilmod:X"
SETTINGS = {
    "learner.name": EVIL,
    "delay.rew": {"law": EVIL},
    "links": {"kind": "updown", "delay": {"law": EVIL}, "loss": 0.0},
    "logger.custom": ["os:remove"],
    "reward.custom": [{"term": "evil-mod:X"}],
    "observation.belief": [EVIL],
    "observation.global_features": [EVIL],
    "sensors": [{"sensor": EVIL, "name": "y"}],
    "motion.kind": "evilmod:",
    "region.kind": EVIL,
}
TABLE = "ID,source time,lat,lon,source spotted,track,takeoff-landing time,battery,AoI,FLA\n"
PROGRAMS = {
    "load": lambda: damian.load("run"),
    "export": lambda: main(["export", "run"]),
    "evaluate": lambda: main(["evaluate", "checkpoint=run", "hydra.run.dir=new"]),
    "fly": lambda: main(["fly", "checkpoint=run", "formats=[]", "hydra.run.dir=new"]),
    "advise": lambda: main(["advise", "checkpoint=run", "table=table.csv", "hydra.run.dir=new"]),
    "train": lambda: main(["train", "checkpoint=run", "hydra.run.dir=new"]),
    "resume": lambda: main(["train", "resume=run", "frames=96"]),
}


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Settings and record of a run of the current folder, beside modules that nobody has asked for."""
    folder = tmp_path_factory.mktemp("stranger")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        main(["train", *TINY, "hydra.run.dir=run"])
        for name in ("evilmod", "evil-mod", "mine"):
            Path(f"{name}.py").write_text(MODULE.format(folder / "imported"), encoding="utf-8")
        Path("table.csv").write_text(TABLE, encoding="utf-8")
        yield (
            Path("run/config.yaml").read_text(encoding="utf-8"),
            json.loads(Path("run/run.json").read_text(encoding="utf-8")),
        )


@pytest.fixture
def store(stored):
    """Write a setting, or words, into the run, as a stranger might; nothing of it is imported in the test."""
    config, record = stored

    def write(key: str | None = None, value: object = None, words: tuple[str, ...] = ()) -> None:
        changed = OmegaConf.create(config)
        if key is not None:
            OmegaConf.update(changed, key, value, merge=False, force_add=True)
        Path("run/config.yaml").write_text(OmegaConf.to_yaml(changed), encoding="utf-8")
        Path("run/run.json").write_text(
            json.dumps({**record, "overrides": [*record["overrides"], *words]}), encoding="utf-8"
        )

    write()
    yield write
    Path("imported").unlink(missing_ok=True)


def check_refuses(start, capsys, message="this run uses code outside DAMIAN (evil") -> None:
    """Assert that a program is refused for the code that settings name, which has not been imported."""
    capsys.readouterr()
    with pytest.raises((InputError, SystemExit)) as stopped:
        start()
    told = str(stopped.value) if isinstance(stopped.value, InputError) else capsys.readouterr().err
    assert message in told, told
    assert not {"evilmod", "evil-mod"} & {*sys.modules}
    assert not Path("imported").exists()
    assert not Path("new").exists()


@pytest.mark.parametrize("number", range(len(SPELLINGS)))
def test_no_word_of_a_stored_command_line_is_run_however_it_is_spelt(store, number, capsys):
    for word in WORDS[number % 6 :: 6]:
        store(words=(word.format(SPELLINGS[number]),))
        check_refuses(PROGRAMS["load"], capsys, "")


@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_no_program_runs_what_a_stored_run_names(store, number, capsys):
    name, start = [*PROGRAMS.items()][number]
    store(*([*SETTINGS.items()][number] if name == "resume" else ()), words=(WORDS[number].format(EVIL),))
    check_refuses(start, capsys)
    store("learner.name", EVIL)
    check_refuses(start, capsys)


@pytest.mark.parametrize("key", SETTINGS)
def test_no_stored_setting_is_run(store, key, capsys):
    store(key, SETTINGS[key])
    check_refuses(PROGRAMS["resume"], capsys, "this run uses code outside DAMIAN (")


def test_no_word_of_a_journal_is_run(store, capsys):
    about = {"overrides": ["region=llanbedr", "learner=[evilmod:X]", "delay.obs={law: evilmod:X}"]}
    head = {"journal": "damian-advice", "version": 3, "fleet": "north", "uavs": ["A"], "about": about}
    Path("north.jsonl").write_text(json.dumps(head) + "\n", encoding="utf-8")
    fly = ["fly", "journal=north.jsonl", "formats=[]", "hydra.run.dir=new"]
    check_refuses(lambda: main(fly), capsys, "north.jsonl: the fleet never began")


def test_comparisons_searches_and_tables_of_results_read_stored_runs_as_data(store, capsys):
    store("learner.name", EVIL)
    arms = "tasks: {{t: [agents=3]}}\narms: {{a: {{delayed: false, overrides: [{}]}}}}\n"
    Path("conf/experiment").mkdir(parents=True, exist_ok=True)
    Path("conf/experiment/x.yaml").write_text(
        arms.format(", ".join(f"'{word}'" for word in TINY)), encoding="utf-8"
    )
    shutil.copytree("run", "old/t/none/a/seed_0", dirs_exist_ok=True)
    words = ["compare", "--config-dir=conf", "experiment=x", "seeds=1", "hydra.run.dir=old"]
    check_refuses(lambda: main(words), capsys, "learner.name is evilmod:X in this stored run")
    main(["results", "run"])
    check_refuses(lambda: main(["tune", "checkpoint=run", "hydra.run.dir=new"]), capsys, "checkpoint: run")


PLAIN = {
    "hydra.searchpath=['file://evil']": None,
    "hydra.callbacks.x._target_=evilmod.X": None,
    "trust=true": None,
    "region.path=${oc.env:SECRET}": "is not an option or a plain value",
    r"region.path=$\{oc.env:SECRET\}": "is not an option or a plain value",
    "scenario=../../{here}/evil": "is not an option or a plain value",
    "learner={here}/evil:y": "is not an option or a plain value",
    "delay@hydra.x=paper": "is not an option or a plain value",
    "+hydra/launcher=evil": None,
}


@pytest.mark.parametrize("word", PLAIN)
def test_stored_words_are_plain_values_and_options_that_there_are_here(word):
    written = ["agents=2", word.format(here=Path.cwd()) if "{here}" in word else word]
    if (message := PLAIN[word]) is None:
        assert cli.stored_words(written, "train", "checkpoint") == ["agents=2"]
    else:
        with pytest.raises(InputError, match=message):
            cli.stored_words(written, "train", "checkpoint")


def test_a_stored_setting_is_not_resolved(store, monkeypatch):
    monkeypatch.setenv("SECRET", "secret")
    store("region", {"kind": "geojson", "path": "${oc.env:SECRET}"})
    assert stored_config(Path("run"), "checkpoint").region.path == "${oc.env:SECRET}"


def test_what_the_person_who_starts_the_program_names_or_trusts_is_imported(store):
    def imported(start) -> bool:
        """Is the module imported, as if it never was before?"""
        sys.modules.pop("mine", None)
        LOGGERS._imported.pop("mine:X", None)
        Path("imported").unlink(missing_ok=True)
        start()
        return Path("imported").exists()

    word = "logger.custom=[mine:X]"
    store("logger.custom", ["mine:X"], (word,))
    with pytest.raises(
        InputError, match=r"logger\.custom\.logger: this run uses code outside DAMIAN \(mine:X\)"
    ):
        imported(lambda: damian.load("run"))
    assert imported(lambda: damian.load("run", word))
    assert imported(lambda: damian.load("run", trust=True))
    assert imported(lambda: main(["train", "resume=run", "frames=96", word]))
    assert imported(lambda: main(["train", "resume=run", "frames=128", "trust=true"]))


def test_a_value_with_a_colon_is_no_name(store):
    park = {"type": "Feature", "properties": {"name": "park"}}
    corners = [[8, 45], [8.01, 45], [8.01, 45.008], [8, 45.008], [8, 45]]
    park["geometry"] = {"type": "Polygon", "coordinates": [corners]}
    Path("park.geojson").write_text(json.dumps(park), encoding="utf-8")
    words = ("region=geojson", "region.path=park.geojson", "region.where=name:park")
    store("region", {"kind": "geojson", "path": "park.geojson", "where": "name:park"}, words)
    _, env = damian.load("run")
    assert env.uav_env.scenario.region.where == "name:park"
