"""Settings of quick runs, a reward term that reads the belief, and an actor that reads other UAVs'
rows."""

from dataclasses import dataclass

from tensordict.nn import TensorDictModule
from torch import nn

import damian
from damian import keys
from damian.learners.config import MappoConfig
from damian.models.distribution import with_distribution

TINY = [
    "frames=128",
    "worlds=4",
    "learner.steps=16",
    "eval_episodes=3",
    "model.hidden=[8]",
    "logger=csv",
    "region.lattice_step=60",
    "episode.max_steps=12",
]


@damian.reward_term(reads=["belief_moments"], scope="system")
def certainty(features, counters):
    """How sure the server is of where the source is."""
    return 1 - features["belief_moments"][..., 0, -1]


@dataclass
class RowsConfig(MappoConfig):
    """An actor that attends over the rows of all UAVs, or (``hidden``) writes so what it
    remembers."""

    hidden: bool = False

    def make_actor(self, env, model):
        n_columns = env.observation_spec[keys.OBSERVATION].shape[-1]

        def make(n_out, *out_keys):
            written = [*out_keys, *[keys.HIDDEN] * self.hidden]
            return TensorDictModule(
                Rows(n_columns, n_out, self.hidden), [keys.OBSERVATION], written
            )

        return with_distribution(env, make)


class Rows(nn.Module):
    def __init__(self, n_columns, n_out, hidden):
        super().__init__()
        self.last = nn.Linear(n_columns, n_out)
        self.hidden = hidden
        self.attention = nn.MultiheadAttention(n_columns, 1, batch_first=True)
        nn.init.zeros_(self.last.weight)  # at first nobody hears anything

    def forward(self, rows):
        heard, _ = self.attention(rows, rows, rows)
        return (self.last(rows), heard) if self.hidden else self.last(heard)
