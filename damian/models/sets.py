"""Networks of sets: rows of things and rows of actions, each read by layers that all rows share."""

import torch
from torch import Tensor, nn

from damian.models.config import ModelConfig
from damian.models.mlp import ACTIVATIONS, hidden_layers
from damian.server.layout import Block, Layout

ACTIONS = "actions"
"""``Block.rows`` of the block with a row for each action."""


def lists_of(layout: Layout) -> list[list[Block]]:
    """The blocks that list the same things, joined, actions apart.

    A block of a name that its list has already, as of a second observation, begins another one.
    """
    found: list[list[Block]] = []
    for block in layout:
        if block.rows in ("", ACTIONS):
            continue
        for blocks in found:
            same = blocks[0].rows == block.rows
            if same and all(block.name != other.name for other in blocks):
                blocks.append(block)
                break
        else:
            found.append([block])
    return found


def rows_of(blocks: list[Block], observation: Tensor) -> Tensor:
    """The columns of several blocks for each thing that they list, [*, R, C], from observations
    [*, F]."""
    n_rows = blocks[0].shape[0]
    parts = [observation[..., b.columns].unflatten(-1, (n_rows, -1)) for b in blocks]
    return torch.cat(parts, -1)


class SetEncoder(nn.Module):
    """From observations to a context: the sum and the maximum over the rows of each list, and all
    other columns, through hidden layers."""

    def __init__(self, config: ModelConfig, layout: Layout, width: int) -> None:
        super().__init__()
        self.lists = lists_of(layout)
        self.others = [block for block in layout if not block.rows]
        row_layers = []
        for blocks in self.lists:
            n_columns = sum(block.width // block.shape[0] for block in blocks)
            row_layers.append(hidden_layers(config, n_columns, [width, width]))
        self.rows = nn.ModuleList(row_layers)
        n_in = sum(block.width for block in self.others) + 2 * width * len(self.lists)
        self.context = hidden_layers(config, n_in, config.hidden)

    def forward(self, observation: Tensor) -> Tensor:
        """Contexts [*, H] of observations [*, F]."""
        parts = [observation[..., block.columns] for block in self.others]
        for blocks, layers in zip(self.lists, self.rows, strict=True):
            rows = rows_of(blocks, observation)
            exists = (rows != 0).any(-1, keepdim=True)
            encoded = layers(rows) * exists
            # A row that does not exist adds nothing, however many there are.
            parts += [encoded.sum(-2), encoded.amax(-2).clamp(min=0)]
        return self.context(torch.cat(parts, -1))


class ActionHead(nn.Module):
    """A number for each action, from its own row and the context alone."""

    def __init__(self, config: ModelConfig, actions: Block, n_context: int, width: int) -> None:
        super().__init__()
        self.actions = actions
        self.row = nn.Linear(actions.shape[-1], width)
        self.context = nn.Linear(n_context, width, bias=False)
        self.activation = ACTIVATIONS[config.activation]()
        self.last = nn.Linear(width, 1)

    def forward(self, context: Tensor, observation: Tensor) -> Tensor:
        """Logits [*, A] of contexts [*, H] and observations [*, F]."""
        rows = self.row(self.actions.of(observation))
        hidden = self.activation(rows + self.context(context).unsqueeze(-2))
        return self.last(hidden).squeeze(-1)


class Joined(nn.Module):
    """A network of an encoder and a head that also reads the observation."""

    def __init__(self, encoder: nn.Module, head: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.head = head

    def forward(self, observation: Tensor) -> Tensor:
        """Outputs [*, n_out] of observations [*, F]."""
        return self.head(self.encoder(observation), observation)
