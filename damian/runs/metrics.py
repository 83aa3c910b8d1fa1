"""Measures of episodes, in training and in evaluations."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.errors import naming_errors
from damian.envs.delayed_env import DelayedEnv
from damian.envs.recompute import beliefs_in_hindsight
from damian.keys import next_key
from damian.models.memory import add_recurrent_state
from damian.replay.backupdate import BackupdateStorage
from damian.runs.checkpoint import Stored, to_tensordict
from damian.runs.measures import BUILT_IN, METRICS
from damian.server.server import Server


class Evaluation(dict[str, float]):
    """Metrics by name, and the number of ``episodes``."""

    returns: Tensor
    """The true return of each episode, [B]."""


class Episodes(NamedTuple):
    """The first episode of each of B worlds, as it truly was or as the server perceived it."""

    succeeded: Tensor
    """Whether it ended with success, [B] bool."""
    steps: Tensor
    """Its length; where success is possible, an episode without it counts the horizon, [B]."""
    returns: Tensor
    """Sum of its rewards, as a mean over the UAVs, [B]."""


class Flights(NamedTuple):
    """What metrics are computed from: the first episode of each world in T steps."""

    rollout: TensorDictBase
    """All entries of the steps, [B, T]."""
    server: Server
    """Reads messages, and computes features and rewards from them."""
    true: Episodes
    """Episodes as messages without delay tell them."""
    perceived: Episodes
    """Episodes as the server perceived them, with rewards as they were paid."""
    in_episode: Tensor
    """Steps up to the end that the server perceived, [B, T] bool."""
    age: Tensor
    """Age of the message of each UAV that the server holds [steps], [B, T, N]."""
    delay: Tensor
    """Delays of the messages sent in the episodes [steps], negative if lost, [M]; 0 if none is
    late."""


@torch.no_grad()
def evaluate(
    env: DelayedEnv,
    policy: nn.Module,
    horizon: int,
    sample: bool = True,
    metrics: Sequence[str] = (),
) -> Evaluation:
    """Fly one episode of at most ``horizon`` steps in every world of an environment with
    ``message``.

    With ``sample``, actions are drawn from the policy's distribution, else the most likely ones are
    taken. ``metrics`` are names or paths of further ones.
    """
    add_recurrent_state(env, policy)
    mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        rollout = env.rollout(horizon, policy, break_when_any_done=False)
    return evaluation(rollout, env.server, metrics)


def evaluation(rollout: TensorDictBase, server: Server, metrics: Sequence[str] = ()) -> Evaluation:
    """Metrics of the first episode of each world in a rollout [B, T]."""
    flights = flights_of(rollout, server)
    found = Evaluation(episodes=len(rollout))
    found.returns = flights.true.returns.cpu()
    for name in dict.fromkeys((*BUILT_IN, *metrics)):
        with naming_errors(f"metric {name}"):
            values = torch.as_tensor(METRICS.get(name, "metrics").compute(flights))
            found[name] = values.float().mean().item()
    return found


def flights_of(rollout: TensorDictBase, server: Server) -> Flights:
    """The first episode of each world in a rollout [B, T], and what has come of its messages."""
    next_step = cast(TensorDictBase, rollout["next"])
    steps = torch.arange(1, rollout.shape[1] + 1, device=rollout.device)
    elapsed = steps.expand(rollout.shape)
    message = next_step[keys.MESSAGE]
    over = next_step.get(keys.SOURCE_OVER, None)
    belief = _true_belief(rollout, server, elapsed)
    truth = server(server.messages(message), elapsed, over, belief=belief)
    perceived = (keys.DONE, keys.SUCCESS, keys.REWARD)
    done, success, reward = (next_step[key].squeeze(-1) for key in perceived)
    in_episode = _up_to_first_end(done)
    true_end = in_episode & _up_to_first_end(truth.status.terminated)
    held = server.messages(next_step.get(keys.RECEIVED, message))
    sent = cast(Tensor, next_step[keys.MESSAGE_SENT])[in_episode]
    delay = torch.zeros(1)
    if sent.any() and keys.DELAY in next_step.keys(True):
        delays = cast(Tensor, next_step[keys.DELAY]).squeeze(-1)
        delay = delays[in_episode][sent]
    episodes = partial(_episodes, can_succeed=server.episode.can_succeed)
    return Flights(
        rollout,
        server,
        true=episodes(truth.status.success, truth.reward, true_end),
        perceived=episodes(success, reward, in_episode),
        in_episode=in_episode,
        age=held.age(elapsed * server.dt) / server.dt,
        delay=delay,
    )


def _episodes(success: Tensor, reward: Tensor, counted: Tensor, can_succeed: bool) -> Episodes:
    """Episodes from the steps that count, a mask [B, T]."""
    succeeded = (success & counted).any(-1)
    steps = counted.sum(-1)
    if can_succeed:
        steps = torch.where(succeeded, steps, counted.shape[1])
    returns = (reward.mean(-1) * counted).sum(-1)
    return Episodes(succeeded, steps, returns)


def _true_belief(rollout: TensorDictBase, server: Server, elapsed: Tensor) -> Tensor | None:
    """The belief from undelayed messages in first episodes, [B, T, K]; None if no reward term reads
    it."""
    if not server.rewards_belief:
        return None
    steps = rollout.select(keys.MESSAGE, keys.BELIEF, next_key(keys.MESSAGE), next_key(keys.BELIEF))
    sent = rollout[next_key(keys.MESSAGE_SENT)]
    steps[next_key(keys.DELAY)] = sent.long().unsqueeze(-1) - 1  # 0, or -1 where none was sent
    steps[keys.STEP_COUNT] = elapsed.unsqueeze(-1) - 1
    return beliefs_in_hindsight(server, steps.transpose(0, 1)).transpose(0, 1)


def _up_to_first_end(ended: Tensor) -> Tensor:
    """Mask of the steps up to and including the first end, [B, T] bool."""
    ends = ended.int()
    ends_before = ends.cumsum(-1) - ends
    return ends_before == 0


class EpisodeLog:
    """Means over the latest episodes of the training, as many of each world, at least ``EPISODES``
    in all.

    Every world counts the same, and nothing is known before one has ended in each: the first
    episodes to end are the shortest, and their means would be too good. ``hindsight`` gives the
    rewards as they are known once they have settled; None if none is late, so that they are those
    perceived.
    """

    NAMES = ("perceived_return", "perceived_success_rate", "perceived_steps")
    EPISODES = 100

    def __init__(self, worlds: int, hindsight: "HindsightReturns | None" = None) -> None:
        self.finished = 0
        self.hindsight = hindsight
        self._known = [self._nothing(worlds, len(self.NAMES))]
        if hindsight:
            self._known.append(self._nothing(hindsight.worlds, 1))
        """Numbers of the latest episodes of each world [B, K, N], perceived and in hindsight."""

    def _nothing(self, worlds: int, n_numbers: int) -> Tensor:
        """Numbers of no episode, [B, K, N]."""
        episodes = math.ceil(self.EPISODES / worlds)
        return torch.full((worlds, episodes, n_numbers), torch.nan)

    def add(self, batch: TensorDictBase) -> None:
        """Add the episodes that end in a batch [B, T], with the entries of ``EpisodeTotals``."""
        steps = cast(TensorDictBase, batch["next"])
        done = steps[keys.DONE].to("cpu")
        of_episodes = (cast(Tensor, steps[key]).flatten(2) for key in _TOTALS)
        totals = torch.stack([each.float().mean(2) for each in of_episodes], -1)
        ended = [totals.to("cpu").masked_fill(~done, torch.nan)]
        if self.hindsight:
            settled = self.hindsight.add(batch).to("cpu")
            ended.append(settled.unsqueeze(-1))
        self._known = [*map(_latest, self._known, ended)]
        self.finished += int(done.sum())

    def state_dict(self) -> Stored:
        hindsight = self.hindsight.state_dict() if self.hindsight else None
        return {"finished": self.finished, "known": self._known, "hindsight": hindsight}

    def load_state_dict(self, state: Stored) -> None:
        self.finished = state["finished"]
        self._known = state["known"]
        if self.hindsight:
            self.hindsight.load_state_dict(state["hindsight"])

    def means(self) -> dict[str, float]:
        """Mean returns, success rate and steps; nan before an episode has ended in each world."""
        perceived, *settled = (known.nanmean(1).mean(0).tolist() for known in self._known)
        in_hindsight = settled[0] if settled else perceived
        means = {"hindsight_return": in_hindsight[0]}
        return means | dict(zip(self.NAMES, perceived, strict=True))


def _latest(known: Tensor, ended: Tensor) -> Tensor:
    """Numbers of the latest episodes of each world in order of time, [B, K, N].

    Args:
        known: those of the latest ones so far, [B, K, N], nan where there were fewer.
        ended: those of the episodes that end in some later steps, nan where none does, [B, T, N].
    """
    both = torch.cat([known, ended], 1)
    is_known = ~both[..., 0].isnan()
    when = torch.arange(both.shape[1]).where(is_known, -1)
    latest = when.topk(known.shape[1], 1).indices
    in_order = latest.sort(1).values.unsqueeze(-1)
    return both.take_along_dim(in_order, 1)


class HindsightReturns:
    """Returns of the training's episodes from late data only, as they are known once they have
    settled.

    The reward of a step has settled when its messages and it itself can no longer be in transit;
    until then it waits in a storage of its own, whatever the learner does. Only a few worlds are
    followed, because that costs time.

    Args:
        storage: an empty storage that corrects the rewards of ``worlds`` worlds.
        worlds: number of worlds to follow, the first ones.
    """

    WORLDS = 32
    """Most worlds to follow."""

    def __init__(self, storage: BackupdateStorage, worlds: int) -> None:
        self.storage = storage
        self.worlds = worlds
        self._written = 0
        """Number of steps written so far."""
        self._waiting = 0
        """Number of stored steps that have not been counted yet."""
        self._running = torch.zeros(worlds, dtype=torch.float64)
        """Return so far of the current episode of each world."""

    def add(self, batch: TensorDictBase) -> Tensor:
        """Returns of the episodes whose last steps settle by the end of a batch [B, T], else nan,
        [W, T']."""
        steps = batch[: self.worlds].transpose(0, 1)
        self._store(steps)
        self._waiting += len(steps)
        n_settled = max(self._waiting - self.storage.longest, 0)
        rows = self.storage.latest(self._waiting)[:n_settled]
        settled: Any = self.storage.steps[rows]
        self._waiting -= n_settled
        if not n_settled:
            return torch.full((self.worlds, 0), torch.nan)
        valid, over = (settled[key].squeeze(-1).cpu() for key in (keys.VALID, keys.RESET_AFTER))
        rewards = settled[next_key(keys.REWARD)].squeeze(-1)
        reward = rewards.double().mean(-1).cpu()
        so_far = self._running + (reward * valid).cumsum(0)
        total = torch.cat([self._running[None], so_far])  # [T' + 1, W]
        n_steps = torch.arange(1, n_settled + 1).view(-1, 1)
        ends = torch.where(over, n_steps, 0)
        latest_end = ends.cummax(0).values
        begin = torch.cat([torch.zeros_like(ends[:1]), latest_end])
        begun = torch.where(begin > 0, total.gather(0, begin), 0.0)
        self._running = total[-1] - begun[-1]
        returns = torch.where(over, so_far - begun[:-1], torch.nan)
        return returns.T.float()

    def _store(self, steps: TensorDictBase, corrected: bool = False) -> None:
        """Write steps [T, W] behind the latest ones, and correct all unless they are
        ``corrected``."""
        begin = self._written
        self._written += len(steps)
        index = torch.arange(begin, self._written)
        n_rows = self.storage.max_size // self.worlds
        storage: Any = super(BackupdateStorage, self.storage) if corrected else self.storage
        storage.set(index % n_rows, steps)

    def state_dict(self) -> Stored:
        rows = self.storage.steps[self.storage.latest()] if self._written else None
        return {"rows": rows, "waiting": self._waiting, "running": self._running}

    def load_state_dict(self, state: Stored) -> None:
        self._waiting = int(state["waiting"])
        self._running = state["running"]
        if state["rows"] is not None:
            self._store(to_tensordict(state["rows"]).to(self.storage.device), corrected=True)


_TOTALS = (keys.EPISODE_REWARD, keys.SUCCESS, keys.STEP_COUNT)
"""Entries of a last step with the measures of the episode, in the order of ``EpisodeLog.NAMES``."""
