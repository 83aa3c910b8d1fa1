"""Tasks of VMAS with late observations: transforms of DAMIAN as BenchMARL's environment
transforms."""

from typing import Any

import compat  # noqa: F401  before BenchMARL
import torch
from benchmarl.environments import VmasClass, VmasTask
from torch import nn
from torchrl.data import Categorical
from torchrl.envs import CatTensors, Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import ActionHistory, ObservationDelay, keys
from damian.common import checks

AGE = (keys.AGENTS, "age")


class DelayedVmasTask(VmasClass):
    """A task of VMAS with agents that observe late, each with delays of its own.

    They know the age of what they observe, and their own latest actions. Everything else is
    BenchMARL's.

    Args:
        name: of VMAS's scenario, such as ``navigation``.
        config: settings of that scenario, as in BenchMARL; its own defaults if not given.
        delay: of the observations: steps, or a law such as ``damian.Uniform(1, 7)``.
        history: number of latest actions that an agent knows.

    Raises:
        InputError: there is no such task, or the delay or the history is impossible.
    """

    def __init__(
        self, name: str, config: dict[str, Any] | None = None, *, delay: Any = 4, history: int = 4
    ) -> None:
        names = [task.name.lower() for task in VmasTask]
        checks.one_of("scenario", name.lower(), names)
        task = VmasTask[name.upper()]
        super().__init__(task.name, config or task.get_from_yaml().config)
        self.delay = delay
        self.history = history

    def get_env_transforms(self, env: EnvBase) -> list[Transform]:
        action = env.full_action_spec_unbatched[keys.ACTION]
        codes = torch.eye(action.space.n) if isinstance(action, Categorical) else None
        return [
            ObservationDelay(self.delay, [keys.OBSERVATION]),
            CatTensors(
                [keys.OBSERVATION, AGE], keys.OBSERVATION, sort=False
            ),  # one entry, as QMIX needs
            ActionHistory(self.history, keys.ACTION, append_to=keys.OBSERVATION, codes=codes),
        ]

    def evaluation_env(self, num_envs: int, continuous_actions: bool, seed: int) -> TransformedEnv:
        """Worlds with the same delays."""
        env = self.get_env_fun(num_envs, continuous_actions, seed, "cpu")()
        return TransformedEnv(env, Compose(*self.get_env_transforms(env)))

    @torch.no_grad()
    def mean_return(self, env: TransformedEnv, policy: nn.Module, sample: bool) -> float:
        """Mean return of a policy in the first episode of each world; rewards are not late."""
        mode = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
        with set_exploration_type(mode):
            steps = env.rollout(self.max_steps(env), policy, break_when_any_done=False)["next"]
        done = steps[keys.DONE].squeeze(-1).int()
        first = done.cumsum(-1) - done == 0  # [B, T]
        return float((steps[keys.REWARD].squeeze(-1).mean(-1) * first).sum(-1).mean())
