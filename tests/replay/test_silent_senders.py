"""Back-updating where a sender is silent for longer than any message takes, as a UAV in flight
is."""

from helpers import square

from damian import DelayConfig, keys
from damian.keys import next_key
from damian.learners.config import MappoConfig
from damian.models.config import MlpConfig
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import learning_env, replay_buffer
from damian.runs.config import LoggerConfig
from damian.server.config import EpisodeConfig
from damian.world.config import MotionConfig


def truth(env, steps):
    """The rewards of steps [T, B], had all messages that were sent arrived at once, [T, B, N]."""
    sent = env.server.messages(steps[next_key(keys.MESSAGE)])
    return env.server(sent, steps["next", "step_count"].squeeze(-1)).reward


def test_the_programs_learn_the_same_rewards_from_flights_in_any_order_of_arrival():
    delay = DelayConfig(
        obs="0..4",
        order="arrival",
    )
    motion = MotionConfig(kind="polynomial", max_speed=10.0, max_acceleration=2.0)
    scenario = square(delay=delay, motion=motion, episode=EpisodeConfig(max_steps=60))
    config = TrainConfig(
        **vars(scenario),
        learner=MappoConfig(steps=5),
        model=MlpConfig(hidden=[8]),
        logger=LoggerConfig(tensorboard=False),
        worlds=24,
        backupdate=True,
    )
    env = learning_env(config)
    buffer = replay_buffer(config, env)
    flight = env.rollout(100, break_when_any_done=False)
    assert buffer is not None
    for part in flight.split(5, 1):
        buffer.extend(part)
        kept = buffer.storage
        steps = kept.steps[kept.latest(5 + 4)[:-4]]
        assert steps[next_key(keys.REWARD)].squeeze(-1).equal(truth(env, steps))
