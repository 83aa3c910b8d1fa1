"""Indexing and mapping of tensors that several folders need."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

Tree = TypeVar("Tree", bound=NamedTuple)


def gather_rows(table: Tensor, index: Tensor) -> Tensor:
    """``table[index]`` for a table [M, ...] and any shape of index; several times as fast on a CPU."""
    return table.index_select(0, index.flatten()).view(*index.shape, *table.shape[1:])


def expand_mask(mask: Tensor, like: Tensor) -> Tensor:
    """A mask [*] with as many trailing dimensions of size 1 as ``like`` [*, ...] has."""
    return mask.view(*mask.shape, *[1] * (like.dim() - mask.dim()))


def tree_map(function: Callable[..., Tensor], tree: Tree, *others: Tree) -> Tree:
    """Apply a function to the tensors of nested named tuples."""
    values: list[Any] = [
        tree_map(function, *leaf) if hasattr(leaf[0], "_fields") else function(*leaf)
        for leaf in zip(tree, *others, strict=True)
    ]
    return tree._make(values)


def tree_where(mask: Tensor, new: Tree, old: Tree) -> Tree:
    """Choose between the tensors [*, ...] of nested named tuples, row by row, by a mask [*]."""
    return tree_map(lambda a, b: torch.where(expand_mask(mask, a), a, b), new, old)
