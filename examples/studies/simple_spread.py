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
blocks that agent 0 sees, then those that agent 1 sees. Each block is a message, with a delay of its own. If
they are registered, an agent has added where it was itself: they are places in the plane."""
HELD, AGES, DELAYS, PAST = (("seen", name) for name in ("received", "age", "delay", "timeline"))
"""Of each block: the message that the agent holds, its age and the delay of the latest one [steps], and the
messages of the latest steps that have arrived (``ObservationTimeline``)."""


class SimpleSpread(EnvBase):
    """``simple_spread_v3`` for B worlds at a time, with discrete actions.

    It writes PettingZoo's observation ``("agents", "observation")`` [B, N, 6 N] (kinematics, landmarks, other
    agents, and zeros for what they might say), its parts, ``KINEMATICS`` and ``SEEN``, and where each agent
    is, ``keys.POSITION`` [B, N, 2]. Episodes are truncated after ``HORIZON`` steps.

    Args:
        worlds: number of worlds, B.
        agents: number of agents and of landmarks, N.
        local_ratio: weight of an agent's own reward; the common one has the rest.
        registered: whether the places in ``SEEN`` are registered.

    Examples:
        >>> env = SimpleSpread(64)
        >>> env.rollout(25)["next", "agents", "reward"].sum((1, 2, 3)).mean()  # about -79
    """

    def __init__(
        self, worlds: int, agents: int = 3, local_ratio: float = 0.5, registered: bool = False
    ) -> None:
        super().__init__(batch_size=torch.Size([worlds]))
        self.n_agents, self.local_ratio, self.registered = agents, local_ratio, registered
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
        outputs = composite(
            {"observation": numbers(6 * n), "kinematics": numbers(4), "position": numbers(2)}, group
        )
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
        agents = {"observation": observation, "kinematics": kinematics, "position": self.position.clone()}
        over = self.steps >= HORIZON
        ends = {keys.DONE: over, keys.TERMINATED: torch.zeros_like(over), keys.TRUNCATED: over.clone()}
        messages = (seen + own if self.registered else seen).flatten(1, 2)
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
    """Writes what agents and critics observe of their kinematics and of what they see.

    Critics observe ``observed(...)`` of the blocks that are held or, if there is one, of their timeline; and
    actors too, with ``ages`` followed by the age of each block. For learners it also writes that every agent
    may choose in every step, the longest delay of the blocks that were sent in this step, and that nothing is
    back-updated yet.

    Args:
        longest: steps that are an age of 1.
        ages: whether actors observe the ages.
        registered: whether the blocks are.
    """

    def __init__(self, longest: int, ages: bool, registered: bool) -> None:
        super().__init__()
        self.longest, self.ages, self.registered = longest, ages, registered

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(self._written(next_tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def _written(self, outputs: TensorDictBase) -> dict[Any, Tensor]:
        kinematics = outputs[KINEMATICS]
        rows = kinematics.shape[:-1]
        known = observed(kinematics, outputs.get(PAST, outputs[HELD]), self.registered)
        ages = outputs[AGES].view(*rows, -1) / self.longest
        return {
            keys.OBSERVATION: torch.cat([known, ages], -1) if self.ages else known.clone(),
            keys.GLOBAL_OBSERVATION: known,
            keys.READY: torch.ones(rows, dtype=torch.bool, device=known.device),
            keys.BACKUPDATED: torch.zeros(*rows, 1, dtype=torch.bool, device=known.device),
            keys.DELAY: outputs[DELAYS].view(*rows, -1).amax(-1, keepdim=True),
        }

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key, value in self._written(observation_spec.zero()).items():  # type: ignore[arg-type]
            kind = Binary if value.dtype == torch.bool else Unbounded
            observation_spec[key] = kind(shape=value.shape, dtype=value.dtype, device=value.device)
        return observation_spec


def observed(kinematics: Tensor, seen: Tensor, registered: bool = False) -> Tensor:
    """What agents make of their kinematics [*, N, 4] and of what they see, [*, N, 4 + C + N].

    That is, the kinematics, the C numbers, and which agent it is. What it sees are blocks
    [*, N (2 N - 1), 2], which are moved into the agent's present frame if they are ``registered``, or their
    timelines [*, N (2 N - 1), K, 3].
    """
    *rows, n, _ = kinematics.shape
    seen = seen.unflatten(len(rows), (n, -1))
    if registered:
        seen = seen - kinematics[..., 2:].unsqueeze(-2)
    which = torch.eye(n, device=kinematics.device).expand(*rows, n, n)
    return torch.cat([kinematics, seen.flatten(len(rows) + 1), which], -1)


def late_spread(
    worlds: int,
    delay: int | Law,
    longest: int,
    *,
    aware: bool = False,
    registered: bool = False,
    slots: int = 0,
) -> TransformedEnv:
    """``SimpleSpread`` for B worlds whose agents see each landmark and each other agent late.

    An agent knows its own velocity and position at once. At the beginning it holds what it sees there.

    Args:
        worlds: number of worlds, B.
        delay: of each block [steps], or its law.
        longest: number of latest actions that an aware actor observes.
        aware: whether actors observe ages, and their own latest actions by how far these move them.
        registered: whether the blocks that agents hold are moved into their present frame.
        slots: number of latest steps that agents observe as the timelines of the blocks, in their present
            frame, instead of the blocks that they hold; 0: there are none.
    """
    parts: list[Transform] = [ObservationDelay(delay, [SEEN], [HELD], age_key="age", delay_key="delay")]
    if slots:
        parts.append(ObservationTimeline(slots, SEEN, delay_key="delay", position_key=keys.POSITION))
    parts.append(Receiver(longest, aware, registered))
    if aware:
        codes = torch.tensor(DIRECTIONS) * REACH
        parts.append(ActionHistory(longest, keys.ACTION, append_to=keys.OBSERVATION, codes=codes))
    parts.append(StepCounter())
    return TransformedEnv(SimpleSpread(worlds, registered=registered), Compose(parts))
