"""The server node: what it makes of the messages that it holds, whenever and wherever it is asked.

Asked by the environment (nothing delayed), by the ``ServerNode`` transform (what has arrived), and by a
learner's storage (what has arrived by the time of learning): one copy of every formula.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common.errors import InputError
from damian.envs.scenario import ScenarioConfig
from damian.server.features import EXACT, Knowledge, Snapshot, observe, stack
from damian.server.rewards import Counters, Status, final_reward, reward, status
from damian.world.airspace import Airspace, rows
from damian.world.coverage import FootprintTables, build_tables

Features = dict[str, Tensor]


class Judgement(NamedTuple):
    """What the UAVs get for how the task stands."""

    reward: Tensor
    """Eq. 8 with bonus and penalty, [*, N]."""
    terms: dict[str, Tensor]
    """Its weighted terms by name, [*, N]."""
    status: Status
    """[*]."""


class Service(NamedTuple):
    """All that the UAVs and the learner get from the server."""

    observation: Tensor
    """Of the actors, [*, N, F]."""
    global_observation: Tensor
    """Of the critic, [*, N, G]."""
    reward: Tensor
    """[*, N]."""
    terms: dict[str, Tensor]
    """[*, N]."""
    status: Status
    """[*]."""


class Server:
    """Features, rewards and status of snapshots [*, N], with any leading dimensions.

    Args:
        scenario: what is asked for.
        airspace: where the UAVs fly.
        radius: of a UAV's footprint [m].

    Raises:
        InputError: more landing points than a message can number.
    """

    def __init__(self, scenario: ScenarioConfig, airspace: Airspace, radius: float) -> None:
        if airspace.points.shape[:2].numel() >= EXACT:
            raise InputError("region.lattice_step: a message cannot number so many landing points")
        self.config = scenario
        self.dt = scenario.clock.dt
        observation, task = scenario.observation, scenario.task
        self._wanted = sorted({*observation.actor, *observation.critic, *task.terms})
        self._scale = airspace.scale
        self._max_points = airspace.max_points
        self._points = airspace.points.flatten(0, 1)
        self._footprints: FootprintTables | None = None
        if "coverage" in self._wanted:
            polygons = [region.polygon for region in airspace.regions]
            places = airspace.points.double().cpu().numpy()
            self._footprints = build_tables(polygons, places, radius)

    def to(self, device: torch.device) -> "Server":
        """Move the tables, in place."""
        self._scale, self._points = self._scale.to(device), self._points.to(device)
        if self._footprints is not None:
            self._footprints = self._footprints.to(device)
        return self

    def features(self, snapshot: Snapshot, steps: Tensor, names: list[str] | None = None) -> Features:
        """What the observations and the rewards are made of (Table 2).

        Args:
            snapshot: the messages held, [*, N].
            steps: elapsed in the episode, [*].
            names: only these; everything that somebody wants, if not given.
        """
        knowledge = Knowledge(
            now=steps * self.dt,
            scale=self._scales(snapshot),
            time_scale=self.config.time_scale,
            battery=self.config.battery,
            footprints=self._footprints,
            points=self._points,
            age_scale=self.config.observation.age_scale,
            newest=self.config.observation.estimate == "newest",
        )
        return observe(snapshot, knowledge, names or self._wanted)

    def observations(self, features: Features) -> tuple[Tensor, Tensor]:
        """What the actors see [*, N, F], and the critic [*, N, G]."""
        wanted = self.config.observation
        return stack(features, wanted.actor), stack(features, wanted.critic)

    def informed(
        self,
        received: Tensor,
        message: Tensor,
        steps: Tensor,
        on_time: Tensor | None = None,
        fields: Sequence[str] = Snapshot._fields,
    ) -> Tensor:
        """What each actor sees if it knows some messages at once, [*, N, F].

        Args:
            received: what the server holds, [*, N, M].
            message: what the UAVs sent last, [*, N, M].
            steps: elapsed in the episode, [*].
            on_time: whose messages, by who is told and who has sent, [N, N]; one's own, if not given.
            fields: what of them.
        """
        n_agents, names = received.shape[-2], self.config.observation.actor
        if on_time is None:
            on_time = torch.eye(n_agents, dtype=torch.bool, device=received.device)
        timely = torch.where(on_time.unsqueeze(-1), message.unsqueeze(-3), received.unsqueeze(-3))
        known = Snapshot.unpack(received.unsqueeze(-3).expand_as(timely))  # [*, N, N], by who is told
        timely = Snapshot.unpack(timely)._asdict()
        known = known._replace(**{name: timely[name] for name in fields})
        told = stack(self.features(known, steps.unsqueeze(-1).expand(received.shape[:-1]), names), names)
        return told.diagonal(dim1=-3, dim2=-2).movedim(-1, -2)

    def judge(self, features: Features, snapshot: Snapshot, steps: Tensor, source_over: Tensor) -> Judgement:
        """Rewards and status (eq. 5-8, SPEC 5).

        Args:
            features: of the snapshot.
            snapshot: the messages held, [*, N].
            steps: elapsed in the episode, [*].
            source_over: has the source finished its walk, [*].
        """
        task, counters = self.config.task, Counters(steps, snapshot.motions)
        ended = status(snapshot, steps, steps * self.dt, source_over, self.dt, self.config.episode)
        terms = reward(features, counters, task)
        final = final_reward(ended, counters, task).unsqueeze(-1).expand_as(snapshot.track)
        return Judgement(sum(terms.values(), start=final), terms, ended)

    def serve(self, snapshot: Snapshot, steps: Tensor, source_over: Tensor | None = None) -> Service:
        """Everything at once; arguments as of ``judge``, with a source that never ends if not given."""
        over = torch.zeros_like(steps, dtype=torch.bool) if source_over is None else source_over
        features = self.features(snapshot, steps)
        judged = self.judge(features, snapshot, steps, over.view(steps.shape))
        return Service(*self.observations(features), *judged)

    def _scales(self, snapshot: Snapshot) -> Tensor:
        """Largest vertex distance of each world's region, which its landing points tell, [*]."""
        here = snapshot.trail[..., 0, 0]
        if len(self._scale) == 1:
            return self._scale.expand(here.shape)
        return rows(self._scale, here // self._max_points)
