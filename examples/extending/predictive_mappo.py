"""Your own learner: MAPPO whose actor predicts, from the messages that have arrived, what arrives
later.

    damian train scenario=delaybench/tracking delay=paper aware=backupdate delay.messages=8 \\
        learner=examples.extending.predictive_mappo:PredictiveMappoConfig            (in a clone)

The actor asks the messages, by attention, one question for each action, predicts what they will
have said when that action has ended, and chooses. It learns to predict from the replay buffer.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import PopArtValueNorm, ProbabilisticActor, recurrent_mode
from torchrl.modules.distributions import NormalParamExtractor

from damian import keys
from damian.common import checks
from damian.common.fields import setting
from damian.common.tensors import expand_mask, gather_rows, next_true
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.config import MappoConfig
from damian.learners.mappo import LOSS_KEYS, Mappo
from damian.models.config import ModelConfig
from damian.models.distribution import with_distribution
from damian.models.mlp import hidden_layers, make_mlp
from damian.replay.backupdate import BackupdateStorage
from damian.replay.hindsight import arrived_by_now

ENCODING = (keys.AGENTS, "encoding")
"""What the actor makes of its observation and the messages it knows, [B, N, H]."""
PREDICTION = (keys.AGENTS, "prediction")
"""What it predicted for each discrete action when it acted, [B, N, A G]."""


@dataclass
class PredictiveMappoConfig(MappoConfig):
    """MAPPO with a learnt belief: attention over the messages that have arrived, trained by
    prediction."""

    prediction_steps: int = setting(
        100,
        "Steps of gradient descent on the predictions after each update.",
        low=1,
        high=checks.STEPS,
    )
    prediction_batch: int = setting(
        400, "Environment steps in each of them.", low=1, high=checks.STEPS
    )
    prediction_lr: float = setting(0.002, "Learning rate of the predictions.", above=0, high=1)
    prediction_buffer: int = setting(
        32000, "Environment steps from which predictions are learnt.", low=1, high=checks.STEPS
    )
    heads: int = setting(4, "Number of attention heads over the messages.", low=1, high=1024)
    width: int = setting(32, "Size of the embedding of a message.", low=1, high=16384)

    reads: ClassVar[tuple[str, ...]] = ("timeline",)
    actor_follows_critic: ClassVar[bool] = True

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        model = setup.model
        constant_delay = setup.action_delay is not None
        should = (
            "needs backupdate=true and a message delay (delay.obs): it predicts what arrives late"
        )
        checks.require(setup.backupdate, "learner", self.name, should)
        should = "needs a constant action delay (delay.act): it predicts when actions take effect"
        checks.require(constant_delay, "learner", self.name, should)
        should = "does not go with this learner, whose actor has an encoder of its own"
        checks.require(not model.recurrent, "model.rnn", model.rnn, should)
        checks.require(not model.prior, "model.prior", True, should)
        checks.require(bool(model.hidden), "model.hidden", [], should)
        checks.require(not setup.recompute_actor, "corrected", "actor", should)

    def buffer_size(self, setup: LearningSetup) -> int | None:
        least = super().buffer_size(setup)
        return (
            None
            if least is None
            else max(least, self.prediction_buffer // setup.worlds * setup.worlds)
        )

    def make(
        self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None
    ) -> "PredictiveMappo":
        return PredictiveMappo(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return make_belief_actor(env, model, self.heads, self.width)


class PredictiveMappo(Mappo):
    """MAPPO that after each update also learns to predict, from random steps of the replay buffer.

    The target of a decision is the critic's observation when its action has ended, as the
    back-updating storage knows it by now. A decision whose last message has not arrived by now has
    no weight.
    """

    config: PredictiveMappoConfig
    buffer: ReplayBuffer
    loss_keys = (*LOSS_KEYS, ENCODING, PREDICTION)

    def __init__(
        self,
        env: EnvBase,
        config: PredictiveMappoConfig,
        setup: LearningSetup,
        buffer: ReplayBuffer | None,
    ) -> None:
        super().__init__(env, config, setup, buffer)
        self.head = next(each for each in self.actor.modules() if isinstance(each, BeliefHead))
        self.head_optimizer = torch.optim.Adam(
            self.head.parameters(), lr=config.prediction_lr, fused=True
        )

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores: also the optimiser of the belief head."""
        return {**super().components(), "head_optimizer": self.head_optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """As ``Mappo.learn``; also the mean ``prediction_error``, 1 if no better than the targets'
        mean."""
        # What is known after a step is what is known before the next one: it need not be stored
        # twice.
        numbers = super().learn(batch.exclude(next_key(keys.TIMELINE)))
        last = self.last_steps()
        errors = [self.learn_prediction(last) for _ in range(self.config.prediction_steps)]
        return {**numbers, "prediction_error": torch.stack(errors).mean().item()}

    def learn_prediction(self, last: Tensor) -> Tensor:
        """Make one step of gradient descent on random steps of the replay buffer; the error before
        it, []."""
        before, target, counts = self.sample(last)
        if counts.any():
            self.head.norm.update(target[counts.squeeze(-1)].double())
        wanted = self.head.norm.normalize(target).clamp(-LARGEST, LARGEST).to(target.dtype)
        error = prediction_loss(
            self.head.predict(*before), wanted.unsqueeze(-2), counts.unsqueeze(-2)
        )
        self.head_optimizer.zero_grad()
        error.backward()
        self.head_optimizer.step()
        return error.detach()

    @property
    def storage(self) -> BackupdateStorage:
        """The stored steps, from which predictions are learnt."""
        return cast(BackupdateStorage, self.buffer.storage)

    def last_steps(self) -> Tensor:
        """The last step of each UAV's action in each stored step, as in ``ends_of_actions``,
        [T, B, N]."""
        steps = self.storage.steps
        rows = self.storage.latest()
        ready, reset = (
            cast(Tensor, steps[key])[rows] for key in (next_key(keys.READY), keys.RESET_AFTER)
        )
        return ends_of_actions(ready, reset, cast(int, self.setup.action_delay))

    def sample(self, last: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Draw K stored steps: what predictions are made from, what came after, and what of it
        counts.

        Returns observations, histories and actions, [K, N, ...]; the critic's observation when
        these actions had ended, [K, N, G]; and whether the UAV could choose, has completed its
        action, and its last message has arrived by now, [K, N, 1] bool.
        """
        steps = self.storage.steps
        rows = self.storage.latest()
        n_samples = self.config.prediction_batch
        n_rows = len(rows)
        device = rows.device
        since = torch.randint(n_rows, (n_samples,), device=device)
        world = torch.randint(self.setup.worlds, (n_samples,), device=device)
        first = n_rows - 1 - since
        read = (keys.OBSERVATION, keys.TIMELINE, keys.ACTION, keys.READY)
        *before, ready = (cast(Tensor, steps[key])[rows[first], world] for key in read)
        end = last[first, world]
        index = (
            rows[end.clamp(max=n_rows - 1)],
            world.unsqueeze(-1),
            torch.arange(end.shape[-1], device=device),
        )
        after = (keys.READY, keys.DELAY, keys.GLOBAL_OBSERVATION)
        completed, delay, target = (cast(Tensor, steps[next_key(key)])[index] for key in after)
        arrived = arrived_by_now(delay, n_rows - 1 - end)
        # An action whose flight the end of the episode has cut leads to nothing that could be
        # predicted.
        return before, target, arrived & (ready & completed).unsqueeze(-1)


# The actor.

FLAGS = 3
"""Columns that follow those of a message: has it arrived, its age, and did the receiver send it."""
CODE_SIZE = 8
"""Size of the learnt code of a discrete action."""
PREFERENCE_UNIT = 30.0
"""Logits per unit of the learnt weights of predictions, which move slowly."""
LARGEST = 5.0
"""Largest magnitude of a normalised target, so that a number that hardly ever changes weighs no
more."""
FORGETTING = 0.99
"""Share of the running statistics of the targets that an update keeps."""


class MessageEncoder(nn.Module):
    """Encodes F features, a set of messages of C columns, and a code [K] of what is asked, by
    attention.

    Each message is given as it is and relative to the newest known message of the first sender,
    which with ``ObservationTimeline`` is the receiver itself. Messages that are not known have no
    influence.
    """

    def __init__(
        self,
        n_features: int,
        n_columns: int,
        n_code: int,
        config: ModelConfig,
        heads: int,
        width: int,
        device: torch.device | None = None,
    ) -> None:
        super().__init__()
        self.n_message = n_columns - 1
        self.heads = heads
        self.width = width
        n_known = n_features + self.n_message
        n_embedded = 2 * self.n_message + FLAGS
        self.embed = nn.Sequential(nn.Linear(n_embedded, width, device=device), nn.ReLU())
        self.queries = nn.Sequential(
            nn.Linear(n_known + n_code, 2 * width, device=device),
            nn.ReLU(),
            nn.Linear(2 * width, heads * width, device=device),
        )
        self.layers = hidden_layers(config, heads * width + n_known + n_code, config.hidden).to(
            device
        )

    def forward(self, observation: Tensor, history: Tensor, codes: Tensor) -> Tensor:
        """Encode observations [*, F] and timelines [*, S, K, C], for Q codes each [*, Q, E], into
        [*, Q, H].

        A timeline has K slots for each of S senders; of one sender it may be [*, K, C].
        """
        if (
            observation.dim() > 2
        ):  # a compiler replaces attention in four dimensions by a slower kernel
            batch = observation.shape[:-1]
            rows = (part.flatten(0, len(batch) - 1) for part in (observation, history, codes))
            return self(*rows).unflatten(0, batch)
        history = with_age(
            history if history.dim() > observation.dim() + 1 else history.unsqueeze(-3)
        )
        message = history[..., : self.n_message]
        known = history[..., self.n_message]
        newest = known.argmax(-1, keepdim=True).unsqueeze(-1)  # the first of the known ones
        reference = message.gather(-2, newest.expand(*newest.shape[:-1], self.n_message))
        relative = (message - reference) * known.unsqueeze(-1)
        embedded = self.embed(torch.cat([history, relative], -1))  # [*, L, E]
        context = torch.cat([observation.unsqueeze(-2), reference], -1)
        first, *others = self.queries
        asked = _apply(others, _linear_of_parts(first, context, codes))
        queries = asked.unflatten(-1, (self.heads, self.width)).flatten(-3, -2)
        scores = queries @ embedded.transpose(-1, -2) / self.width**0.5  # [*, Q heads, L]
        shares = (scores + (known.unsqueeze(-2) - 1) * 1e8).softmax(-1)
        found = (shares @ embedded).unflatten(-2, (-1, self.heads)).flatten(-2)
        first, *others = self.layers
        return _apply(others, _linear_of_parts(first, found, context, codes))


def with_age(timeline: Tensor) -> Tensor:
    """Rows of a timeline [*, S, K, C], followed by age and whether of the first sender,
    [*, S K, C + 2]."""
    senders, slots = timeline.shape[-3:-1]
    age = torch.arange(slots, device=timeline.device) / slots
    first = (torch.arange(senders, device=timeline.device) == 0).float().unsqueeze(-1)
    flags = torch.stack(torch.broadcast_tensors(age, first), -1).to(timeline.dtype)
    return torch.cat([timeline, flags.expand(*timeline.shape[:-1], 2)], -1).flatten(-3, -2)


def _linear_of_parts(layer: nn.Module, *parts: Tensor) -> Tensor:
    """What a linear layer makes of features in several parts, [*, K] each, broadcast without
    copies."""
    weights = cast(nn.Linear, layer).weight.split([part.shape[-1] for part in parts], -1)
    return sum(
        (part @ w.T for part, w in zip(parts, weights, strict=True)), cast(nn.Linear, layer).bias
    )


def _apply(layers: list[nn.Module], features: Tensor) -> Tensor:
    for layer in layers:
        features = layer(features)
    return features


class BeliefHead(TensorDictModuleBase):
    """Predicts what arrives later, for every discrete action, and encodes what is known for a
    policy.

    The predictions are normalised targets. Code 0 asks what will have been whatever the action; its
    encoding is for the policy. While acting it writes ``("agents", "encoding")`` [*, H] and, with
    discrete actions, ``("agents", "prediction")`` [*, A G]; in TorchRL's recurrent mode, which
    losses switch on, nothing.
    """

    def __init__(
        self,
        encoder: MessageEncoder,
        n_encoding: int,
        n_targets: int,
        n_actions: int | None,
        n_code: int,
        device: torch.device | None = None,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.n_actions = n_actions
        self.codes = nn.Parameter(0.5 * torch.randn((n_actions or 0) + 1, n_code, device=device))
        self.predictor = nn.Linear(n_encoding, n_targets, device=device)
        norm = PopArtValueNorm(shape=n_targets, beta=FORGETTING, epsilon=1e-16, device=device)
        self.norm = norm.double()  # the variance is a difference of squares
        self.in_keys = [keys.OBSERVATION, keys.TIMELINE]  # type: ignore[assignment]
        written = [ENCODING, *[PREDICTION] * (n_actions is not None)]
        self.out_keys = written  # type: ignore[assignment]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if recurrent_mode():
            return tensordict
        observation = tensordict[keys.OBSERVATION]
        history = tensordict[keys.TIMELINE]
        codes = self.codes.expand(*observation.shape[:-1], -1, -1)
        encodings = self.encoder(observation, history, codes)
        tensordict.set(ENCODING, encodings[..., 0, :])
        if self.n_actions is not None:
            tensordict.set(PREDICTION, self.predictor(encodings[..., 1:, :]).flatten(-2))
        return tensordict

    def predict(self, observation: Tensor, history: Tensor, action: Tensor) -> Tensor:
        """Normalised predictions, whatever the action and for this one, [*, 2, G]."""
        code = action if self.n_actions is None else gather_rows(self.codes, action + 1)
        codes = torch.stack([self.codes[0].expand_as(code), code], -2)
        return self.predictor(self.encoder(observation, history, codes))


class Preference(nn.Module):
    """Logits from observations, encodings and what is predicted for each action, with learnt
    weights."""

    def __init__(self, network: nn.Module, n_targets: int, device: torch.device | None) -> None:
        super().__init__()
        self.network = network
        self.weight = nn.Parameter(torch.zeros(n_targets, device=device))

    def forward(self, observation: Tensor, encoding: Tensor, prediction: Tensor) -> Tensor:
        """Logits [*, A] from observations [*, F], encodings [*, H] and predictions [*, A G]."""
        logits = self.network(torch.cat([observation, encoding], -1))
        return logits + PREFERENCE_UNIT * (
            prediction.unflatten(-1, (logits.shape[-1], -1)) @ self.weight
        )


class NormalPolicy(nn.Module):
    """Means and scales of continuous actions, [*, n] each, from observations and encodings."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.normal = NormalParamExtractor()

    def forward(self, observation: Tensor, encoding: Tensor) -> tuple[Tensor, Tensor]:
        """Means and scales from observations [*, F] and encodings [*, H]."""
        return self.normal(self.network(torch.cat([observation, encoding], -1)))


def make_belief_actor(
    env: EnvBase, config: ModelConfig, heads: int, width: int
) -> ProbabilisticActor:
    """Make the policy from observations and histories to ``("agents", "action")``."""
    known = env.observation_spec.keys(True, True)
    device = env.device
    should = (
        "reads no messages: set delay.messages, or add damian.ObservationTimeline to the "
        "environment"
    )
    checks.require(keys.TIMELINE in known, "learner", "this one", should)
    observation = env.observation_spec[keys.OBSERVATION]
    history = env.observation_spec[keys.TIMELINE]
    n_targets = env.observation_spec[keys.GLOBAL_OBSERVATION].shape[-1]
    n_encoding = config.hidden[-1]

    def network(n_out: int, *out_keys: NestedKey) -> TensorDictSequential:
        discrete = len(out_keys) == 1
        n_actions, n_code = (n_out, CODE_SIZE) if discrete else (None, n_out // 2)
        n_features = observation.shape[-1]
        encoder = MessageEncoder(
            n_features, history.shape[-1], n_code, config, heads, width, device
        )
        head = BeliefHead(encoder, n_encoding, n_targets, n_actions, n_code, device)
        read = [keys.OBSERVATION, *head.out_keys]
        policy = make_mlp(config, n_features + n_encoding, n_out).to(device)
        module = Preference(policy, n_targets, device) if discrete else NormalPolicy(policy)
        parts = [head, TensorDictModule(module, read, list(out_keys))]
        return TensorDictSequential(parts)  # type: ignore[arg-type]

    return with_distribution(env, network)


def ends_of_actions(ready: Tensor, reset: Tensor, delay: int) -> Tensor:
    """The last step of the action chosen in each of T steps, [T, ...]; T if it comes later, or
    never.

    ``ready`` [T, ...] and ``reset`` tell whether the UAV could choose, and the episode was reset,
    after each step; an action is executed ``delay`` steps later.
    """
    ends = next_true(ready | reset)
    n_steps = len(ready)
    executed = torch.arange(n_steps, device=ready.device) + delay
    ends = ends[executed.clamp(max=n_steps - 1)]
    prevented = next_true(reset.expand_as(ready)) < expand_mask(executed, ready)
    return ends.where(~prevented & expand_mask(executed < n_steps, ready), n_steps)


def prediction_loss(predicted: Tensor, target: Tensor, counts: Tensor) -> Tensor:
    """Mean square error of predictions of targets [*, G] where they count, [*, 1] bool; 0 if none
    does."""
    error = torch.where(counts, predicted - target, 0.0).square()
    return error.sum() / counts.expand_as(error).sum().clamp(min=1)
