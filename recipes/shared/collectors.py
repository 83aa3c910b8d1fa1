"""Collects the batches that a learner learns from: in this process, in several, or on a Ray cluster.

TorchRL's ``Collector``, ``MultiSyncCollector`` and ``RayCollector`` do the work (docs/scaling.md). This adds
what a training needs beside them: the environment, batches between two ticks of the system clock, worlds and
seeds for each worker, their states for checkpoints, and one line if a worker is lost.
"""

import copy
import io
import os
import random
import re
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import TransformedEnv

from damian import keys
from damian.common import counter_rng
from damian.common.errors import InputError, RunError
from damian.common.threads import using_threads
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.learners.networks import COMPILE_OPTIONS
from damian.learners.recurrent import add_recurrent_state
from damian.learners.schedule import SystemClock
from damian.runs.checkpoint import plain
from damian.runs.training_state import CarriedStep, RandomState
from damian.server.server import Server
from damian.settings import TrainConfig
from damian.transforms.reward import EpisodeTotals

from .ray_cluster import connected_ray
from .runs import seed_generators
from .settings import backupdates

START_LIMIT = 300
"""Seconds after which a Ray cluster that has no room for the workers is given up."""
_ENDLESS = 2**62
"""Environment steps that no run reaches; ``RayCollector`` collects nothing if it is told -1."""


def learning_env(config: TrainConfig) -> DelayedEnv:
    """The environment of the training, [B], with what the learner and the logs need."""
    messages = backupdates(config) or config.clock.trigger is not None
    privileged = config.critic == "privileged"
    reads = set(config.learner.reads) - {"hindsight"}  # the storage adds it
    extras = {"reward_terms", *["message"] * messages, *["privileged"] * privileged, *reads}
    env = make_env(config.train_scenario, config.worlds, config.seed, config.device, extras)
    if config.compile:
        env.compile()
    env.append_transform(EpisodeTotals())
    return env


def make_collector(
    env: TransformedEnv, actor: torch.nn.Module, frames: int, compile: bool = False
) -> Collector:
    """An endless collector of batches of ``frames`` environment steps; ``compile``: with a compiled actor."""
    add_recurrent_state(env, actor)
    return Collector(env, actor, frames_per_batch=frames, total_frames=-1, **_of_actor(compile))


def _of_actor(compile: bool) -> dict[str, Any]:
    """Options of every collector, whose worlds carry the hidden state of the actor and may compile it."""
    compiled = {"options": COMPILE_OPTIONS} if compile else None
    return {"auto_register_policy_transforms": True, "compile_policy": compiled}


@contextmanager
def collecting(
    config: TrainConfig, env: TransformedEnv, actor: torch.nn.Module
) -> Iterator["Collector | Workers"]:
    """The collector that a training's settings choose; its workers, if it has some, end with the context.

    Its batches are as long as the largest number of steps that divides every possible period of the clock.
    """
    frames = config.worlds * SystemClock(config.clock, config.update_steps).unit
    if config.collector == "sync":
        collector = make_collector(env, actor, frames, config.compile)
    else:
        collector = Workers(config, actor, frames)
        where = ", ".join(map(str, collector.process_ids))
        print(f"collector: {config.collector}, {config.workers} workers (processes {where})")
    try:
        yield collector
    finally:
        collector.shutdown()


def collector_parts(collector: "Collector | Workers") -> dict[str, Any]:
    """What a checkpoint stores of a collector, by name."""
    if isinstance(collector, Workers):
        return {"workers": collector}
    return {"environment": collector.env, "collector": CarriedStep(collector)}


def ticks(collector: "Collector | Workers", clock: SystemClock, server: Server) -> Iterator[TensorDictBase]:
    """Batches [B, T], each collected between two ticks of the system clock (paper, section 3.6)."""
    parts: list[TensorDictBase] = []
    for part in collector:
        parts.append(part)
        if sum(part.shape[1] for part in parts) < clock.period:
            continue
        batch = cast(TensorDictBase, torch.cat(parts, 1)) if len(parts) > 1 else part  # type: ignore[arg-type]
        if clock.change:
            clock.tick(spotting(batch, server))
        if isinstance(collector, Workers):
            collector.keep_state()
        parts = []
        yield batch


def spotting(batch: TensorDictBase, server: Server) -> torch.Tensor:
    """Which UAVs spot the source at the end of a batch [B, T], by what the server holds, [B, N] bool."""
    after = cast(TensorDictBase, batch["next"][:, -1])
    return server.messages(after.get(keys.RECEIVED, after[keys.MESSAGE])).spotted


# Several workers.


class WorkerLost(RunError):
    """A worker has ended; ``str(error)`` says which one, and how."""


class WorkerCollector(Collector):
    """The collector of one worker, which takes weights, and hands out its state and goes on from it.

    What it takes and hands out are bytes, which pipes pass faster than many tensors.
    """

    def __init__(self, *args: Any, traj_pool: Any = None, **options: Any) -> None:
        # A pool that all workers share would number episodes by which worker comes first.
        super().__init__(*args, **options)

    def take_weights(self, weights: bytes) -> None:
        """Act with the weights of the learner's actor from now on."""
        actor = cast(torch.nn.Module, self.policy)
        for own, new in zip(actor.state_dict().values(), unpacked(weights), strict=True):
            own.copy_(new)

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


def packed(content: Any) -> bytes:
    """Nested dictionaries and lists of tensors and numbers as bytes."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def unpacked(content: bytes) -> Any:
    """What ``packed`` has packed; nothing in it is executed."""
    return torch.load(io.BytesIO(content), weights_only=True)


def worker_seed(seed: int, worker: int) -> int:
    """The seed of a worker's global generators, which draw its actions; 32 bits."""
    return int(np.random.SeedSequence((seed, worker)).generate_state(1)[0])


def worker_env(config: TrainConfig, actor: torch.nn.Module, worker: int) -> DelayedEnv:
    """The environment of a worker, made in its process: its share of the run's worlds, [B / workers].

    A world has the same random stream whichever process it is in; the actions are drawn from a generator of
    each worker.

    Args:
        config: settings of the run.
        actor: the actor; its weights need not be there.
        worker: number of the worker, from 0.
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
        self._actor, self._connected = actor, False
        self._ray: Any = None
        skeleton = copy.deepcopy(actor).to("meta")
        makers = [partial(worker_env, config, skeleton, worker) for worker in range(config.workers)]
        options = {"frames_per_batch": frames, "collector_class": cast(Any, WorkerCollector)}
        if config.collector == "ray":
            self._collector: Any = self._on_ray(makers, options, _of_actor(config.compile))
        else:
            with using_threads(torch.get_num_threads()):  # the collector changes it
                self._collector = MultiSyncCollector(
                    makers,
                    actor,
                    total_frames=-1,
                    cat_results="stack",
                    **options,
                    **_of_actor(config.compile),
                )
        self.process_ids: list[int] = self._on_all("process_id")
        self._states: list[bytes] = self._on_all("dump")

    def _on_ray(self, makers: list[Any], options: dict[str, Any], of_workers: dict[str, Any]) -> Any:
        """TorchRL's collector whose workers are Ray actors with one CPU each."""
        state = random.getstate()  # Ray draws from Python's generator, of which the run has seeded this one
        self._ray, self._connected = connected_ray("collector", len(makers))
        places = self._room_on_ray(len(makers))
        from torchrl.collectors.distributed import RayCollector  # noqa: PLC0415 (needs Ray)

        collector = RayCollector(
            makers,
            self._actor,
            total_frames=_ENDLESS,
            sync=True,
            collector_kwargs=of_workers,
            remote_configs={"num_cpus": 1, "scheduling_strategy": places},
            **options,
        )
        collector.update_policy_weights_(self._actor)  # before, the workers' actors have no tensors to fill
        random.setstate(state)
        return collector

    def _room_on_ray(self, number: int) -> Any:
        """Room for all workers in the cluster at once; without it Ray would wait for ever."""
        ray = self._ray
        group = import_module("ray.util").placement_group([{"CPU": 1}] * number)
        try:
            ray.get(group.ready(), timeout=START_LIMIT)
        except ray.exceptions.GetTimeoutError:
            free, all_of = (
                int(found().get("CPU", 0)) for found in (ray.available_resources, ray.cluster_resources)
            )
            ray.shutdown()
            should = f"have found no room on Ray for {START_LIMIT} s: {free} of its {all_of} CPUs are free"
            raise InputError(f"workers: {number} {should}; choose fewer, or a larger cluster") from None
        strategies = import_module("ray.util.scheduling_strategies")
        return strategies.PlacementGroupSchedulingStrategy(placement_group=group)

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches = iter(self._collector)
        while True:
            weights = packed(list(self._actor.state_dict().values()))
            self._on_all("take_weights", [(weights,)] * len(self.process_ids))
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
        """End all workers, and a connection to Ray that was made for them."""
        with using_threads(torch.get_num_threads()):
            self._collector.shutdown()
        if self._connected:
            self._ray.shutdown()

    def _on_all(self, method: str, arguments: list[tuple] | None = None) -> list[Any]:
        with self._naming_lost():
            return self._collector.map_fn(method, arguments)

    @contextmanager
    def _naming_lost(self) -> Iterator[None]:
        """Turn what a lost worker causes into a ``WorkerLost``; all other errors stay."""
        try:
            yield
        except Exception as error:
            lost = self._lost_actor(error) if self._ray else self._lost_process()
            if lost is None:
                raise
            process, how = lost
            which = f"worker {self.process_ids.index(process)} of {len(self.process_ids)} (process {process})"
            raise WorkerLost(f"collector: {which} was lost: {how}") from error

    def _lost_actor(self, error: Exception) -> tuple[int, str] | None:
        """Id of the process of a Ray actor whose end is an error, and how it ended."""
        if not isinstance(error, self._ray.exceptions.RayActorError):
            return None
        process, how = (re.search(pattern, str(error)) for pattern in (r"pid: (\d+)", r"exit type: (\w+)"))
        return (int(process[1]), f"Ray says {how[1] if how else 'that it has died'}") if process else None

    def _lost_process(self) -> tuple[int, str] | None:
        """Id of the process whose end has caused an error, and how it ended; None if all are there."""
        codes: dict[int, int] = {}
        for number, process in enumerate(self._collector.procs):
            with suppress(ValueError):  # TorchRL closes the others, once it has ended them
                process.join(0.2)  # the pipe of a killed process closes before it has an exit code
                if process.exitcode is not None:
                    codes[self.process_ids[number]] = process.exitcode
        if not codes:
            return None
        # After an error, TorchRL makes all others exit, or ends them by SIGTERM if they take long.
        lost = min(codes, key=lambda each: (codes[each] == 0, codes[each] == -signal.SIGTERM))
        code = codes[lost]
        return lost, f"killed by signal {-code}" if code < 0 else f"exit code {code}, see above"
