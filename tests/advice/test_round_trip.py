"""Simulated UAVs that report to the service, late and with losses, and fly where it sends them."""

import socket
import time
from multiprocessing import get_context
from pathlib import Path

import httpx2
import pytest
import torch
from reporting import START, Client, flown_by_clients, names_of
from starlette.testclient import TestClient
from test_fleet import TASKS, scenario_of
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.advice.desk import Desk
from damian.advice.fitting import fit, read_log, trace_rows
from damian.advice.fleet import Fleet
from damian.advice.ground import Ground
from damian.advice.node import Node
from damian.advice.service import make_app
from damian.baselines.greedy import greedy_policy
from damian.envs.pipeline import make_env
from damian.learners.mappo import MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.recurrent import add_recurrent_state
from damian.recipes.advise import AdviseConfig, make_desk, serve
from damian.runs.metrics import evaluate
from damian.server.rewards import RewardConfig

TOKEN = "a-token-of-the-service"
REWARD = RewardConfig(spotted=1.0)


def network(env):
    """A policy with random weights, the same for every environment of a scenario."""
    torch.manual_seed(7)
    return MappoConfig().make_actor(env, ModelConfig(hidden=[16]))


def recurrent(env):
    """The same with hidden states."""
    torch.manual_seed(7)
    actor = MappoConfig().make_actor(env, ModelConfig(hidden=[16], rnn="gru"))
    add_recurrent_state(env, actor)
    return actor


def served(scenario, policy_of, n_worlds: int, horizon: int, drawn: bool = False):
    """What episodes bring whose UAVs do as a service in this process tells them."""
    node = Node(scenario, 3)
    policy = policy_of(node.env)
    seeds = iter(range(n_worlds))
    desk = Desk(lambda uavs: Fleet(node, uavs, policy, drawn=drawn, seed=next(seeds)))
    now = [START]
    env = make_env(flown_by_clients(scenario), n_worlds, 3, extras=["message"])
    ground = Fleet(node, names_of(scenario.agents), policy).ground
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(make_app(desk, TOKEN, lambda: now[0]), headers=headers) as http:
        return evaluate(env, Client(env, ground, http, lambda time: now.__setitem__(0, time), START), horizon)


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("task", "policy_of"),
    [("late", greedy_policy), ("flights", greedy_policy), ("belief", network), ("flights", recurrent)],
)
def test_flights_by_the_service_are_those_of_the_simulation(task, policy_of):
    scenario = scenario_of(**TASKS[task], reward=REWARD)
    horizon = 40 if task == "flights" else 15
    simulated = evaluate(
        make_env(scenario, 3, 3, extras=["message"]), policy_of_env(policy_of, scenario), horizon, False
    )
    assert served(scenario, policy_of, 3, horizon) == simulated
    assert simulated.late > 0
    assert simulated.age > 0


def policy_of_env(policy_of, scenario):
    return policy_of(make_env(scenario, 1, 3, extras=["message"]))


def returns(env, policy, horizon: int, drawn: bool) -> torch.Tensor:
    """Steps in which UAVs truly spot the source in each world, as a mean over the UAVs, [B]."""
    mode = ExplorationType.RANDOM if drawn else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode), torch.no_grad():
        rollout = env.rollout(horizon, policy, break_when_any_done=False)
    messages = env.server.messages(rollout["next", "agents", "message"])
    return messages.spotted.float().mean(-1).sum(-1)  # what ``REWARD`` pays for, whatever came in


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def serving(config: AdviseConfig, folder: Path) -> None:
    """The service, in a process of its own."""
    torch.set_num_threads(1)
    serve(config, make_desk(config, folder))


@pytest.fixture
def service(tmp_path):
    """A service over HTTP, and the settings by which it flies."""
    given = scenario_of(**TASKS["belief"], reward=REWARD)
    settings = {
        name: getattr(given, name) for name in ("delay", "observation", "episode", "region", "source")
    }
    config = AdviseConfig(**settings, reward=REWARD, policy="greedy", port=free_port(), token=TOKEN, seed=3)
    process = get_context("spawn").Process(target=serving, args=(config, tmp_path / "journals"))
    process.start()
    yield config, tmp_path / "journals"
    process.terminate()
    process.join()


def until(time_: float) -> None:
    time.sleep(max(time_ - time.time(), 0.0))


@pytest.mark.slow
def test_flights_by_the_service_over_http_are_as_good_as_those_of_the_simulation(service, tmp_path):
    """In real time: a message that takes longer over loopback than the rest of its step is one step later."""
    config, journals = service
    n_worlds, horizon, scenario = 12, 25, config.eval_scenario
    simulated = make_env(scenario, n_worlds, config.seed, extras=["message"])
    expected = returns(simulated, greedy_policy(simulated), horizon, False)
    env = make_env(flown_by_clients(scenario), n_worlds, config.seed, extras=["message"])
    ground = Ground(env.uav_env.simulation.airspace, 100.0)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx2.Client(base_url=f"http://127.0.0.1:{config.port}", headers=headers, timeout=30) as http:
        for _ in range(300):
            try:
                http.get("/")
                break
            except httpx2.TransportError:
                time.sleep(0.1)
        client = Client(env, ground, http, until, 0.0)
        for reporter in client.reporters:
            reporter.start = round(time.time()) + 2.0
        found = returns(env, client, horizon, False)
    difference = found - expected
    spread = 1.96 * difference.std() / n_worlds**0.5
    assert abs(difference.mean()) <= spread + 1e-6
    assert expected.mean() > 1
    fitted = fit(read_log(journals / "f0.jsonl"))
    assert fitted.losses == "by their numbers"
    assert fitted.n_lost > 0
    assert max(float(row) for row in trace_rows(fitted, dt=1.0) if row != "lost") == 4
