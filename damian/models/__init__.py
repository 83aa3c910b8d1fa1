"""Models: the networks of actors and critics, made from the layouts of what they observe."""
