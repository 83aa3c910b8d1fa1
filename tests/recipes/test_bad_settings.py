"""Bad settings are refused in one line; whatever is accepted builds and flies with finite numbers.

``make test-deep`` tries thousands of command lines; the schema itself says which settings there are.
"""

from unittest.mock import patch

import pytest
from fuzzing import SMALL, composed, examples, fly, refusal, settings_of, words
from hypothesis import given

from damian.recipes.command import _answered
from damian.recipes.compare import CompareConfig
from damian.recipes.shared.launch import checked

LEARNERS = {"mappo": SMALL, "sac": (*SMALL, "learner=sac")}


@pytest.mark.parametrize("learner", LEARNERS)
def test_every_number_has_bounds(learner):
    """The settings are found in the schema: a new one without a largest value fails here."""
    numbers = {"int": ["1" + "0" * 30, "-1" + "0" * 30], "float": ["1e30", "-1e30", "nan"]}
    has, accepted = composed("train", [], LEARNERS[learner]), []
    for key, setting in settings_of("train").items():
        section, _, name = key.partition(".")
        is_tried = name in has.learner if section == "learner" else learner == "mappo"
        for value in numbers.get(setting.kind.partition(" ")[0], []) if is_tried else []:
            line = refusal(
                [f"{key}={value}"], lambda given: checked(composed("train", given, LEARNERS[learner]))
            )
            accepted += [] if line and key in line else [f"{key}={value}: {line}"]
    assert accepted == []


REFUSED = [
    ("clock.simulation=1e9s", "clock.simulation: 1000000000.0 s is not between"),
    ("clock.simulation=1e-9s", "clock.simulation"),
    ("clock.agents=1e300s", "clock.agents"),
    ("actions.distances=[1e12]", "actions.distances: 1000000000000.0 m is not between 0 and 2e+07 m"),
    ("frames=1e5", "frames: 100000.0 is not written as a whole number; write 100000"),
    ("worlds=0.5", "worlds: 0.5 is not written as a whole number"),
    ("actions.distances=[0,50,50]", "actions.distances: 50.0 appears twice"),
    ("actions.headings=[nan]", "actions.headings: nan deg"),
    ("battery.charging_points=[[1e9,0]]", "is not within 2e+07 m of the origin"),
    ("battery.charging_points=7", "battery.charging_points"),
    ("battery.efficiency=1e-300", "battery.efficiency"),
    ("region.start_positions=[[9,9],[9,9],[50,50]]", "lead to the same landing point"),
    ("region.start_positions=abc", "region.start_positions"),
    ("source.min_stops=0", "source.min_stops: 0 is not at least 1"),
    ("source.position=[nan,0]", "source.position: [nan, 0] is not [x, y] in metres"),
    ("source.speed=1e300", "source.speed: 1e+300 m/s is not between"),
    ("observation.global_features=[source_time,source_time]", "source_time appears twice"),
    ("observation.local_features=[[]]", "observation.local_features: [] is not one of battery, spotted"),
    ("region.path=x.csv", "region.path: x.csv means nothing with region.kind=vertices"),
    ("region.id=X", "region.id: X means nothing with region.kind=vertices"),
    ("region.options={a: 1}", "region.options"),
    ("motion.options={a: 1}", "motion.options"),
    *(
        (f"reward.desired_{name}={value}", f"reward.desired_{name}: ")
        for name in ("spotting", "distance", "distance_not_spotting", "distance_spotting")
        for value in ("nan", "inf", "-3")
    ),
    ("reward.bonus=1e30", "reward.bonus: 1e+30 is not between"),
    ("learner.lr=1e6", "learner.lr: 1000000.0 is not between 0 and 1"),
    ("learner.clip_epsilon=1.5", "learner.clip_epsilon: 1.5 is not between 0 and 1"),
    ("delay.obs={law: burst, enter: true}", "delay.obs.enter: True is not between 0 and 1"),
    ("delay.obs={law: geometric, mean: 1e20}", "delay.obs.mean"),
    ("agents=1000000", "agents: 1000000 is not between 1 and 1000"),
    ("model.hidden=[" + ",".join("8" * 100) + "]", "model.hidden (number of layers): 100"),
    ("=3", "is not of the form KEY=VALUE"),
    ("@agents=-1", "is not of the form KEY=VALUE"),
    ("hydra.run.dir=", "hydra.run.dir: it is empty"),
    ("hydra.sweep.dir=''", "hydra.sweep.dir: it is empty"),
    ("~region=nan", "region: nan is not one of fir, geojson, llanbedr"),
    ("motion=[3]", "motion: [3] is not one of instant, polynomial"),
    ("agents=" + "9" * 5000, "agents: it has more than 4300 digits"),
    ("actions.distances.x=1", "actions.distances.x: no such key"),
    ("region.kind=\x1b[31m", "region.kind: Hydra cannot read"),
    ("motion.kind='\x1b[31m'", r"motion.kind: \x1b[31m is not one of instant, polynomial"),
    ("motion.kind=" + "x" * 5000, "x...xxxxxxxxxxxxxxxxxxxxxxxxx is not one of instant"),
]
"""Words that were accepted once, or ended in a traceback or in an obscure line; and what refuses them."""


@pytest.mark.parametrize(("word", "message"), REFUSED, ids=[word[:40] for word, _ in REFUSED])
def test_bad_values_are_refused(word, message):
    line = refusal([word], fly)
    assert line is not None
    assert message in line


def test_sacs_updates_have_a_limit():
    line = refusal(
        ["learner.updates=10000000000"], lambda given: checked(composed("train", given, LEARNERS["sac"]))
    )
    assert line == "learner.updates: 10000000000 is not between 1 and 1e+06"


def test_a_batch_has_a_limit():
    line = refusal(["worlds=1000000", "learner.steps=1000000"], fly)
    assert line.startswith("worlds: 1000000000000 environment steps between two updates is not between 1 and")


@examples(25, 4000)
@given(words("train"))
def test_any_words_are_refused_in_one_line_or_fly(given_words):
    refusal(given_words, fly)


@examples(15, 1000)
@given(words("compare"))
def test_any_words_of_a_comparison_are_refused_in_one_line_or_make_a_plan(given_words):
    def compare(given_words):
        config: CompareConfig = checked(composed("compare", given_words, ("experiment=usecase2",)), "compare")
        assert len(config.every_seed) <= 10_000

    refusal(given_words, compare, "compare")


@examples(12, 1000)
@given(words("train"))
def test_the_quick_look_at_any_words_ends_without_a_traceback(given_words):
    """``damian PROGRAM`` looks at its words before it loads torch; it prints help, refuses, or goes on."""
    with patch("sys.exit", lambda code: code):
        _answered("train", given_words)
