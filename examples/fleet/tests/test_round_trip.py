"""Simulated UAVs that report to the service, late and with losses, and fly where it sends them."""

import pytest
import torch
from reporting import FREE, START, Client, flown_by_clients, names_of
from starlette.testclient import TestClient
from test_fleet import TASKS, scenario_of

from damian.envs.pipeline import make_env
from damian.field.node import Node
from damian.learners.config import MappoConfig, ModelConfig
from damian.learners.recurrent import add_recurrent_state
from damian.runs.metrics import evaluate
from damian.server.config import RewardConfig
from damian_fleet.fleet import Fleet
from damian_fleet.service import make_app
from damian_fleet.session import AdviceSession

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


def served(scenario, policy_of, n_worlds: int, horizon: int):
    """What episodes bring whose UAVs do as a service in this process tells them."""
    node = Node(scenario, 3)
    policy = policy_of(node.env)
    session = AdviceSession(lambda uavs, mark: Fleet(node, uavs, policy, rules=FREE, mark=mark))
    now = [START]
    env = make_env(flown_by_clients(scenario), n_worlds, 3, extras=["message"])
    ground = Fleet(node, names_of(scenario.agents), policy).ground
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(make_app(session, TOKEN, lambda: now[0]), headers=headers) as http:
        return evaluate(env, Client(env, ground, http, lambda time: now.__setitem__(0, time), START), horizon)


@pytest.mark.parametrize(("task", "policy_of"), [("belief", network), ("flights", recurrent)])
def test_flights_by_the_service_are_those_of_the_simulation(task, policy_of):
    scenario = scenario_of(**TASKS[task], reward=REWARD)
    horizon = 40 if task == "flights" else 15
    policy = policy_of(make_env(scenario, 1, 3, extras=["message"]))
    simulated = evaluate(make_env(scenario, 3, 3, extras=["message"]), policy, horizon, False)
    assert served(scenario, policy_of, 3, horizon) == simulated
    assert simulated.late > 0
    assert simulated.age > 0
