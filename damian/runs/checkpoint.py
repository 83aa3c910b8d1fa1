"""Checkpoint files: nested dictionaries of tensors and numbers, as ``torch.save`` writes them.

Nothing in a file is ever executed: ``torch.load`` reads them with ``weights_only=True``.
"""

import hashlib
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line

Stored = dict[str, Any]
"""Plain data by name, as ``state_dict`` returns and a checkpoint stores them."""
_PLAIN = (bool, int, float, str, bytes, torch.Size, torch.device, torch.dtype, type(None))


def write_checkpoint(path: Path, content: Stored) -> None:
    """Write a checkpoint, completely or not at all; an older file of this name is replaced."""
    buffer = io.BytesIO()
    torch.save(plain(content), buffer)
    write_atomically(path, buffer.getvalue())


def read_checkpoint(path: Path, key: str) -> Stored:
    """Read a checkpoint, with all tensors on the CPU."""
    try:
        # torch does not compare checksums, so that a changed bit would be a silently wrong weight.
        whole = zipfile.ZipFile(path).testzip() is None
        content = torch.load(path, map_location="cpu", weights_only=True) if whole else None
    except OSError as error:
        raise InputError(f"{key}: {path}: it cannot be read: {error.strerror}") from None
    except Exception:  # a damaged file can raise anything
        content = None
    if not isinstance(content, dict):
        raise InputError(f"{key}: {path}: it is damaged, or no checkpoint of a training")
    return content


def digest(path: Path) -> str | None:
    """The SHA-256 of a file; None if there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def plain(value: Any) -> Any:
    """A value without TensorDicts, and without tensors that hold on to a larger one."""
    if isinstance(value, Tensor):
        tensor = value.detach().cpu()
        # torch.save would write the whole storage that a view was cut from.
        whole = tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
        return (
            tensor
            if whole and type(tensor) is Tensor
            else torch.Tensor.clone(tensor).as_subclass(Tensor)
        )
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, TensorDictBase):
        return {"batch_size": value.batch_size, "entries": plain(dict(value.items()))}
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        items = [plain(each) for each in value]
        return items if isinstance(value, list) else tuple(items)
    consists = "state_dict must consist of tensors, numbers, strings, lists and dicts"
    raise InputError(f"checkpoint: a {type(value).__name__} cannot be stored: {consists}")


def to_tensordict(stored: Mapping[str, Any]) -> TensorDict:
    """The TensorDict that ``plain`` has made a dictionary."""
    entries = {
        name: to_tensordict(value) if isinstance(value, Mapping) else value
        for name, value in stored["entries"].items()
    }
    return TensorDict(entries, stored["batch_size"])


def restore(components: Mapping[str, Any], stored: Stored, path: Path, key: str) -> None:
    """Restore components in place with their ``load_state_dict``; ``key`` is the setting of the
    file."""
    for name, component in components.items():
        if name not in stored:
            raise InputError(f"{key}: {path}: it has no {name}, only {', '.join(map(str, stored))}")
        try:
            component.load_state_dict(stored[name])
        except (InputError, RunError):
            raise
        except Exception as error:  # a component of the user's own can raise anything
            problem = f"its {name} does not fit this run: {one_line(str(error))[:300]}"
            raise InputError(f"{key}: {path}: {problem}") from error
