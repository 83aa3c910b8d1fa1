"""DAMIAN: delay-aware multi-UAV reinforcement learning on TorchRL."""
