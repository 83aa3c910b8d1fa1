"""The server node computes features, rewards and the ends of episodes from the messages that it
holds."""
