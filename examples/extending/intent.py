"""Your own learner: MAPPO whose UAVs send what they intend, and read what has arrived of it.

    damian train scenario=delaybench/crowded delay.obs=1..7 observation.own=true aware=backupdate \\
        delay.messages=8 learner=examples.extending.intent:IntentConfig      (in a clone)

The manner of CoDe (Song et al., *CoDe: Communication Delay-Tolerant Multi-Agent Collaboration via
Dual Alignment of Intent and Timeliness*, AAAI 2025), without its term for diverse intents. Each UAV
encodes what it observes and where it has been as an intent, from which its next actions can be
inferred and which changes slowly; it sends the intent with its message, and both are late or lost
together. A receiver attends over the newest intent of each other UAV, by how well it matches its
own and by its age. The policy learns from the intents that it has read; gradients do not pass
through links.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Categorical, Composite, ReplayBuffer, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, recurrent_mode

from damian import keys
from damian.common import checks
from damian.common.fields import setting
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.config import MappoConfig
from damian.learners.mappo import LOSS_KEYS, Mappo
from damian.models.config import ModelConfig
from damian.models.distribution import with_distribution
from damian.models.memory import RecurrentModule
from damian.server.layout import layout_at

SENT = "intents_sent"
"""The intents that each UAV sent in the latest steps, the newest first, [B, N, K - 1, W]. It is no
entry of ``agents``, since no UAV reads it before it has arrived."""
HEARD = (keys.AGENTS, "heard")
"""A UAV's own intent and the newest one that it has of each other UAV, [B, N, N, W + 4]: behind it
the way to the sender's place in that message, the message's age over K steps, and 1; zeros if there
is none."""


@dataclass
class IntentConfig(MappoConfig):
    """MAPPO whose UAVs send and read intents."""

    width: int = setting(32, "Width of the encoder and of what is read.", low=1, high=1024)
    intent_width: int = setting(8, "Numbers of an intent.", low=1, high=1024)
    horizon: int = setting(5, "Next actions that are inferred.", low=1, high=checks.STEPS)
    discount: float = setting(0.9, "Weight of an intent for each step of age.", above=0, high=1)
    smoothness: float = setting(0.1, "Weight of an intent's change in a step.", low=0, high=1e6)
    intent_steps: int = setting(
        40, "Steps of gradient descent on intents after each update.", low=1, high=checks.STEPS
    )
    intent_batch: int = setting(256, "Environment steps in each.", low=1, high=checks.STEPS)
    intent_lr: float = setting(0.002, "Learning rate of intents.", above=0, high=1)

    reads: ClassVar[tuple[str, ...]] = ("timeline",)

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        model = setup.model
        should = "does not go with this learner, whose actor has an encoder of its own"
        checks.require(not model.recurrent, "model.rnn", model.rnn, should)
        checks.require(not model.prior, "model.prior", True, should)
        checks.require(model.shared, "model.shared", False, should)
        should = "does not go with this learner, whose policy learns from what it has read"
        checks.require(not setup.recompute_actor, "corrected", ["actor"], should)
        should = f"is not less than the steps of an update, {setup.shortest_period}"
        checks.require(
            self.horizon < setup.shortest_period, "learner.horizon", self.horizon, should
        )

    def make(
        self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None
    ) -> "IntentMappo":
        return IntentMappo(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return make_intent_actor(env, model, self)


class IntentMappo(Mappo):
    """MAPPO that after each update also learns intents, from random steps of the batch."""

    config: IntentConfig
    loss_keys = (*LOSS_KEYS, HEARD)

    def __init__(
        self,
        env: EnvBase,
        config: IntentConfig,
        setup: LearningSetup,
        buffer: ReplayBuffer | None,
    ) -> None:
        super().__init__(env, config, setup, buffer)
        self.intents = next(each for each in self.actor.modules() if isinstance(each, Intents))
        n_actions = cast(Categorical, env.full_action_spec_unbatched[keys.ACTION]).n
        self.infer = nn.Linear(config.intent_width, config.horizon * n_actions)
        self.infer.to(env.device)
        weights = [*self.intents.parameters(), *self.infer.parameters()]
        self.intent_optimizer = torch.optim.Adam(weights, lr=config.intent_lr, fused=True)

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores: also what infers actions, and the optimiser of intents."""
        more = {"infer": self.infer, "intent_optimizer": self.intent_optimizer}
        return {**super().components(), **more}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """As ``Mappo.learn``; also ``intent_loss``, the mean cross-entropy of inferred actions
        [nats]."""
        unread = [SENT, keys.TIMELINE]
        numbers = super().learn(batch.exclude(*unread, *map(next_key, unread)))
        losses = [self.learn_intents(batch) for _ in range(self.config.intent_steps)]
        return {**numbers, "intent_loss": torch.stack(losses).mean().item()}

    def learn_intents(self, batch: TensorDictBase) -> Tensor:
        """Make one step of gradient descent on random steps of a batch [B, T]; returns the mean
        cross-entropy of inferred actions before it."""
        n_worlds, n_steps = batch.shape
        horizon = self.config.horizon
        sampled = (self.config.intent_batch, 1)
        world = torch.randint(n_worlds, sampled, device=self.infer.weight.device)
        first = torch.randint(n_steps - horizon + 1, sampled, device=world.device)
        step = first + torch.arange(horizon, device=world.device)
        ended = batch[next_key(keys.DONE)][world, step].squeeze(-1).cumsum(-1)
        same = F.pad(ended[:, :-1] == 0, (1, 0), value=True).unsqueeze(-1)  # the same episode
        pair = step[:, : min(2, horizon)]
        observation, timeline = (
            batch[key][world, pair] for key in (keys.OBSERVATION, keys.TIMELINE)
        )
        intent = self.intents.encoded(observation, timeline)  # [M, 2, N, W]
        logits = self.infer(intent[:, 0]).unflatten(-1, (horizon, -1)).transpose(1, 2)
        action = batch[keys.ACTION][world, step]
        counts = batch[keys.READY][world, step] & same
        error = F.cross_entropy(logits.flatten(0, 2), action.flatten(), reduction="none")
        error = (error * counts.flatten()).sum() / counts.sum().clamp(min=1)
        change = (intent[:, -1] - intent[:, 0]).square().mean(-1)
        change = (change * same[:, pair.shape[1] - 1]).mean()
        self.intent_optimizer.zero_grad()
        (error + self.config.smoothness * change).backward()
        self.intent_optimizer.step()
        return error.detach()


# The actor.


class Intents(RecurrentModule):
    """Encodes each UAV's intent, sends it, and writes those that have arrived.

    While acting it writes ``("agents", "heard")``; in TorchRL's recurrent mode, which losses switch
    on, nothing, so that the policy learns from what it has read.
    """

    def __init__(self, n_features: int, n_columns: int, slots: int, config: IntentConfig) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.TIMELINE, SENT]  # type: ignore[assignment]
        self.out_keys = [SENT, HEARD]  # type: ignore[assignment]
        self.slots = slots
        self.read = nn.Linear(n_features, config.width)
        self.cell = nn.GRUCell(n_columns, config.width)
        self.tell = nn.Linear(config.width, config.intent_width)

    def state_spec(self, env: EnvBase) -> Composite:
        n_agents = cast(Composite, env.observation_spec[keys.AGENTS]).shape[-1]
        shape = (*env.batch_size, n_agents, self.slots - 1, self.tell.out_features)
        return Composite(
            {SENT: Unbounded(torch.Size(shape))},
            shape=env.batch_size,
            device=cast(torch.device, env.device),
        )

    def encoded(self, observation: Tensor, timeline: Tensor) -> Tensor:
        """Intents [*, N, W] from observations [*, N, F] and timelines [*, N, S, K, C].

        Each UAV reads only its own part of the timeline, from the oldest slot to the newest.
        """
        own = timeline[..., 0, :, :].flatten(0, -3)
        belief = own.new_zeros(len(own), self.cell.hidden_size)
        for slot in own.flip(1).unbind(1):
            belief = self.cell(slot, belief)
        read = self.read(observation) + belief.view(*observation.shape[:-1], -1)
        return torch.tanh(self.tell(read.relu()))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if recurrent_mode():
            return tensordict
        timeline = tensordict[keys.TIMELINE]
        intent = self.encoded(tensordict[keys.OBSERVATION], timeline)
        sent = torch.cat([intent.unsqueeze(-2), tensordict[SENT]], -2)  # [*, N, K, W]
        return tensordict.set(SENT, sent[..., :-1, :]).set(HEARD, heard(timeline, sent))


def heard(timeline: Tensor, sent: Tensor) -> Tensor:
    """``HEARD`` from timelines [*, N, S, K, C], which tell what has arrived, and the intents that
    each UAV sent in their slots, [*, N, K, W]."""
    agent = torch.arange(timeline.shape[-4], device=sent.device)
    sender = (agent.unsqueeze(-1) + agent) % len(agent)  # the receiver is its own first sender
    known = timeline[..., -1:] > 0  # [*, N, S, K, 1]
    itself = (agent == 0)[:, None, None]
    present = torch.arange(known.shape[-2], device=sent.device).unsqueeze(-1) == 0
    known = known & (itself | ~present)  # of others what was sent in a step before
    exists = known.any(-2)
    newest = known.byte().argmax(-2, keepdim=True)
    intent = sent[..., sender, :, :].take_along_dim(newest, -2).squeeze(-2)
    place = timeline[..., :2].take_along_dim(newest, -2).squeeze(-2)
    way = 2 * (place - place[..., :1, :])
    age = newest.squeeze(-2) / known.shape[-2]
    return torch.cat([intent, way, age, exists], -1) * exists


def make_intent_actor(env: EnvBase, model: ModelConfig, config: IntentConfig) -> ProbabilisticActor:
    """Make the policy from observations, timelines and intents to ``("agents", "action")``."""
    should = "reads no messages: set delay.messages"
    told = keys.TIMELINE in env.observation_spec.keys(True, True)
    checks.require(told, "learner", config.name, should)
    should = "needs actions.kind=discrete"
    discrete = isinstance(env.full_action_spec_unbatched[keys.ACTION], Categorical)
    checks.require(discrete, "learner", config.name, should)
    slots, n_columns = env.observation_spec[keys.TIMELINE].shape[-2:]
    layout = layout_at(env, keys.OBSERVATION)
    intents = Intents(layout.width, n_columns, slots, config)
    read = layout.appended("intents", (config.intent_width + config.width,), -1.0, 1.0)

    def make(n_out: int, *out_keys: NestedKey) -> TensorDictModule:
        fused = Fused(model.make_network(read, n_out), slots, config)
        chosen = TensorDictModule(fused, [keys.OBSERVATION, HEARD], list(out_keys))
        return TensorDictSequential([intents, chosen])  # type: ignore[list-item]

    actor = with_distribution(env, make)
    actor.to(env.device)
    return actor


class Fused(nn.Module):
    """A network that reads observations, a UAV's own intent, and the mean of those of others,
    weighed by how well they match its own and by their age."""

    def __init__(self, network: nn.Module, slots: int, config: IntentConfig) -> None:
        super().__init__()
        self.network = network
        self.intent_width = config.intent_width
        self.lost_per_age = slots * torch.tensor(config.discount).log().item()
        self.query = nn.Linear(config.intent_width, config.width)
        self.key = nn.Linear(config.intent_width, config.width)
        self.value = nn.Linear(config.intent_width + 3, config.width)

    def forward(self, observation: Tensor, heard: Tensor) -> Tensor:
        """Outputs from observations [*, F] and intents [*, N, W + 4]."""
        own = heard[..., 0, : self.intent_width]
        others = heard[..., 1:, :]
        key = self.key(others[..., : self.intent_width])
        match = key @ self.query(own).unsqueeze(-1) / key.shape[-1] ** 0.5  # [*, N - 1, 1]
        age, exists = others[..., -2:].split(1, -1)
        match = match + self.lost_per_age * age
        weight = match.masked_fill(exists == 0, -1e4).softmax(-2) * exists
        fused = (weight * torch.tanh(self.value(others[..., :-1]))).sum(-2)
        return self.network(torch.cat([observation, own, fused], -1))
