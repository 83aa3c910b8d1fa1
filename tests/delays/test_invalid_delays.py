"""One line for each kind of mistake in a delay law, a trace, or a setting of delays."""

import math
from dataclasses import dataclass

import pytest
from delay_twin import ACTION, Crowd, delayed, trace
from helpers import square

from damian import ActionDelay, ObservationDelay, RewardDelay, TableSampler, make_env
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.delays.laws import LONGEST, Burst, Lag, Law, Uniform
from damian.delays.scenario import ScenarioDelays


def delays(**settings):
    """The delays of a scenario with these settings."""
    return ScenarioDelays(DelayConfig(**settings), LinkConfig(), 1.0)


INVALID_LAWS = [
    (
        -1,
        ": -1 is not a delay, which is a number of steps >= 0 (3), a time (3s, 2min), a range (1..7",
    ),
    ("3h", f": 3h is more than {LONGEST} steps"),
    ({"law": "gauss"}, ".law: gauss is not one of constant, uniform, geometric, burst, trace"),
    (
        {"law": "uniform", "high": 2.5},
        ".high: 2.5 is neither a number of steps >= 0 (3) nor a time (3s",
    ),
    ({"law": "burst", "bad": {"law": "burst"}}, ".bad: {'law': 'burst'} is not a memoryless law"),
    ({"law": "distance", "speed": math.nan}, ".speed: nan m/s is not above 0 m/s"),
    ("7..1", ": 7..1 is not a range of two numbers of steps"),
]


@pytest.mark.parametrize(("setting", "error"), INVALID_LAWS, ids=lambda value: str(value)[:50])
def test_an_invalid_law_raises_one_line_that_names_its_key(setting, error):
    with pytest.raises(InputError) as caught:
        delays(act=setting)
    assert str(caught.value).startswith(f"delay.act{error}")
    assert "\n" not in str(caught.value)


def test_links_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match=r"links.delay: 3 means nothing with links=server"):
        LinkConfig(delay=3)
    with pytest.raises(InputError, match=r"the links are given for 2 agents, but .* is of 3"):
        make_env(square(agents=3, links=LinkConfig("matrix", delay=[[0, 1], [1, 0]])))


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("when,late\n1,2\n", "line 1: no column delay"),
        ("delay\n2\n\n3\n-1\n", "line 5: delay: -1"),
        (None, "no such file"),
    ],
)
def test_an_invalid_trace_raises_one_line_that_names_the_file_and_the_line(tmp_path, text, error):
    file = tmp_path / "trace.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError) as caught:
        delays(obs={"law": "trace", "path": str(file)})
    assert str(caught.value).startswith(f"{file}: {error}")


@pytest.mark.parametrize("user", [Lag, lambda law: Burst(bad=law)])
def test_a_law_with_memory_or_context_is_refused_as_an_inner_law(user, tmp_path):
    for law in (trace(tmp_path, 1, 2), Lag(Uniform(1, 5)), Crowd()):
        with pytest.raises(InputError, match="is not a memoryless law"):
            user(law).sampler()


def test_losses_are_refused_where_a_reward_would_be_lost():
    for make in (lambda: delays(rew={"law": "burst"}), lambda: RewardDelay(Burst())):
        with pytest.raises(InputError, match="no reward may be lost"):
            make()


@dataclass(frozen=True)
class Lossless(Law):
    """A law that forgets the argument ``loss``."""

    def sampler(self, dt=1.0, loss=0.0, key="delay"):
        return TableSampler([[0.0, 1.0]])


def test_a_law_that_forgets_the_loss_is_refused():
    ObservationDelay(Lossless())
    with pytest.raises(InputError, match="delay: Lossless loses no message"):
        ObservationDelay(Lossless(), loss=0.1)


def test_a_law_that_reads_what_there_is_not_is_refused():
    with pytest.raises(InputError, match="has no key for position, which the delay law reads"):
        ObservationDelay(Crowd())
    with pytest.raises(
        InputError, match=r"delay.act: .* reads altitude, but a law can read only position"
    ):
        delays(act=Crowd("altitude"))
    env = delayed(ActionDelay(Crowd("seen"), ACTION, context_keys={"seen": "speed"}))
    with pytest.raises(InputError, match=r"ActionDelay: .*speed.* is not among the keys"):
        env.reset()
