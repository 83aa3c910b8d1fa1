"""Comparison with runs recorded from the original implementation in which messages were late.

The recorded messages pass a ``DelayLine`` with the recorded times of arrival, and the server node
computes features from what it then holds
(rewards and ends: ``tests/server/test_golden_rewards.py``). A recorded value that this project
computes differently is left out only for a named reason, whose condition is checked in the record
itself. Each test pins how many values were compared, and how many were left out for each reason.
"""

import itertools
import json
from collections import Counter
from functools import cache
from typing import Any, NamedTuple

import pytest
import torch
from golden_records import FEATURES, close, converted
from helpers import DATA, GOLDEN, usecase

from damian import ContextSampler, MessageContext, UavEnv
from damian.delays.line import DelayLine
from damian.server.config import ObservationConfig
from damian.world.messages import Messages

RUNS = json.loads((DATA / "delayed_runs.json").read_text())
"""By use case and kind, runs of up to 15 steps; each field has an entry for each step. The original
counts steps from 0, this project from 1, and the reset is at 0 in both."""

KINDS = ("p0.15_persistent", "p0.6_persistent", "p0.4_terminal_as_usecase")
"""Kinds of runs: the probability that a message is late, and whether episodes end."""

LONGEST = 7


class Step(NamedTuple):
    """A recorded step, and what our server holds after it."""

    run: dict[str, Any]
    number: int
    """Number of the step in its run, from 1."""
    held: Messages
    """The messages that the server holds, [N]."""

    @property
    def uavs(self):
        return range(len(self.recorded("positions")))

    def recorded(self, field):
        """What the record says of the step; None if episodes do not end and it lacks ``info``."""
        return self.run[field][self.number - 1] if field in self.run else None

    def observed(self, uav):
        """The recorded features of a UAV, by our names."""
        return dict(zip(self.run["features"], self.recorded("obs_global")[uav], strict=True))

    def reset_came_last(self, uav):
        """Whether the UAV's message of the reset was late, and arrived after its other messages so
        far."""
        now = self.number - 1
        first = self.run["reset_arrives_at"][uav]
        others = [
            arrival[uav] for arrival in self.run["arrives_at"][: self.number] if arrival[uav] <= now
        ]
        return 0 < first <= now and bool(others) and max(others) < first

    @property
    def lost_in_reset(self):
        """Whether the server of the original has replaced a newer message by a late one of the
        reset."""
        return any(map(self.reset_came_last, self.uavs))


def sent_messages(case, run):
    """What the UAVs of a run sent at its reset and in each step, [1 + T, N].

    As in the original, a UAV that hears nothing passes on the newest detection that the server has
    told of, if that is newer than its own.
    """
    start = GOLDEN[case]["scenario"]["uav_start_positions"]
    position = torch.tensor([start, *run["positions"]])
    spotted = torch.tensor([[0] * len(start), *run["spotting_true"]]).bool()
    time = torch.full(spotted.shape, -1.0)
    place = torch.zeros_like(position)
    told = (-1.0, [0.0, 0.0])
    for step, uav in itertools.product(range(1, len(time)), range(len(start))):
        own = (time[step - 1, uav].item(), place[step - 1, uav].tolist())
        newest = max(own, told, key=lambda detection: detection[0])
        if spotted[step, uav]:
            newest = (float(step), position[step, uav].tolist())
        time[step, uav], place[step, uav] = newest[0], torch.tensor(newest[1])
        if uav == len(start) - 1 and run["last_time"][step - 1] is not None:
            latest = (run["last_time"][step - 1] + 1.0, run["est_pos"][step - 1])
            told = max(told, latest, key=lambda detection: detection[0])
    blank = Messages.blank(torch.zeros(*spotted.shape, 2, dtype=torch.long))
    return blank._replace(
        time=torch.arange(len(time)).float().unsqueeze(-1).expand_as(time),
        position=position,
        spotted=spotted,
        battery=blank.battery + 100,
        detected_time=time.unsqueeze(-1),
        detected_position=place.unsqueeze(-2),
    )


def received_messages(case, run):
    """What the server holds after each step of a run, [T, N]: messages arrive as recorded."""
    first, *sent = sent_messages(case, run).pack()
    arrivals = ContextSampler(lambda context: context.entries["late"], LONGEST, loses=False)
    line = DelayLine(arrivals, "arrival")
    none = torch.zeros(len(first), dtype=torch.long)
    memory = line.init_memory([first], none)
    held = []
    for t, message in enumerate(sent):
        late = {"late": torch.tensor(run["arrives_at"][t]) - t}
        context = MessageContext(none, none, none, none, none, 1.0, late)
        memory, delivery = line.step(memory, [message], None, context)
        held.append(delivery.held[0])
    return Messages.unpack(torch.stack(held))


@cache
def replay(case, *kinds):
    """All recorded steps of some kinds of runs, with what our server holds after each."""
    steps = []
    for kind in kinds:
        record = RUNS[f"usecase{case}"][kind]
        names = [FEATURES[name] for name in record["observations_order"]]
        for run in record["sequences"]:
            held = received_messages(case, run)
            for t in range(len(run["positions"])):
                steps.append(
                    Step(run | {"features": names}, t + 1, Messages(*(part[t] for part in held)))
                )
    return steps


def held_by_server(steps):
    """What the server holds after M steps, [M, N], and the numbers of the steps, [M]."""
    held = Messages(*map(torch.stack, zip(*(step.held for step in steps), strict=True)))
    return held, torch.tensor([step.number for step in steps])


@pytest.mark.parametrize(
    ("case", "compared", "late_resets"),
    [
        (1, 181, 2),
        (2, 621, 9),
    ],
)
def test_the_server_holds_the_recorded_messages_but_for_late_ones_of_the_reset(
    case, compared, late_resets
):
    counts = Counter()
    for step in replay(case, *KINDS):
        for uav, place in enumerate(step.recorded("server_agent_pos")):
            late_reset = step.reset_came_last(uav)
            counts[late_reset] += 1
            ours = step.held.position[uav].tolist()
            assert (ours == pytest.approx(place, abs=1e-2)) is not late_reset, step
            if not late_reset:
                assert (
                    max(step.held.time[uav].item() - 1, 0)
                    == step.recorded("server_agent_sent_at")[uav]
                )
                assert step.held.spotted[uav].item() == (uav + 1 in step.recorded("spotting_ids"))
    assert counts == {False: compared, True: late_resets}


LATE_RESET = "a late message of the reset came last"
NOTHING_COVERED = "the newest position always covers nothing"
DIVIDED = "divided again for every further UAV"
ONCE = "a place that several UAVs report counts once"
NO_BEARING = "no bearing to where it stands"


def make_server(case):
    """The server of a use case that computes every recorded feature."""
    names = [FEATURES[name] for name in RUNS[f"usecase{case}"][KINDS[0]]["observations_order"]]
    names = [name for name in names if name not in ("spotted", "coverage")]
    observation = ObservationConfig(["spotted"], names, time_scale=14400.0)
    return UavEnv(usecase(case, observation=observation), extras=()).server


def reason_for_other_feature(step, name, uav):
    """Why a feature differs from the original's; None if it does not."""
    if step.lost_in_reset:
        return LATE_RESET
    if name == "coverage":
        return NOTHING_COVERED
    if (
        name == "source_time"
        and uav > 0
        and step.recorded("last_time") not in (None, step.number - 1)
    ):
        return DIVIDED
    detected = step.held.detected_time >= 0
    places = {tuple(place) for place in step.held.detected_position[detected].tolist()}
    if name in ESTIMATED and len(places) < detected.sum():
        return ONCE
    at_estimate = step.recorded("est_pos") == pytest.approx(
        step.recorded("server_agent_pos")[uav], abs=1e-2
    )
    if name in ("source_bearing", "source_drift") and at_estimate:
        return NO_BEARING
    return None


ESTIMATED = ("source_distance", "source_bearing", "source_drift", "mean_distance_spotting")
"""Features that depend on where the server believes the source to be."""


@pytest.mark.parametrize(
    ("case", "compared", "reasons"),
    [
        (1, 974, {NOTHING_COVERED: 181, NO_BEARING: 112, LATE_RESET: 14}),
        (
            2,
            4593,
            {
                ONCE: 672,
                NOTHING_COVERED: 603,
                LATE_RESET: 270,
                DIVIDED: 136,
                NO_BEARING: 26,
            },
        ),
    ],
)
def test_the_server_computes_the_recorded_features(case, compared, reasons):
    steps = replay(case, *KINDS)
    messages, numbers = held_by_server(steps)
    names = [name for name in steps[0].run["features"] if name != "coverage"]
    server = make_server(case)
    ours = {
        name: value.tolist() for name, value in server.features(messages, numbers, names).items()
    }
    counts = Counter()
    for m, step in enumerate(steps):
        for uav in step.uavs:
            for name, value in step.observed(uav).items():
                reason = reason_for_other_feature(step, name, uav)
                counts[reason] += 1
                if reason is None:
                    theirs = converted(name, value, step.recorded("est_pos") is not None)
                    assert close(name, ours[name][m][uav], theirs), (name, step, uav)
    assert counts.pop(None) == compared
    assert counts == reasons
