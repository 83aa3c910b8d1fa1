"""A planner: the UAVs try every action, one after the other, in copies of the world in which the
script flies on (one-at-a-time rollout; Bertsekas 2021)."""

import time
from collections.abc import Callable

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from damian import keys
from damian.baselines.script import script_without_belief
from damian.common import checks, counter_rng
from damian.common.compiling import CompiledMethods, world_options
from damian.common.tensors import tree_map
from damian.envs.commands import destination
from damian.envs.delayed_env import DelayedEnv
from damian.envs.forward import ForetoldWorlds, ToldWorlds
from damian.envs.uav_env import UavEnv
from damian.world.simulation import Simulation
from damian.world.state import PackedState, State

_STREAM = counter_rng.number_of("planner")


def planner_policy(
    env: DelayedEnv, horizon: int = 4, samples: int = 1, *, compile: bool = False
) -> TensorDictModule:
    """Build a policy that plans in copies of the worlds of an environment.

    For each UAV in turn, in index order, every legal action is tried, with what the UAVs before it
    have chosen, while the later ones, and all of them in later steps, follow the script. The action
    of the largest sum of team rewards over ``samples`` copies is taken; of equal ones the script's.
    Copies have the state of the world, and draw anew what has not happened yet: gusts, requests and
    reports; no flight is aborted in them, and no UAV fails. Where sources are and how they will
    move they know, so that with sources the planner is clairvoyant.

    Where messages are late (with ``observation.forward``), all UAVs share one plan. It is made
    from the messages that the server holds, in a copy of the world that has flown until now by the
    plans of the steps between, and each UAV flies to its planned place.

    Args:
        env: environment whose worlds the policy flies, [B]; with ``message`` among its extras.
        horizon: steps to look ahead.
        samples: copies of a world for each action.
        compile: compile the steps of the copies, which decide the same in a fraction of the time.

    Raises:
        InputError: actions are continuous, or late messages are not flown forward.
    """
    discrete = env.uav_env.scenario.actions.kind == "discrete"
    checks.require(discrete, "policy", "planner", "needs discrete actions")
    available = env.observation_spec.keys(True, True)
    relative = keys.COMMANDS not in available
    checks.require(relative, "policy", "planner", "plans for actions.command=relative")
    if not env.delays.obs.late:
        worlds = ForetoldWorlds(env.uav_env.simulation)
        planner = Planner(env.uav_env, worlds, horizon, samples, compile)
        return TensorDictModule(planner, [keys.MESSAGE], [keys.ACTION])
    should = "plans from late messages with observation.own=true observation.forward=script"
    checks.require(keys.RECALLED in available, "policy", "planner", should)
    worlds = ToldWorlds(env.uav_env.simulation)
    planner = LatePlanner(env.uav_env, worlds, horizon, samples, compile)
    read = [keys.RECALLED, keys.RECEIVED, keys.MESSAGE]
    if keys.ACTION_MASK in available:
        read.append(keys.ACTION_MASK)
    return TensorDictModule(planner, read, [keys.ACTION])


class Planner:
    """Function from the messages of B worlds, whose states it reads, to actions.

    It plans in copies that ``simulation`` steps, compiled if ``compile``.
    """

    def __init__(
        self,
        worlds: UavEnv,
        simulation: Simulation,
        horizon: int,
        samples: int,
        compile: bool = False,
    ) -> None:
        self.worlds = worlds
        self.simulation = simulation
        self.horizon = horizon
        self.samples = samples
        self.script = script_without_belief(worlds)
        # The number of copies stays: a graph for any number of them takes several times as long.
        options = {"dynamic": False, **world_options(worlds.n_agents)}
        self._compiled = CompiledMethods(options) if compile else None
        self.milliseconds: list[float] = []
        """How long each decision took, of all worlds together."""

    @torch.no_grad()
    def __call__(self, message: Tensor) -> Tensor:
        """Actions, [B, N], from the messages [B, N, M] of the worlds' present states."""
        begin = time.perf_counter()
        joint = self.plan(self.worlds.state)
        self.milliseconds.append(1000 * (time.perf_counter() - begin))
        return joint

    def plan(self, state: State) -> Tensor:
        """The actions of all UAVs, [B, N], from a state."""
        legal = self.simulation.action_mask(state)
        copies = self.copies(state)
        each = len(copies.flags) // len(legal)
        # Of copies, as later: for another number of worlds a graph would be compiled anew.
        joint = self._fast(self.usual)(copies)[::each]
        for uav in range(joint.shape[1]):
            value = self.values(copies, joint, uav).where(legal[:, uav], -torch.inf)
            usual = value.gather(-1, joint[:, uav : uav + 1]).squeeze(-1)
            better = value.amax(-1) > usual + 1e-6
            joint[:, uav] = torch.where(better, value.argmax(-1), joint[:, uav])
        return joint

    def choice(self, state: State) -> Tensor:
        """The actions that the script chooses in a state, [B, N]."""
        mask = self.simulation.action_mask(state)
        return self.script(state.sent.pack(), mask=mask)

    def copies(self, state: State) -> PackedState:
        """C = B A S copies of worlds [B], each A S times: S for each action."""
        n_copies = self.worlds.scenario.actions.n_actions * self.samples
        copies = tree_map(lambda each: each.repeat_interleave(n_copies, 0), state)
        copy = torch.arange(len(copies.seed), device=copies.seed.device)
        # Every action meets the same draws.
        number = copy % self.samples
        seed = counter_rng.bits64(copies.seed, _STREAM, copies.steps, number)
        return self.simulation.layout.pack(copies._replace(seed=seed))

    def values(self, copies: PackedState, joint: Tensor, uav: int) -> Tensor:
        """The sum of rewards, over the horizon, for each action of a UAV, [B, A], if the others
        choose as in ``joint`` [B, N]."""
        n_actions = self.worlds.scenario.actions.n_actions
        n_copies = n_actions * self.samples
        actions = joint.repeat_interleave(n_copies, 0)
        copy = torch.arange(len(actions), device=joint.device)
        actions[:, uav] = copy // self.samples % n_actions
        total = torch.zeros_like(copy, dtype=torch.float32)
        alive = torch.ones_like(total)
        for step in range(self.horizon):
            if step:
                actions = self._fast(self.usual)(copies)
            copies, reward, ended = self._fast(self.advance)(copies, actions)
            total += reward * alive
            alive *= ~ended
        return total.view(len(joint), n_actions, self.samples).mean(-1)

    # Pure functions of copies, which can be compiled.

    def usual(self, copies: PackedState) -> Tensor:
        """The actions that the script chooses in copies, [C, N]."""
        return self.choice(self.simulation.layout.unpack(copies))

    def advance(self, copies: PackedState, actions: Tensor) -> tuple[PackedState, Tensor, Tensor]:
        """The copies one step later, the sums of their rewards, and whether they have ended,
        [C]."""
        layout = self.simulation.layout
        state = self.simulation.step(layout.unpack(copies), actions)
        served = self.worlds.server(state.sent, state.steps, state.source_over, observers=())
        ended = served.status.terminated | served.status.truncated
        return layout.pack(state), served.reward.sum(-1), ended

    def _fast(self, function: Callable) -> Callable:
        """A function of this object, compiled if that is wanted."""
        return function if self._compiled is None else self._compiled.get(function)


class LatePlanner(Planner):
    """Function from late messages of B worlds to actions, which remembers its latest plans."""

    simulation: ToldWorlds

    def __init__(
        self,
        worlds: UavEnv,
        simulation: ToldWorlds,
        horizon: int,
        samples: int,
        compile: bool = False,
    ) -> None:
        super().__init__(worlds, simulation, horizon, samples, compile)
        self.steps: Tensor | None = None
        """Steps of each world since its reset, [B]."""
        self.plans: Tensor | None = None
        """Flat ids of the landing points planned in the latest steps, the latest first,
        [B, S, N]."""

    @torch.no_grad()
    def __call__(  # type: ignore[override]
        self, recalled: Tensor, received: Tensor, message: Tensor, mask: Tensor | None = None
    ) -> Tensor:
        """Actions, [B, N], from the messages that the server received: those of the latest steps,
        and the newest of each UAV.

        Where it stands, [B, N, M], and what it may do, [B, N, A], each UAV knows itself.
        """
        begin = time.perf_counter()
        sent = self.worlds.server.messages(message)
        if self.steps is None or self.plans is None:
            n_worlds, n, n_slots = recalled.shape[:3]
            self.steps = recalled.new_zeros(n_worlds, dtype=torch.long)
            self.plans = self.steps.new_zeros(n_worlds, n_slots - 1, n)
        begins = (sent.time == 0).all(-1)
        now = torch.where(begins, 0, self.steps + 1)
        plans = self.plans
        state = self.flown(recalled, received, now, plans)
        goals = destination(self.simulation.candidates, state.goal, self.plan(state))
        self.steps = now
        self.plans = torch.cat([goals.unsqueeze(1), plans[:, :-1]], 1)
        action = self.simulation.towards(self.simulation.bound_for(sent), goals, mask)
        self.milliseconds.append(1000 * (time.perf_counter() - begin))
        return action

    def flown(self, recalled: Tensor, received: Tensor, now: Tensor, plans: Tensor) -> State:
        """The worlds ``now`` [B] steps after their reset, flown to by ``plans`` [B, S, N]."""

        def as_planned(state: State, back: int) -> Tensor:
            mask = self.simulation.action_mask(state)
            return self.simulation.towards(state.goal, plans[:, back - 1], mask)

        return self.simulation.flown(recalled, received, now, as_planned)
