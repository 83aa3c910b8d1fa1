"""A run folder of a stranger is plain data: nothing in it is imported, resolved, composed or
followed."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from helpers import SMALLEST_TRAINING, ring

import damian
from damian.common.errors import InputError
from damian.common.fields import set_at
from damian.recipes.command import main
from damian.recipes.shared.runs import stored_config
from damian.runs.metrics_log import LOGGERS

TINY = [*SMALLEST_TRAINING, "logger=csv"]
MODULE = """
from pathlib import Path
Path(r'{}').touch()

class X:
    def __init__(self, folder):
        pass

    def log_scalar(self, name, value, step):
        pass
"""
SPELLINGS = [
    "evilmod:X",
    "'evilmod:X'",
    r"evilmod\:X",
    "[evilmod:X]",
    "' evilmod:X'",
    "str(evilmod:X)",
]
SPELLINGS += [
    "evil-mod:X",
    "evilmod:",
    "evil${oc.env:NOWHERE,mod}:X",
    r"evil$\{oc.env:NOWHERE,mod\}:X",
]
SETTINGS = {
    "learner.name": lambda name: name,
    "delay.rew": lambda name: {"law": name},
    "delay.act": lambda name: {"law": "lag", "lag": {"law": name}},
    "links": lambda name: {
        "kind": "updown",
        "delay": {"law": name},
        "loss": 0.0,
    },
    "logger.custom": lambda name: [name],
    "metrics": lambda name: [name],
    "reward.custom": lambda name: [{"term": name}],
    "observation.local_features": lambda name: [name],
    "observation.belief": lambda name: [name],
    "observation.global_features": lambda name: [name],
    "sensors": lambda name: [{"sensor": name, "name": "y"}],
    "motion.kind": lambda name: name,
    "region.kind": lambda name: name,
}
"""Settings that name code, by their keys."""
WORDS = [f"{key}={name}" for key in ("learner", "motion", "logger.custom") for name in SPELLINGS]
WORDS += [
    "hydra.searchpath=['file://evil']",
    "hydra.callbacks.x._target_=evilmod.X",
    "+hydra/launcher=evil",
]
WORDS += ["region.path=${oc.env:SECRET}", "scenario=../../evil", "trust=true", "agents=2"]
PROGRAMS = {
    "load": lambda: damian.load("run"),
    "export": lambda: main(["export", "run"]),
    "evaluate": lambda: main(["evaluate", "checkpoint=run", "hydra.run.dir=new"]),
    "fly": lambda: main(["fly", "checkpoint=run", "formats=[]", "hydra.run.dir=new"]),
    "train": lambda: main(["train", "checkpoint=run", "hydra.run.dir=new"]),
    "resume": lambda: main(["train", "resume=run", "frames=96"]),
}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A run of the current folder, beside modules that nobody has asked for."""
    folder = tmp_path_factory.mktemp("stranger")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        patch.setattr(sys, "argv", [])
        main(["train", *TINY, "hydra.run.dir=original"])
        for name in ("evilmod", "evil-mod", "mine"):
            Path(f"{name}.py").write_text(MODULE.format(folder / "imported"), "utf-8")
        yield Path("original")


@pytest.fixture
def store(original):
    """Write a setting into a copy of the run, as a stranger might; nothing is imported in the
    test."""
    shutil.rmtree("run", ignore_errors=True)
    shutil.copytree(original, "run")
    config = (original / "config.yaml").read_text("utf-8")

    def write(key=None, value=None):
        changed = yaml.safe_load(config)
        if key is not None:
            set_at(changed, key, value)
        Path("run/config.yaml").write_text(yaml.safe_dump(changed), "utf-8")

    yield write
    Path("imported").unlink(missing_ok=True)


def check_nothing_ran():
    assert not {"evilmod", "evil-mod"} & {*sys.modules}
    assert not Path("imported").exists()
    assert not Path("new").exists()


def check_refuses(start, capsys, message):
    """Assert that a program is refused in a line with this message, and that nothing was run or
    made."""
    capsys.readouterr()
    with pytest.raises((InputError, SystemExit)) as stopped:
        start()
    told = str(stopped.value) if isinstance(stopped.value, InputError) else capsys.readouterr().err
    assert message in told, told
    check_nothing_ran()


@pytest.mark.parametrize("key", SETTINGS)
def test_no_stored_setting_is_imported_however_it_is_spelt(store, key, capsys):
    for name in SPELLINGS if key == "learner.name" else SPELLINGS[:1]:
        store(key, SETTINGS[key](name))
        told = "this run uses code outside DAMIAN (evilmod:X)" if name == "evilmod:X" else ""
        check_refuses(PROGRAMS["load"], capsys, told)


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_program_imports_what_a_stored_run_names(store, name, capsys):
    store("learner.name", "evilmod:X")
    check_refuses(PROGRAMS[name], capsys, "this run uses code outside DAMIAN (evilmod:X)")


def test_stored_words_are_only_shown_and_stored_settings_not_resolved(store, monkeypatch):
    monkeypatch.setenv("SECRET", "secret")
    record = json.loads(Path("run/run.json").read_text("utf-8"))
    Path("run/run.json").write_text(json.dumps({**record, "overrides": WORDS}), "utf-8")
    _, env = damian.load("run")
    assert env.uav_env.scenario.agents == 3
    check_nothing_ran()
    store("region", {"kind": "geojson", "path": "${oc.env:SECRET}"})
    assert stored_config(Path("run"), "checkpoint").region.path == "${oc.env:SECRET}"


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", ["load", "export", "evaluate", "train", "resume"])
@pytest.mark.parametrize(
    "linked", ["config.yaml", "checkpoint.pt", "replay", "replay/000000.pt", "export"]
)
def test_links_in_a_run_folder_are_not_followed(store, name, linked, capsys):
    shutil.rmtree("outside", ignore_errors=True)
    Path("outside").mkdir()
    Path("outside/000007.pt").write_text("mine", "utf-8")
    link = Path("run", linked)
    if link.exists():
        link.rename(Path("outside", link.name))
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(Path("outside").absolute() / (link.name if link.suffix else ""))
    before = sorted(Path("outside").iterdir())
    check_refuses(PROGRAMS[name], capsys, f"{link} is a link, and links")
    assert sorted(Path("outside").iterdir()) == before
    assert Path("outside/000007.pt").read_text("utf-8") == "mine"


def test_comparisons_and_tables_of_results_read_stored_runs_as_data(store, capsys):
    store("learner.name", "evilmod:X")
    methods = "tasks: {{t: [agents=3]}}\nmethods: {{a: {{delayed: false, overrides: [{}]}}}}\n"
    Path("conf/experiment").mkdir(parents=True, exist_ok=True)
    Path("conf/experiment/x.yaml").write_text(
        methods.format(", ".join(f"'{word}'" for word in TINY)), "utf-8"
    )
    shutil.copytree("run", "old/t/none/a/seed_0", dirs_exist_ok=True)
    words = ["compare", "--config-dir=conf", "experiment=x", "seeds=1", "hydra.run.dir=old"]
    check_refuses(lambda: main(words), capsys, "learner.name is evilmod:X in this stored run")
    main(["results", "run"])


def test_what_the_person_who_starts_the_program_names_or_trusts_is_imported(store):
    def imported(start):
        """Is the module imported, as if it never was before?"""
        sys.modules.pop("mine", None)
        LOGGERS._components.pop("mine:X", None)
        Path("imported").unlink(missing_ok=True)
        start()
        return Path("imported").exists()

    word = "logger.custom=[mine:X]"
    store("logger.custom", ["mine:X"])
    with pytest.raises(
        InputError, match=r"logger\.custom\.logger: this run uses code outside DAMIAN .mine:"
    ):
        imported(lambda: damian.load("run"))
    assert imported(lambda: damian.load("run", word))
    assert imported(lambda: damian.load("run", trust=True))
    assert imported(lambda: main(["train", "resume=run", "frames=96", "trust=true"]))


def test_a_value_with_a_colon_is_no_name(store):
    park = {"type": "Feature", "properties": {"name": "park"}}
    park["geometry"] = {"type": "Polygon", "coordinates": [ring(8, 45, 8.01, 45.008)]}
    Path("park.geojson").write_text(json.dumps(park), "utf-8")
    store("region", {"kind": "geojson", "path": "park.geojson", "where": "name:park"})
    _, env = damian.load("run")
    assert env.uav_env.scenario.region.where == ["name:park"]
