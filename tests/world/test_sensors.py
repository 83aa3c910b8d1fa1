"""Readings of your own sensors equal those of a plain loop, and change nothing else in a
message."""

import torch
from helpers import both_motions, everything, random_actions
from hypothesis import given, strategies as st
from sensor_cases import GLOBAL, LOCAL, SENSORS, readings_of

from damian import UavEnv
from damian.server.config import ObservationConfig
from damian.world.messages import Messages, Widths


def sensing(motion="instant", **changed):
    """A scenario with everything, and with sensors and features of your own."""
    observation = ObservationConfig(["spotted", *LOCAL], ["source_distance", *GLOBAL])
    return everything(motion, **({"sensors": SENSORS, "observation": observation} | changed))


@both_motions
def test_readings_equal_those_of_a_loop_and_uavs_in_flight_keep_those_of_their_last_messages(
    motion,
):
    env = UavEnv(sensing(motion), num_worlds=4, seed=2)
    td = env.reset()
    expected = readings_of(env)
    kept = 0
    resets = 0
    for _ in range(30):
        read = env.server.messages(td["agents", "message"]).readings
        torch.testing.assert_close(read, expected, rtol=0, atol=1e-3)
        observation = td["agents", "observation"]
        assert observation[..., -2:].equal(read[..., :2].sin())
        assert observation[..., 1].equal(read[..., 2].amax(-1, keepdim=True).expand(4, 3))
        after, td = env.step_and_maybe_reset(td.set(("agents", "action"), random_actions(env)))
        sends = td["agents", "message_sent"]
        expected = torch.where(sends.unsqueeze(-1), readings_of(env), expected)
        kept = kept + int((~sends).sum())
        resets = resets + int(after["next", "done"].sum())
    assert resets > 0
    assert (kept > 50) == (motion == "polynomial")


@given(
    seed=st.integers(0, 2**32 - 1),
    window=st.integers(1, 5),
    n_readings=st.integers(0, 5),
    n_sources=st.integers(1, 3),
    shape=st.lists(
        st.integers(1, 3),
        min_size=1,
        max_size=3,
    ),
)
def test_unpacked_messages_equal_the_packed_ones(seed, window, n_readings, n_sources, shape):
    generator = torch.Generator().manual_seed(seed)
    widths = Widths(n_sources, n_readings)
    blank = Messages.blank(torch.randint(2**24, (*shape, window), generator=generator), widths)
    assert blank.readings.shape == (*shape, n_readings)

    def fill(field):
        numbers = torch.randint(2**24, field.shape, generator=generator)
        return numbers % 2 == 0 if field.dtype == torch.bool else numbers.to(field.dtype)

    messages = Messages._make(map(fill, blank))
    rows = messages.pack()
    again = Messages.unpack(rows, widths)
    for name, field in messages._asdict().items():
        assert getattr(again, name).equal(field), name
    assert rows[..., rows.shape[-1] - n_readings :].equal(messages.readings)
