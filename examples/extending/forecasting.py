"""Your own learner: MAPPO whose actor reads where its teammates are now, as a network forecasts it
from the messages that have arrived.

    damian train scenario=delaybench/crowded delay.obs=1..7 observation.own=true aware=backupdate \\
        delay.messages=10 learner=examples.extending.forecasting:ForecastConfig      (in a clone)
    ... learner.encoder=gru

With ``encoder=transformer`` a transformer reads all messages that have arrived, each at the step in
which it was sent, and forecasts at once what is missing: the manner of DFBT (Wu et al., *Directly
Forecasting Belief for Reinforcement Learning with Delays*, ICML 2025). With ``encoder=gru`` a
recurrent filter runs over the same steps in order, where a step without a message is a prediction
and a message that comes out of order runs it again: the manner of Karamzade et al. (*Model-Based
Reinforcement Learning under Random Observation Delays*, L4DC 2026), without their planning in
latent states. The forecast learns from what later messages tell, never from the simulator.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, recurrent_mode

from damian import keys
from damian.common import checks
from damian.common.fields import setting
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.config import MappoConfig
from damian.learners.mappo import LOSS_KEYS, Mappo
from damian.models.actor import NormalParameters
from damian.models.config import ModelConfig
from damian.models.distribution import with_distribution
from damian.replay.backupdate import BackupdateStorage
from damian.server.features.others import OTHERS
from damian.server.layout import layout_at

FORECAST = (keys.AGENTS, "forecast")
"""Ways to where the nearest teammates are now by the forecast, and 1, [B, N, 4, 3]; zeros for those
that do not exist."""


@dataclass
class ForecastConfig(MappoConfig):
    """MAPPO whose actor also reads a forecast of its teammates' present places."""

    encoder: str = setting(
        "transformer", "What reads the messages.", choices=("transformer", "gru")
    )
    width: int = setting(32, "Width of the encoder.", low=1, high=1024)
    layers: int = setting(2, "Layers of a transformer.", low=1, high=100)
    heads: int = setting(4, "Attention heads of a transformer.", low=1, high=1024)
    forecast_steps: int = setting(
        40, "Steps of gradient descent on the forecast after each update.", low=1, high=checks.STEPS
    )
    forecast_batch: int = setting(
        256, "Environment steps in each of them.", low=1, high=checks.STEPS
    )
    forecast_lr: float = setting(0.002, "Learning rate of the forecast.", above=0, high=1)
    forecast_buffer: int = setting(
        32000, "Environment steps from which forecasts are learnt.", low=1, high=checks.STEPS
    )

    reads: ClassVar[tuple[str, ...]] = ("timeline",)

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        model = setup.model
        checks.require(
            setup.backupdate, "learner", self.name, "needs backupdate=true, whose steps it reads"
        )
        checks.require(
            self.width % self.heads == 0, "learner.width", self.width, "is no multiple of the heads"
        )
        should = "does not go with this learner, whose actor has an encoder of its own"
        checks.require(not model.recurrent, "model.rnn", model.rnn, should)
        checks.require(not model.prior, "model.prior", True, should)
        checks.require(model.shared, "model.shared", False, should)

    def buffer_size(self, setup: LearningSetup) -> int | None:
        wanted = self.forecast_buffer // setup.worlds * setup.worlds
        return max(super().buffer_size(setup) or 0, wanted)

    def make(
        self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None
    ) -> "ForecastingMappo":
        return ForecastingMappo(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return make_forecasting_actor(env, model, self)


class ForecastingMappo(Mappo):
    """MAPPO that after each update also learns to forecast, from random steps of the replay
    buffer."""

    config: ForecastConfig
    buffer: ReplayBuffer
    loss_keys = (*LOSS_KEYS, FORECAST)

    def __init__(
        self,
        env: EnvBase,
        config: ForecastConfig,
        setup: LearningSetup,
        buffer: ReplayBuffer | None,
    ) -> None:
        super().__init__(env, config, setup, buffer)
        self.forecaster = next(
            each for each in self.actor.modules() if isinstance(each, Forecaster)
        )
        self.slots = self.forecaster.slots
        should = f"is more than the steps of an update, {setup.shortest_period}"
        checks.require(self.slots <= setup.shortest_period, "delay.messages", self.slots, should)
        self.forecast_optimizer = torch.optim.Adam(
            self.forecaster.parameters(), lr=config.forecast_lr, fused=True
        )

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores: also the optimiser of the forecast."""
        return {**super().components(), "forecast_optimizer": self.forecast_optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """As ``Mappo.learn``; also ``forecast_error``, the mean square error of the forecast present
        places, over that of the places which the newest messages tell."""
        # What is known after a step is what is known before the next one: it need not be stored
        # twice.
        numbers = super().learn(batch.exclude(next_key(keys.TIMELINE)))
        errors = [self.learn_forecast() for _ in range(self.config.forecast_steps)]
        forecast, newest = torch.stack(errors).sum(0).tolist()
        return {**numbers, "forecast_error": forecast / max(newest, 1e-12)}

    def learn_forecast(self) -> Tensor:
        """Make one step of gradient descent on random steps of the replay buffer.

        Returns sums of squares over present places, of the error before it, and of that of the
        places which the newest messages tell, [2].
        """
        n_steps = len(self.storage.latest()) - self.slots + 1
        sampled = (self.config.forecast_batch,)
        first = torch.randint(n_steps, sampled, device=self.storage.device)
        world = torch.randint(self.setup.worlds, sampled, device=self.storage.device)
        observation, timeline, later = self.stored(first, world)
        place, known = ways(timeline)
        truth, told = ways(later, timeline)
        counts = told & ~known
        counts[..., 0, :, :] = False  # the receiver knows itself
        error = (self.forecaster.forecast(observation, timeline) - truth).square() * counts
        self.forecast_optimizer.zero_grad()
        (error.sum() / counts.sum().clamp(min=1)).backward()
        self.forecast_optimizer.step()
        newest = place.take_along_dim(newest_slot(known), -2)
        unmoved = (newest - truth).square() * counts
        return torch.stack([each[..., 0, :].sum().detach() for each in (error, unmoved)])

    @property
    def storage(self) -> BackupdateStorage:
        """The stored steps, from which forecasts are learnt."""
        return cast(BackupdateStorage, self.buffer.storage)

    def stored(self, first: Tensor, world: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Stored steps, by their order in time and their worlds, [M] each; the last K - 1 steps have
        no answer yet.

        Returns observations [M, N, F], timelines [M, N, S, K, C], and timelines of the same K steps
        of what each UAV knew of a step when that had come to the last slot, zeros for what it did
        not know even then, or if the episode had ended.
        """
        steps = self.storage.steps
        rows = self.storage.latest()
        observation, timeline = (
            cast(Tensor, steps[key]) for key in (keys.OBSERVATION, keys.TIMELINE)
        )
        # A timeline holds nothing of an earlier episode, so an answer is of the same one.
        slot = torch.arange(self.slots, device=rows.device)
        in_last_slot = rows[first.unsqueeze(-1) + self.slots - 1 - slot]
        later = timeline[..., -1, :][in_last_slot, world.unsqueeze(-1)].movedim(1, -2)
        row = rows[first]
        return observation[row, world], timeline[row, world], later


# The actor.


def newest_slot(known: Tensor) -> Tensor:
    """Index of the newest known slot of each sender, [*, S, 1, 1], from flags [*, S, K, 1]."""
    return known.byte().argmax(-2, keepdim=True)


def ways(timeline: Tensor, seen: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Where senders were by a timeline [*, S, K, C], and which of its slots are known.

    Ways [*, S, K, 2] begin at the newest place of the receiver, who is the first sender, in the
    timeline ``seen`` (if not given, this one), and are over half the size of the region; zeros for
    unknown slots. Flags [*, S, K, 1] bool.
    """
    own = (timeline if seen is None else seen)[..., :1, :, :]
    newest = own.take_along_dim(newest_slot(own[..., -1:]), -2)
    known = timeline[..., -1:] > 0
    return 2 * (timeline[..., :2] - newest[..., :2]) * known, known


class RecurrentFilter(nn.GRUCell):
    """A gated recurrent unit that runs from the oldest slot to the newest one."""

    def forward(self, slots: Tensor) -> Tensor:  # type: ignore[override]
        """Beliefs [M, K, W] from what is read of each slot, [M, K, W], the newest first."""
        belief = torch.zeros_like(slots[:, 0])
        beliefs = []
        for slot in slots.flip(1).unbind(1):  # a compiled loss takes no nn.GRU
            belief = super().forward(slot, belief)
            beliefs.append(belief)
        return torch.stack(beliefs[::-1], 1)


def make_encoder(config: ForecastConfig) -> nn.Module:
    """A network from what is read of a sender's slots, [M, K, W], to encodings of the same
    shape."""
    width = config.width
    if config.encoder == "gru":
        return RecurrentFilter(width, width)
    layer = nn.TransformerEncoderLayer(
        width, config.heads, 2 * width, dropout=0.0, batch_first=True, norm_first=True
    )
    return nn.TransformerEncoder(layer, config.layers, enable_nested_tensor=False)


class Forecaster(TensorDictModuleBase):
    """Forecasts where each sender of a timeline was in each of its slots, from all of them.

    While acting it writes ``("agents", "forecast")`` [*, 4, 3]; in TorchRL's recurrent mode, which
    losses switch on, nothing, so that the policy learns from what it has read.
    """

    def __init__(self, n_features: int, n_columns: int, slots: int, config: ForecastConfig) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.TIMELINE]  # type: ignore[assignment]
        self.out_keys = [FORECAST]  # type: ignore[assignment]
        self.slots = slots
        width = config.width
        self.read_slot = nn.Linear(n_columns + 5, width)
        self.read_slots_of_all = nn.Linear(width, width)
        self.read_observation = nn.Linear(n_features, width)
        self.age = nn.Parameter(0.1 * torch.randn(slots, width))
        self.encoder = make_encoder(config)
        self.tell = nn.Linear(width, 2)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if recurrent_mode():
            return tensordict
        timeline = tensordict[keys.TIMELINE]
        told, known = ways(timeline)
        forecast = self.forecast(tensordict[keys.OBSERVATION], timeline)
        present = torch.where(known, told, forecast)[..., 1:, 0, :]  # of the others, now
        order = present.square().sum(-1, keepdim=True).argsort(-2)[..., :OTHERS, :]
        nearest = present.take_along_dim(order, -2).clamp(-1, 1)
        rows = F.pad(nearest, (0, 1), value=1.0)
        return tensordict.set(FORECAST, F.pad(rows, (0, 0, 0, OTHERS - rows.shape[-2])))

    def forecast(self, observation: Tensor, timeline: Tensor) -> Tensor:
        """Ways to where each sender was in each slot, as in ``ways``, [*, S, K, 2], from
        observations [*, F] and timelines [*, S, K, C].

        The slots of a sender are a sequence. Each also tells the sender's newest known place, from
        which the forecast counts, and the mean of what has been read of all senders in this slot.
        """
        place, known = ways(timeline)
        newest = place.take_along_dim(newest_slot(known), -2)
        receiver = torch.zeros_like(place[..., :1])
        receiver[..., 0, :, :] = 1
        seen = torch.cat([place, newest.expand_as(place), timeline, receiver], -1)
        slots = self.read_slot(seen) + self.age
        of_all = self.read_slots_of_all(slots.mean(-3, keepdim=True))
        read = slots + of_all + self.read_observation(observation)[..., None, None, :]
        encoded = self.encoder(read.flatten(0, -3)).view_as(read)
        return newest + self.tell(encoded)


def make_forecasting_actor(
    env: EnvBase, model: ModelConfig, config: ForecastConfig
) -> ProbabilisticActor:
    """Make the policy from observations and timelines to ``("agents", "action")``."""
    should = "reads no messages: set delay.messages"
    checks.require(
        keys.TIMELINE in env.observation_spec.keys(True, True), "learner", config.name, should
    )
    slots, n_columns = env.observation_spec[keys.TIMELINE].shape[-2:]
    layout = layout_at(env, keys.OBSERVATION)
    forecaster = Forecaster(layout.width, n_columns, slots, config)
    read = layout.appended("forecast", (OTHERS, 3), -1.0, 1.0, rows="forecasts")

    def make(n_out: int, *out_keys: NestedKey) -> TensorDictModule:
        policy: nn.Module = JoinedForecast(model.make_network(read, n_out))
        if len(out_keys) == 2:
            policy = NormalParameters(policy, NormalParamExtractor())
        chosen = TensorDictModule(policy, [keys.OBSERVATION, FORECAST], list(out_keys))
        return TensorDictSequential([forecaster, chosen])  # type: ignore[arg-type]

    actor = with_distribution(env, make)
    actor.to(env.device)
    return actor


class JoinedForecast(nn.Module):
    """A network that reads observations with the forecast behind them."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor, forecast: Tensor) -> Tensor:
        """Outputs from observations [*, F] and forecasts [*, 4, 3]."""
        return self.network(torch.cat([observation, forecast.flatten(-2)], -1))
