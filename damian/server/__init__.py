"""The server node: features, rewards and the end of an episode from the messages that have arrived."""
