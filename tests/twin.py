"""The slow reference implementation (twin): one world, one UAV at a time, in plain Python."""

import math
from dataclasses import dataclass, field

import numpy as np
import shapely

from damian.server.config import EpisodeConfig, RewardConfig

LOCAL = ["battery", "spotted"]
GLOBAL = [
    "source_distance",
    "source_bearing",
    "source_drift",
    "source_time",
    "agent_distances",
    "coverage",
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
    "spotting_agents",
]
"""The features of the paper's Table 2."""
INDIVIDUAL = ("coverage", "spotted", "battery")
"""The terms of eq. 7; the others are those of eq. 6."""


@dataclass
class Uav:
    """The message that the server holds of one UAV: metres, seconds, radians clockwise from
    north."""

    place: tuple[float, float]
    point: int = 0
    track: float = 0.0
    battery: float = 100.0
    empty: bool = False
    spots: bool = False
    motions: int = 0
    """Motions since the latest detection before this message."""
    moved: int = 0
    """Motions since the latest detection, this message included."""
    heard_at: float | None = None
    heard_from: tuple[float, float] = (0.0, 0.0)


def features(uavs, now, scale, time_scale, resolution=5.0):
    """The features of the paper's Table 2 except the coverage: a list with one value for each
    UAV."""
    heard = [uav for uav in uavs if uav.heard_at is not None]
    source = None
    if heard:
        last = max(uav.heard_at for uav in heard)
        source = tuple(sum(uav.heard_from[axis] for uav in heard) / len(heard) for axis in (0, 1))
    table = {}
    for uav in uavs:
        others = [other for other in uavs if other is not uav]
        row = {
            "battery": math.floor(uav.battery / resolution + 1e-4) * resolution / 100,
            "spotted": float(uav.spots),
            "source_distance": 1.0,
            "source_bearing": 1.0,
            "source_drift": 1.0,
            "source_time": 1.0,
            "agent_distances": [near(uav.place, other.place, scale) for other in others],
            "spotting_agents": sum(other.spots for other in uavs) / len(uavs),
        }
        if source is not None:
            bearing = 0.0  # of a UAV that stands at the estimate
            if math.dist(source, uav.place) > 1e-3:
                bearing = math.atan2(source[0] - uav.place[0], source[1] - uav.place[1])
            row["source_distance"] = near(uav.place, source, scale)
            row["source_bearing"] = bearing % (2 * math.pi) / (2 * math.pi)
            row["source_drift"] = (bearing - uav.track + math.pi) % (2 * math.pi) / (2 * math.pi)
            row["source_time"] = min((now - last) / time_scale, 1.0)
        row["mean_distance"] = mean([math.dist(uav.place, u.place) / scale for u in others])
        both_silent = [u for u in others if not u.spots and not uav.spots]
        row["mean_distance_not_spotting"] = mean(
            [math.dist(uav.place, u.place) / scale for u in both_silent]
        )
        row["mean_distance_spotting"] = mean(
            [math.dist(u.place, source) / scale for u in uavs if u.spots]
        )
        for name, value in row.items():
            table.setdefault(name, []).append(value)
    return table


def near(one, other, scale):
    """Distance over the scale, at most 1."""
    return min(math.dist(one, other) / scale, 1.0)


def mean(values):
    """Mean, at most 1; 0 for an empty list."""
    return min(sum(values) / len(values), 1.0) if values else 0.0


def terms(values, motions, task):
    """The reward terms of one UAV (paper, eq. 6 and 7), times their weights (eq. 8)."""
    weighted = {}
    for name, value in values.items():
        weight = getattr(task, name) * (task.individual if name in INDIVIDUAL else task.system)
        if getattr(task, name) != 0:
            weighted[name] = weight * term(name, value, max(motions, 1), task)
    return weighted


def term(name, value, motions, task):
    """One reward term before its weight (paper, eq. 6 and 7)."""
    desired = {
        "spotting_agents": task.desired_spotting,
        "mean_distance": task.desired_distance,
        "mean_distance_not_spotting": task.desired_distance_not_spotting,
        "mean_distance_spotting": task.desired_distance_spotting,
    }
    if name in ("coverage", "battery"):
        return value
    if name == "spotted":
        return value / motions
    if name == "source_distance":
        return (1 - value) / motions
    if name in desired:
        return 1 - abs(desired[name] - value)
    if name == "source_drift" and task.drift == "smooth":
        return 1 - abs(2 * value - 1)
    if name == "source_drift":
        return 2 * value if value <= 0.5 else 1 - value
    return 1 - value


def end(uavs, steps, now, dt, episode):
    """Whether the episode ends: success, terminated, truncated."""

    def enough(share, flags):
        return sum(flags) >= max(share * len(flags), 1) - 1e-9

    success = failure = timeout = False
    if episode.success_share is not None:
        success = enough(episode.success_share, [u.spots for u in uavs])
    if episode.discharged_share is not None:
        failure = enough(episode.discharged_share, [u.empty for u in uavs])
    if episode.max_steps is not None:
        counted = steps
        if episode.since_detection:
            counted = (now - max([0.0, *[u.heard_at for u in uavs if u.heard_at is not None]])) / dt
        timeout = counted > episode.max_steps - 1e-3
    ended = success or failure
    return success, ended, timeout and not ended


def final(ended, steps, task):
    """Bonus or penalty at the end of an episode; 0 before."""
    success, terminated, truncated = ended
    if success:
        return task.bonus / steps if task.bonus_over_steps else task.bonus
    return -task.penalty if terminated or truncated else 0.0


def assign_landing_points(preferences, standing, ready):
    """Book points by preference, in index order; points that others hold or have booked are not
    free."""
    booked = []
    for i, preferred in enumerate(preferences):
        busy = {*booked, *standing[:i], *standing[i + 1 :]}
        own = standing[i]
        booked.append(next((p for p in preferred if p == own or p not in busy), own))
        if not ready[i]:
            booked[i] = own
    return booked


@dataclass
class World:
    """A world with instant motion and a static source, without batteries."""

    polygon: shapely.Geometry
    points: list
    source: tuple[float, float]
    radius: float
    scale: float
    time_scale: float
    dt: float
    task: RewardConfig
    episode: EpisodeConfig
    uavs: list[Uav]
    steps: int = 0
    ended: tuple[bool, bool, bool] = field(default=(False, False, False))

    def begin(self):
        """Let every UAV listen for the source at time 0."""
        for uav in self.uavs:
            self._listen(uav)

    def step(self, moves):
        """Fly each UAV's (distance [m], heading [rad]) and return each UAV's reward."""
        preferences = [self._preferences(*pair) for pair in zip(self.uavs, moves, strict=True)]
        standing = [uav.point for uav in self.uavs]
        self.steps += 1
        for uav, point in zip(
            self.uavs,
            assign_landing_points(preferences, standing, [True] * len(standing)),
            strict=True,
        ):
            self._move(uav, point)
            self._listen(uav)
        now = self.steps * self.dt
        self.ended = end(self.uavs, self.steps, now, self.dt, self.episode)
        observation = self.observe()
        end_reward = final(self.ended, self.steps, self.task)
        rewards = []
        for i, uav in enumerate(self.uavs):
            own = {
                name: values[i] for name, values in observation.items() if name != "agent_distances"
            }
            rewards.append(sum(terms(own, uav.motions, self.task).values()) + end_reward)
        return rewards

    def observe(self):
        """The features of all UAVs now."""
        return features(self.uavs, self.steps * self.dt, self.scale, self.time_scale)

    def _preferences(self, uav, move):
        """Landing points, nearest the target first; only the UAV's own point if the target is
        outside."""
        distance, heading = move
        target = (
            uav.place[0] + distance * math.sin(heading),
            uav.place[1] + distance * math.cos(heading),
        )
        if not shapely.contains_xy(self.polygon, *target):
            return [uav.point]
        return sorted(range(len(self.points)), key=lambda p: math.dist(self.points[p], target))

    def _move(self, uav, point):
        place = tuple(self.points[point])
        if point != uav.point:
            east, north = (b - a for a, b in zip(uav.place, place, strict=True))
            uav.track = math.atan2(east, north) % (2 * math.pi)
        uav.point = point
        uav.place = place
        uav.moved += 1

    def _listen(self, uav):
        uav.motions = uav.moved
        uav.spots = math.dist(uav.place, self.source) <= self.radius
        if uav.spots:
            uav.heard_at = self.steps * self.dt
            uav.heard_from = uav.place
            uav.moved = 0


def exact_share(polygon, positions, radius):
    """Exact coverage of one world by shapely, UAV by UAV: positions ``[N, n, 2]`` [m] ->
    ``[N]``."""
    discs = [[shapely.Point(p).buffer(radius, quad_segs=128) for p in uav] for uav in positions]
    shares = []
    for i, own in enumerate(discs):
        areas = []
        for k, disc in enumerate(own):
            excluded = [other[k] for j, other in enumerate(discs) if j != i] + own[k + 1 :]
            areas.append(disc.intersection(polygon).difference(shapely.union_all(excluded)).area)
        shares.append(np.mean(areas) / (math.pi * radius**2))
    return np.array(shares)
