"""A scripted policy that learns nothing: fly to where the source is believed, else over fresh ground.

Every UAV flies where its footprint holds most of what it wants: while a detection is recent, ground on which
the source is likely to be; else its own ground (nearer to it than to the others), not just covered. If there
is none of it within reach, it flies as near as it can.
"""

import math

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor

from damian import keys
from damian.common.tensors import gather_rows
from damian.envs.delayed_env import DelayedEnv
from damian.envs.uav_env import UavEnv
from damian.world.messages import Messages

BLUR_M = 5.0
"""How uncertain a place just told is: landing points stand for the ground around them."""
TRUST = 0.9
"""How sure it is that a footprint in which nothing is heard holds no source."""
RECENT = 3.0
"""Footprint radii that the source may go before it must be searched for anew."""
_NEARER = 1e-6
"""Landing points that a metre less to fly is worth: of equally good places the nearest."""
_NOTHING = 1e-3
"""Landing points: if no choice gains more, what is wanted lies further away."""


def greedy_policy(env: DelayedEnv) -> TensorDictModule:
    """What a careful engineer would script; reads what the server knows (regime R0) and the action mask.

    Stateless and deterministic: equal messages, equal actions. Writes ``("agents", "action")`` [B, N], or
    [B, N, 2] if actions are continuous. The environment must have ``message`` among its extras.
    """
    available = env.observation_spec.keys(True, True)
    message = keys.RECEIVED if keys.RECEIVED in available else keys.MESSAGE
    wanted = {"message": message, "age": keys.AGE, "mask": keys.ACTION_MASK}
    in_keys: dict[str, NestedKey] = {name: key for name, key in wanted.items() if key in available}
    return TensorDictModule(Greedy(env.uav_env), in_keys, [keys.ACTION])


class Greedy:
    """Messages to actions, for the regions, the source and the UAVs of an environment."""

    def __init__(self, worlds: UavEnv) -> None:
        scenario, simulation = worlds.scenario, worlds.simulation
        source, terms = scenario.source, {*scenario.reward.terms} - {"coverage", "battery", "mean_distance"}
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
        held = Messages.unpack(message)
        region = held.trail[:, 0, 0] // self.points.shape[1]
        ground = self.points[region]
        wanted = self.fresh(held, ground)
        if self.seeks:
            time = held.time if age is None else held.time + age.squeeze(-1) * self.dt
            likely, recent = self.believe(held, ground, time.amax(-1, keepdim=True))
            wanted = torch.where(recent, likely, wanted * likely)
        gain = wanted @ (self.near if len(self.near) == 1 else self.near[region])
        gain = gain.where(self.real[region].unsqueeze(1), -torch.inf)
        flown = _apart(held.target, ground)
        goal = (gain - _NEARER * flown).argmax(-1)
        left = _apart(_pick(ground, goal), ground)
        if self.actions.kind == "discrete":
            return self.best_action(held, gain, left, mask)
        return self.best_move(held, gain, flown, left, ground)

    def fresh(self, held: Messages, ground: Tensor) -> Tensor:
        """1 where ground [B, L, 2] is the UAV's own and not in its latest footprints, else 0, [B, N, L]."""
        apart = _apart(held.target, ground)
        own = apart <= apart.amin(1, keepdim=True)
        been = _apart(gather_rows(self.points.flatten(0, 1), held.trail), ground.unsqueeze(1))
        return (own & (been > self.radius).all(-2)).float()

    def believe(self, held: Messages, ground: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
        """How likely the source is on ground [B, L, 2], up to 1, [B, 1, L]; is that recent, [B, 1, 1].

        Heard within a footprint, the source has gone on since: two deviations at its full speed. A footprint
        that is silent now speaks against it, less so if the source may just not have emitted.
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

    def best_action(self, held: Messages, gain: Tensor, left: Tensor, mask: Tensor | None) -> Tensor:
        """The best legal action, [B, N]; by landing point: its gain, and how far the goal is, [B, N, L]."""
        action = torch.arange(self.actions.n_actions, device=gain.device)
        row = held.trail[..., :1] * len(action) + action
        point, flown = (gather_rows(table[:, 0], row) for table in self.candidates.ranking)
        gain, left = (numbers.gather(-1, point.long()) for numbers in (gain, left))
        return _best(gain if mask is None else gain.where(mask, -torch.inf), flown, left)

    def best_move(self, held: Messages, gain: Tensor, flown: Tensor, left: Tensor, ground: Tensor) -> Tensor:
        """Distance and heading in [0, 1] to the best landing point within reach, [B, N, 2]."""
        best = _best(gain.where(flown <= self.candidates.max_distance, -torch.inf), flown, left)
        east, north = (_pick(ground, best) - held.target).unbind(-1)
        turn = torch.remainder(torch.atan2(east, north) / (2 * math.pi), 1.0)
        far = flown.gather(-1, best.unsqueeze(-1)).squeeze(-1) / self.candidates.max_distance
        return torch.stack([far, turn], -1)


def _best(gain: Tensor, flown: Tensor, left: Tensor) -> Tensor:
    """Where most is gained, of equals the nearest; if nothing is, where least is left to the goal, [B, N].

    Args:
        gain: of each choice, -inf if it must not be made, [B, N, C].
        flown: to get there [m], [B, N, C].
        left: from there to where most is gained of all [m], [B, N, C].
    """
    some = gain.amax(-1, keepdim=True) > _NOTHING
    return torch.where(some, gain - _NEARER * flown, -left.where(gain.isfinite(), torch.inf)).argmax(-1)


def _pick(ground: Tensor, chosen: Tensor) -> Tensor:
    """Places [B, N, 2] by index [B, N] among [B, L, 2]."""
    return ground.gather(1, chosen.unsqueeze(-1).expand(*chosen.shape, 2))


def _apart(places: Tensor, others: Tensor) -> Tensor:
    """Distances [*, P, Q] between places [*, P, 2] and others [*, Q, 2], exact also for small ones."""
    return torch.cdist(places, others, compute_mode="donot_use_mm_for_euclid_dist")
