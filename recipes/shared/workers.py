"""Collects batches with several workers, in processes or on a Ray cluster (docs/scaling.md).

TorchRL's ``MultiSyncCollector`` and ``RayCollector`` do the work. This adds what a training needs beside
them: worlds and seeds for each worker, their states for checkpoints, and one line if a worker is lost.
"""

import copy
import io
import os
import queue
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.weight_update import SharedMemWeightSyncScheme

from damian.common import counter_rng
from damian.common.errors import RunError
from damian.common.threads import using_threads
from damian.envs.delayed_env import DelayedEnv
from damian.learners.networks import COMPILE_OPTIONS
from damian.learners.recurrent import add_recurrent_state
from damian.runs.checkpoint import plain
from damian.runs.training_state import CarriedStep, RandomState

from .launch import seed_generators
from .learning_env import learning_env
from .ray_workers import RayWorkers, WorkerPlan
from .settings import TrainConfig


class WorkerLost(RunError):
    """A worker has ended; ``str(error)`` says which one, and how."""


class WorkerCollector(Collector):
    """The collector of one worker, which can hand out its state and go on from it."""

    def __init__(self, *args: Any, traj_pool: Any = None, **options: Any) -> None:
        # A pool that all workers share would number episodes by which worker comes first.
        super().__init__(*args, **options)

    def dump(self) -> bytes:
        """The state of the worlds, of the next step and of the random generators, for a checkpoint."""
        return packed(plain({name: part.state_dict() for name, part in self._parts().items()}))

    def load(self, state: bytes) -> None:
        """Go on from a state that ``dump`` has returned."""
        stored = unpacked(state)
        for name, part in self._parts().items():
            part.load_state_dict(stored[name])

    def process_id(self) -> int:
        """Id of the worker's process on its machine."""
        return os.getpid()

    def _parts(self) -> dict[str, Any]:
        return {"environment": self.env, "collector": CarriedStep(self), "random": RandomState()}


def packed(state: dict[str, Any]) -> bytes:
    """Nested dictionaries of tensors and numbers as bytes, which pipes pass faster than many tensors."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def unpacked(state: bytes) -> dict[str, Any]:
    """What ``packed`` has packed; nothing in it is executed."""
    return torch.load(io.BytesIO(state), weights_only=True)


def worker_seed(seed: int, worker: int) -> int:
    """The seed of a worker's global generators, which draw its actions; 32 bits."""
    return int(np.random.SeedSequence((seed, worker)).generate_state(1)[0])


def worker_env(config: TrainConfig, actor: torch.nn.Module, worker: int) -> DelayedEnv:
    """The environment of a worker, made in its process: its share of the run's worlds, [B / workers].

    Args:
        config: settings of the run.
        actor: the actor, weights need not be there.
        worker: number of the worker, from 0.

    A world has the same random stream whichever process it is in; the actions are drawn from a generator of
    each worker's own.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes, and the main one answers it
    torch.set_num_threads(1)
    seed_generators(worker_seed(config.seed, worker))
    share = config.worlds // config.workers
    env = learning_env(replace(config, worlds=share))
    add_recurrent_state(env, actor)
    seeds = counter_rng.world_seeds(config.seed, config.worlds)
    env.seed_worlds(seeds[worker * share : (worker + 1) * share])
    return env


class Weights(cast(Any, SharedMemWeightSyncScheme)):
    """Sends weights through shared memory, and does not wait for a worker that has ended."""

    processes: Sequence[Any] = ()
    """Those of the workers, once they run."""

    def _wait_for_ack(self, worker_ids: Any = None, timeout: float | None = None) -> None:
        for worker, process in enumerate(self.processes):
            while process.is_alive():  # else the collector finds it out at its next step
                with suppress(queue.Empty):
                    self._ack_queues[worker].get(timeout=0.5)
                    break


class Processes:
    """Workers in processes of this machine.

    Args:
        plan: what they collect.
    """

    def __init__(self, plan: WorkerPlan) -> None:
        weights = Weights()
        with using_threads(torch.get_num_threads()):  # the collector changes it
            self.batches = MultiSyncCollector(
                plan.makers,
                plan.actor,
                frames_per_batch=plan.frames,
                total_frames=-1,
                collector_class=plan.collector,
                cat_results="stack",
                update_at_each_batch=True,
                weight_sync_schemes={"policy": weights},
                auto_register_policy_transforms=True,
                compile_policy=plan.compiled,
            )
        weights.processes = self.batches.procs

    def lost(self) -> tuple[int, str] | None:
        """The worker whose end has caused an error, and how it ended; None if all are there."""
        codes: dict[int, int] = {}
        for number, process in enumerate(self.batches.procs):
            with suppress(ValueError):  # TorchRL closes the others, once it has ended them
                process.join(0.2)  # the pipe of a killed process closes before it has an exit code
                if process.exitcode is not None:
                    codes[number] = process.exitcode
        if not codes:
            return None
        # After an error, TorchRL makes all others exit, or ends them by SIGTERM if they take long.
        number = min(codes, key=lambda each: (codes[each] == 0, codes[each] == -signal.SIGTERM))
        code = codes[number]
        return number, f"killed by signal {-code}" if code < 0 else f"exit code {code}, see above"

    def shutdown(self) -> None:
        """End all workers."""
        with using_threads(torch.get_num_threads()):
            self.batches.shutdown()


KINDS: dict[str, type[Processes] | type[RayWorkers]] = {"process": Processes, "ray": RayWorkers}
"""Where workers may be: values of the setting ``collector`` beside ``sync``, which has none."""


class Workers:
    """Collects batches [B, T]; worker w of W has the worlds from number w B / W on, in every batch.

    Args:
        config: settings of the run; ``config.collector`` says where the workers are.
        actor: the actor that the learner changes; the workers get its weights before each batch.
        frames: environment steps of a batch, over all worlds.

    Raises:
        InputError: the workers cannot be started.
    """

    def __init__(self, config: TrainConfig, actor: torch.nn.Module, frames: int) -> None:
        skeleton = copy.deepcopy(actor).to("meta")
        makers = [partial(worker_env, config, skeleton, worker) for worker in range(config.workers)]
        compiled = {"options": COMPILE_OPTIONS} if config.compile else None
        self._kind = KINDS[config.collector](WorkerPlan(makers, actor, frames, WorkerCollector, compiled))
        self.process_ids: list[int] = self._kind.batches.map_fn("process_id")
        self._states: list[bytes] = self._on_all("dump")

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches = iter(self._kind.batches)
        while True:
            with self._naming_lost():
                batch = next(batches)
            yield batch.flatten(0, 1)

    def keep_state(self) -> None:
        """Make the present state the one that a checkpoint stores, also once a worker is lost."""
        self._states = self._on_all("dump")

    def state_dict(self) -> dict[str, Any]:
        """The states of all workers when ``keep_state`` was called."""
        return {str(worker): unpacked(state) for worker, state in enumerate(self._states)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let all workers go on from their states."""
        self._states = [packed(state[str(worker)]) for worker in range(len(self._states))]
        self._on_all("load", [(each,) for each in self._states])

    def shutdown(self) -> None:
        """End all workers."""
        self._kind.shutdown()

    def _on_all(self, method: str, arguments: list[tuple] | None = None) -> list[Any]:
        with self._naming_lost():
            return self._kind.batches.map_fn(method, arguments)

    @contextmanager
    def _naming_lost(self) -> Iterator[None]:
        """Turn what a lost worker causes into a ``WorkerLost``; all other errors stay."""
        try:
            yield
        except Exception as error:
            if not (lost := self._kind.lost()):
                raise
            number, how = lost
            which = (
                f"worker {number} of {self._kind.batches.num_workers} (process {self.process_ids[number]})"
            )
            raise WorkerLost(f"collector: {which} was lost: {how}") from error
