"""What the columns of an observation mean: named blocks, each with the shape that its values
have."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from damian import keys


@dataclass(frozen=True)
class Block:
    """The values of one feature in an observation, of one UAV."""

    name: str
    """Name of the feature, or of what has been appended."""
    shape: tuple[int, ...]
    """Shape of the values, such as (4, 5) for five values of each of four others; () for a single
    one."""
    low: float
    """Lowest possible value."""
    high: float
    """Highest possible value."""
    first: int
    """The block's first column in the observation."""
    meaning: str = ""
    """What the values are, in a sentence."""
    entries: tuple[str, ...] = ()
    """What each value of the last dimension is, as far as it has a name."""
    rows: str = ""
    """What the first dimension lists, such as ``others``, if it lists things; those that do not
    exist are zeros. Blocks that list the same have the same things in the same order."""

    @property
    def width(self) -> int:
        """Number of columns."""
        return math.prod(self.shape)

    @property
    def columns(self) -> slice:
        """The block's columns in the observation."""
        return slice(self.first, self.first + self.width)

    def columns_of(self, entry: str) -> slice:
        """The columns, in the observation, of what ``entries`` names so."""
        first = self.first + self.entries.index(entry)
        return slice(first, self.first + self.width, self.shape[-1])

    def of(self, observation: Tensor) -> Tensor:
        """The block's values in observations [*, F], in its shape, [*, ...]."""
        values = observation[..., self.columns]
        return values.unflatten(-1, self.shape) if self.shape else values.squeeze(-1)


class Layout:
    """The blocks of an observation, in the order of its columns."""

    def __init__(self, blocks: tuple[Block, ...] = ()) -> None:
        self.blocks = blocks

    @property
    def width(self) -> int:
        """Number of columns of the observation, F."""
        return sum(block.width for block in self.blocks)

    def __iter__(self) -> Iterator[Block]:
        return iter(self.blocks)

    def __contains__(self, name: object) -> bool:
        return any(block.name == name for block in self.blocks)

    def __getitem__(self, name: str) -> Block:
        """The block of this name; ``KeyError`` if there is none."""
        found = [block for block in self.blocks if block.name == name]
        if not found:
            raise KeyError(
                f"{name} is not a block of this observation, which has {[b.name for b in self]}"
            )
        return found[0]

    def appended(
        self,
        name: str,
        shape: tuple[int, ...],
        low: float = -math.inf,
        high: float = math.inf,
        **more,
    ) -> "Layout":
        """This layout with a further block behind its last column; ``more``: further fields of
        ``Block``."""
        return Layout((*self.blocks, Block(name, tuple(shape), low, high, self.width, **more)))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest possible value of each column, [F] each."""
        widths = torch.tensor([block.width for block in self.blocks])
        limits = torch.tensor([[block.low, block.high] for block in self.blocks])
        low, high = limits.repeat_interleave(widths, 0).unbind(-1)
        return low, high


def joined(layouts: Sequence[Layout]) -> Layout:
    """The layout of several observations, one behind the other."""
    blocks: list[Block] = []
    for layout in layouts:
        first = sum(block.width for block in blocks)
        blocks += [replace(block, first=first + block.first) for block in layout]
    return Layout(tuple(blocks))


def layout_at(env: EnvBase, key: NestedKey) -> Layout:
    """The layout of an observation of an environment; a single block where it tells none of these
    columns."""
    width = env.observation_spec[key].shape[-1]
    told = getattr(env, "layout", {}).get(keys.last_part(key))
    return (
        told if told and told.width == width else Layout().appended(keys.last_part(key), (width,))
    )
