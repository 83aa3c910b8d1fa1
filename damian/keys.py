"""The TensorDict keys of the UAV environments, the learners and the replay storage.

The root TensorDict has the batch size [B] (worlds), the one under ``"agents"`` [B, N] (UAVs). After
a step, TorchRL stores the environment's outputs with the same keys under ``"next"``.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tensordict import NestedKey

AGENTS = "agents"

# The environment.
ACTION = (AGENTS, "action")
"""Actions of the UAVs: discrete [B, N], or continuous [B, N, 2] in [0, 1]."""
ACTION_MASK = (AGENTS, "action_mask")
"""Legal discrete actions, [B, N, A] bool."""
ACTION_VALID = (AGENTS, "action_valid")
"""Written by ``ActionDelay`` for the environment: does this action arrive now, or is it the default
action, [B, N] bool. The environment ignores all others, which are repetitions."""
FRAME = (AGENTS, "frame")
"""With absolute commands that are late: the landing point from which the UAV's next command counts,
which is that to which its last one leads, flat ids [B, N]."""
COMMANDS = (AGENTS, "commands")
"""Its latest commands, the newest first: where each leads (flat id), its number (the step in which
it was chosen, from 1; 0 for none), and the step by which it has been executed, or never will be,
[B, N, K, 3]."""
COMMAND = (AGENTS, "command")
"""Written by ``CommandDelay`` for the environment: the landing point from which the action that is
executed was chosen (flat id), its number (0 for the default action), and 0; then ``COMMANDS``,
[B, N, 1 + K, 3]."""
REACH = (AGENTS, "reach")
"""How far the UAV may fly now [m], negative if it is not ready, [B, N]; for the action mask, never
for an actor."""
READY = (AGENTS, "ready")
"""May the UAV choose an action now, [B, N] bool."""
OBSERVATION = (AGENTS, "observation")
"""Observations of the actor, [B, N, F]."""
GLOBAL_OBSERVATION = (AGENTS, "global_observation")
"""Observations of the critic, from the messages that the server holds, [B, N, G]."""
PRIVILEGED_OBSERVATION = (AGENTS, "privileged_observation")
"""Observations of a critic that knows the simulator's truth, [B, N, G + 2]; never for an actor."""
REWARD = (AGENTS, "reward")
"""Rewards of the UAVs (paper, eq. 8), [B, N, 1]."""
REWARD_TERMS = (AGENTS, "reward_terms")
"""Weighted terms of the reward by name, each [B, N]."""
MESSAGE = (AGENTS, "message")
"""The latest message that each UAV has sent, packed (``Messages.pack``), [B, N, M]."""
MESSAGE_SENT = (AGENTS, "message_sent")
"""Did the UAV send that message in this step, [B, N] bool."""
RECEIVED = (AGENTS, "received")
"""The message of each UAV that the server holds, packed (``Messages.pack``), [B, N, M]."""
LINKED = (AGENTS, "linked")
"""Messages that each UAV holds of each other with ``links=matrix``, [B, N, N, M]
(receiver, sender)."""
TIMELINE = (AGENTS, "timeline")
"""Messages of the latest steps that each UAV knows (``ObservationTimeline``), [B, N, N, K, C]."""
AGE = (AGENTS, "age")
"""Age of information: steps since the message that the server holds was generated, [B, N, 1]."""
DELAY = (AGENTS, "delay")
"""Delay of the message sent in this step [steps], -1 if it never arrives, [B, N, 1]; never for an
actor."""
REWARD_DELAY = (AGENTS, "reward_delay")
"""Delay of the reward earned in this step [steps], [B, N, 1]; never for an actor."""
EARNED_REWARD = (AGENTS, "earned_reward")
"""The reward earned in this step, whenever it is paid, [B, N, 1]; never for an actor."""
POSITION = (AGENTS, "position")
"""True position of each UAV at this instant, east and north [m], [B, N, 2]; for delay laws, never
for an actor."""
LOSS = (AGENTS, "loss")
"""Probability with which messages to the server are lost, if it is drawn, [B, N, 1]; never for an
actor."""
BELIEF = "belief"
"""Probability that each source is in each cell of the server's grid, as far as the messages tell
that have arrived, [B, K, C]."""
OWN_BELIEF = (AGENTS, "belief")
"""The same as each UAV knows it, whose own messages are not delayed for it, [B, N, K, C]."""
STOPS, OWN_STOPS = (AGENTS, "stops"), (AGENTS, "own_stops")
"""By age in steps, where each UAV is known to have stopped, east and north [m], what happened there
(``Messages.events``), and 1, else zeros: by the messages that the server holds, and by all that it
has sent itself, [B, N, slots, 3 + E]."""
HEARD_STOPS = (AGENTS, "heard_stops")
"""The same by what has reached a UAV directly, [B, N, N, slots, 3 + E] (receiver, sender)."""
RECALLED, OWN_RECALLED = (AGENTS, "recalled"), (AGENTS, "own_recalled")
"""The messages of the latest steps, the latest one first, each followed by 1 if it is known, else
zeros: by what has arrived, and by all that a UAV has sent itself, [B, N, steps + 1, M + 1]."""
FORWARD = (AGENTS, "forward")
"""The messages that each UAV expects to be sent now, by a model of the world, [B, N, N, M]
(receiver, sender)."""
FORWARD_MASK = (AGENTS, "forward_mask")
"""The actions that are legal by these messages, [B, N, N, A]."""
LINK_DELAY = (AGENTS, "link_delay")
"""Delays of the messages sent directly in this step, [B, N, N] (receiver, sender); -1 for lost
ones."""
STATE = "state"
"""The simulator's true state, [B, S]: of each UAV the position (east, north, up [m]), of each the
battery level [%], whether the source emits, and its position [m]. For drawing and references, never
an actor."""
SOURCE_OVER = "source_over"
"""Has the source finished its walk for good, [B, 1] bool."""
SUCCESS = "success"
"""Is the task accomplished, as far as the server knows, [B, 1] bool."""
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"
"""TorchRL's flags of the end of an episode, [B, 1] bool each; only at the root, as TorchRL's
transforms expect one reset key."""
ENDS = (DONE, TERMINATED, TRUNCATED)
STEPPED = "_step"
"""TorchRL's flag of the worlds that take this step, [B] bool; all of them if there is no such
entry."""

# Data collection and learning.
STEP_COUNT = "step_count"
"""Steps of the episode so far, [B, 1] (``EpisodeTotals``, as TorchRL's ``StepCounter``)."""
EPISODE_REWARD = (AGENTS, "episode_reward")
"""Return of the episode so far, [B, N, 1] (``EpisodeTotals``, as TorchRL's ``RewardSum``)."""
ACTION_LOG_PROB = (AGENTS, "action_log_prob")
"""Log-probability of the action when it was chosen, [B, N]."""
LOGITS, LOC, SCALE = (AGENTS, "logits"), (AGENTS, "loc"), (AGENTS, "scale")
"""Parameters of the actor's distribution: logits of discrete actions, [B, N, A]; place and scale of
continuous ones, [B, N, 2] each."""
HIDDEN, HIDDEN_BEFORE = (AGENTS, "hidden"), (AGENTS, "hidden_before")
"""Recurrent state of the actor after and before a step, [B, N, H]."""
IS_INIT = "is_init"
"""Does an episode begin with this step, [B, 1] bool (TorchRL's ``InitTracker``)."""
STATE_VALUE, VALUE_TARGET = (AGENTS, "state_value"), (AGENTS, "value_target")
"""The critic's estimate of the return, and the target that it is trained on, [B, N, 1] each."""
ADVANTAGE = (AGENTS, "advantage")
"""Advantage of the action, [B, N, 1]."""
TEACHER_ACTION = (AGENTS, "teacher_action")
"""The actions of the teacher that a policy imitates, [B, N]."""
BACKUPDATED = (AGENTS, "backupdated")
"""Has a late message changed the stored reward of this step, [T, B, N, 1] bool; if only rewards are
late: has it been credited with a late reward."""
HINDSIGHT = (AGENTS, "hindsight")
"""Under ``"next"``, if a back-updating storage gets this key: the newest message sent by that step
that has arrived by now, packed, [T, B, N, M]."""
VALID = "valid"
"""False where, by the messages that have arrived since, the episode had already ended, [T, B, 1]
bool."""
RESET_AFTER = "reset_after"
"""Was the environment reset after this step, [T, B, 1] bool."""


def next_key(key: "NestedKey") -> "NestedKey":
    """The key under which TorchRL stores an entry's value after the step: ``("next", *key)``."""
    return ("next", *((key,) if isinstance(key, str) else key))


def last_part(key: "NestedKey") -> str:
    """The last part of a key, which is its name within the innermost TensorDict."""
    return key if isinstance(key, str) else last_part(key[-1])
