"""BenchMARL's MAPPO, set as ``damian train`` is, until a return is reached
(``make bench-training``)."""

import tempfile
from collections.abc import Callable, Sequence
from typing import cast

import compat  # noqa: F401  before BenchMARL
from benchmarl.algorithms import MappoConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDictBase
from uav_task import UavTask

from damian.learners import mappo
from damian.recipes.config import TrainConfig

Measured = tuple[float, int]
"""Processor time [s] and steps."""


class Reached(Exception):
    """Raised to end an experiment; its argument is the processor time and the steps."""


class Ends(Callback):
    """Ends an experiment when ``after``, of a batch, returns what was measured instead of None."""

    def __init__(self, after: Callable[[TensorDictBase], Measured | None]) -> None:
        super().__init__()
        self.after = after

    def on_batch_collected(self, batch: TensorDictBase) -> None:
        if found := self.after(batch):
            raise Reached(found)


def until(
    config: TrainConfig, words: Sequence[str], after: Callable[[TensorDictBase], Measured | None]
) -> Measured:
    """Train with the settings of ``config``, which is made of ``words``, until ``after`` ends
    it."""
    ours = cast(mappo.MappoConfig, config.learner)
    batch = config.worlds * config.update_steps
    options = ExperimentConfig.get_from_yaml()
    options.on_policy_n_envs_per_worker = config.worlds
    options.on_policy_collected_frames_per_batch = batch
    options.on_policy_minibatch_size = batch // ours.minibatches
    options.on_policy_n_minibatch_iters = ours.epochs
    options.lr = ours.lr
    options.gamma = ours.gamma
    options.clip_grad_val = ours.max_grad_norm
    options.prefer_continuous_actions = options.evaluation = options.render = (
        options.create_json
    ) = False
    options.loggers = []
    algorithm = MappoConfig.get_from_yaml()
    model = MlpConfig.get_from_yaml()
    algorithm.entropy_coef = ours.entropy_coeff
    algorithm.clip_epsilon = ours.clip_epsilon
    algorithm.lmbda = ours.lmbda
    model.num_cells = list(config.model.hidden)
    task = UavTask("until", {"overrides": list(words)})
    with tempfile.TemporaryDirectory() as options.save_folder:
        experiment = Experiment(
            task, algorithm, model, config.seed, options, callbacks=[Ends(after)]
        )
        try:
            experiment.run()
        except Reached as end:
            return end.args[0]
    raise AssertionError("BenchMARL ends by itself")
