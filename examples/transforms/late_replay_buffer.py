"""A replay buffer of undelayed steps becomes a delayed one."""

from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, GymEnv

from damian import ObservationDelay, RewardDelay, Uniform, delay_trajectories

buffer = ReplayBuffer(storage=LazyTensorStorage(1000), batch_size=32)
buffer.extend(GymEnv("CartPole-v1").rollout(500, break_when_any_done=False))  # many episodes in a row

delays = Compose(ObservationDelay(Uniform(1, 4), seed=0), RewardDelay(2, seed=1))
steps = delay_trajectories(buffer[:], delays)
buffer.empty()
buffer.extend(steps)
print(f"mean age of an observation: {buffer.sample()['age'].mean():.1f} steps")
