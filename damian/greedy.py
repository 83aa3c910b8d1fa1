"""A scripted policy that learns nothing: fly to where the source is believed, else over fresh ground.

Every UAV flies where its footprint holds most of what it wants: while a detection is recent, ground on which
the source is likely to be; else its own ground (nearer to it than to the others), not just covered.
"""

import math

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor

from damian.chain import DelayedEnv
from damian.env import UavEnv
from damian.features import Snapshot
from damian.world.airspace import rows

BLUR_M = 5.0
"""How uncertain a place just told is: landing points stand for the ground around them."""
TRUST = 0.9
"""How sure it is that a footprint in which nothing is heard holds no source."""
RECENT = 3.0
"""Footprint radii that the source may go before it must be searched for anew."""
_NEARER = 1e-6
"""Landing points that a metre less to fly is worth: of equally good places the nearest."""


def greedy_policy(env: DelayedEnv) -> TensorDictModule:
    """What a careful engineer would script; reads what the server knows (regime R0) and the action mask.

    Stateless and deterministic: equal messages, equal actions. Writes ``("agents", "action")`` [B, N], or
    [B, N, 2] if actions are continuous. The environment must have ``message`` among its extras.
    """
    shown = env.observation_spec["agents"].keys()
    names = {"message": "received" if "received" in shown else "message", "age": "age", "mask": "action_mask"}
    reads: dict[str, NestedKey] = {name: ("agents", key) for name, key in names.items() if key in shown}
    return TensorDictModule(Greedy(env.worlds), reads, [("agents", "action")])


class Greedy:
    """Messages to actions, for the regions, the source and the UAVs of an environment."""

    def __init__(self, worlds: UavEnv) -> None:
        scenario, simulation = worlds.scenario, worlds.simulation
        source, terms = scenario.source, {*scenario.task.terms} - {"coverage", "battery", "mean_distance"}
        self.radius, self.dt = simulation.radius, scenario.clock.dt
        self.candidates, self.actions = simulation.candidates, scenario.actions
        self.speed = max(source.speed, source.local_speed) if source.motion == "dynamic" else 0.0
        self.emits = 1.0 if source.emission == "constant" else source.emission_probability
        self.seeks = bool(terms) or scenario.episode.success_share is not None
        self.real = simulation.airspace.points[..., 0].isfinite()
        self.points = simulation.airspace.points.nan_to_num(posinf=0.0)
        near = _apart(self.points, self.points) <= self.radius
        # Row: ground; column: where it is seen from.
        self.near = (near & self.real.unsqueeze(-1)).float()

    def __call__(self, message: Tensor, age: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Actions for messages [B, N, M] of these ages [steps], [B, N, 1], under a mask [B, N, A]."""
        held = Snapshot.unpack(message)
        region = held.trail[:, 0, 0] // self.points.shape[1]
        ground = self.points[region]
        wanted = self.fresh(held, ground)
        if self.seeks:
            time = held.time if age is None else held.time + age.squeeze(-1) * self.dt
            likely, recent = self.believe(held, ground, time.amax(-1, keepdim=True))
            wanted = torch.where(recent, likely, wanted * likely)
        gain = wanted @ (self.near if len(self.near) == 1 else self.near[region])
        if self.actions.kind == "discrete":
            return self.best_action(held, gain, mask)
        return self.best_move(held, gain, ground, self.real[region])

    def fresh(self, held: Snapshot, ground: Tensor) -> Tensor:
        """1 where ground [B, L, 2] is the UAV's own and not in its latest footprints, else 0, [B, N, L]."""
        apart = _apart(held.target, ground)
        own = apart <= apart.amin(1, keepdim=True)
        been = _apart(rows(self.points.flatten(0, 1), held.trail), ground.unsqueeze(1))
        return (own & (been > self.radius).all(-2)).float()

    def believe(self, held: Snapshot, ground: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
        """How likely the source is on ground [B, L, 2], up to 1, [B, 1, L]; is that recent, [B, 1, 1].

        Heard within a footprint, the source has gone on since: two deviations at its full speed. A silent
        footprint speaks against it, less so if the source may just not have emitted.
        """
        known = held.detected_time >= 0
        since = torch.where(known, now - held.detected_time, torch.inf).unsqueeze(-1)
        outside = (_apart(held.detected_position, ground) - self.radius).clamp(min=0)
        heard = -(outside / (BLUR_M + self.speed * since / 2)).square() / 2
        heard = torch.where(known.unsqueeze(-1), heard, 0.0).sum(1, keepdim=True)
        silent = ~held.spotted & (held.time > now - self.dt / 2)
        passed = (_apart(held.position, ground) <= self.radius) & silent.unsqueeze(-1)
        latest = since.amin(1, keepdim=True)
        sure = TRUST * torch.where(latest < self.dt / 2, 1.0, self.emits)
        log = heard + torch.log1p(-sure * passed.any(1, keepdim=True))
        gone = torch.where(latest.isfinite(), latest * self.speed, torch.inf)
        return (log - log.amax(-1, keepdim=True)).exp(), gone <= RECENT * self.radius

    def best_action(self, held: Snapshot, gain: Tensor, mask: Tensor | None) -> Tensor:
        """The legal action that leads to the landing point [B, N, L] with most gain, [B, N]."""
        action = torch.arange(self.actions.n_actions, device=gain.device)
        row = held.trail[..., :1] * len(action) + action
        point, distance = (rows(table[:, 0], row) for table in self.candidates.ranking)
        gain = gain.gather(-1, point.long()) - _NEARER * distance
        return (gain if mask is None else gain.where(mask, -torch.inf)).argmax(-1)

    def best_move(self, held: Snapshot, gain: Tensor, ground: Tensor, real: Tensor) -> Tensor:
        """Distance and heading in [0, 1] to the landing point [B, N, L] with most gain, [B, N, 2]."""
        distance = _apart(held.target, ground)
        reached = (distance <= self.candidates.max_distance) & real.unsqueeze(1)
        best = (gain - _NEARER * distance).where(reached, -torch.inf).argmax(-1, keepdim=True)
        east, north = (ground.gather(1, best.expand(*best.shape[:2], 2)) - held.target).unbind(-1)
        turn = torch.remainder(torch.atan2(east, north) / (2 * math.pi), 1.0)
        far = distance.gather(-1, best).squeeze(-1) / self.candidates.max_distance
        return torch.stack([far, turn], -1)


def _apart(places: Tensor, others: Tensor) -> Tensor:
    """Distances [*, P, Q] between places [*, P, 2] and others [*, Q, 2], exact also for small ones."""
    return torch.cdist(places, others, compute_mode="donot_use_mm_for_euclid_dist")
