"""Messages of UAVs that take off, fly and land, against a slow reference (twin), and what flights
earn."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from helpers import KEEPS_GOING, REGIONS, act, fresh, random_actions, sent_messages, walking

from damian import ScenarioConfig
from damian.server.config import ObservationConfig, RewardConfig
from damian.world.config import MotionConfig


@dataclass
class FlyingUav:
    """What one UAV sends, one step at a time: metres, seconds."""

    level: float
    place: tuple
    motions: int = 0
    heard_at: float = -1.0
    heard_from: tuple = (0.0, 0.0)
    duration: float = 0.0
    elapsed: int = 10**6
    start: tuple = ()
    stopped: bool = False
    message: dict = field(default_factory=dict)
    stops: list = field(default_factory=list)
    """Time and place of each landing, or decision to hold, the newest first."""
    told: list = field(default_factory=list)
    """Those that it has told."""

    def choose(self, target, motion):
        """Begin to fly to a landing point, or to hold."""
        self.start = self.place
        self.place = target
        self.elapsed = 0
        self.duration = 0.0
        self.stopped = False
        self.motions += 1
        if self.start != target:
            phases = self.level, math.dist(self.start, target), self.level
            # A phase of degree 5 is limited by its largest speed or its largest acceleration.
            fast = 15 / 8 / motion.max_speed
            hard = 10 * math.sqrt(3) / 3 / motion.max_acceleration
            self.duration = sum(max(fast * length, math.sqrt(hard * length)) for length in phases)

    def listen(self, now, dt, source, radius):
        """Pass a step, and send a message on the ground or as the flight begins; returns if one is
        sent."""
        self.elapsed += 1
        landed = self.elapsed * dt >= self.duration
        if not landed and self.elapsed > 1:
            return False
        spotted = landed and math.dist(self.place, source) <= radius
        if landed and not (self.stops and self.stopped):
            self.stops = [(now, self.place), *self.stops]
            self.stopped = True
        if spotted:
            self.heard_at = now
            self.heard_from = self.place
        self.message = {
            "time": now,
            "position": self.place if landed else self.start,
            "target": self.place,
            "spotted": spotted,
            "motions": self.motions,
            "detected_time": [self.heard_at],
            "detected_position": [self.heard_from],
        }
        self.told = list(self.stops)
        self.motions = 0 if spotted else self.motions
        return True


def twins(env):
    """The UAVs of all worlds as they begin an episode."""
    levels = env.simulation.vehicles.levels.tolist()
    places = env.state.position[..., :2].tolist()
    worlds = [
        [FlyingUav(*uav) for uav in zip(levels, map(tuple, row), strict=True)] for row in places
    ]
    for world, source in zip(worlds, env.state.source[:, 0].tolist(), strict=True):
        for uav in world:
            uav.listen(0.0, env.simulation.dt, source, env.simulation.radius)
    return worlds


@pytest.mark.parametrize("sensing_time", [0.0, 2.5])
def test_messages_and_rewards_equal_those_of_the_twin(sensing_time):
    motion = MotionConfig(
        "polynomial", max_speed=20.0, max_acceleration=10.0, sensing_time=sensing_time
    )
    scenario = ScenarioConfig(
        region=REGIONS["fixed"],
        motion=motion,
        source=walking(level_db=136.0),
        reward=RewardConfig(spotted=1.0, spotting_agents=0.5),
        observation=ObservationConfig(global_features=["spotting_agents"], timeline=4),
        episode=KEEPS_GOING,
    )
    env = fresh(scenario, num_worlds=6)
    worlds = twins(env)
    begun = spotting = 0
    for step in range(1, 41):
        ready = env.simulation.vehicles.ready(env.state).tolist()
        output = act(env, random_actions(env))
        goals = env.simulation.points[env.state.goal].tolist()
        sent = sent_messages(output)
        told = output["agents", "message_sent"].tolist()
        for b, world in enumerate(worlds):
            source = env.state.source[b, 0].tolist()
            for n, uav in enumerate(world):
                if ready[b][n]:
                    uav.choose(tuple(goals[b][n]), motion)
                assert uav.listen(float(step), 1.0, source, env.simulation.radius) == told[b][n]
                for name, value in uav.message.items():
                    np.testing.assert_allclose(
                        getattr(sent, name)[b, n].tolist(), value, atol=1e-4, err_msg=name
                    )
                told_stops = zip(sent.landed[b, n].tolist(), sent.trail[b, n].tolist(), strict=True)
                for (time, point), stop in zip(told_stops, uav.told, strict=False):
                    assert (time, env.simulation.points[point].tolist()) == (
                        stop[0],
                        pytest.approx(stop[1]),
                    )
                begun += uav.message["position"] != uav.message["target"]
            spots = [uav.message["spotted"] for uav in world]
            shared = 0.5 * sum(spots) / len(world)
            own = [uav.message["spotted"] / max(uav.message["motions"], 1) for uav in world]
            reward = output["agents", "reward"][b, :, 0].tolist()
            assert reward == pytest.approx([each + shared for each in own])
            spotting += sum(spots)
    assert begun > 100
    assert spotting > 10
