"""The runs recorded from the original implementation, as transitions and as inputs of the
server."""

import itertools
from typing import Any, NamedTuple

import torch
from helpers import GOLDEN, nearest

from damian import UavEnv
from damian.server.config import ObservationConfig
from damian.server.features import ServerContext
from damian.server.rewards import Counters
from damian.world.messages import Messages

EPISODES = "episodes_usecase_settings"
PERSISTENT = "persistent_all_obs_weights_1"
CUMULATIVE = "cumulative_reward_size3_usecase_weights"

FEATURES = {
    "source distance": "source_distance",
    "source bearing": "source_bearing",
    "source drift": "source_drift",
    "source time": "source_time",
    "AVG agent-all distance": "mean_distance",
    "AVG agent-not_spotting_agents distance": "mean_distance_not_spotting",
    "AVG spotting_agents-source distance": "mean_distance_spotting",
    "current N spotting agents": "spotting_agents",
    "current agent spotted the source": "spotted",
    "agents distances": "agent_distances",
    "single-agent coverage area": "coverage",
}
"""Feature names of the original implementation, and of this project."""

TOLERANCE = 1e-4
"""Largest difference between a feature or a reward and the recorded one."""


class Transition(NamedTuple):
    """One recorded transition."""

    number: int
    """Number of the step in its run, from 1."""
    places: list
    """Positions of the UAVs before the step [m]."""
    motions: list
    """Motions of the UAVs since their latest detections, before the step."""
    detected: float | None
    """Step number of the latest detection that the server knows, before the step."""
    estimate: list | None
    """The server's estimate of the source position before the step [m]."""
    after: dict[str, Any]
    """The record after the step."""


def recorded(case, *kinds):
    """The recorded transitions of the given kinds of runs."""
    golden = GOLDEN[case]
    transitions = []
    start = golden["scenario"]["uav_start_positions"]
    no_detection = {"server": {"last_time": None, "est_pos": None}}
    first = no_detection | {"positions": start, "motions_counter_after": [0] * len(start)}
    for run in (run for kind in kinds for run in golden[kind]["sequences"]):
        for number, (old, new) in enumerate(itertools.pairwise([first, *run["steps"]]), start=1):
            transitions.append(
                Transition(
                    number,
                    old["positions"],
                    old["motions_counter_after"],
                    detection_step(old),
                    old["server"]["est_pos"],
                    new,
                )
            )
    return transitions


def detection_step(record):
    """Step number of the latest detection; the original stamps step k with k - 1, this project with
    k."""
    time = record["server"]["last_time"]
    return None if time is None else time + 1


def column(records, field):
    """A field of the records after M transitions, [M, N, ...]."""
    return torch.tensor([transition.after[field] for transition in records])


def set_state(env, records, places):
    """Set world m to the state before transition m, with the UAVs standing at ``places[m]``."""
    points = settings_points(env).tolist()
    goal = torch.tensor([[nearest(points, place) for place in world] for world in places])
    place = env.simulation.airspace.points[0][goal]
    detected = torch.tensor([[-1.0 if m.detected is None else m.detected] for m in records])
    estimate = (
        torch.tensor([[m.estimate or [0.0, 0.0]] for m in records])
        - env.simulation.airspace.offset[0]
    )
    state = env.state
    env.state = state._replace(
        steps=torch.tensor([m.number - 1 for m in records]),
        goal=goal,
        origin=goal,
        position=torch.cat([place, torch.zeros_like(place[..., :1])], -1),
        motions=torch.tensor([m.motions for m in records]),
        sent=state.sent._replace(
            detected_time=detected.expand(-1, env.n_agents).unsqueeze(-1).contiguous(),
            detected_position=estimate.expand(-1, env.n_agents, -1).unsqueeze(-2).contiguous(),
        ),
    )


def settings_points(env):
    """Landing points in the coordinates of the settings, which are those of the records, [L, 2]."""
    airspace = env.simulation.airspace
    return airspace.exact_points[0] + torch.tensor(airspace.regions[0].offset)


def ready_env(scenario, n_worlds):
    env = UavEnv(scenario, num_worlds=n_worlds)
    env.reset()
    return env


def server_inputs(case, records):
    """The server's inputs after each transition; every UAV reports the recorded estimate as its
    detection."""
    golden = GOLDEN[case]["scenario"]
    place = column(records, "positions")
    zeros = torch.zeros(place.shape[:-1])
    steps = [detection_step(m.after) for m in records]
    detected = torch.tensor([-1.0 if step is None else step for step in steps])
    estimate = torch.tensor([m.after["server"]["est_pos"] or [0.0, 0.0] for m in records])
    ids = golden["uav_ids"]
    flags = [[i in m.after["server"]["spotting_ids"] for i in ids] for m in records]
    number = torch.tensor([m.number for m in records])
    motions = torch.tensor([m.motions for m in records]) + 1
    blank = Messages.blank(torch.zeros(*zeros.shape, 2, dtype=torch.long))
    messages = blank._replace(
        time=zeros + number[:, None],
        position=place,
        target=place,
        battery=zeros + 100,
        spotted=torch.tensor(flags),
        motions=motions,
        detected_time=(zeros + detected[:, None])[..., None],
        detected_position=(zeros[..., None] + estimate[:, None])[..., None, :],
    )
    server = ServerContext(
        now=number.float(),
        scale=torch.full((len(records),), golden["max_distance_normaliser_m"]),
        time_scale=golden["time_max_normaliser"],
        observation=ObservationConfig(),
        points=torch.zeros(1, 2),
    )
    return messages, server, Counters(number, motions, torch.ones_like(messages.spotted))


def converted(name, value, detected):
    """A feature of the original in this project's convention: bearings clockwise from north."""
    if not detected or name not in ("source_bearing", "source_drift"):
        return value
    # A drift is the bearing relative to the track, which is 0 here, plus half a turn.
    return (0.25 - value) % 1.0 if name == "source_bearing" else (1.25 - value) % 1.0


def close(name, one, other):
    """Whether two values of a feature are equal within the tolerance; angles wrap around."""
    difference = abs(one - other)
    if name in ("source_bearing", "source_drift"):
        difference = min(difference, 1 - difference)
    return difference < TOLERANCE
