"""The environment that a learner learns in."""

from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.transforms.episode_totals import EpisodeTotals

from .settings import TrainConfig


def learning_env(config: TrainConfig) -> DelayedEnv:
    """The environment of the training, [B], with what the learner and the logs need."""
    messages = config.backupdates or config.clock.trigger is not None
    privileged = config.critic == "privileged"
    reads = set(config.learner.reads) - {"hindsight"}  # the storage adds it
    extras = {"reward_terms", *["message"] * messages, *["privileged"] * privileged, *reads}
    env = make_env(config.train_scenario, config.worlds, config.seed, config.device, extras)
    if config.compile:
        env.compile()
    env.append_transform(EpisodeTotals())
    return env
