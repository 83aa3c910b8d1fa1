"""The TensorDict keys of the UAV environments, the learners and the replay storage.

The batch size of the root is [B] (worlds), that of ``"agents"`` [B, N] (UAVs). After a step the same keys
lie under ``"next"``.
"""

from tensordict import NestedKey

AGENTS = "agents"

# The environment.
ACTION = (AGENTS, "action")
"""Discrete [B, N], or continuous [B, N, 2] in [0, 1]."""
ACTION_MASK = (AGENTS, "action_mask")
"""Legal discrete actions, [B, N, A] bool."""
ACTION_VALID = (AGENTS, "action_valid")
"""Written by ``ActionDelay`` for the environment: does this action count, [B, N] bool."""
READY = (AGENTS, "ready")
"""May the UAV choose now, [B, N] bool."""
OBSERVATION = (AGENTS, "observation")
"""Of the actor, [B, N, F]."""
GLOBAL_OBSERVATION = (AGENTS, "global_observation")
"""Of the critic, from what the server knows, [B, N, G]."""
PRIVILEGED_OBSERVATION = (AGENTS, "privileged_observation")
"""Of a critic that knows the simulator's truth, [B, N, G + 2]; never for an actor."""
REWARD = (AGENTS, "reward")
"""Paper, eq. 8, [B, N, 1]."""
REWARD_TERMS = (AGENTS, "reward_terms")
"""Weighted terms of the reward by name, each [B, N]."""
MESSAGE = (AGENTS, "message")
"""The latest message that each UAV has sent, packed, [B, N, M]."""
MESSAGE_SENT = (AGENTS, "message_sent")
"""Did the UAV send that message in this step, [B, N] bool."""
RECEIVED = (AGENTS, "received")
"""The message of each UAV that the server holds, packed, [B, N, M]."""
AGE = (AGENTS, "age")
"""Age of information: steps since the held message was generated, [B, N, 1]."""
DELAY = (AGENTS, "delay")
"""Delay of the message sent in this step [steps], -1 if it never arrives, [B, N, 1]; never for an actor."""
STATE = "state"
"""The simulator's truth, [B, S]: for drawing and for reference arms, never for an actor."""
SOURCE_OVER = "source_over"
"""Has the source finished its walk, [B, 1] bool."""
SUCCESS = "success"
"""[B, 1] bool."""
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"
"""[B, 1] bool each; at the root only, as TorchRL's transforms expect one reset key."""
DURATION = "duration"
"""Simulation steps that one step lasted, with ``SkipUntilReady``, [B, 1] long."""

# Collecting and learning.
STEP_COUNT = "step_count"
"""Steps of the episode so far, [B, 1] (TorchRL's ``StepCounter``)."""
EPISODE_REWARD = (AGENTS, "episode_reward")
"""Return of the episode so far, [B, N, 1] (TorchRL's ``RewardSum``)."""
ACTION_LOG_PROB = (AGENTS, "action_log_prob")
LOGITS, LOC, SCALE = (AGENTS, "logits"), (AGENTS, "loc"), (AGENTS, "scale")
"""Parameters of the actor's distribution."""
HIDDEN, HIDDEN_BEFORE = (AGENTS, "hidden"), (AGENTS, "hidden_before")
"""Recurrent state after and before a step, [B, N, H]."""
IS_INIT = "is_init"
"""Does an episode begin with this step, [B, 1] bool (TorchRL's ``InitTracker``)."""
STATE_VALUE, VALUE_TARGET = (AGENTS, "state_value"), (AGENTS, "value_target")
ADVANTAGE = (AGENTS, "advantage")
BACKUPDATED = (AGENTS, "backupdated")
"""Did a late message replace what the server held at this step, [T, B, N, 1] bool."""
VALID = "valid"
"""False where the episode had ended already, as the server knows now, [T, B, 1]."""
RESET_AFTER = "reset_after"
"""Was the environment reset after this step, [T, B, 1]."""


def next_key(key: NestedKey) -> NestedKey:
    """The key of an entry after the step."""
    return ("next", *((key,) if isinstance(key, str) else key))
