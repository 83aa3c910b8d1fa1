"""Your own learner: QMIX (Rashid et al. 2018), or VDN (Sunehag et al. 2018), on TorchRL's mixers
and loss.

    damian train scenario=delaybench/crowded delay.obs=4 observation.own=true \\
        learner=examples.extending.qmix:QmixConfig             (in a clone; VDN: learner.mixer=vdn)
    ... aware=backupdate      (rewards and what the mixer reads are corrected; only settled steps are drawn)

The UAVs share one network of action values; the mixer joins those of the chosen actions to the
value of the team, and reads what the critic observes of all UAVs. The policy is epsilon-greedy: an
evaluation that samples does so with the last epsilon, and a deterministic one is greedy. A UAV in
flight has a single action.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import QMixer, QValueModule, VDNMixer
from torchrl.objectives import SoftUpdate
from torchrl.objectives.multiagent import QMixerLoss

from damian import LearnerConfig, LearningSetup, keys
from damian.common import checks
from damian.common.fields import setting
from damian.keys import next_key
from damian.models.distribution import with_distribution
from damian.models.mlp import make_mlp

VALUES = (keys.AGENTS, "action_value")
CHOSEN = (keys.AGENTS, "chosen_action_value")
JOINT = "joint"


@dataclass
class QmixConfig(LearnerConfig):
    """Settings of QMIX."""

    lr: float = 5e-4
    steps: int = 4
    mixer: str = setting(
        "qmix", "How values are joined: qmix, or vdn (their sum).", choices=("qmix", "vdn")
    )
    epsilon: float = setting(0.95, "Probability of a random action at first.", low=0.05, high=0.95)
    epsilon_end: float = setting(0.05, "The same after ``annealed``.", above=0, high=0.95)
    annealed: float = setting(0.5, "Share of the run in which epsilon falls.", above=0, high=1)
    updates: int = setting(8, "Updates per round.", low=1, high=checks.STEPS)
    batch_size: int = setting(256, "Environment steps per update.", low=1, high=checks.STEPS)
    buffer_steps: int = setting(100_000, "Environment steps in the replay buffer.", low=1)

    def check(self, setup: LearningSetup) -> None:
        for name in ("recurrent", "prior"):
            checks.require(not getattr(setup.model, name), "model", name, "does not go with QMIX")

    def buffer_size(self, setup: LearningSetup) -> int:
        return max(self.buffer_steps // setup.worlds * setup.worlds, setup.least_buffer)

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "Qmix":
        return Qmix(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: Any) -> Any:
        masked = keys.ACTION_MASK in env.observation_spec.keys(True)
        checks.require(
            masked, "actions.mask", masked, "is not true: QMIX chooses among legal actions"
        )
        n_features = env.observation_spec[keys.OBSERVATION].shape[-1]

        def make(n_actions: int, *out_keys: Any) -> TensorDictModule:
            chooser = EpsilonGreedy(
                make_mlp(model, n_features, n_actions).to(env.device), self.epsilon
            )
            return TensorDictModule(chooser, [keys.OBSERVATION, keys.ACTION_MASK], list(out_keys))

        return with_distribution(env, make)


class EpsilonGreedy(nn.Module):
    """From observations [*, F] and legal actions [*, A] to the logarithms of their probabilities,
    [*, A]."""

    def __init__(self, network: nn.Module, epsilon: float) -> None:
        super().__init__()
        self.network = network
        device = next(network.parameters()).device
        self.epsilon, self.learnt = (
            nn.Buffer(torch.tensor(n, device=device)) for n in (epsilon, 0)
        )

    def forward(self, observation: Tensor, legal: Tensor) -> Tensor:
        values = self.network(observation).masked_fill(~legal, -math.inf)
        greedy = torch.zeros_like(values).scatter(-1, values.argmax(-1, keepdim=True), 1.0)
        return (
            (1 - self.epsilon) * greedy + self.epsilon * legal / legal.sum(-1, keepdim=True)
        ).log()


class Qmix:
    """Learns the value of the team by temporal differences of steps that are drawn from a replay
    buffer."""

    def __init__(self, env: EnvBase, config: QmixConfig, setup: LearningSetup, buffer: Any) -> None:
        self.config = config
        self.setup = setup
        self.buffer = buffer
        self.actor = config.make_actor(env, setup.model)
        self.chooser = self.actor[0].module
        n_agents, n_columns = env.observation_spec[setup.critic_key].shape[-2:]
        mixer = VDNMixer(n_agents, env.device)
        read = [CHOSEN]
        if config.mixer == "qmix":
            mixer = QMixer((n_agents * n_columns,), 32, n_agents, env.device)
            read = [CHOSEN, JOINT]
        values = TensorDictModule(self.chooser.network, [keys.OBSERVATION], [VALUES])
        best = QValueModule("categorical", VALUES, keys.ACTION_MASK, [keys.ACTION, VALUES, CHOSEN])
        team = TensorDictModule(mixer, read, ["chosen_action_value"])
        self.loss = QMixerLoss(TensorDictSequential(values, best), team, action_space="categorical")
        self.loss.make_value_estimator(gamma=config.gamma)
        # A checkpoint also holds the discount of its run, which must not replace this run's.
        renew = lambda loss, _: loss.make_value_estimator(gamma=config.gamma)  # noqa: E731
        self.loss.register_load_state_dict_post_hook(renew)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.lr)
        self.targets = SoftUpdate(self.loss, tau=0.01)

    def components(self) -> dict[str, Any]:
        return {"actor": self.actor, "critic": self.loss, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        self.buffer.extend(batch.exclude("collector", keys.LOGITS, keys.ACTION_LOG_PROB))
        order = self.buffer.storage.latest()
        loss = torch.tensor(math.nan)
        settled = order[: len(order) - self.setup.longest_delay * self.setup.backupdate]
        for _ in range(self.config.updates if len(settled) else 0):
            world = torch.randint(self.setup.worlds, (self.config.batch_size,))
            step = settled[torch.randint(len(settled), world.shape)]
            loss = self.loss(self.joint(self.buffer.storage.steps[step, world]))["loss"]
            self.optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.loss.parameters(), 10.0)
            self.optimizer.step()
            self.targets.step()
        self.chooser.learnt += batch.numel()  # environment steps, over all worlds
        first = self.config.epsilon
        last = self.config.epsilon_end
        annealed = self.config.annealed
        share = min(self.chooser.learnt.item() / max(int(annealed * self.setup.frames), 1), 1.0)
        self.chooser.epsilon.fill_(first + (last - first) * share)
        return {"loss": loss.item(), "epsilon": self.chooser.epsilon.item()}

    def joint(self, steps: TensorDictBase) -> TensorDictBase:
        """Turn stored steps [K] into those of a team that chooses at once, as the loss reads
        them."""
        if keys.VALID in steps:
            steps = steps[
                steps[keys.VALID].squeeze(-1)
            ]  # not after an end that was known only later
        team = steps.select(keys.OBSERVATION, next_key(keys.OBSERVATION), *map(next_key, keys.ENDS))
        for now, found in ((team, steps), (team["next"], steps["next"])):
            legal = found[keys.ACTION_MASK]
            ready = found[keys.READY].unsqueeze(-1)
            now[keys.ACTION_MASK] = legal.where(
                ready, torch.arange(legal.shape[-1], device=legal.device) == 0
            )
            now[JOINT] = found[self.setup.critic_key].flatten(-2)
        team[keys.ACTION] = steps[keys.ACTION] * steps[keys.READY]
        team["next", "reward"] = steps[next_key(keys.REWARD)].mean(-2)
        team["steps_to_next_obs"] = torch.ones(len(steps), 1)
        return team
