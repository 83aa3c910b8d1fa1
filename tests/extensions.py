"""Settings of quick runs with extensions."""

TINY = ["frames=128", "worlds=4", "learner.steps=16", "eval_episodes=3", "model.hidden=[8]", "logger=csv"]
TINY += ["region.lattice_step=60", "episode.max_steps=12"]
