"""Walks of the source for tests, and their slow reference (twin): one walk at a time, in plain Python."""

import json
import math
from pathlib import Path

import numpy as np
import shapely
import torch

from damian.world.signal_source import SourceConfig, Walk, draw_walks

SCENARIO = json.loads((Path(__file__).parent / "data" / "usecase1.json").read_text())["scenario"]
USE_CASE = shapely.Polygon(SCENARIO["polygon_vertices_ring"])
DYNAMIC = SourceConfig(motion="dynamic")


def dynamic_walks(polygon=USE_CASE, n=8, seed=0, **settings_):
    config = SourceConfig(**({"motion": "dynamic", "after_walk": "stop"} | settings_))
    return draw_walks(polygon, config, n, np.random.default_rng(seed))


def in_double(walk):
    return Walk(*(x if x.dtype == torch.bool else x.double() for x in walk))


def n_stops(walk):
    return walk.arrive.isfinite().sum(1)


def twin_duration(length, speed, acceleration):
    """Duration of a leg: two ramps and a constant speed between them, or two ramps that meet."""
    if length == 0:
        return 0.0
    ramp = speed**2 / (2 * acceleration)
    if 2 * ramp >= length:
        return 2 * math.sqrt(length / acceleration)
    return 2 * speed / acceleration + (length - 2 * ramp) / speed


def twin_covered(length, speed, acceleration, elapsed, n=4000):
    """Integrate the speed, the least of rising, largest and falling speed, by the midpoint rule."""
    duration = twin_duration(length, speed, acceleration)
    end = min(max(elapsed, 0.0), duration)
    t = (np.arange(n) + 0.5) * end / n
    profile = np.minimum(np.minimum(acceleration * t, acceleration * (duration - t)), speed)
    return profile.sum() * end / n


def twin_position(walk, w, time):
    """Position [m] and latest stop of walk w at a time, by a search over its stops."""
    stop, arrive, depart, speed, acceleration = (x[w].tolist() for x in walk[:5])
    n = sum(math.isfinite(a) for a in arrive)
    k = max(i for i in range(n) if arrive[i] <= time)
    if k == n - 1 or time <= depart[k]:
        return stop[k], k
    length = math.dist(stop[k], stop[k + 1])
    share = twin_covered(length, speed[k], acceleration[k], time - depart[k]) / length
    return [a + share * (b - a) for a, b in zip(stop[k], stop[k + 1], strict=True)], k
