"""What a training needs to continue exactly where it was: learner, environment, progress, random
numbers."""

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer

from damian.common.text_files import data_file
from damian.learners.base import Progress
from damian.learners.schedule import SystemClock
from damian.runs.checkpoint import Stored, read_checkpoint, restore, to_tensordict, write_checkpoint
from damian.runs.metrics import EpisodeLog, HindsightReturns
from damian.runs.replay_memory import ReplayMemory
from damian.runs.run_folder import BEST, CHECKPOINT, REPLAY


@dataclass
class RunProgress(Progress):
    """How far the training of a run has come."""

    best: float = -math.inf
    """Best mean episode return at a checkpoint so far."""


class TrainingState:
    """All that changes in a training, stored in a run folder: resumed, it goes on bit for bit on a
    CPU."""

    def __init__(
        self,
        folder: Path,
        components: Mapping[str, Any],
        collector: Collector,
        clock: SystemClock,
        buffer: ReplayBuffer | None = None,
        hindsight: HindsightReturns | None = None,
    ) -> None:
        self.folder = folder
        self.components = components
        self.progress = RunProgress()
        self.episodes = EpisodeLog(collector.env.batch_size[0], hindsight)
        self.saved = 0
        """The update after which the checkpoint of the run was written."""
        self._replay = ReplayMemory(buffer, folder / REPLAY)
        self._parts = {
            "progress": self.progress,
            "episodes": self.episodes,
            "clock": clock,
            "environment": collector.env,
            "collector": CarriedStep(collector),
            "replay": self._replay,
            "random": RandomState(),  # last, because loading the others may draw numbers
        }

    def save(self) -> None:
        """Replace the checkpoint of the run; if that fails, the older one is intact."""
        # The states of the parts first: that of the replay memory writes files, which the
        # checkpoint names.
        parts = _states(self._parts)
        networks = _states(self.components)
        write_checkpoint(self.folder / CHECKPOINT, {"components": networks, "training": parts})
        self.saved = self.progress.updates
        self._replay.remove_old()

    def save_best(self, due: bool) -> None:
        """Store the learner if the mean return in hindsight is the best at a ``due`` update so far.

        If none was due yet, it is stored anyway, until one is. ``save`` must follow.
        """
        mean = self.episodes.means()["hindsight_return"]
        if due and mean > self.progress.best:
            self.progress.best = mean
        elif self.progress.best > -math.inf:
            return
        training = _states({"progress": self.progress})
        content = {"components": _states(self.components), "training": training}
        write_checkpoint(self.folder / BEST, content)

    def load(self) -> None:
        """Continue from the checkpoint of the run, and remove what a killed run has left beside
        it."""
        path = self.folder / CHECKPOINT
        content = read_checkpoint(path, "resume")
        restore(self.components, content.get("components", {}), path, "resume")
        restore(self._parts, content.get("training", {}), path, "resume")
        self.saved = self.progress.updates
        self._replay.remove_old()


def load_networks(written: Path, key: str, components: Mapping[str, Any]) -> None:
    """Restore some components of a learner in place, such as its actor."""
    path = checkpoint_file(written)
    restore(components, read_checkpoint(path, key).get("components", {}), path, key)


def checkpoint_file(written: Path) -> Path:
    """The file that a run folder, a file in one, or ``damian:NAME`` of the package's own, stands
    for."""
    written = Path(data_file(str(written), "checkpoint"))
    return written if written.is_file() else written / CHECKPOINT


def _states(parts: Mapping[str, Any]) -> Stored:
    return {name: part.state_dict() for name, part in parts.items()}


class CarriedStep:
    """What a collector takes its next step from, which TorchRL has no public way to restore."""

    def __init__(self, collector: Collector) -> None:
        self._collector = collector

    def state_dict(self) -> Stored:
        collector = self._collector
        return {"step": collector._carrier, "trajectories": collector._traj_pool.state_dict()}

    def load_state_dict(self, state: Stored) -> None:
        collector = self._collector
        step = to_tensordict(state["step"]).to(collector.env.device)
        collector._carrier = step.clear_device_() if collector._carrier.device is None else step
        collector._traj_pool.load_state_dict(state["trajectories"])


class RandomState:
    """The states of the global random generators of torch, NumPy and Python."""

    def state_dict(self) -> Stored:
        name, numbers, *rest = np.random.get_state()  # noqa: NPY002 (components of the user's own may use it)
        return {
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
            "numpy": [name, np.asarray(numbers).tolist(), *rest],
            "python": random.getstate(),
        }

    def load_state_dict(self, state: Stored) -> None:
        torch.set_rng_state(state["torch"])
        if len(state["cuda"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state["cuda"])
        name, numbers, *rest = state["numpy"]
        np.random.set_state((name, np.array(numbers, dtype=np.uint32), *rest))  # noqa: NPY002
        random.setstate(state["python"])
