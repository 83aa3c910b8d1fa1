"""A run that was stopped and resumed equals one that never was: metrics, weights and results, bit
for bit."""

import itertools
import os
import random
import signal
from pathlib import Path

import pytest
from stopped_runs import SAC, TINY, check_equal, counted_updates, ended, files, forked, killed_after

WHOLE = [
    "delay=paper",
    "delay.obs.high=9s",
    "aware=backupdate+history",
    "delay.act=1",
    "motion=polynomial",
    "model.rnn=gru",
]
TRIGGERED = [
    "learner.steps=4",
    "clock.trigger=2s",
    "clock.longest=10s",
    "source.level_db=106",
    "delay.obs=2",
    "learner.normalize_value=true",
]
SLOW_CLOCKS = [
    "delay=paper",
    "delay.obs.high=9s",
    "clock.agents=2s",
    "clock.server=4s",
    "clock.system=16s",
]
SETS = ["model=sets", "observation.actions=true", "model.prior=true", "reward=coverage"]
SETS += ["learner.warm_up=2", "learner.anneal=true", "learner.team=0.5"]
CASES = {
    "recurrent": [
        "delay.obs=2",
        "aware=backupdate",
        "delay.act=1",
        "delay.history=2",
        "model.rnn=gru",
    ],
    "sac": [*SAC, "delay.obs=3", "aware=backupdate", "delay.loss=0.1"],
    "sac bursts": [*SAC, "scenario=tracking", "delay=burst", "delay.history=2"],
    "sets": [*SETS, "delay.obs=2", "aware=timeline", "model.rnn=gru"],
    "everything": [*WHOLE, "settle=true", "learner.steps=16", "frames=512"],
    "triggered": TRIGGERED,
    "slow clocks": [*SLOW_CLOCKS, "frames=512"],
    "lags": ["delay=lag", "delay.rew=2", "scenario=coverage", "region=random", "region.pool=2"],
    "matrix": ["links=matrix", "links.delay=2", "scenario=mixed", "actions=continuous"],
    "privileged": [
        "critic=privileged",
        "source.motion=dynamic",
        "observation.own=true",
        "delay.obs=2",
    ],
}
QUICK = ("sac",)


@pytest.mark.parametrize(
    "case",
    [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in CASES],
)
def test_a_run_that_was_stopped_twice_equals_one_that_never_was(run, case):
    words = [*TINY, *CASES[case]]
    whole = run(*words, folder="whole")
    with killed_after(2):
        run(*words, folder="other")
    with killed_after(7):
        run("resume=other", folder="unused")
    with counted_updates() as updates:
        other = run("resume=other", folder="unused").with_name("other")
    check_equal(whole, other)
    made = len((whole / "metrics.csv").read_text().splitlines()) - 1
    assert updates[0] <= made - 6  # 6 were in the checkpoint
    has_memory = case in ("recurrent", "sets", "sac", "sac bursts", "everything")
    assert any(name.startswith("replay/") for name in files(whole)) == has_memory


@pytest.mark.slow
def test_a_finished_run_that_goes_on_equals_a_longer_one(run):
    longer = run(*TINY, *SAC, "frames=384", folder="longer")
    run(*TINY, *SAC, "frames=192", folder="other")
    run("resume=other", "frames=384", folder="unused")
    check_equal(longer, longer.with_name("other"))


SMALL = [*TINY, "frames=512", "checkpoint_every=4", "episode.max_steps=6"]
LEARNERS = {"mappo": ["delay.obs=2", "aware=backupdate"], "sac": [*SAC, "delay.obs=2"]}
STOPPED = (0, 130, 143, -signal.SIGTERM, -signal.SIGKILL)
"""Exit codes of a run that has ended, or that a signal has stopped before, in or after its
training."""
STOPS = 20
STOPS_PER_RUN = 5


def run_through(words, folder, stop):
    """Start a run and resume it until it is finished; returns how often ``stop``, which starts it,
    did so."""
    for stops in range(STOPS_PER_RUN + 1):
        begun = Path(folder, "config.yaml").exists()
        again = (
            [f"resume={folder}", "hydra.run.dir=unused"]
            if begun
            else [*words, f"hydra.run.dir={folder}"]
        )
        code = stop(again) if stops < STOPS_PER_RUN else ended(forked(again))
        assert code in STOPPED, Path("output.txt").read_text("utf-8")[-2000:]
        if code == 0:
            return stops
    raise AssertionError("a run that nothing stops does not end")


def check_stopped_runs(words, whole, stop):
    """Stop runs until enough were stopped, and compare each with one that never was."""
    stops = runs = 0
    while stops < STOPS:
        stops += run_through(words, f"run_{runs}", stop)
        check_equal(whole, whole.with_name(f"run_{runs}"))
        runs += 1


@pytest.mark.slow
@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_killed_in_the_middle_of_writing_loses_nothing(run, learner):
    words = [*SMALL, *LEARNERS[learner]]
    moments = random.Random(learner)

    def stop(words):
        return ended(forked(words, lambda: kill_at_write(moments.randrange(40))))

    whole = run(*words, folder="whole")
    check_stopped_runs(words, whole, stop)


def kill_at_write(number):
    """Kill this process before the call of this number that makes a file last or gives it its
    name."""
    calls = itertools.count()
    for name in ("fsync", "replace", "unlink"):
        original = getattr(os, name)

        def call(*arguments, original=original, **options):
            if next(calls) == number:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*arguments, **options)

        setattr(os, name, call)
