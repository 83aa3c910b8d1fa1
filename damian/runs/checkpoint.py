"""Checkpoint files: dictionaries of tensors and numbers behind a line that tells whether they are whole.

The first line names the format and its version, the version of damian that wrote the file, and the length and
the SHA-256 of the rest, which is what ``torch.save`` writes. Nothing in a file is ever executed.
"""

import hashlib
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import damian
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line

FORMAT = 2
"""Version of the format; a change that older programs cannot read raises it."""
_MAGIC = b"damian checkpoint "
_FIRST_LINE = re.compile(_MAGIC + rb"(\d{1,9}) (\S{1,50}) (\d{1,18}) ([0-9a-f]{64})\n")
_LONGEST_LINE = 200
_BATCH_SIZE, _ENTRIES = "batch_size", "entries"
_REMEDY = "take another copy of it, or another checkpoint of the run"


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> str:
    """Write a checkpoint, completely or not at all; returns its SHA-256.

    Args:
        path: of the file; an older one of this name is replaced.
        content: nested mappings, lists and tuples of tensors, TensorDicts, numbers, strings and None.

    Raises:
        InputError: something else is in the content.
        RunError: the file cannot be written.
    """
    buffer = io.BytesIO()
    torch.save(plain(content), buffer)
    payload = buffer.getbuffer()
    digest = hashlib.sha256(payload).hexdigest()
    first_line = _MAGIC + f"{FORMAT} {damian.__version__} {len(payload)} {digest}\n".encode()
    write_atomically(path, first_line + payload)
    return digest


def read_checkpoint(path: Path, key: str, digest: str | None = None) -> dict[str, Any]:
    """Read a checkpoint, with all tensors on the CPU.

    Args:
        path: of the file.
        key: the setting that names the file or its folder, for errors.
        digest: the SHA-256 that the file should have, if that is known.

    Raises:
        InputError: the file is missing, damaged, or not a checkpoint of this version of damian.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{key}: {path}: it cannot be read: {error.strerror}") from None
    try:
        payload, found = _payload(data)
        if digest not in (None, found):
            raise InputError("it belongs to another checkpoint than the others in its folder")
        content = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except InputError as error:
        raise InputError(f"{key}: {path}: {error}") from None
    except Exception:  # a file that was made to look whole can raise anything
        problem = "it holds something else than tensors and numbers, and is not loaded"
        raise InputError(f"{key}: {path}: {problem}; {_REMEDY}") from None
    if not isinstance(content, dict):
        raise InputError(f"{key}: {path}: it is no checkpoint of a training; {_REMEDY}")
    return content


def stored_digest(path: Path) -> str | None:
    """The SHA-256 in the first line of a checkpoint file; None if there is none that can be read."""
    try:
        with path.open("rb") as file:
            match = _FIRST_LINE.match(file.read(_LONGEST_LINE))
    except OSError:
        return None
    return match and match[4].decode()


def _payload(data: bytes) -> tuple[memoryview, str]:
    """What follows the first line of a file, and its SHA-256."""
    if not data:
        raise InputError(f"it is empty; {_REMEDY}")
    match = _FIRST_LINE.match(data[:_LONGEST_LINE])
    if match is None:
        cut = data.startswith(_MAGIC) or _MAGIC.startswith(data)
        raise InputError(f"{'it is cut or damaged' if cut else 'it is no checkpoint of damian'}; {_REMEDY}")
    version, writer = int(match[1]), match[2].decode(errors="replace")
    if version != FORMAT:
        here = f"and damian {damian.__version__} reads format {FORMAT}"
        raise InputError(f"damian {writer} wrote it in format {version}, {here}: use damian {writer}")
    payload, length = memoryview(data)[match.end() :], int(match[3])
    if len(payload) != length:
        raise InputError(f"it has {len(payload)} bytes after its first line instead of {length}; {_REMEDY}")
    digest = hashlib.sha256(payload).hexdigest()
    if digest.encode() != match[4]:
        raise InputError(f"it is damaged: its SHA-256 is not the one in its first line; {_REMEDY}")
    return payload, digest


def plain(value: Any, name: str = "checkpoint") -> Any:
    """A value without TensorDicts, and without tensors that hold on to a larger one.

    Args:
        value: as in ``write_checkpoint``.
        name: where the value is, for errors.

    Raises:
        InputError: it is something that a checkpoint cannot store.
    """
    if isinstance(value, Tensor):
        tensor = value.detach().cpu()
        whole = tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
        return tensor if whole and type(tensor) is Tensor else torch.Tensor.clone(tensor).as_subclass(Tensor)
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str | bytes | torch.Size | torch.device):
        return value
    if isinstance(value, torch.dtype):
        return value
    if isinstance(value, TensorDictBase):
        return {_BATCH_SIZE: value.batch_size, _ENTRIES: plain(dict(value.items()), name)}
    if isinstance(value, Mapping):
        return {key: plain(each, f"{name}.{key}") for key, each in value.items()}
    if isinstance(value, list | tuple):
        items = [plain(each, f"{name}[{i}]") for i, each in enumerate(value)]
        return items if isinstance(value, list) else tuple(items)
    raise InputError(
        f"{name}: a checkpoint cannot store a {type(value).__name__}: "
        "state_dict must consist of tensors, numbers, strings, lists and dicts"
    )


def to_tensordict(stored: Mapping[str, Any]) -> TensorDict:
    """The TensorDict that ``plain`` has made a dictionary."""
    entries = {
        name: to_tensordict(value) if isinstance(value, Mapping) else value
        for name, value in stored[_ENTRIES].items()
    }
    return TensorDict(entries, stored[_BATCH_SIZE])


def restore(components: Mapping[str, Any], stored: Mapping[str, Any], path: Path, key: str) -> None:
    """Restore components in place with their ``load_state_dict``.

    Args:
        components: by name.
        stored: their states by name; further ones are not used.
        path: of the checkpoint, for errors.
        key: the setting that names the file or its folder, for errors.

    Raises:
        InputError: a component is missing, or does not fit.
    """
    for name, component in components.items():
        if name not in stored:
            found = ", ".join(map(str, stored)) or "nothing"
            raise InputError(f"{key}: {path}: it has no {name}, only {found}: another learner wrote it")
        try:
            component.load_state_dict(stored[name])
        except RunError:
            raise
        except Exception as error:  # a component of one's own can raise anything
            if isinstance(error, InputError) and str(error).startswith(f"{key}: "):
                raise  # a file that belongs to the checkpoint
            problem = f"its {name} does not fit this run: {_detail(error)}"
            raise InputError(f"{key}: {path}: {problem}") from (error if _is_foreign(error) else None)


def _is_foreign(error: Exception) -> bool:
    return not isinstance(error, InputError | RuntimeError | KeyError | ValueError)


def _detail(error: Exception) -> str:
    """What torch says of the first entry that does not fit, on one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    more = len(lines) > 1 and lines[0].startswith("Error(s) in loading")
    text = one_line(lines[1] if more else " ".join(lines)) or type(error).__name__
    if "TensorDict(" in text:  # TorchRL's losses keep weights in one, which they print as a whole
        return "its networks have other sizes or layers"
    return text if len(text) <= 300 else f"{text[:297]}..."
