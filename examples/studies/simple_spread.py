"""PettingZoo's ``simple_spread_v3`` in batches, and what its agents observe when they see others late.

N agents have to cover N landmarks in a plane, and to avoid each other. Physics and rewards are those of the
discrete environment (Lowe et al. 2017, "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive
Environments"; its maintained version is mpe2).
"""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import softplus
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, StepCounter, Transform, TransformedEnv

from damian import keys
from damian.delays.laws import Law
from damian.transforms import ActionHistory, ObservationDelay, ObservationTimeline

HORIZON = 25
"""Steps of an episode."""
DT, DAMPING = 0.1, 0.25
"""Length of a step, and the share of its velocity that an agent loses in it."""
FORCE, SIZE = 5.0, 0.15
"""Force of an action on an agent of mass 1, and radius of an agent."""
CONTACT_FORCE, CONTACT_MARGIN = 100.0, 1e-3
"""Force per length by which agents overlap, and the length over which it sets in."""
DIRECTIONS = ((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))
"""Direction of each action: none, left, right, down, up."""
REACH = FORCE * DT**2 / DAMPING
"""How far an action moves an agent in the long run, if it meets no other one."""

KINEMATICS = (keys.AGENTS, "kinematics")
"""Velocity and position of each agent, [B, N, 4]: what it knows of itself, at once."""
SEEN = ("seen", "message")
"""Places of the landmarks and of the other agents relative to each agent, [B, N (2 N - 1), 2]: the N + N - 1
blocks that agent 0 sees, then those that agent 1 sees. Each block is a message, with a delay of its own."""
HELD, AGES, DELAYS, PAST = (("seen", name) for name in ("received", "age", "delay", "timeline"))
"""Of each block: the message that the agent holds, its age and the delay of the latest one [steps], and the
messages of the latest steps that have arrived (``ObservationTimeline``)."""


class SimpleSpread(EnvBase):
    """``simple_spread_v3`` for B worlds at a time, with discrete actions.

    It writes PettingZoo's observation ``("agents", "observation")`` [B, N, 6 N] (kinematics, landmarks, other
    agents, and zeros for what they might say) and its parts, ``KINEMATICS`` and ``SEEN``. Episodes are
    truncated after ``HORIZON`` steps.

    Args:
        worlds: number of worlds, B.
        agents: number of agents and of landmarks, N.
        local_ratio: weight of an agent's own reward; the common one has the rest.

    Examples:
        >>> env = SimpleSpread(64)
        >>> env.rollout(25)["next", "agents", "reward"].sum((1, 2, 3)).mean()  # about -79
    """

    def __init__(self, worlds: int, agents: int = 3, local_ratio: float = 0.5) -> None:
        super().__init__(batch_size=torch.Size([worlds]))
        self.n_agents, self.local_ratio = agents, local_ratio
        self.directions = torch.tensor(DIRECTIONS)
        places = torch.arange(agents)
        self.others = places.expand(agents, -1)[places != places.unsqueeze(-1)].view(agents, -1)
        self.generator = torch.Generator()
        self.generator.seed()
        self._make_specs(worlds, agents)
        self.position, self.landmarks = (torch.zeros(worlds, agents, 2) for _ in range(2))
        self.velocity = torch.zeros_like(self.position)
        self.steps = torch.zeros(worlds, 1, dtype=torch.long)

    def _make_specs(self, worlds: int, n: int) -> None:
        group, batch = torch.Size([worlds, n]), torch.Size([worlds])

        def composite(entries: dict[str, Any], rows: torch.Size = batch) -> Composite:
            return Composite(entries, shape=rows)

        def numbers(width: int, rows: torch.Size = group) -> Unbounded:
            return Unbounded(torch.Size((*rows, width)))

        seen = torch.Size([worlds, n * (2 * n - 1)])
        outputs = composite({"observation": numbers(6 * n), "kinematics": numbers(4)}, group)
        messages = composite({"message": numbers(2, seen)}, seen)
        self.observation_spec = composite({"agents": outputs, "seen": messages})
        action = composite({"action": Categorical(len(DIRECTIONS), shape=group)}, group)
        self.action_spec = composite({"agents": action})
        self.reward_spec = composite({"agents": composite({"reward": numbers(1)}, group)})
        flag = Categorical(2, shape=torch.Size([worlds, 1]), dtype=torch.bool)
        self.done_spec = composite({name: flag.clone() for name in keys.ENDS})

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones_like(self.steps, dtype=torch.bool)
        drawn = torch.rand(2, *self.position.shape, generator=self.generator)
        new, world = 2 * drawn - 1, mask.view(-1, 1, 1)
        self.position = torch.where(world, new[0], self.position)
        self.landmarks = torch.where(world, new[1], self.landmarks)
        self.velocity = self.velocity.masked_fill(world, 0.0)
        self.steps = self.steps.masked_fill(mask, 0)
        return self._outputs()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        force = FORCE * self.directions[tensordict[keys.ACTION]] + contact_forces(self.position)
        self.position = self.position + DT * self.velocity
        self.velocity = (1 - DAMPING) * self.velocity + DT * force
        self.steps = self.steps + 1
        return self._outputs().set(keys.REWARD, self._rewards().unsqueeze(-1))

    def _rewards(self) -> Tensor:
        """Reward of each agent where the agents are now, [B, N]."""
        common = -torch.cdist(self.landmarks, self.position).amin(-1).sum(-1, keepdim=True)
        apart = (self.position.unsqueeze(-2) - self.position.unsqueeze(-3)).norm(dim=-1)
        collisions = (apart < 2 * SIZE).sum(-1) - 1  # none with itself
        return (1 - self.local_ratio) * common - self.local_ratio * collisions

    def _outputs(self) -> TensorDictBase:
        worlds, n = self.position.shape[:2]
        own = self.position.unsqueeze(2)
        seen = torch.cat([self.landmarks.unsqueeze(1) - own, self.position[:, self.others] - own], 2)
        kinematics = torch.cat([self.velocity, self.position], -1)
        silence = kinematics.new_zeros(worlds, n, 2 * (n - 1))
        observation = torch.cat([kinematics, seen.flatten(2), silence], -1)
        agents = {"observation": observation, "kinematics": kinematics}
        over = self.steps >= HORIZON
        ends = {keys.DONE: over, keys.TERMINATED: torch.zeros_like(over), keys.TRUNCATED: over.clone()}
        messages = seen.flatten(1, 2)
        groups = {
            "agents": TensorDict(agents, [worlds, n]),
            "seen": TensorDict({"message": messages}, messages.shape[:2]),
        }
        return TensorDict({**groups, **ends}, self.batch_size)


def contact_forces(position: Tensor) -> Tensor:
    """Forces on agents at positions [B, N, 2] by all others that they touch, [B, N, 2]."""
    way = position.unsqueeze(-2) - position.unsqueeze(-3)  # from the others to each agent, [B, N, N, 2]
    distance = way.norm(dim=-1, keepdim=True)
    overlap = CONTACT_MARGIN * softplus((2 * SIZE - distance) / CONTACT_MARGIN)
    return CONTACT_FORCE * (way / distance.clamp(min=1e-12) * overlap).sum(-2)


class Receiver(Transform):
    """Writes what agents and critics observe of their kinematics and of the blocks that they hold.

    Critics observe ``observed(...)``, and actors too, with ``ages`` followed by the age of each block. For
    learners it also writes that every agent may choose in every step, the longest delay of the blocks that
    were sent in this step, that nothing is back-updated yet, and, if there is one, the history of each
    agent's blocks.

    Args:
        longest: steps that are an age of 1.
        ages: whether actors observe the ages.
    """

    def __init__(self, longest: int, ages: bool) -> None:
        super().__init__()
        self.longest, self.ages = longest, ages

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(self._written(next_tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def _written(self, outputs: TensorDictBase) -> dict[Any, Tensor]:
        kinematics = outputs[KINEMATICS]
        rows = kinematics.shape[:-1]
        known = observed(kinematics, outputs[HELD])
        ages = outputs[AGES].view(*rows, -1) / self.longest
        written = {
            keys.OBSERVATION: torch.cat([known, ages], -1) if self.ages else known.clone(),
            keys.GLOBAL_OBSERVATION: known,
            keys.READY: torch.ones(rows, dtype=torch.bool, device=known.device),
            keys.BACKUPDATED: torch.zeros(*rows, 1, dtype=torch.bool, device=known.device),
            keys.DELAY: outputs[DELAYS].view(*rows, -1).amax(-1, keepdim=True),
        }
        if PAST in outputs.keys(True):
            written[keys.TIMELINE] = histories(outputs[PAST], rows[-1])
        return written

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key, value in self._written(observation_spec.zero()).items():  # type: ignore[arg-type]
            kind = Binary if value.dtype == torch.bool else Unbounded
            observation_spec[key] = kind(shape=value.shape, dtype=value.dtype, device=value.device)
        return observation_spec


def observed(kinematics: Tensor, blocks: Tensor) -> Tensor:
    """Kinematics [*, N, 4], blocks [*, N (2 N - 1), 2], and which agent it is, [*, N, 5 N + 2]."""
    n = kinematics.shape[-2]
    which = torch.eye(n, device=kinematics.device).expand(*kinematics.shape[:-1], n)
    return torch.cat([kinematics, blocks.unflatten(-2, (n, -1)).flatten(-2), which], -1)


def histories(past: Tensor, n_agents: int) -> Tensor:
    """Timelines of all blocks, [B, N M, K, 2 + 1], by agent, [B, N, M, K, 2 + M + 1].

    A row of the result has the place, which of the M blocks it is, and whether it is known.
    """
    rows = past.unflatten(1, (n_agents, -1))  # [B, N, M, K, C]
    m = rows.shape[2]
    block = torch.eye(m, device=past.device).view(m, 1, m).expand(*rows.shape[:-1], m)
    return torch.cat([rows[..., :2], block, rows[..., 2:]], -1)


def late_spread(
    worlds: int, delay: int | Law, longest: int, *, aware: bool = False, messages: int = 0
) -> TransformedEnv:
    """``SimpleSpread`` for B worlds whose agents see each landmark and each other agent late.

    An agent knows its own velocity and position at once. At the beginning it holds what it sees there.

    Args:
        worlds: number of worlds, B.
        delay: of each block [steps], or its law.
        longest: number of latest actions that an aware actor observes.
        aware: whether actors observe ages, and their own latest actions by how far these move them.
        messages: number of latest steps whose messages ``("agents", "timeline")`` has; 0: there is none.
    """
    parts: list[Transform] = [ObservationDelay(delay, [SEEN], [HELD], age_key="age", delay_key="delay")]
    if messages:
        parts.append(ObservationTimeline(messages, SEEN, delay_key="delay"))
    parts.append(Receiver(longest, ages=aware))
    if aware:
        codes = torch.tensor(DIRECTIONS) * REACH
        parts.append(ActionHistory(longest, keys.ACTION, append_to=keys.OBSERVATION, codes=codes))
    parts.append(StepCounter())
    return TransformedEnv(SimpleSpread(worlds), Compose(parts))
