"""What nobody can predict: flights that end elsewhere than commanded, and UAVs that fail for a
while."""

import torch
import torch.nn.functional as F
from torch import Tensor

from damian.common import counter_rng
from damian.common.tensors import gather_rows
from damian.world.config import WorldConfig
from damian.world.landing import Candidates, Ranking
from damian.world.state import State
from damian.world.values import Value

_ABORT = counter_rng.number_of("abort")
_ELSEWHERE = counter_rng.number_of("elsewhere")
_FAILURE = counter_rng.number_of("failure")


class News:
    """Draws of N UAVs with A actions, from the streams of their worlds."""

    def __init__(self, config: WorldConfig, candidates: Candidates, dt: float) -> None:
        n = config.agents
        self.uavs = torch.arange(n)
        self.fails = config.failure.probability > 0
        self.fail_chance = config.failure.probability
        self.join_chance = dt / config.failure.duration
        self.aborts = config.may_abort
        if self.aborts:
            self.numbers = torch.arange(n * (config.actions.n_actions + 1)).view(n, -1)
            """Numbers of the draws that order the ends of an aborted flight, [N, A + 1]."""
            self.n_points = candidates.airspace.max_points
            self.nearest = candidates.nearest
            self.first = _first_of_each(candidates.nearest, candidates.distance)

    def fail(self, state: State) -> State:
        """Let some UAVs fail, and some that have failed join again."""
        share = draw(state, _FAILURE, self.uavs)
        failed = torch.where(state.failed, share >= self.join_chance, share < self.fail_chance)
        return state._replace(failed=failed)

    def abort(self, state: State, chance: Value) -> Tensor:
        """Whether flights that may turn in this step do, with this chance, [B, N] bool."""
        return draw(state, _ABORT, self.uavs) < chance

    def elsewhere(self, state: State, start: Tensor, distance: Tensor) -> tuple[Ranking, Tensor]:
        """Other landing points than the ``goal``, to which actions lead, in a random order.

        ``start`` [B, N] are the flat ids of those from which UAVs fly on, ``distance`` [B, N, A]
        the lengths of the legal actions [m], infinite for others. Also the row of each UAV in the
        ranking, [B, N]; the end of each list is infinitely far away.
        """
        flat = gather_rows(self.nearest, start)
        other = gather_rows(self.first, start) & (flat != state.goal.unsqueeze(-1))
        distance = F.pad(distance.where(other, torch.inf), (0, 1), value=torch.inf)
        share = draw(state, _ELSEWHERE, self.numbers)
        order = share.where(distance.isfinite(), 2.0).argsort(stable=True, dim=-1)
        point = F.pad(flat % self.n_points, (0, 1))
        return Ranking.of_each(point.gather(-1, order), distance.gather(-1, order))


def draw(state: State, stream: int, numbers: Tensor) -> Tensor:
    """Uniform draws of a stream in this step for the given numbers [N, ...], [B, N, ...]."""
    counters = state.seed, state.episode, state.steps
    seed, episode, steps = (each.view(-1, *[1] * numbers.dim()) for each in counters)
    return counter_rng.uniform(seed, stream, episode, steps, numbers)


def _first_of_each(nearest: Tensor, distance: Tensor) -> Tensor:
    """Which actions are the first that lead to their landing points, [M, A]; none leads to one
    that is infinitely far away."""
    point, order = nearest.where(distance.isfinite(), -1).sort(stable=True, dim=-1)
    first = torch.ones_like(point, dtype=torch.bool)
    first[:, 1:] = point.diff(dim=-1) != 0
    return torch.zeros_like(first).scatter(-1, order, first & (point >= 0))
