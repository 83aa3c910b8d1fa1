"""Helpers that index tensors and map functions over nested named tuples of tensors."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

Tree = TypeVar("Tree", bound=NamedTuple)


def gather_rows(table: Tensor, index: Tensor) -> Tensor:
    """Compute ``table[index]`` [*, ...], several times as fast on a CPU; table [M, ...], index
    [*]."""
    return table.index_select(0, index.flatten()).view(*index.shape, *table.shape[1:])


def expand_mask(mask: Tensor, like: Tensor) -> Tensor:
    """Append dimensions of size 1 to a mask [*], so that it broadcasts against ``like``
    [*, ...]."""
    return mask.view((*mask.shape, *[1] * (like.dim() - mask.dim())))


def distances(places: Tensor, others: Tensor) -> Tensor:
    """Distances [*, P, Q] between places [*, P, 2] and others [*, Q, 2], exact also for small
    distances."""
    if places.is_cuda or torch.compiler.is_compiling():  # where cdist takes several times as long
        east, north = (places.unsqueeze(-2) - others.unsqueeze(-3)).unbind(-1)
        return (east.square() + north.square()).sqrt()
    return torch.cdist(
        places, others, compute_mode="donot_use_mm_for_euclid_dist"
    )  # no matrix product


def next_true(flags: Tensor) -> Tensor:
    """Index of the next true flag at or after each place, T if there is none; flags [T, ...] by
    time."""
    n_flags = len(flags)
    index = expand_mask(torch.arange(n_flags, device=flags.device), flags)
    return torch.where(flags, index, n_flags).flip(0).cummin(0).values.flip(0)


def tree_map(function: Callable[..., Tensor], tree: Tree, *others: Tree) -> Tree:
    """Apply a function to the corresponding tensors of nested named tuples."""
    values = [
        tree_map(function, *leaf) if hasattr(leaf[0], "_fields") else function(*leaf)
        for leaf in zip(tree, *others, strict=True)
    ]
    return tree._make(values)


def move_attributes(owner: object, device: torch.device) -> None:
    """Move the tensors among an object's attributes, and in tuples and mappings there, to a
    device."""
    moved = tree_map_only(Tensor, lambda each: each.to(device), vars(owner))
    vars(owner).update(moved)


def where_rows(mask: Tensor, new: Tensor, old: Tensor | float) -> Tensor:
    """Take the rows of ``new`` [*, ...] where the mask [*] is true and of ``old`` elsewhere."""
    return torch.where(expand_mask(mask, new), new, old)


def tree_where(mask: Tensor, new: Tree, old: Tree) -> Tree:
    """The same of nested named tuples of tensors."""
    return tree_map(partial(where_rows, mask), new, old)
