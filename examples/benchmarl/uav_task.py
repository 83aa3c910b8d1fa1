"""The delayed scenarios of DAMIAN as a task of BenchMARL."""

from collections.abc import Callable
from typing import Any

import compat  # noqa: F401  before BenchMARL
from benchmarl.environments import TaskClass
from tensordict import NestedKey
from torch import nn
from torchrl.data import Composite
from torchrl.envs import CatTensors, EnvBase, FlattenObservation, Transform

from damian import ScenarioConfig, compose_scenario, keys, make_env
from damian.common import checks
from damian.envs.delayed_env import DelayedEnv
from damian.runs.metrics import evaluate

STATE = "critic_state"
"""What central critics and the mixer of QMIX read, [B, S]: of all UAVs the observations that the
server makes of the messages it holds, and what they observe themselves
(with the actions that the server cannot know of yet). Nothing in it is the simulator's truth."""


class UavTask(TaskClass):
    """UAVs whose messages arrive late, for any algorithm of BenchMARL.

    ``damian.make_env`` puts the delays, and the history of a UAV's own actions, into the
    environment. Actions
    are discrete, with a mask, or continuous: BenchMARL decides, and its default is continuous.

    Args:
        name: of the task, in BenchMARL's logs.
        config: ``overrides``: those of ``damian train`` that concern the environment, such as
            ``["scenario=delaybench/tracking", "delay.obs=4", "aware=history"]``.

    Raises:
        InputError: an override is misspelt, its value is impossible, or the task has no time limit.
    """

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        super().__init__(name, config)
        self.scenario("discrete")

    def scenario(self, kind: str) -> ScenarioConfig:
        """All settings, with ``discrete`` or ``continuous`` actions."""
        scenario = compose_scenario(*self.config["overrides"], f"actions={kind}")
        problem = "is no time limit [steps], and BenchMARL needs one"
        checks.require(
            scenario.episode.max_steps is not None,
            "episode.max_steps",
            scenario.episode.max_steps,
            problem,
        )
        return scenario

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        scenario = self.scenario("continuous" if continuous_actions else "discrete")
        return lambda: make_env(scenario, num_envs, seed or 0, device)

    def get_env_transforms(self, env: EnvBase) -> list[Transform]:
        known = "critic_known"
        joined = CatTensors(
            [keys.GLOBAL_OBSERVATION, keys.OBSERVATION], (keys.AGENTS, known), del_keys=False
        )
        return [
            joined,
            FlattenObservation(-2, -1, in_keys=[(keys.AGENTS, known)], out_keys=[STATE]),
        ]

    def evaluation_env(self, num_envs: int, continuous_actions: bool, seed: int) -> DelayedEnv:
        """Worlds that also output the messages themselves, to be judged by."""
        scenario = self.scenario("continuous" if continuous_actions else "discrete")
        return make_env(scenario, num_envs, seed, extras=("message",))

    def mean_return(self, env: DelayedEnv, policy: nn.Module, sample: bool) -> float:
        """Mean return of a policy by what has truly happened, whenever the server heard of it."""
        return evaluate(env, policy, self.max_steps(env), sample)["return"]

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return True

    def max_steps(self, env: EnvBase) -> int:
        return self.scenario("discrete").episode.max_steps or 0

    def has_render(self, env: EnvBase) -> bool:
        return False

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        n_agents = env.full_action_spec_unbatched[keys.AGENTS].shape[0]
        return {keys.AGENTS: [f"uav_{number}" for number in range(n_agents)]}

    def observation_spec(self, env: EnvBase) -> Composite:
        return _entry(env, keys.OBSERVATION)

    def action_mask_spec(self, env: EnvBase) -> Composite | None:
        masked = keys.ACTION_MASK in env.full_observation_spec_unbatched.keys(True, True)
        return _entry(env, keys.ACTION_MASK) if masked else None

    def state_spec(self, env: EnvBase) -> Composite:
        return Composite({STATE: env.full_observation_spec_unbatched[STATE]})

    def action_spec(self, env: EnvBase) -> Composite:
        return env.full_action_spec_unbatched

    def info_spec(self, env: EnvBase) -> None:
        return None

    @staticmethod
    def env_name() -> str:
        return "damian"


def _entry(env: EnvBase, key: NestedKey) -> Composite:
    """The spec of one entry of the UAVs: BenchMARL's networks read every entry that they are
    given."""
    spec = env.full_observation_spec_unbatched[key]
    return Composite({keys.AGENTS: Composite({key[1]: spec}, shape=spec.shape[:1])})
