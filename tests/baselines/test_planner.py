"""The planner equals a plain loop over worlds, UAVs, actions and steps, and is above the script."""

import pytest

from damian import keys, make_env
from damian.baselines.planner import Planner, planner_policy
from damian.baselines.script import assumed_script, script_policy
from damian.common.errors import InputError
from damian.recipes.shared.environments import compose_scenario

WORDS = ["scenario=delaybench/crowded", "region.initial_conditions=16", "agents=2"]
WORDS += ["actions.distances=[0,90]", "actions.headings=[0,72,144,216,288]", "source.level_db=147"]

LATE = ["delay.obs=1..3", "observation.own=true", "observation.forward=script"]


def made(*words, worlds=2):
    return make_env(compose_scenario(*WORDS, *words), worlds, seed=5, extras=["message"])


def loop(env, alone, td, horizon):
    """What the planner would choose, by one world, one UAV, one action and one step at a time."""
    script = script_policy(env)
    begin = env.uav_env.get_extra_state()
    joint = script(td.clone())[keys.ACTION].clone()
    for world in range(len(joint)):
        rows = {name: table[world : world + 1] for name, table in begin.items()}
        for uav in range(joint.shape[1]):
            values = []
            for action in range(env.uav_env.scenario.actions.n_actions):
                td = alone.reset()
                alone.uav_env.set_extra_state(rows)
                chosen = joint[world : world + 1].clone()
                chosen[0, uav] = action
                total = 0.0
                for _ in range(horizon):
                    td = alone.step(td.set(keys.ACTION, chosen))["next"]
                    total += td[keys.REWARD].sum().item()
                    chosen = script(td)[keys.ACTION]
                values.append(total)
            best = max(values)
            if best > values[joint[world, uav]] + 1e-6:
                joint[world, uav] = values.index(best)
    return joint


def test_the_planner_equals_a_plain_loop_in_which_no_flight_is_aborted():
    horizon = 2
    env, alone = made("motion.abort=0.9"), made(worlds=1)
    planner = planner_policy(env, horizon)
    td = env.reset()
    differs = 0
    for _ in range(2):
        expected = loop(env, alone, td, horizon)
        chosen = planner(td.clone())[keys.ACTION]
        assert chosen.equal(expected)
        differs += (chosen != script_policy(env)(td.clone())[keys.ACTION]).sum().item()
        td = env.step(td.set(keys.ACTION, chosen))["next"]
    assert differs


def test_the_planner_returns_more_than_the_script_and_tells_its_time():
    env = made(worlds=4)
    returns = {}
    planner = planner_policy(env, 3)
    for name, policy in (("script", script_policy(env)), ("planner", planner)):
        env.set_seed(5)
        rollout = env.rollout(8, policy, break_when_any_done=False)
        returns[name] = rollout["next"][keys.REWARD].sum((1, 2)).mean()
    assert returns["planner"] > returns["script"] + 0.2
    assert len(planner.module.milliseconds) == 8


def test_without_news_a_late_plan_is_the_undelayed_one():
    chosen = []
    for words in ([], LATE):
        env = made(*words)
        env.assume(assumed_script(env))
        rollout = env.rollout(5, planner_policy(env, 2), break_when_any_done=False)
        chosen.append(rollout[keys.ACTION])
    assert chosen[0].equal(chosen[1])


@pytest.mark.parametrize("words", [["motion.abort=0.9"], LATE])
@pytest.mark.parametrize(
    "options", [{"backend": "eager"}, pytest.param({}, marks=pytest.mark.slow)]
)
def test_a_compiled_planner_decides_as_one_that_is_not(words, options):
    env = made(*words)
    env.assume(assumed_script(env))
    planner, compiled = planner_policy(env, 2), planner_policy(env, 2, compile=True)
    graphs = compiled.module._compiled
    graphs._options |= options
    td = env.reset()
    for _ in range(5):
        chosen = planner(td.clone())[keys.ACTION]
        assert compiled(td.clone())[keys.ACTION].equal(chosen)
        td = env.step_and_maybe_reset(td.set(keys.ACTION, chosen))[1]
    assert {*graphs._graphs} == {("usual",), ("advance",)}


def test_copies_draw_anew_what_has_not_happened_and_every_action_meets_the_same():
    few = ["actions.distances=[0,90]", "actions.headings=[0,120,240]"]
    env = make_env(compose_scenario("scenario=requests", *few), 2, seed=5, extras=["message"])
    planner = Planner(env.uav_env, env.uav_env.simulation, 6, 2)
    env.rollout(3, break_when_any_done=False)
    state = env.uav_env.state
    joint = planner.choice(state)
    copies = planner.copies(state)
    first = planner.values(copies, joint, 0)
    assert first.equal(planner.values(copies, joint, 0)), "no hidden state"
    held = joint.clone()
    held[:, 0] = 0
    same = planner.values(copies, held, 0)
    assert first.equal(same), "its own choice is replaced"
    others = planner.copies(state._replace(seed=state.seed + 1))
    assert not planner.values(others, joint, 0).equal(first)


@pytest.mark.parametrize(
    ("word", "error"),
    [
        ("delay.obs=2", "observation.forward=script"),
        ("actions=continuous", "needs discrete"),
    ],
)
def test_what_it_cannot_plan_is_refused(word, error):
    with pytest.raises(InputError, match=error):
        planner_policy(made(word, worlds=1))
