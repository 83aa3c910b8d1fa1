"""An episode of ``damian fly`` for the viewer rerun (https://rerun.io): paths, beliefs, detections,
ages.

    pip install "damian[rerun]"
    damian fly scenario=tracking delay=paper "formats=[]" hydra.run.dir=runs/flight
    python examples/rerun_episode.py runs/flight/episode_0.json
    rerun runs/flight/episode_0.rrd
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from damian.common.plotting import COLOURS
from damian.show.episode import Episode


def save_recording(episode: Episode, path: Path) -> None:
    """Write an episode as a recording with the timeline ``time``.

    Entities are ``region``, ``landing_points``, ``source`` (large while it emits) and, for each
    UAV, in its colour: ``uavs/NAME`` with ``paths/NAME``, ``believed/NAME`` (where the server
    believes it to be, on the ground), ``detections/NAME`` (while it spots the source), and the
    scalars ``age/NAME`` [s] (of the message that the server holds), ``delay/NAME`` [steps] (of the
    message sent) and ``reward/NAME``.
    """
    rr: Any = import_module("rerun")
    recording = rr.RecordingStream("damian")
    time = rr.TimeColumn("time", duration=episode.time)
    recording.save(path)
    size = float(np.ptp(np.reshape(episode.region.bounds, (2, 2)), axis=0).max()) / 100
    rings = [on_ground(shapely.get_coordinates(ring)) for ring in shapely.get_rings(episode.region)]
    recording.log("region", rr.LineStrips3D(rings), static=True)
    points = rr.Points3D(on_ground(episode.landing_points), radii=size / 5)
    recording.log("landing_points", points, static=True)
    if episode.source is not None and episode.has_source:
        emits = np.zeros((len(episode.time), 1)) if episode.emits is None else episode.emits
        columns = {"positions": on_ground(episode.source[:, 0]), "radii": size * (1 + emits[:, 0])}
        recording.send_columns("source", [time], rr.Points3D.columns(**columns))
    for uav, name in enumerate(episode.names):
        colour = COLOURS[uav % len(COLOURS)]
        spotted = episode.spotted[:, uav]
        colour = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        position = episode.position[:, uav]
        path_of = rr.LineStrips3D([position], colors=[colour], radii=size / 10)
        recording.log(["paths", name], path_of, static=True)
        places = {
            "uavs": position,
            "believed": on_ground(episode.believed[:, uav]),
            "detections": position,
        }
        for kind, radius in {"uavs": size, "believed": size / 2, "detections": 2 * size}.items():
            style = {
                "colors": [colour],
                "labels": [name],
                "radii": [radius],
                "show_labels": kind == "uavs",
            }
            recording.log([kind, name], rr.Points3D.from_fields(**style), static=True)
            shown = spotted if kind == "detections" else np.ones_like(spotted)
            columns = rr.Points3D.columns(positions=places[kind][shown]).partition(
                shown.astype(int)
            )
            recording.send_columns(rr.new_entity_path([kind, name]), [time], columns)
        for kind, values in {
            "age": episode.age,
            "delay": episode.delay,
            "reward": episode.reward,
        }.items():
            columns = rr.Scalars.columns(scalars=values[:, uav])
            recording.send_columns(rr.new_entity_path([kind, name]), [time], columns)
    recording.flush()


def on_ground(places: Any) -> Any:
    """Places [*, 2] in space, [*, 3]."""
    return np.concatenate([places, np.zeros_like(places[..., :1])], -1)


if __name__ == "__main__":
    for word in sys.argv[1:]:
        save_recording(Episode.load(Path(word)), Path(word).with_suffix(".rrd"))
