"""A learnt belief: an actor that encodes the messages that have arrived, and predicts what arrives later.

Under delay a receiver holds a set of messages with ages, of its own and of others, and its own latest
actions. An encoder turns it into a vector, by attention over the messages; from this vector and an action a
predictor tells what the messages of the next step will have said, once they have arrived. The policy reads
the vector and, for each discrete action, the prediction. Nothing here depends on what the messages mean.
"""

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import PopArtValueNorm, ProbabilisticActor
from torchrl.modules.distributions import NormalParamExtractor

from damian import keys
from damian.common import checks
from damian.learners.networks import POLICY_GAIN, ModelConfig, with_distribution

FLAGS = 3
"""Columns of ``MessageHistory`` behind those of the message: whether it has arrived, its age, is it own."""
PREFERENCE_UNIT = 10.0
"""Logits per unit of the learnt weights of predictions: weights move slowly, and a policy that relies on
predictions needs large logits."""
FORGETTING = 0.99
"""Share of the running statistics of the targets that an update keeps."""


class MessageEncoder(nn.Module):
    """Encodes an observation and a set of messages with ages, by attention over the messages.

    Each message is given as it is and relative to the newest known message of the first sender, which with
    ``MessageHistory`` is the receiver itself. The observation asks the questions (queries); keys and values
    are an embedding of the messages. Messages that are not known have no influence.

    Args:
        n_features: number of features of the observation, F.
        n_columns: number of columns of a row of the history, C.
        config: networks; the hidden layers follow the attention.
        heads: number of questions.
        width: size of the embedding of a message.
        device: of the weights.
    """

    def __init__(
        self,
        n_features: int,
        n_columns: int,
        config: ModelConfig,
        heads: int,
        width: int,
        device: torch.device | None = None,
    ) -> None:
        super().__init__()
        self.n_message, self.heads, self.width = n_columns - FLAGS, heads, width
        n_context = n_features + self.n_message
        self.embed = nn.Sequential(nn.Linear(n_columns + self.n_message, width, device=device), nn.ReLU())
        self.queries = nn.Linear(n_context, heads * width, device=device)
        self.values = nn.Linear(heads * width, config.hidden[0], device=device)
        self.layers = config.hidden_layers(config.hidden[0] + n_context, config.hidden, device)

    def forward(self, observation: Tensor, history: Tensor) -> Tensor:
        """Encode observations [*, F] and histories [*, L, C] into [*, H]."""
        message, known = history[..., : self.n_message], history[..., self.n_message]
        newest = known.argmax(-1, keepdim=True).unsqueeze(-1)  # the first of the known ones
        reference = message.gather(-2, newest.expand(*newest.shape[:-1], self.n_message))
        relative = (message - reference) * known.unsqueeze(-1)
        embedded = self.embed(torch.cat([history, relative], -1))  # [*, L, E]
        context = torch.cat([observation, reference.squeeze(-2)], -1)
        queries = self.queries(context).unflatten(-1, (self.heads, self.width))
        scores = queries @ embedded.transpose(-1, -2) / self.width**0.5  # [*, heads, L]
        shares = (scores + (known.unsqueeze(-2) - 1) * 1e8).softmax(-1)
        found = (shares @ embedded).flatten(-2)
        return self.layers(torch.cat([self.values(found), context], -1))


class BeliefHead(nn.Module):
    """The network of an actor: encoder, predictor and policy.

    The predictor tells, in units of their running standard deviation, what the G numbers of the critic's
    observation will have been after the next step, once the messages of that step have arrived. With discrete
    actions it tells so for every action, and the logits are those of the policy plus a weighted sum of the
    prediction, whose G weights are learnt and begin with 0; the policy's gradient does not reach the
    predictor.

    Args:
        encoder: from observations and histories to encodings [*, H].
        n_encoding: size of the encodings, H.
        n_targets: number of numbers to predict, G.
        n_actions: number of discrete actions, A; None if they are continuous.
        n_numbers: number of numbers of a continuous action.
        config: initial weights, and the hidden layers of the predictor of continuous actions.
        device: of the weights.
    """

    def __init__(
        self,
        encoder: MessageEncoder,
        n_encoding: int,
        n_targets: int,
        n_actions: int | None,
        n_numbers: int,
        config: ModelConfig,
        device: torch.device | None = None,
    ) -> None:
        super().__init__()
        self.encoder, self.n_actions, self.n_targets = encoder, n_actions, n_targets
        n_out = 2 * n_numbers if n_actions is None else n_actions
        self.policy = config.initialized(nn.Linear(n_encoding, n_out, device=device), POLICY_GAIN)
        self.predictor: nn.Module
        if n_actions is None:
            self.normal = NormalParamExtractor()
            self.predictor = config.network(n_encoding + n_numbers, n_targets, device)
        else:
            self.predictor = nn.Linear(n_encoding, n_actions * n_targets, device=device)
            self.preference = nn.Parameter(torch.zeros(n_targets, device=device))
        self.norm = PopArtValueNorm(shape=n_targets, beta=FORGETTING, device=device)

    def forward(self, observation: Tensor, history: Tensor) -> tuple[Tensor, ...]:
        """Parameters of the actions' distribution, and encodings [*, H].

        Args:
            observation: observations, [*, F].
            history: messages with ages, [*, L, C].

        Returns:
            Logits [*, A] and encodings; with continuous actions, means and scales [*, n] and encodings.
        """
        encoding = self.encoder(observation, history)
        out = self.policy(encoding)
        if self.n_actions is None:
            return (*self.normal(out), encoding)
        predicted = self.predictor(encoding).unflatten(-1, (self.n_actions, self.n_targets)).detach()
        return out + PREFERENCE_UNIT * (predicted @ self.preference), encoding

    def predict(self, encoding: Tensor, action: Tensor) -> Tensor:
        """Normalised predictions [*, G] for encodings [*, H] and actions [*] or [*, n]."""
        if self.n_actions is None:
            return self.predictor(torch.cat([encoding, action], -1))
        all_actions = self.predictor(encoding).unflatten(-1, (self.n_actions, self.n_targets))
        index = action[..., None, None].expand(*action.shape, 1, self.n_targets)
        return all_actions.gather(-2, index).squeeze(-2)


def make_belief_actor(env: EnvBase, config: ModelConfig, heads: int, width: int) -> ProbabilisticActor:
    """Make the policy from observations and histories to ``("agents", "action")``; it also writes encodings.

    Raises:
        InputError: the environment has no history of messages.
    """
    known, device = env.observation_spec.keys(True, True), env.device
    should = "reads no messages: set delay.messages, or add damian.MessageHistory to the environment"
    checks.require(keys.HISTORY in known, "learner", "predictive_mappo", should)
    observation, history = env.observation_spec[keys.OBSERVATION], env.observation_spec[keys.HISTORY]
    n_targets = env.observation_spec[keys.GLOBAL_OBSERVATION].shape[-1]

    def network(n_out: int, *out_keys: NestedKey) -> TensorDictModule:
        encoder = MessageEncoder(observation.shape[-1], history.shape[-1], config, heads, width, device)
        continuous = len(out_keys) == 2
        n_actions, n_numbers = (None, n_out // 2) if continuous else (n_out, 0)
        head = BeliefHead(encoder, config.hidden[-1], n_targets, n_actions, n_numbers, config, device)
        return TensorDictModule(head, [keys.OBSERVATION, keys.HISTORY], [*out_keys, keys.ENCODING])

    return with_distribution(env, network)


def belief_head(actor: ProbabilisticActor) -> BeliefHead:
    """The network of a policy that ``make_belief_actor`` has made."""
    return next(module for module in actor.modules() if isinstance(module, BeliefHead))


def prediction_loss(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Mean square error of predictions, [].

    Args:
        predicted: normalised predictions, [*, G].
        target: normalised numbers that later arrived, [*, G]; where the weight is 0, anything.
        weight: 1 where they have arrived, else 0, [*, 1].
    """
    error = torch.where(weight > 0, predicted - target, 0.0).square().mean(-1, keepdim=True)
    return (error * weight).sum() / weight.sum().clamp(min=1)


def arrived_by_now(delay: Tensor, later_steps: int = 0) -> Tensor:
    """Whether the messages sent in consecutive steps have arrived by the latest step, as delay, bool.

    Args:
        delay: of the message sent in each step [steps], -1 if it never arrives, [B, T, ...].
        later_steps: number of steps after the last one of these that have been taken by now.
    """
    n_steps = delay.shape[1]
    since = later_steps + torch.arange(n_steps - 1, -1, -1, device=delay.device)
    return (delay >= 0) & (delay <= since.view(1, -1, *[1] * (delay.dim() - 2)))
