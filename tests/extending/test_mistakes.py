"""A mistake in a component of one's own is one clear line as soon as the environment is built."""

from pathlib import Path

import pytest
import torch
import wrong
from helpers import same, square

from damian import make_env
from damian.common.errors import InputError
from damian.delays.config import DelayConfig

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
            f"delay.obs: {LAW} returns a NoneType from sampler(dt, loss, key), not a Sampler",
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
            {"mistake": "undefined"},
            "Rush.undefined: [inf] is not a finite number of steps; a negative one means that the message is "
            "lost",
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
    for written, own in (("wrong:Rush", "a law of one's own"), ("uniform", "that law")):
        message = f"delay.obs: {written} is no delay; {own} is written {{law: {written}}}"
        check({"delay": lambda written=written: DelayConfig(obs=written)}, message)
