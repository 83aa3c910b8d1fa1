"""Episodes made by hand, whose every column a test chooses."""

import numpy as np
import shapely

from damian.show.episode import Episode

SQUARE = shapely.box(-200.0, -200.0, 200.0, 200.0)


def flight(n_steps=3, **changes):
    """An episode of two UAVs that stand still, of which the server knows the places; the source is
    silent."""
    t = n_steps + 1
    position = np.array([[-100.0, 100.0, 0.0], [100.0, 100.0, 0.0]])
    uavs = np.zeros((t, 2))
    flags = np.zeros((t, 2), bool)
    columns = {
        "time": np.arange(t) * 2.0,
        "position": np.tile(position, (t, 1, 1)),
        "target": np.tile(position[:, :2], (t, 1, 1)),
        "battery": uavs + 100,
        "source": np.tile([0.0, -120.0], (t, 1, 1)),
        "believed": np.tile(position[:, :2], (t, 1, 1)),
        **dict.fromkeys(("track", "age", "reward"), uavs),
        **{
            "spotted": flags,
            "sent": flags,
            "delay": uavs.astype(int),
            "emits": flags[:, :1],
        },
    }
    fixed = {
        "about": {},
        "region": SQUARE,
        "origin": None,
        "landing_points": np.array([[150.0, -190.0]]),
    }
    fixed |= {"radius": 50.0, "instant": True, "success": False}
    return Episode(**{**fixed, **columns, **changes})


NO_SOURCE = {
    "source": np.zeros((4, 0, 2)),
    "emits": np.zeros((4, 0), bool),
}
UNKNOWN_SOURCE = {"source": None, "emits": None}
"""Changes of a flight of three steps whose task has no source, and whose source nobody knows."""


def crowd(n_steps=3, **changes):
    """An episode of 20 UAVs, ten at each of two places."""
    few = flight(n_steps)
    names = "position target battery believed track age reward spotted sent delay"
    columns = {name: np.repeat(getattr(few, name), 10, axis=1) for name in names.split()}
    return flight(n_steps, **columns | changes)
