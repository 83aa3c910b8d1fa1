"""Wrong input of the training recipe: one line that names the remedy, and no folder that is left behind."""

from pathlib import Path

import pytest
from helpers import check_refused

from damian.common.errors import InputError
from damian.recipes.shared.launch import perform
from damian.recipes.shared.leftovers import remember_folders
from damian.recipes.shared.settings import TrainConfig
from damian.recipes.shared.stored_runs import save_config


@pytest.mark.sample(6)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["agent=3"], "agent: no such key; did you mean agents?"),
        (["learner=ppo"], "learner: ppo is not one of bpql, mappo, predictive_mappo, sac"),
        (["learner.name=sac"], "learner.name: sac is not the learner of these settings"),
        (["algo=sac"], "algo: no such key; since damian 0.2 it is learner"),
        (["mappo.lr=1"], "mappo: no such key; since damian 0.2 it is learner"),
        (["+usecase=2"], "usecase: no such key; since damian 0.2 it is scenario=paper/usecase1"),
        (
            ["+delaybench=tracking"],
            "delaybench: no such key; since damian 0.2 it is scenario=delaybench/tracking",
        ),
        (
            ["region.situations=1"],
            "region.situations: no such key; since damian 0.2 it is region.initial_cond",
        ),
        (
            ["learner=sac", "recompute_actor=true", "backupdate=true"],
            "recompute_actor: True is for learner=mappo",
        ),
        (
            ["learner=sac", "learner.buffer_steps=100", "learner.warm_up=0"],
            "learner.buffer_steps: 100 steps is not at least",
        ),
        (
            ["learner=sac", "worlds=60", "learner.warm_up=200000"],
            "learner.warm_up: 200000 steps is not between",
        ),
        (["clock.skip=true", "model=gru"], "clock.skip: True does not go with model.rnn"),
        (
            ["clock.skip=true", "clock.skip_discount=0.5"],
            "clock.skip_discount: 0.5 is set to learner.gamma",
        ),
        (
            ["observation.own=true", "clock.server=2s", "clock.agents=2s"],
            "observation.own: True does not go",
        ),
        (
            ["learner=predictive_mappo", "delay=paper"],
            "learner: predictive_mappo needs backupdate=true and a",
        ),
        (
            ["learner=predictive_mappo", "delay.messages=4", "delay.rew=3", "aware=backupdate"],
            "learner: predictive_mappo needs backupdate=true and a message delay",
        ),
        (
            ["learner=predictive_mappo", "delay=paper", "aware=backupdate"],
            "learner: predictive_mappo reads no messages: set delay.messages",
        ),
        (
            ["learner=predictive_mappo", "delay=paper", "aware=backupdate", "model=gru"],
            "model.rnn: gru does not go with learner=predictive_mappo",
        ),
        (
            ["learner=predictive_mappo", "delay=paper", "aware=backupdate", "delay.act=${delay.obs}"],
            "learner: predictive_mappo needs a constant action delay (delay.act)",
        ),
        (["learner=predictive_mappo", "learner.heads=0"], "learner.heads: 0 is not between 1 and 1024"),
        (["delay.messages=4"], "delay.messages: 4 is not read by learner=mappo; choose learner=predictive"),
        (
            ["delay.reward_discount=0.5"],
            "delay.reward_discount: 0.5 means nothing with delay.reward_window=1",
        ),
        (["delay.messages=4", "links=matrix"], "delay.messages: 4 does not go with links=matrix"),
        (
            ["learner=sac", "learner.warm_up=300000"],
            "learner.warm_up: 300000 is not between 0 and 200000",
        ),
        (
            ["learner=sac", "learner.warmup=1"],
            "learner.warmup: no such key; did you mean learner.warm_up?",
        ),
        (["learner.lrr=1"], "learner.lrr: no such key; did you mean learner.lr?"),
        (["+motion.foo=1"], "motion.foo: no such key"),
        (["+delay.foo=3"], "delay.foo: no such key"),
        (["delay.obs=-3"], "delay.obs: -3 is neither whole steps such as 3 nor a time such as 3s"),
        (["delay.act=3.5"], "delay.act: 3.5 is neither whole steps"),
        (
            ["delay=paper", "delay.obs.enter=0.1"],
            "to write another law, choose delay=none first",
        ),
        (["delay=papers"], "delay: papers is not one of burst, distance, lag, none, paper"),
        (["delay=paper", "delay.obs.high=1s"], "delay.obs.low: 3s and high=1s are not two"),
        (["delay.obs={law: poisson}"], "delay.obs.law: poisson is not one of constant, uniform"),
        (["delay.obs={law: trace, path: nowhere.csv}"], "nowhere.csv: no such file"),
        (["agents=two"], "agents: Value 'two'"),
        (["agents=0"], "agents: 0 is not between 1 and 1000"),
        (["reward=foo"], "reward: foo is not one of coverage, energy"),
        (
            ["scenario=paper/usecase3"],
            "scenario: paper/usecase3 is not one of coverage, delaybench/coverage",
        ),
        (["motion.degree=4"], "motion.degree: 4 is not one of 3, 5, 7"),
        (["clock.agents=1.5s"], "clock.agents: 1.5s is not a multiple of clock.simulation=1s"),
        (["clock.server=soon"], "clock.server: soon is not a time"),
        (["agents=600", "motion.max_level=900"], "agents: 600 UAVs need as many landing points"),
        (["agents=60", "motion=polynomial"], "leaves room for 39 flight levels"),
        (
            ["motion=polynomial", "motion.min_level=1900", "motion.max_level=2000"],
            "is not between 0 and 1828.8 m",
        ),
        (["region.id=Nope"], "Nope"),
        (["region=fir"], "region.path: it is missing"),
        (["region=geojson", "region.path=nowhere.json"], "nowhere.json"),
        (["region=vertices", "region.vertices=[[0,0],[1,1]]"], "region.vertices"),
        (["source.position=[1,2,3]"], "source.position: [1, 2, 3] is not [x, y] in metres"),
        (["region.start_positions=[[0,0]]"], "region.start_positions: 1 places"),
        (["source.emission=per_stop"], "needs source.motion=dynamic"),
        (
            ["worlds=7", "learner.steps=3", "learner.minibatches=22"],
            "learner.minibatches: 22 is not between 1 and 21",
        ),
        (["clock.longest=8s"], "clock.longest: 8s means nothing without clock.trigger"),
        (["clock.trigger=2s", "clock.shortest=64s"], "clock.system: 32 steps is out of clock.shortest"),
        (["recompute_actor=true"], "recompute_actor: True means nothing without backupdate=true"),
        (
            ["links=updown", "delay=paper", "backupdate=true", "recompute_actor=true"],
            "recompute_actor: True does not go with links=updown",
        ),
        (["links=matrix", "links.hears=[[true]]"], "links.hears: 1 x 1 is not 3 x 3"),
        (["links.delay=3"], "links.delay: 3 means nothing with links=server"),
        (["settle=true", "backupdate=true", "delay.obs=32"], "settle: True needs more than 32 steps"),
        (["checkpoint=nowhere"], "checkpoint: nowhere"),
        (["device=abacus"], "device: abacus"),
        (["collector=threads"], "collector: threads is not one of sync, process, ray"),
        (["workers=2"], "workers: 2 means nothing with collector=sync; choose process or ray"),
        (["collector=process", "workers=3"], "workers: 3 does not divide worlds=64: every worker has as"),
        (["collector=process", "workers=0"], "workers: 0 is not between 1 and 1024"),
        (["device=meta"], "device: meta is not one of the devices here: cpu"),
        (["source.level_db=1e4"], "source.level_db: 10000.0 dB is not between"),
        (["frames=1" + "0" * 400], "frames: "),
        (["worlds=8192", "delay.obs=10000"], "delay.obs: 10000 needs "),
        (["worlds=1000000000000"], "worlds: 1000000000000 is not between 1 and 1e+06"),
        (["model.hidden=[100000000000]"], "model.hidden: 100000000000 is not between"),
        (["motion.max_speed=1e-300"], "motion.max_speed: 1e-300 m/s is not at least 0.001 m/s"),
        (["reward=3"], "reward: 3 is not one of coverage, energy"),
        (["learner=null"], "learner: null is not one of bpql, mappo, predictive_mappo, sac"),
        (["region.pool=64"], "region.pool: 64 means nothing with region.kind=fir"),
        (["episode.discharged_share=0.5"], "episode.discharged_share: 0.5 needs battery.enabled"),
        (["episode.end_with_source=true"], "episode.end_with_source: True needs source.motion"),
        (
            ["region=vertices", "region.vertices=[[0,0],[5e4,0],[5e4,4e4],[0,4e4]]"],
            "more than 4 GB: raise region.lattice_step",
        ),
        (["-m", "seed=-1,0", "hydra.sweep.dir=sweep"], "seed: -1 is not between"),
        (["-m", "resume=nowhere", "frames=1,2", "hydra.sweep.dir=sweep"], "leave out -m"),
        (["resume=nowhere"], "nowhere holds no config.yaml"),
        (["-m", "seed=0,x"], "seed: Value 'x'"),
        (["seed=0,1"], "seed: several values need -m"),
        (
            ["delay.obs={law:", "uniform,", "low:", "3s}"],
            'a mapping needs quotes, such as "delay.obs={law: uni',
        ),
        (["delay.obs={law: uniform"], "a mapping needs quotes, such as"),
        (["agents"], "agents: this word is not of the form KEY=VALUE"),
        (["sensors=geiger:counts"], "sensors: it is a list: [geiger:counts]"),
        (["reward.custom={component: a:b}"], "reward.custom: it is a list: [{component: a:b}]"),
        (["model.hidden=8"], "model.hidden: it is a list: [8]"),
        (["experiment=usecase2"], "experiment: no such key"),
        (["resume=nowhere", "agents=4"], "agents=4: a resumed run keeps its configuration"),
    ],
)
def test_wrong_input_is_refused_in_one_line_and_leaves_no_folder(run, capsys, tmp_path, overrides, message):
    check_refused(lambda: run(*overrides), message, capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kept", [None, "checkpoint.pt", "metrics.csv", "notes.txt"])
def test_a_run_that_is_refused_before_its_first_step_leaves_no_folder(tmp_path, monkeypatch, kept):
    monkeypatch.chdir(tmp_path)
    remember_folders([])
    folder = tmp_path / "runs" / "sweep" / "seed=0"
    folder.mkdir(parents=True)
    (folder.parent / "multirun.yaml").touch()

    def program(config: TrainConfig, folder: Path) -> None:
        save_config(config, folder)
        (folder / "events.out.tfevents.1").touch()
        if kept:
            (folder / kept).touch()
        raise InputError("wrong")

    with pytest.raises(InputError, match="wrong"):
        perform(TrainConfig(), folder, program)
    assert {path.name for path in tmp_path.iterdir()} == ({"runs"} if kept else set())
    assert folder.exists() == bool(kept)


def test_files_that_lay_in_the_folder_before_are_kept(tmp_path):
    (tmp_path / "events.out.tfevents.1").touch()

    def program(config: TrainConfig, folder: Path) -> None:
        raise InputError("wrong")

    with pytest.raises(InputError, match="wrong"):
        perform(TrainConfig(), tmp_path, program)
    assert (tmp_path / "events.out.tfevents.1").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("agents: 2\n", "scenario: begin scenario/mine.yaml with the line # @package _global_"),
        ("# @package _global_\nagents: 2\n\tseed: 3\n", "mine.yaml, line 3, column 1: found character"),
        ("# @package _global_\nagents: [2\n", "mine.yaml, line 3, column 1: expected ',' or ']'"),
        ("# @package _global_\nmodel: {hidden: 8}\n", "model.hidden: it is a list: [...]"),
    ],
)
def test_a_mistake_in_a_file_of_ones_own_is_one_line(run, capsys, tmp_path, text, message):
    (tmp_path / "own" / "scenario").mkdir(parents=True)
    (tmp_path / "own" / "scenario" / "mine.yaml").write_text(text)
    check_refused(lambda: run("--config-dir=own", "scenario=mine"), message, capsys)


def test_a_sweep_is_no_run(run, capsys, tmp_path):
    (tmp_path / "swept" / "seed=0").mkdir(parents=True)
    (tmp_path / "swept" / "multirun.yaml").touch()
    for key in ("checkpoint", "resume"):
        message = f"{key}: swept is a sweep: give one of the folders in it"
        check_refused(lambda key=key: run(f"{key}=swept"), message, capsys)


BROKEN = """
from dataclasses import dataclass
from damian.learners.mappo import MappoConfig

@dataclass
class BrokenConfig(MappoConfig):
    sign: int = 3

    def __post_init__(self):
        if self.sign != 3:
            "three" + self.sign

@dataclass
class NeverConfig(BrokenConfig):
    sign: int = 4
"""


@pytest.mark.parametrize(
    "words",
    [["learner=unmade:NeverConfig"], ["learner=unmade:BrokenConfig", "learner.sign=4"]],
    ids=["when it is made", "when it gets its values"],
)
def test_the_traceback_of_an_exception_of_ones_own_code_can_be_shown(run, capsys, monkeypatch, words):
    Path("unmade.py").write_text(BROKEN)
    hint = "(DAMIAN_TRACEBACK=1 shows the traceback)\n"
    check_refused(lambda: run(*words), 'can only concatenate str (not "int") to str ' + hint, capsys)
    monkeypatch.setenv("DAMIAN_TRACEBACK", "1")
    with pytest.raises(SystemExit):
        run(*words)
    printed = capsys.readouterr().err
    assert '"three" + self.sign' in printed
    assert printed.splitlines()[-1].startswith("error: ")
    assert hint not in printed


@pytest.mark.parametrize("word", ["agents=two", "region=3", "agnts=3", "agents=0", "checkpoint=nowhere"])
def test_wrong_input_needs_no_traceback(run, capsys, word):
    with pytest.raises(SystemExit):
        run(word)
    assert "traceback" not in capsys.readouterr().err
