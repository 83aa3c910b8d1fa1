"""Shared test helpers: the paper's use cases without Hydra, small scenarios, and functions that
step them."""

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode
from twin import GLOBAL, LOCAL, Uav

from damian import ClockConfig, LearningSetup, ScenarioConfig, UavEnv, keys
from damian.models.config import MlpConfig
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import learning_env, make_learner, replay_buffer
from damian.runs.config import LoggerConfig
from damian.server.config import BUILT_IN, EpisodeConfig, ObservationConfig, RewardConfig
from damian.server.features import ServerContext
from damian.server.features.place import battery_settings
from damian.world.config import (
    ActionConfig,
    BatteryConfig,
    MotionConfig,
    RegionConfig,
    SourceConfig,
)
from damian.world.messages import Messages

DATA = Path(__file__).parent / "data"

GOLDEN = {case: json.loads((DATA / f"usecase{case}.json").read_text()) for case in (1, 2)}

SCALE, TIME_SCALE = 250.0, 60.0
"""In random worlds, distances [m] and times [s] are divided by these."""

SMALLEST_TRAINING = [
    "frames=64",
    "worlds=2",
    "learner.steps=16",
    "eval_episodes=2",
    "model.hidden=[4]",
    "region.lattice_step=90",
    "episode.max_steps=8",
    "learner.minibatches=1",
]
"""Words of the smallest training that makes two updates."""


def corners(west, south, east, north):
    """Corners of a rectangle, [x, y] each."""
    return [[west, south], [east, south], [east, north], [west, north]]


def ring(*bounds):
    """The same, closed."""
    open_ring = corners(*bounds)
    return [*open_ring, open_ring[0]]


SQUARE = corners(0.0, 0.0, 200.0, 200.0)
"""Corners of a square region of 200 m by 200 m, [x, y] in metres."""

DENTED = [
    [0, 0],
    [600, 0],
    [600, 400],
    [320, 400],
    [300, 240],
    [280, 400],
    [0, 400],
]
"""Corners of a region with a dent, which some straight ways cross."""


def usecase(case, **changed):
    """The paper's use case 1 or 2; ``changed`` replaces whole sections."""
    golden = GOLDEN[case]["scenario"]
    table = GOLDEN[case]["action_table"]
    distances = sorted({row["distance_m"] for row in table})
    headings = [row["heading_deg_input"] for row in table[: len(table) // len(distances)]]
    region = RegionConfig(
        kind="vertices",
        vertices=golden["polygon_vertices_ring"][:-1],
        lattice_step=golden["step_m"],
        lattice_angle=golden["deg"],
        initial_conditions=1,
        start_positions=golden["uav_start_positions"],
        start_together=case == 2,
    )
    observation = ObservationConfig(
        local_features=["spotted"],
        global_features=[] if case == 1 else ["source_distance"],
        ctde=case == 2,
        time_scale=golden["time_max_normaliser"],
    )
    task = RewardConfig(spotted=1.0, bonus=0.5)
    if case == 2:
        task = RewardConfig(spotted=0.05, source_distance=0.04, bonus=2.0, bonus_over_steps=True)
    sections = {
        "agents": len(golden["uav_start_positions"]),
        "region": region,
        "source": SourceConfig(
            level_db=golden["source_db"],
            microphone_db=golden["min_db_level"],
            position=golden["source_position"],
        ),
        "actions": ActionConfig(distances=distances, headings=headings, mask=False),
        "observation": observation,
        "reward": task,
        "episode": EpisodeConfig(
            max_steps=golden["max_episode_len"], success_share=golden["perc_needed"]
        ),
    }
    return ScenarioConfig(**(sections | changed))


def square(**changed):
    """Three UAVs that start on different points of a small square, with the source in its
    middle."""
    region = RegionConfig(kind="vertices", vertices=SQUARE, lattice_step=40.0, initial_conditions=8)
    sections = {
        "region": region,
        "source": SourceConfig(level_db=135.0, position=[100.0, 100.0]),
        "episode": EpisodeConfig(max_steps=6),
    }
    return ScenarioConfig(**(sections | changed))


def everything(motion="instant", kind="discrete", **changed):
    """A scenario with every feature, every reward term, a walking intermittent source and
    batteries."""
    in_order = getattr(changed.get("delay"), "order", "generation") == "generation"
    sections = {
        "region": RegionConfig(min_area=20_000, max_area=60_000, pool=3, initial_conditions=12),
        "motion": MotionConfig(kind=motion, max_speed=20.0, max_acceleration=10.0),
        "source": walking(emission="per_step", emission_probability=0.7),
        "battery": BatteryConfig(enabled=True, capacity_kwh=0.05, charging_power_kw=20.0),
        "actions": ActionConfig(kind=kind),
        "observation": ObservationConfig(LOCAL, GLOBAL, timeline=3 * in_order),
        "reward": RewardConfig(
            **dict.fromkeys(BUILT_IN, 0.5) | {"served": 0.0}, bonus=1.0, penalty=0.25
        ),
        "episode": EpisodeConfig(max_steps=8, success_share=1.0, discharged_share=1.0),
    }
    return ScenarioConfig(**(sections | changed))


def walking(**changed):
    """A source that leaves its first stop soon enough for a short test."""
    sections = {"level_db": 140.0, "motion": "dynamic", "min_wait": 1.0, "max_wait": 3.0}
    return SourceConfig(**(sections | {"local_distance": 15.0} | changed))


def tracking(emission):
    """Scenario sections of a task in which UAVs track a walking source."""
    return {
        "source": walking(emission=emission),
        "reward": RewardConfig(spotted=0.0, spotting_agents=0.5, source_drift=0.5, source_time=0.5),
        "observation": ObservationConfig(global_features=["source_drift", "source_bearing"]),
    }


KINDS = {
    "spotting": {"episode": EpisodeConfig(max_steps=5, success_share=0.5)},
    "tracking, emission per stop": tracking("per_stop"),
    "tracking, emission per step": tracking("per_step"),
    "coverage": {
        "reward": RewardConfig(spotted=0.0, coverage=1.0),
        "observation": ObservationConfig(global_features=["coverage", "agent_distances"]),
    },
    "energy": {
        "battery": BatteryConfig(enabled=True, capacity_kwh=0.2, charging_power_kw=40.0),
        "reward": RewardConfig(battery=0.5),
        "observation": ObservationConfig(local_features=["battery", "spotted"], ctde=True),
        "episode": EpisodeConfig(max_steps=5, discharged_share=0.5),
    },
    "mixed": {
        name: getattr(everything(), name)
        for name in ("source", "battery", "observation", "reward", "episode")
    },
}
"""Scenario sections of each kind of task."""

REGIONS = {
    "fixed": RegionConfig(
        kind="vertices", vertices=SQUARE, lattice_step=40.0, initial_conditions=4
    ),
    "pool": RegionConfig(min_area=20_000, max_area=60_000, pool=2, initial_conditions=8),
}


def random_actions(env, generator=None):
    """Uniform random actions, [B, N] discrete or [B, N, 2] continuous."""
    shape = (*env.batch_size, env.n_agents)
    if env.scenario.actions.kind == "continuous":
        return torch.rand(*shape, 2, generator=generator)
    return torch.randint(env.scenario.actions.n_actions, shape, generator=generator)


def act(env, action):
    """Step once without resets, and return the ``next`` entry."""
    td = TensorDict({"agents": {"action": action}}, env.batch_size)
    return env.step(td)["next"]


def play(env, choose, n_steps=None):
    """Step through episodes, resetting worlds that are done; return the output of every step and
    reset."""
    td = env.reset()
    shown = [td.clone()]
    for t in range(len(choose) if n_steps is None else n_steps):
        action = choose(t) if callable(choose) else choose[t]
        td = td.set(("agents", "action"), action)
        after, td = env.step_and_maybe_reset(td)
        shown += [after["next"].clone(), td.exclude(("agents", "action"))]
    return shown


def sent_messages(output):
    """The messages in an environment's output, unpacked into their fields."""
    return Messages.unpack(output["agents", "message"])


def same(one, other, atol=0.0):
    """Whether both have the same keys and equal values: bit for bit, or floats up to ``atol``."""

    def equal(a, b):
        is_near = atol > 0 and a.is_floating_point() and a.shape == b.shape
        return (
            torch.allclose(
                a,
                b,
                rtol=0,
                atol=atol,
            )
            if is_near
            else a.equal(b)
        )

    keys = {*one.keys(True, True)}
    return keys == {*other.keys(True, True)} and all(equal(one[key], other[key]) for key in keys)


def all_same(some, others, atol=0.0):
    """Whether both sequences are equal at every step: bit for bit, or floats up to ``atol``."""
    return len(some) == len(others) and all(
        same(*pair, atol) for pair in zip(some, others, strict=True)
    )


def saved_and_loaded(state):
    """A state after it was saved to a file and loaded from it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def clock(period):
    """A clock with a simulation step of ``period``."""
    return ClockConfig(simulation=period)


def nearest(points, place):
    """Index of the point nearest a place; of several, the lowest index."""
    return min(range(len(points)), key=lambda i: math.dist(points[i], place))


def random_worlds(seed, n_agents, heard, spots, n_worlds=4):
    """Random times and UAVs of the twin; a UAV without any detection does not spot the source
    either."""
    rng = np.random.default_rng(seed)
    worlds = []
    for _ in range(n_worlds):
        now = float(rng.uniform(0, 100))  # sometimes longer than the time scale
        uavs = []
        for _ in range(n_agents):
            place = tuple(rng.uniform(-150, 150, 2).astype(np.float32).tolist())
            uav = Uav(place, track=float(rng.uniform(0, 2 * math.pi)))
            uav.battery = float(rng.choice([0.0, 35.0, 100.0, rng.uniform(0, 100)]))
            uav.empty = uav.battery < 40
            if rng.random() < heard:
                uav.heard_at = float(rng.uniform(0, now))
                uav.heard_from = tuple(rng.uniform(-150, 150, 2).tolist())
            if uav.heard_at is not None and rng.random() < spots:
                uav.spots = True
                uav.heard_at = now
                uav.heard_from = place
            uavs.append(uav)
        worlds.append((now, uavs))
    return worlds


def messages_of(worlds):
    """The messages [B, N] and the server context of the twin's worlds."""

    def column(read, dtype=torch.float32):
        return torch.tensor([[read(uav) for uav in uavs] for _, uavs in worlds], dtype=dtype)

    place = column(lambda uav: uav.place)
    messages = Messages.blank(torch.zeros(*place.shape[:-1], 2, dtype=torch.long))._replace(
        position=place,
        target=place,
        track=column(lambda uav: uav.track),
        battery=column(lambda uav: uav.battery),
        spotted=column(lambda uav: uav.spots, torch.bool),
        empty=column(lambda uav: uav.empty, torch.bool),
        motions=column(lambda uav: uav.motions, torch.long),
        detected_time=column(lambda uav: [-1.0 if uav.heard_at is None else uav.heard_at]),
        detected_position=column(lambda uav: [uav.heard_from]),
    )
    server = ServerContext(
        now=torch.tensor([now for now, _ in worlds]),
        scale=torch.full((len(worlds),), SCALE),
        time_scale=TIME_SCALE,
        observation=ObservationConfig(),
        tables={battery_settings: BatteryConfig(resolution=5.0)},
        points=torch.zeros(1, 2),
    )
    return messages, server


MOTIONS = {
    "instant": MotionConfig(),
    "polynomial": MotionConfig("polynomial", max_speed=20.0, max_acceleration=10.0),
}
FLYING = MOTIONS["polynomial"]
KEEPS_GOING = EpisodeConfig(max_steps=None)

both_motions = pytest.mark.parametrize("motion", ["instant", "polynomial"])
both_kinds = pytest.mark.parametrize("kind", ["discrete", "continuous"])


def one_uav(**changed):
    """One UAV that starts near (60, 100) in a rectangle, too far to hear the source at
    (390, 100)."""
    region = RegionConfig(
        kind="vertices",
        vertices=corners(0.0, 0.0, 400.0, 200.0),
        initial_conditions=1,
        start_positions=[[60.0, 100.0]],
    )
    sections = {
        "agents": 1,
        "region": region,
        "source": SourceConfig(level_db=130.0, position=[390.0, 100.0]),
        "episode": KEEPS_GOING,
        "actions": ActionConfig(kind="continuous", distances=[0.0, 100.0]),
    }
    return ScenarioConfig(**(sections | changed))


def fresh(scenario, num_worlds=1, **options):
    """A new environment after its first reset."""
    env = UavEnv(scenario, num_worlds=num_worlds, **options)
    env.reset()
    return env


def learning(model, settle=0, **changed):
    """Setup of a learner that postpones learning from a step by ``settle`` steps."""
    setup = LearningSetup(model, 1, 1, 1, longest_delay=settle, settle=settle > 0)
    return setup._replace(**changed)


def check_refused(recipe, message, capsys):
    """Assert that a recipe ends with exit code 2 and one error line on stderr that contains
    ``message``."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        recipe()
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert message in error, error
    assert error.startswith("error: ")
    assert error.count("\n") == 1


def backupdating_learner(scenario, learner):
    """A learner of four worlds of a scenario, with back-updating, and its environment."""
    config = TrainConfig(
        **vars(scenario),
        learner=learner,
        model=MlpConfig(hidden=[16, 8]),
        logger=LoggerConfig(tensorboard=False),
        worlds=4,
        backupdate=True,
    )
    torch.manual_seed(0)
    env = learning_env(config)
    return make_learner(config, env, replay_buffer(config, env)), env


def log_prob_in_learning(actor, batch):
    """Log-probabilities of a batch's actions, as a loss computes them."""
    with set_recurrent_mode(True):
        return actor.get_dist(batch.clone()).log_prob(batch[keys.ACTION])
