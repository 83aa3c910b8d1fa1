"""A Gymnasium environment whose observations, actions and rewards are late, and an agent that knows
of it."""

from torchrl.envs import Compose, GymEnv, TransformedEnv

from damian import ActionDelay, ActionHistory, ObservationDelay, RewardDelay, Uniform, set_seed

delays = Compose(
    ActionDelay(1),  # executed one step after it was chosen
    ObservationDelay(Uniform(1, 4), loss=0.1),  # one draw for each step; a tenth never arrives
    RewardDelay(Uniform(0, 3)),  # paid later; the last step of an episode pays the rest
    ActionHistory(5, append_to="observation"),  # with it the process is Markovian again
)
env = TransformedEnv(GymEnv("Pendulum-v1"), delays)
set_seed(env, 0)
steps = env.rollout(200)
print(f"mean age of an observation: {steps['age'].mean():.1f} steps")
