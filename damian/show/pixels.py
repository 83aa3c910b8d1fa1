"""Pictures while an environment runs: for TorchRL's ``VideoRecorder``, and for ``render`` of Gymnasium."""

from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from damian.common import checks
from damian.envs.uav_env import UavEnv
from damian.show.episode import at_instant, episode_of
from damian.show.film import DPI, SIZE, VIEWS, Film


class LiveFilm:
    """Draws an episode while it is flown; drawing takes about 0.3 s an instant.

    Args:
        env: the environment without delays, of one world, with the extras ``message``, ``state`` and
            ``reward_terms``.
        view: ``2d`` or ``3d``.
    """

    def __init__(self, env: UavEnv, view: str = "2d") -> None:
        should = "is not 1: a film shows one world"
        checks.require(env.batch_size[0] == 1, "film: number of worlds", env.batch_size[0], should)
        checks.one_of("film: view", view, VIEWS)
        for extra in ("message", "state"):
            checks.require(extra in env.extras, "film: extras", sorted(env.extras), f"lack {extra}")
        self.env, self.view = env, view
        self._instants: list[TensorDictBase] = []

    def begin(self, outputs: TensorDictBase) -> None:
        """Begin an episode, with the outputs of a reset, [1]."""
        self._instants = [at_instant(outputs).detach().cpu()]

    def add(self, outputs: TensorDictBase) -> None:
        """Add the outputs of a step, [1]."""
        self._instants.append(at_instant(outputs).detach().cpu())

    def picture(self) -> NDArray[np.uint8]:
        """The latest instant, as a film of the episode so far shows it, [height, width, 3]."""
        stacked = cast(TensorDictBase, torch.stack([each[0] for each in self._instants]))  # type: ignore[arg-type]
        episode = episode_of(stacked, self.env, {})
        return Film(episode, self.view).frame(episode.n_steps)


class FilmPixels(Transform):
    """Writes the picture of each instant, as a film of the episode so far shows it.

    It writes ``pixels`` [1, height, width, 3] uint8. Drawing takes about 0.3 s a step, so that it suits
    evaluations, not training.

    Args:
        env: the environment without delays, of one world, with the extras ``message``, ``state`` and
            ``reward_terms``.
        view: ``2d`` or ``3d``.

    Examples:
        >>> env = make_env(scenario, 1, extras=["message", "state", "reward_terms"])
        >>> env.append_transform(FilmPixels(env.uav_env))
        >>> env.append_transform(VideoRecorder(logger, tag="flight"))
        >>> env.rollout(50, policy)
        >>> env.transform.dump()
    """

    def __init__(self, env: UavEnv, view: str = "2d") -> None:
        super().__init__(in_keys=[], out_keys=["pixels"])
        self.film = LiveFilm(env, view)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.film.add(next_tensordict)
        return self._draw(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self.film.begin(tensordict_reset)
        return self._draw(tensordict_reset)

    def _draw(self, outputs: TensorDictBase) -> TensorDictBase:
        return outputs.set("pixels", torch.as_tensor(self.film.picture(), device=outputs.device).unsqueeze(0))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        width, height = (round(DPI * size) for size in SIZE)
        shape, device = torch.Size([1, height, width, 3]), observation_spec.device
        observation_spec["pixels"] = Unbounded(shape, dtype=torch.uint8, device=device)
        return observation_spec
