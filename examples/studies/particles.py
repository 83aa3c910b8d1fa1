"""PettingZoo's ``simple_spread_v3`` and ``simple_tag_v3`` in batches, whose agents see others late.

N agents have to cover N landmarks in a plane and to avoid each other, or to catch a prey that is
faster. Physics and rewards are those of the discrete environments
(Lowe et al. 2017, "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments"; their
maintained version is mpe2).
"""

import math
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
CONTACT_FORCE, CONTACT_MARGIN = 100.0, 1e-3
"""Force per length by which bodies overlap, and the length over which it sets in."""
DIRECTIONS = ((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))
"""Direction of each action: none, left, right, down, up."""
REACH = DT**2 / DAMPING
"""How far a force of 1 in one step moves an agent in the long run, if it meets no other one."""

KINEMATICS = (keys.AGENTS, "kinematics")
"""Velocity and position of each agent, [B, N, 4]: what it knows of itself, at once."""
SEEN = ("seen", "message")
"""Places of the landmarks and of the other agents relative to each agent, [B, N K, 2]: the K blocks
that agent 0 sees, then those that agent 1 sees; in simple_tag also where the prey is, and would be
in a second at its velocity. Each block is a message, with a delay of its own. If they are
registered, an agent has added
where it was itself: they are places in the plane."""
HELD, AGES, DELAYS, PAST = (("seen", name) for name in ("received", "age", "delay", "timeline"))
"""Of each block: the message that the agent holds, its age and the delay of the latest one [steps],
and the messages of the latest steps that have arrived (``ObservationTimeline``)."""


class SimpleSpread(EnvBase):
    """``simple_spread_v3`` for B worlds at a time, with discrete actions.

    It writes PettingZoo's observation ``("agents", "observation")`` [B, N, 6 N]
    (kinematics, landmarks, other agents, and zeros for what they might say), its parts,
    ``KINEMATICS`` and ``SEEN``, and where each agent is, ``keys.POSITION`` [B, N, 2]. Episodes are
    truncated after ``HORIZON`` steps.

    Args:
        worlds: number of worlds, B.
        agents: number of agents and of landmarks, N.
        local_ratio: weight of an agent's own reward; the common one has the rest.
        registered: whether the places in ``SEEN`` are registered.

    Examples:
        >>> env = SimpleSpread(64)
        >>> env.rollout(25)["next", "agents", "reward"].sum((1, 2, 3)).mean()  # about -79
    """

    moving: tuple[tuple[float, float, float], ...] = ((5.0, math.inf, 0.15),)
    """Force of an action, largest speed and radius of an agent; and of a prey, if there is one."""
    n_landmarks: int | None = None
    """Number of landmarks; N if None."""

    def __init__(
        self, worlds: int, agents: int = 3, local_ratio: float = 0.5, registered: bool = False
    ) -> None:
        super().__init__(batch_size=torch.Size([worlds]))
        self.n_agents = agents
        self.local_ratio = local_ratio
        self.registered = registered
        self.directions = torch.tensor(DIRECTIONS)
        places = torch.arange(agents)
        self.others = places.expand(agents, -1)[places != places.unsqueeze(-1)].view(agents, -1)
        self.generator = torch.Generator()
        self.generator.seed()
        bodies = [*self.moving[:1] * agents, *self.moving[1:]]
        self.force, self.speed, self.size = torch.tensor(bodies).unbind(-1)
        self.position = torch.zeros(worlds, len(bodies), 2)
        self.landmarks = torch.zeros(worlds, self.n_landmarks or agents, 2)
        self.velocity = torch.zeros_like(self.position)
        self.steps = torch.zeros(worlds, 1, dtype=torch.long)
        self._make_specs(worlds, agents)

    def _make_specs(self, worlds: int, n: int) -> None:
        group = torch.Size([worlds, n])
        batch = torch.Size([worlds])

        def composite(entries: dict[str, Any], rows: torch.Size = batch) -> Composite:
            return Composite(entries, shape=rows)

        def numbers(width: int, rows: torch.Size = group) -> Unbounded:
            return Unbounded(torch.Size((*rows, width)))

        seen = self._seen().flatten(1, 2).shape[:2]
        width = self._observation().shape[-1]
        outputs = composite(
            {"observation": numbers(width), "kinematics": numbers(4), "position": numbers(2)}, group
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
        new = self._drawn()
        world = mask.view(-1, 1, 1)
        self.position = torch.where(world, new[0], self.position)
        self.landmarks = torch.where(world, new[1], self.landmarks)
        self.velocity = self.velocity.masked_fill(world, 0.0)
        self.steps = self.steps.masked_fill(mask, 0)
        return self._outputs()

    def _drawn(self) -> tuple[Tensor, ...]:
        """Where what moves [B, M, 2], and the landmarks [B, L, 2], are at first."""
        return (2 * torch.rand(2, *self.position.shape, generator=self.generator) - 1).unbind(0)

    def chosen(self, actions: Tensor) -> Tensor:
        """What all that moves does, [B, M], when the agents choose ``actions`` [B, N]."""
        return actions

    def _contacts(self) -> Tensor:
        """Forces on what moves by what it touches, [B, M, 2]."""
        return contact_forces(self.position, self.size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        pushes = self.force.unsqueeze(-1) * self.directions[self.chosen(tensordict[keys.ACTION])]
        force = pushes + self._contacts()
        self.position = self.position + DT * self.velocity
        velocity = (1 - DAMPING) * self.velocity + DT * force
        self.velocity = velocity * (self.speed / velocity.norm(dim=-1)).clamp(max=1).unsqueeze(-1)
        self.steps = self.steps + 1
        return self._outputs().set(keys.REWARD, self._rewards().unsqueeze(-1))

    def _rewards(self) -> Tensor:
        """Reward of each agent where the agents are now, [B, N]."""
        common = -torch.cdist(self.landmarks, self.position).amin(-1).sum(-1, keepdim=True)
        apart = (self.position.unsqueeze(-2) - self.position.unsqueeze(-3)).norm(dim=-1)
        collisions = (apart < 2 * self.size[0]).sum(-1) - 1  # none with itself
        return (1 - self.local_ratio) * common - self.local_ratio * collisions

    @property
    def agents(self) -> Tensor:
        """Where the agents are, [B, N, 2]."""
        return self.position[:, : self.n_agents]

    def _seen(self) -> Tensor:
        """The places that agents see, relative to themselves, [B, N, K, 2]."""
        own = self.agents.unsqueeze(2)
        return torch.cat(
            [self.landmarks.unsqueeze(1) - own, self.position[:, self.others] - own], 2
        )

    def _kinematics(self) -> Tensor:
        return torch.cat([self.velocity[:, : self.n_agents], self.agents], -1)

    def _observation(self) -> Tensor:
        """PettingZoo's observation, [B, N, F]: kinematics, what is seen, and what others say, which
        is 0."""
        known = torch.cat([self._kinematics(), self._seen().flatten(2)], -1)
        return torch.cat([known, known.new_zeros(*known.shape[:-1], 2 * (self.n_agents - 1))], -1)

    def _outputs(self) -> TensorDictBase:
        shape = self.agents.shape[:2]
        seen = self._seen()
        over = self.steps >= HORIZON
        ends = {
            keys.DONE: over,
            keys.TERMINATED: torch.zeros_like(over),
            keys.TRUNCATED: over.clone(),
        }
        agents = {"observation": self._observation(), "kinematics": self._kinematics()}
        agents["position"] = self.agents.clone()
        messages = (seen + self.agents.unsqueeze(2) if self.registered else seen).flatten(1, 2)
        groups = {
            "agents": TensorDict(agents, shape),
            "seen": TensorDict({"message": messages}, messages.shape[:2]),
        }
        return TensorDict({**groups, **ends}, self.batch_size)


class SimpleTag(SimpleSpread):
    """``simple_tag_v3`` without its bonus for the prey, which is no agent here but flees by a rule.

    The N predators get 10 for each of them that touches the prey. Of its five actions the prey
    takes the one after which it would come to rest farthest from the nearest predator, and not
    outside the plane's edge. In PettingZoo the prey learns, too; Fu et al. (2025) have trained one
    beforehand.
    """

    moving = ((3.0, 1.0, 0.075), (4.0, 1.3, 0.05))
    n_landmarks = 2
    obstacle: float = 0.2
    """Radius of a landmark, which nothing passes."""

    def _drawn(self) -> tuple[Tensor, ...]:
        shapes = (self.position.shape, self.landmarks.shape)
        most = (1.0, 0.9)
        drawn = (torch.rand(shape, generator=self.generator) for shape in shapes)
        return tuple(size * (2 * new - 1) for new, size in zip(drawn, most, strict=True))

    def chosen(self, actions: Tensor) -> Tensor:
        rest = self.position[:, -1:] + DT / DAMPING * self.velocity[:, -1:]
        rest = rest + self.force[-1] * REACH * self.directions  # [B, 5, 2]
        outside = (rest.abs() - 0.9).clamp(min=0).sum(-1)
        flight = (torch.cdist(rest, self.agents).amin(-1) - 10 * outside).argmax(-1, keepdim=True)
        return torch.cat([actions, flight], -1)

    def _contacts(self) -> Tensor:
        size = torch.cat([self.size, torch.full(self.landmarks.shape[1:2], self.obstacle)])
        return contact_forces(torch.cat([self.position, self.landmarks], 1), size)[
            :, : len(self.size)
        ]

    def _rewards(self) -> Tensor:
        way = (self.agents - self.position[:, -1:]).norm(dim=-1)
        return 10.0 * (way < self.size[0] + self.size[-1]).sum(-1, keepdim=True).expand_as(way)

    def _seen(self) -> Tensor:
        own = self.agents.unsqueeze(2)
        prey = self.position[:, None, -1:]
        after = prey + self.velocity[:, None, -1:]
        return torch.cat([super()._seen(), prey - own, after - own], 2)

    def _observation(self) -> Tensor:
        seen = self._seen()
        seen = torch.cat(
            [seen[:, :, :-1], seen[:, :, -1:] - seen[:, :, -2:-1]], 2
        )  # the prey's velocity
        return torch.cat([self._kinematics(), seen.flatten(2)], -1)


def contact_forces(position: Tensor, size: Tensor) -> Tensor:
    """Forces on bodies at positions [B, M, 2], of radius [M], by all others that they touch,
    [B, M, 2]."""
    way = position.unsqueeze(-2) - position.unsqueeze(
        -3
    )  # from the others to each body, [B, M, M, 2]
    distance = way.norm(dim=-1, keepdim=True)
    touching = (size.unsqueeze(-1) + size).unsqueeze(-1)
    overlap = CONTACT_MARGIN * softplus((touching - distance) / CONTACT_MARGIN)
    return CONTACT_FORCE * (way / distance.clamp(min=1e-12) * overlap).sum(-2)


class Receiver(Transform):
    """Writes what agents and critics observe of their kinematics and of what they see.

    Critics observe ``observed(...)`` of the blocks that are held or, if there is one, of their
    timeline; and actors too, with ``ages`` followed by the age of each block. For learners it also
    writes that every agent may choose in every step, the longest delay of the blocks that were sent
    in this step, and that nothing is back-updated yet.

    Args:
        longest: steps that are an age of 1.
        ages: whether actors observe the ages.
        registered: whether the blocks are.
    """

    def __init__(self, longest: int, ages: bool, registered: bool) -> None:
        super().__init__()
        self.longest = longest
        self.ages = ages
        self.registered = registered

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(self._written(next_tensordict))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
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
    [*, N K, 2], which are moved into the agent's present frame if they are ``registered``, or their
    timelines [*, N K, slots, 3].
    """
    *rows, n, _ = kinematics.shape
    seen = seen.unflatten(len(rows), (n, -1))
    if registered:
        seen = seen - kinematics[..., 2:].unsqueeze(-2)
    which = torch.eye(n, device=kinematics.device).expand(*rows, n, n)
    return torch.cat([kinematics, seen.flatten(len(rows) + 1), which], -1)


def late_game(
    game: type[SimpleSpread],
    worlds: int,
    delay: int | Law,
    longest: int,
    *,
    aware: bool = False,
    registered: bool = False,
    slots: int = 0,
) -> TransformedEnv:
    """A game for B worlds whose agents see each landmark, each other agent and the prey late.

    An agent knows its own velocity and position at once. At the beginning it holds what it sees
    there.

    Args:
        game: ``SimpleSpread`` or ``SimpleTag``.
        worlds: number of worlds, B.
        delay: of each block [steps], or its law.
        longest: number of latest actions that an aware actor observes.
        aware: whether actors observe ages, and their own latest actions by how far these move them.
        registered: whether the blocks that agents hold are moved into their present frame.
        slots: number of latest steps that agents observe as the timelines of the blocks, in their
            present frame, instead of the blocks that they hold; 0: there are none.
    """
    parts: list[Transform] = [
        ObservationDelay(delay, [SEEN], [HELD], age_key="age", delay_key="delay")
    ]
    if slots:
        parts.append(
            ObservationTimeline(slots, SEEN, delay_key="delay", position_key=keys.POSITION)
        )
    parts.append(Receiver(longest, aware, registered))
    if aware:
        codes = torch.tensor(DIRECTIONS) * game.moving[0][0] * REACH
        parts.append(ActionHistory(longest, keys.ACTION, append_to=keys.OBSERVATION, codes=codes))
    parts.append(StepCounter())
    return TransformedEnv(game(worlds, registered=registered), Compose(parts))
