"""TorchRL environments: the UAVs without delays, and the whole pipeline of a scenario."""
