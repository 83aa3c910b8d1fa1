"""A planner: the UAVs try every action, one after the other, in copies of the world in which the
script flies on (one-at-a-time rollout; Bertsekas 2021)."""

import time

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from damian import keys
from damian.baselines.script import script_without_belief
from damian.common import checks, counter_rng
from damian.common.tensors import tree_map
from damian.envs.delayed_env import DelayedEnv
from damian.envs.uav_env import UavEnv
from damian.world.state import State

_STREAM = counter_rng.number_of("planner")


def planner_policy(env: DelayedEnv, horizon: int = 4, samples: int = 1) -> TensorDictModule:
    """Build a policy that plans in copies of the worlds of an environment without late messages.

    For each UAV in turn, in index order, every legal action is tried, with what the UAVs before it
    have chosen, while the later ones, and all of them in later steps, follow the script. The action
    of the largest sum of team rewards over ``samples`` copies is taken; of equal ones the script's.
    Copies have the state of the world, and draw anew what has not happened yet: gusts, requests and
    reports. Where sources are and how they will move they know, so that with sources the planner is
    clairvoyant.

    Args:
        env: environment whose worlds the policy flies, [B]; with ``message`` among its extras.
        horizon: steps to look ahead.
        samples: copies of a world for each action.

    Raises:
        InputError: actions are continuous, or messages are late.
    """
    actions = env.uav_env.scenario.actions
    checks.require(actions.kind == "discrete", "policy", "planner", "needs discrete actions")
    should = "plans on the present state: leave out delay.obs, or fly an undelayed environment"
    checks.require(not env.delays.obs.late, "policy", "planner", should)
    planner = Planner(env.uav_env, horizon, samples)
    return TensorDictModule(planner, [keys.MESSAGE], [keys.ACTION])


class Planner:
    """Function from the messages of B worlds, whose states it reads, to actions."""

    def __init__(self, worlds: UavEnv, horizon: int, samples: int) -> None:
        checks.whole("planner.horizon", horizon, 1, 1000)
        checks.whole("planner.samples", samples, 1, 1000)
        self.worlds = worlds
        self.horizon = horizon
        self.samples = samples
        self.script = script_without_belief(worlds)
        self.milliseconds: list[float] = []
        """How long each decision took, of all worlds together."""

    @torch.no_grad()
    def __call__(self, message: Tensor) -> Tensor:
        """Actions, [B, N], from the messages [B, N, M] of the worlds' present states."""
        begin = time.perf_counter()
        state = self.worlds.state
        legal = self.worlds.simulation.action_mask(state)
        joint = self.script(message, mask=legal)
        for uav in range(joint.shape[1]):
            value = self.values(state, joint, uav).where(legal[:, uav], -torch.inf)
            usual = value.gather(-1, joint[:, uav : uav + 1]).squeeze(-1)
            better = value.amax(-1) > usual + 1e-6
            joint[:, uav] = torch.where(better, value.argmax(-1), joint[:, uav])
        self.milliseconds.append(1000 * (time.perf_counter() - begin))
        return joint

    def choice(self, state: State) -> Tensor:
        """The actions that the script chooses in a state, [B, N]."""
        mask = self.worlds.simulation.action_mask(state)
        return self.script(state.sent.pack(), mask=mask)

    def values(self, state: State, joint: Tensor, uav: int) -> Tensor:
        """The sum of rewards, over the horizon, for each action of a UAV, [B, A], if the others
        choose as in ``joint`` [B, N]."""
        n_actions = self.worlds.scenario.actions.n_actions
        n_copies = n_actions * self.samples
        copies = tree_map(lambda each: each.repeat_interleave(n_copies, 0), state)
        copy = torch.arange(len(copies.seed), device=joint.device)
        stream = torch.full_like(copies.seed, _STREAM)
        # Every action meets the same draws.
        number = copy % self.samples
        seed = counter_rng.bits64(copies.seed, stream, copies.steps, number)
        copies = copies._replace(seed=seed)
        actions = joint.repeat_interleave(n_copies, 0)
        actions[:, uav] = copy // self.samples % n_actions
        total = torch.zeros_like(actions[:, 0], dtype=torch.float32)
        alive = torch.ones_like(total)
        for step in range(self.horizon):
            if step:
                actions = self.choice(copies)
            copies = self.worlds.simulation.step(copies, actions)
            served = self.worlds.server(copies.sent, copies.steps, copies.source_over, observers=())
            total += served.reward.sum(-1) * alive
            alive *= ~(served.status.terminated | served.status.truncated)
        return total.view(len(joint), n_actions, self.samples).mean(-1)
