"""What actions offer, and the newest detections, equal the script's numbers and plain loops."""

import math

import pytest
import torch

from damian import keys, make_env
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.envs.config import ScenarioConfig
from damian.recipes.shared.environments import compose_scenario
from damian.server.config import ObservationConfig
from damian.world.config import ActionConfig

BATTERY = "battery=charging"
SEARCH = ["scenario=search_and_rescue", "source.count=2"]


def observed(env, steps):
    """By name, what the actions of each UAV offer, [B, T, N, A]."""
    block = env.layout["observation"]["actions"]
    values = block.of(steps["next"][keys.OBSERVATION])
    return dict(zip(block.entries, values.unbind(-1), strict=True))


def roll(words, n_steps=12, policy=None):
    """A rollout of a scenario whose actors observe actions, and its environment."""
    words = [*words, "observation.actions=true", "region.initial_conditions=16"]
    scenario = compose_scenario(*words)
    env = make_env(scenario, 4, seed=3, extras=["message", "state"])
    chosen = script_policy(env) if policy == "script" else None
    with torch.no_grad():
        return env, env.rollout(n_steps, chosen, break_when_any_done=False)


@pytest.mark.parametrize(
    "words",
    [
        ["scenario=delaybench/crowded", "agents=5"],
        ["scenario=delaybench/crowded", "delay.obs=1..4", "observation.own=true"],
        ["scenario=patrol", "observation.window=4"],
    ],
)
def test_the_script_finds_the_same_new_ground_in_turn(words):
    env, steps = roll(words, policy="script")
    script = script_policy(env).module
    offers = observed(env, steps)
    last = steps["next"][:, -1]
    held = script.unpack(last[keys.RECEIVED if keys.RECEIVED in last.keys(True) else keys.MESSAGE])
    own = script.unpack(last[keys.MESSAGE]) if env.uav_env.scenario.observation.own else held
    ground = env.uav_env.simulation.airspace.points
    near = torch.cdist(ground, ground).nan_to_num(nan=torch.inf) <= script.radius
    largest = near.sum(1).amax()
    near = near[script.region_of(held)].float()
    bits = script.footprints(script.region_of(held))
    claimed = bits.new_zeros(4, bits.shape[-1])
    taken_before = torch.zeros(4, script.n_points)
    for uav in range(env.n_agents):
        both = type(held)(
            *(
                torch.where(
                    (torch.arange(env.n_agents) == uav).view(-1, *[1] * (o.dim() - 2)), o, h
                )
                for o, h in zip(own, held, strict=True)
            )
        )
        latest = script.counted(both)[:, uav, :-1] % script.n_points
        places = script.points[script.region_of(held)]
        standing = torch.cdist(both.target[:, uav : uav + 1], places).argmin(-1).squeeze(-1)
        row = standing + script.region_of(held) * script.n_points
        goal = script.candidates.goals()[0, row]
        for known, name in ((taken_before, "in turn"), (torch.zeros_like(taken_before), "new")):
            taken = known.unsqueeze(1)
            if latest.shape[-1]:
                footprints = near.expand(4, -1, -1).gather(
                    1, latest.unsqueeze(-1).expand(-1, -1, script.n_points)
                )
                taken = torch.cat([footprints, taken], 1)
            gain = (1 - taken.amax(1, keepdim=True)) @ near
            gain = gain.squeeze(1).gather(-1, goal) / largest
            torch.testing.assert_close(offers[name][:, -1, uav], gain)
        _, claims = script.choose_new(held, uav, claimed, bits, None)
        claimed = claimed | claims
        number = torch.arange(script.n_points)
        told = claimed.gather(1, (number // 64).expand(4, -1)) >> (number % 64) & 1
        taken_before = told.float()
    assert (offers["in turn"] < offers["new"]).any(), "somebody is in somebody's way"


@pytest.mark.parametrize(
    "words",
    [
        ["scenario=energy", "observation.window=1"],
        ["scenario=delaybench/flights", BATTERY, "battery.capacity_kwh=0.03"],
        ["scenario=energy", "agents=2", "battery.capacity_kwh=[0.03,0.06]"],
    ],
)
def test_batteries_and_ways_are_as_they_turn_out_to_be(words):
    env, steps = roll(words, 20)
    offers = observed(env, steps)
    after = steps["next"]
    ready = after[keys.READY].unsqueeze(-1)
    legal = offers["legal"].bool() == after[keys.ACTION_MASK]
    assert (legal | ~ready).all()
    assert not (after[keys.ACTION_MASK] | ~ready).all(), "some actions are out of reach"
    messages = env.uav_env.server.messages(after[keys.MESSAGE])
    longest = env.uav_env.simulation.candidates.max_distance
    chosen = after[keys.ACTION] if keys.ACTION in after.keys(True) else None
    assert chosen is None
    action = steps[keys.ACTION][:, 1:]
    index = action.unsqueeze(-1)
    before = messages.target[:, :-1]
    flown = messages.target[:, 1:] - before
    flies = (flown != 0).any(-1) & steps[keys.READY][:, 1:]
    told = torch.stack([offers[name][:, :-1].gather(-1, index) for name in ("east", "north")], -1)
    way = (flown / longest).clamp(-1, 1)
    alone = flies & (told.squeeze(-2) - way).abs().amax(-1).lt(1e-5)
    assert alone.sum() > 0.8 * flies.sum(), "the rest found another UAV there"
    if "time" in offers:
        return
    level = messages.battery[:, 1:] / 100
    expected = offers["battery"][:, :-1].gather(-1, index).squeeze(-1)
    torch.testing.assert_close(level[alone], expected[alone], atol=1e-5, rtol=0)
    holds = ~(flown != 0).any(-1) & steps[keys.READY][:, 1:] & (action == 0)
    torch.testing.assert_close(level[holds], expected[holds], atol=1e-5, rtol=0)


def test_what_lies_where_actions_lead_equals_a_plain_loop():
    words = [*SEARCH, "observation.own=true", "delay.obs=1..3"]
    words.append("observation.global_features=[detections,others]")
    env, steps = roll(words, 25, "script")
    offers = observed(env, steps)
    server = env.uav_env.server
    simulation = env.uav_env.simulation
    radius = simulation.radius
    points = simulation.points
    rows = env.layout["observation"]["detections"].of(steps["next"][keys.OBSERVATION])
    held = server.messages(steps["next"][keys.RECEIVED])
    sent = server.messages(steps["next"][keys.MESSAGE])
    found = 0
    for world in range(4):
        for step in range(25):
            for i in range(env.n_agents):
                known = [sent if j == i else held for j in range(env.n_agents)]
                target = [known[j].target[world, step, j].tolist() for j in range(env.n_agents)]
                heard = {}
                listed = []
                for k in range(2):
                    times = [
                        (known[j].detected_time[world, step, j, k].item(), j)
                        for j in range(env.n_agents)
                    ]
                    times = sorted((t for t in times if t[0] >= 0), key=lambda t: (-t[0], t[1]))
                    places = [
                        known[j].detected_position[world, step, j, k].tolist() for _, j in times
                    ]
                    if times:
                        heard[k] = places[0]
                    listed.append([*zip(times, places, strict=True)])
                half = simulation.airspace.scale[held.region(server._context.n_points)[world, step]]
                for k, each in enumerate(listed):
                    for rank in range(3):
                        row = rows[world, step, i, 3 * k + rank].tolist()
                        if rank >= len(each):
                            assert row == [0.0] * 6
                            continue
                        (time, _), place = each[rank]
                        way = [
                            (p - t) / (half.item() / 2)
                            for p, t in zip(place, target[i], strict=True)
                        ]
                        way = [max(-1.0, min(1.0, w)) for w in way]
                        age = (step + 1) - time / simulation.dt
                        source = [float(k == s) for s in range(2)]
                        expected = [*way, max(0.0, min(1.0, 1 - age / 10)), *source, 1.0]
                        assert row == pytest.approx(expected, abs=1e-4)
                place = torch.tensor(target[i])
                start = (points - place).square().sum(-1).argmin()
                goals = points[simulation.candidates.nearest[start]].tolist()
                goal = assigned(target, heard).get(i)
                near = [] if goal is None else [goal]
                for action, goal in enumerate(goals):
                    others = [target[j] for j in range(env.n_agents) if j != i]
                    values = {
                        "source": closeness(goal, heard.values(), radius),
                        "own source": closeness(goal, [heard[k] for k in near], radius),
                        "others": closeness(goal, others, radius),
                    }
                    for name, value in values.items():
                        seen = offers[name][world, step, i, action].item()
                        assert seen == pytest.approx(value, abs=1e-4)
                found += bool(near)
    assert found > 20, "UAVs hear sources"


def closeness(goal, places, radius):
    return max((math.exp(-math.dist(goal, place) / radius) for place in places), default=0.0)


def assigned(targets, places):
    """The place of each UAV, by the nearest pair of those left, one pair after the other."""
    found = {}
    pairs = [
        (math.dist(target, place), i, k)
        for i, target in enumerate(targets)
        for k, place in places.items()
    ]
    for _, i, k in sorted(pairs):
        if i not in found and k not in found.values():
            found[i] = k
    return found


def test_a_request_is_offered_where_it_is_open():
    env, steps = roll(["scenario=requests", "agents=4"], 20, "script")
    offers = observed(env, steps)
    server = env.uav_env.server
    messages = server.messages(steps["next"][keys.MESSAGE])
    radius = env.uav_env.simulation.radius
    goals = env.uav_env.simulation.points[env.uav_env.simulation.candidates.nearest]
    scale = env.uav_env.scenario.time_scale
    n_open = 0
    for world in range(4):
        for step in range(20):
            requests = messages.requests[world, step, 0].tolist()
            served = messages.served[world, step].amax(0).tolist()
            waiting = [r for r, s in zip(requests, served, strict=True) if 0 <= r[2] != s]
            targets = messages.target[world, step].tolist()
            for i in range(4):
                goals_of = assigned(targets, {k: r[:2] for k, r in enumerate(waiting)})
                own = [waiting[goals_of[i]][:2]] if i in goals_of else []
                for action in range(0, 40, 7):
                    goal = goals[messages.trail[world, step, i, 0], action].tolist()
                    inside = [r for r in waiting if math.dist(goal, r[:2]) <= radius]
                    now = (step + 1) * env.uav_env.scenario.clock.dt
                    age = max(((now - r[2]) / scale for r in inside), default=0.0)
                    values = {
                        "request": closeness(goal, [r[:2] for r in waiting], radius),
                        "own request": closeness(goal, own, radius),
                        "request age": age,
                    }
                    for name, value in values.items():
                        seen = offers[name][world, step, i, action].item()
                        assert seen == pytest.approx(value, abs=1e-4)
            n_open += len(waiting)
    assert n_open > 40


def test_the_gain_is_of_the_task_and_columns_are_those_of_the_scenario():
    crowded = roll(["scenario=delaybench/crowded"], 3, policy="script")
    search = roll(SEARCH, 3)
    belief = roll(["scenario=delaybench/tracking", "aware=belief"], 3)
    offers = {
        name: observed(*each) for name, each in zip("csb", (crowded, search, belief), strict=True)
    }
    assert [*offers["c"]] == [
        "east", "north", "new", "new to all", "in turn", "others", "gain", "choice", "legal",
    ]  # fmt: skip
    words = ["scenario=delaybench/crowded", "observation.advice=false"]
    facts = observed(*roll(words, 3, policy="script"))
    assert [*facts] == ["east", "north", "new", "new to all", "others", "legal"]
    assert all(offers["c"][name].equal(fact) for name, fact in facts.items())
    torch.testing.assert_close(offers["c"]["gain"], offers["c"]["in turn"], atol=1e-3, rtol=0)
    assert {"time", "source", "own source"} <= {*offers["s"]}
    assert "request" not in offers["s"]
    knows = offers["s"]["own source"].amax(-1, keepdim=True) > 0
    either = torch.where(knows, offers["s"]["own source"], offers["s"]["in turn"])
    torch.testing.assert_close(offers["s"]["gain"], either, atol=1e-3, rtol=0)
    env, steps = belief
    gain = env.layout["observation"]["belief_gain"].of(steps["next"][keys.OBSERVATION])
    torch.testing.assert_close(offers["b"]["gain"], gain, atol=1e-3, rtol=0)
    assert offers["b"]["belief"].equal(gain)


def test_the_choice_is_the_script_s_where_it_covers_ground():
    env, steps = roll(["scenario=delaybench/crowded", "agents=4"], policy="script")
    choice = observed(env, steps)["choice"]
    assert (choice.sum(-1) == 1).all()
    assert choice[:, :-1].argmax(-1).equal(steps[keys.ACTION][:, 1:])


def test_actions_need_discrete_ones():
    observation = ObservationConfig(actions=True)
    with pytest.raises(InputError, match=r"observation\.actions: True needs discrete actions"):
        ScenarioConfig(observation=observation, actions=ActionConfig(kind="continuous"))


def test_what_is_drawn_for_an_episode_is_taken_as_the_settings_say():
    words = ["scenario=patrol", "randomise={motion.max_speed: [8, 15], wind.speed: [0, 6]}"]
    times = []
    for each in (words, words[:1]):
        env, steps = roll(each, 1)
        block = env.layout["observation"]["actions"]
        first = block.of(steps[keys.OBSERVATION][:, 0])
        times.append(first[..., block.entries.index("time")])
    assert times[0].equal(times[1])
