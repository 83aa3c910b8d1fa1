"""Settings of quick runs with extensions, and a reward term that reads the belief."""

import damian

TINY = ["frames=128", "worlds=4", "learner.steps=16", "eval_episodes=3", "model.hidden=[8]", "logger=csv"]
TINY += ["region.lattice_step=60", "episode.max_steps=12"]


@damian.reward_term(reads=["belief_moments"], scope="system")
def certainty(features, counters):
    """How sure the server is of where the source is."""
    return 1 - features["belief_moments"][..., -1]
