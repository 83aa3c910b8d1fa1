"""A mistake in a component of one's own is one clear line as soon as the environment is built."""

from pathlib import Path

import pytest
import torch
import wrong
from helpers import same, square
from torchrl.envs.utils import check_env_specs

from damian import make_env
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.server.features import ObservationConfig
from damian.server.rewards import RewardConfig
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig

LINES = Path(wrong.__file__).read_text().splitlines()


def line(code: str) -> str:
    """The end of a message that blames the only line of ``wrong.py`` with this code."""
    (number,) = [number for number, text in enumerate(LINES, 1) if code in text]
    return f" (wrong.py, line {number})"


def check(changed: dict, message: str) -> None:
    """Assert that the environment of a changed scenario is refused with this message."""
    with pytest.raises(InputError) as error:
        make_env(square(**{name: make() for name, make in changed.items()}), 2)
    assert str(error.value) == message


LAW = "law wrong:Rush"


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (
            {"mistake": "raise"},
            f"delay.obs: {LAW}: RuntimeError: no signal" + line('RuntimeError("no\\n  signal")'),
        ),
        (
            {"mistake": "none"},
            f"delay.obs: the NoneType of sampler(dt, loss, key) of the {LAW} is no Sampler",
        ),
        (
            {},
            f"delay.obs: {LAW}: TypeError: Rush.__init__() missing 1 required positional argument: 'mistake'",
        ),
        (
            {"mistake": "typo"},
            f"{LAW}: AttributeError: 'MessageContext' object has no attribute 'tme'" + line("context.tme"),
        ),
        (
            {"mistake": "branch"},
            f"{LAW}: RuntimeError: Boolean value of Tensor with more than one value is ambiguous"
            + line("return context.time if"),
        ),
        (
            {"mistake": "compares", "start": "3s"},
            f"{LAW}: TypeError: '>' not supported between instances of 'Tensor' and 'str'"
            + line("(context.time > self.start).long()"),
        ),
        (
            {"mistake": "undeclared"},
            f"{LAW}: the context has no entry position: the sampler declares those that it has, reads=[]",
        ),
    ],
)
def test_a_mistake_in_a_law_is_one_line(written, message):
    law = {"law": "wrong:Rush", **written}
    check({"delay": lambda: DelayConfig(obs=law)}, message)
    if "delay.obs" not in message:
        check({"delay": lambda: DelayConfig(act=law)}, message)


def test_trying_a_law_changes_no_episode():
    law = {"law": "context_law:Crowd"}
    env = make_env(square(delay=DelayConfig(obs=law, act=law)), 2, seed=3, extras=["message"])
    torch.manual_seed(0)
    one = env.rollout(5)
    env.set_seed(3)
    torch.manual_seed(0)
    assert same(one, env.rollout(5))


def test_a_law_without_its_braces_is_told_how_to_write_it():
    for written in ("wrong:Rush", "uniform"):
        message = f"delay.obs: {written} is no delay; that law is written {{law: {written}}}"
        check({"delay": lambda written=written: DelayConfig(obs=written)}, message)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (
            {"sensor": "wrong:unmarked", "half": 20},
            "sensors[0].half: 20 is no parameter of wrong:unmarked, which has none; parameters stand after "
            "a *, as in (..., *, half: float = 3.0)",
        ),
    ],
)
def test_a_mistake_in_a_sensor_is_one_line(written, message):
    check({"sensors": lambda: [written]}, message)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "absent",
            "AttributeError: 'FeatureCache' object has no attribute 'message'" + line("cache.message.track"),
        ),
        ("divided", "[nan] is not finite"),
        ("mean_place", "is local, but depends on the messages of other UAVs: make it global"),
        ("single", "shape [8, 3] is not [8, 3, 2] = [initial conditions, UAVs, values]"),
    ],
)
def test_a_mistake_in_a_feature_is_one_line(name, message):
    message = f"feature wrong:{name}: {message}"
    check({"observation": lambda: ObservationConfig([f"wrong:{name}"])}, message)


def test_local_features_without_mistakes_are_not_refused(folder):
    names = ["wrong:flag", "features:heading", "sensor:wind_felt"]
    make_env(square(observation=ObservationConfig(names), sensors=["sensor:wind"]))


@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("name", ["flag", "precise"])
def test_observations_and_rewards_are_float32_whatever_a_component_returns(name, delay):
    parts = {"observation": ObservationConfig([f"wrong:{name}"], []), "delay": DelayConfig(obs=delay)}
    env = make_env(square(**parts, reward=RewardConfig(custom=[{"term": "wrong:exact"}])), 2)
    check_env_specs(env)
    assert {env.rollout(3)["next", "agents", key].dtype for key in ("observation", "reward")} == {
        torch.float32
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "undeclared",
            "reward term undeclared: KeyError: 'battery'" + line('features["battery"] + features'),
        ),
        ("scalar", "reward term scalar: a float is not a tensor"),
        ("hopeless", "reward term hopeless: [nan] is not finite"),
    ],
)
def test_a_mistake_in_a_reward_term_is_one_line(name, message):
    check({"reward": lambda: RewardConfig(custom=[{"term": f"wrong:{name}"}])}, message)
    observation = ObservationConfig(["spotted", "battery"])
    with pytest.raises(InputError) as error:  # also if another part of the scenario needs the feature
        make_env(square(observation=observation, reward=RewardConfig(custom=[{"term": f"wrong:{name}"}])))
    assert str(error.value) == message


def test_a_misspelt_feature_of_a_reward_term_names_the_term():
    terms = [{"term": "wrong:hopeless"}, {"term": "wrong:misspelt"}]
    with pytest.raises(
        InputError, match=r"^reward\.custom\[1\]\.term: reads of wrong:misspelt: batery is not"
    ):
        RewardConfig(custom=terms)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ("raise", "region.kind: wrong:park: KeyError: 'raise'" + line("return returned[config.options]")),
        ("polygon", "region.kind: wrong:park: a Polygon is not a list of at least one Region"),
        ("polygons", "region.kind: wrong:park: a list is not a list of at least one Region"),
        (
            "crossing",
            "region.kind: wrong:park: park: Self-intersection[100 100] [m]: edges must not cross",
        ),
        ("many", "region.initial_conditions: 8 for 9 regions: each needs at least one initial condition"),
    ],
)
def test_a_mistake_in_a_region_source_is_one_line(mistake, message):
    check({"region": lambda: RegionConfig("wrong:park", options=mistake, initial_conditions=8)}, message)


def test_a_region_source_with_other_arguments_is_one_line():
    message = "region.kind: wrong:no_arguments: TypeError: no_arguments() takes 0 positional arguments but 2 "
    check({"region": lambda: RegionConfig("wrong:no_arguments")}, f"{message}were given")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "KeyError: 'mistake'" + line("self.mistake = config")),
    ],
)
def test_a_mistake_in_a_motion_model_is_one_line(options, message):
    message = f"motion.kind: wrong:Flight: {message}"
    check({"motion": lambda: MotionConfig("wrong:Flight", options=options)}, message)


@pytest.mark.parametrize(
    ("decorator", "message"),
    [
        ("@sensor", "bare: write @damian.sensor() above it, with parentheses"),
        ("@feature", 'bare: write @damian.feature("local") above it, with parentheses'),
        (
            "@reward_term",
            "bare: write @damian.reward_term(reads=[...]) above it, with parentheses",
        ),
        (
            "@reward_term('battery')",
            "reads of a reward term: battery is not a list of names: write reads=['battery']",
        ),
    ],
)
def test_a_decorator_without_parentheses_or_with_one_name_is_one_line(decorator, message):
    with pytest.raises(InputError) as error:
        exec(f"from damian import *\n{decorator}\ndef bare(*given): ...")
    assert str(error.value) == message
