"""A filter that knows the source's velocity beside one that knows its place alone.

    python examples/studies/heading.py                  (ten minutes on one core)
    python examples/studies/heading.py --seeds 8 9 10   (these seeds only)

The states of the other filter are pairs of a cell and of a class of velocity: at rest, or one of eight
directions. How classes follow each other, and how far the source moves in each, is counted from walks, like
the moves of the built-in filter. The script flies by either filter in the same episodes, undelayed and with
every message four steps late. The table has its return, and how probable the true cell was, as a mean
logarithm; the walks that are flown are not those from which moves were counted.
"""

import math
from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from tqdm import tqdm

from damian import keys
from damian.baselines.script import script_policy
from damian.common.tables import markdown_table
from damian.compare.comparison import means_over_seeds, shown
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.keys import next_key
from damian.recipes.shared.environments import compose_scenario
from damian.runs.metrics import evaluation
from damian.server import belief
from damian.server.belief import SourceGrid, build_source_grid
from damian.world.airspace import Airspace
from damian.world.config import SourceConfig
from damian.world.signal_source import draw_walks, locate
from damian.world.state import Truth

TASKS, LATE = ("tracking", "intermittent", "flights"), (0, 4)
DIRECTIONS, AT_REST = 8, 0.4
"""Directions of the classes of velocity; share of the steps, the slowest ones, that count as rest."""
WALKS, STEPS, RARE = 512, 128, 1e-6
"""Walks from which moves are counted, and their steps; weight of a move that was never counted."""
HEADER = (
    "task",
    "return: place",
    "place and velocity",
    "more [%]",
    "log-probability: place",
    "and velocity",
)
GridBuilder = Callable[..., SourceGrid]


def velocity_grid(airspace: Airspace, source: SourceConfig, *options: float | None) -> SourceGrid:
    """As ``build_source_grid``, for one region, over pairs of a class of velocity and a cell, [V * K]."""
    grid, dt = build_source_grid(airspace, source, *options), options[1]
    edge = float(torch.pdist(grid.centres).min())
    steps = walked_steps(airspace, source, float(dt or 1)) / edge
    kind, n_kinds = classes(steps), 1 + DIRECTIONS
    pairs = torch.bincount((kind[:, :-1] * n_kinds + kind[:, 1:]).flatten(), minlength=n_kinds**2)
    follows = (pairs.view(n_kinds, n_kinds) + RARE) / (pairs.view(n_kinds, n_kinds) + RARE).sum(1, True)
    column = (grid.centres / edge).round().long()
    moves = torch.stack([moves_of(steps[kind == k], column) for k in range(n_kinds)])
    joint = torch.einsum("vw,wab->vawb", follows.float(), moves * (grid.prior[0] > 0))
    joint = joint.flatten(2).flatten(0, 1)
    joint = joint / joint.sum(-1, keepdim=True)  # the source stays in its region
    share = torch.bincount(kind.flatten(), minlength=n_kinds) / kind.numel()
    reports, emits = grid.log_reports.repeat(1, n_kinds), source.emits
    again = reports[grid.no_report // 2 : -1].exp()
    again[::2] = 1 - again[::2]
    return grid._replace(
        centres=grid.centres.repeat(n_kinds, 1),
        prior=(share.unsqueeze(-1) * grid.prior).view(1, -1),
        moves=joint.unsqueeze(0),
        staying=joint.new_ones(1, len(joint)),
        next_detection=emits * reports[1 : grid.no_report // 2 : 2].exp() @ joint.T,
        next_staying=torch.cat([emits * again @ joint.T, joint.new_zeros(1, len(joint))]),
        log_reports=reports,
    )


def walked_steps(airspace: Airspace, source: SourceConfig, dt: float) -> Tensor:
    """Steps of drawn walks, and the same turned and mirrored as a square can be, [8 * W, T, 2] metres."""
    source, time = replace(source, position=None), torch.arange(STEPS + 1, dtype=torch.float64) * dt
    walks = draw_walks(airspace.regions[0].polygon, source, WALKS, np.random.default_rng(0))
    walks = walks._make(field.repeat_interleave(len(time), 0) for field in walks)
    place = locate(walks, time.repeat(WALKS), source.after_walk == "loop").position.view(WALKS, -1, 2)
    step = place.diff(dim=1).double()
    turned = [
        torch.stack(each, -1) for x, y in [step.unbind(-1)] for each in ((x, y), (-y, x), (-x, -y), (y, -x))
    ]
    return torch.cat([*turned, *(each.flip(-1) for each in turned)])


def classes(step: Tensor) -> Tensor:
    """Class of velocity of each step [W, T, 2]: 0 at rest, or 1 + its direction, [W, T]."""
    speed, angle = step.norm(dim=-1), torch.atan2(step[..., 1], step[..., 0])
    slow = speed <= speed[speed > 1e-9].quantile(AT_REST)
    return torch.where(slow, 0, 1 + (angle * DIRECTIONS / (2 * math.pi)).round().long() % DIRECTIONS)


def moves_of(step: Tensor, column: Tensor) -> Tensor:
    """Weight of each move between cells of these columns and rows [K, 2], from steps [S, 2] of cells."""
    reach = int((column.amax(0) - column.amin(0)).amax())
    table, whole = torch.full((2 * reach + 1,) * 2, RARE, dtype=step.dtype), step.floor()
    part = step - whole
    for corner in torch.tensor([(0, 0), (0, 1), (1, 0), (1, 1)]):  # from anywhere in its cell
        share = (1 - corner - part).abs().prod(-1) / len(step)
        table.index_put_(tuple((whole.long() + corner + reach).clamp(0, 2 * reach).T), share, accumulate=True)
    offset = column - column.unsqueeze(1) + reach
    return table[offset[..., 0], offset[..., 1]].float()


def flown(scenario: ScenarioConfig, build: GridBuilder, worlds: int, seed: int) -> tuple[float, float]:
    """Return of the script by a filter, and the mean log-probability that this gives to the true cell."""
    with patch.object(belief, "build_source_grid", build):
        env = make_env(scenario, worlds, seed, extras=["message", "state"])
    limit = scenario.episode.max_steps
    assert limit
    assert env.server.grid
    rollout = env.rollout(limit, script_policy(env), break_when_any_done=False)
    cells = len(env.server.grid.centres.unique(dim=0))
    place = Truth.unpack(rollout[next_key(keys.STATE)]).source[..., 0, :].float()
    true = torch.cdist(place, env.server.grid.centres[:cells]).argmin(-1, keepdim=True)
    probable = rollout[next_key(keys.BELIEF)].squeeze(-2).unflatten(-1, (-1, cells)).sum(-2).gather(-1, true)
    return evaluation(rollout, env.server).return_, probable.clamp(min=1e-9).log().mean().item()


def main() -> None:
    """Fly, and print the table."""
    options = ArgumentParser(description="Compare a filter over places with one over velocities too.")
    options.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    options.add_argument("--seeds", nargs="+", type=int, default=range(8, 18))
    options.add_argument("--worlds", type=int, default=256, help="episodes of each seed")
    args = options.parse_args()
    torch.set_num_threads(1)
    rows = []
    for task, late in tqdm([(task, late) for task in args.tasks for late in LATE]):
        words = [f"delay.obs={late}", "observation.own=true"] if late else []
        scenario = compose_scenario(
            f"scenario=delaybench/{task}", *words, "observation.belief=[belief_moments]"
        )
        found = [
            [flown(scenario, build, args.worlds, 10_000 + seed) for seed in args.seeds]
            for build in (build_source_grid, velocity_grid)
        ]
        returns, logs = ([[each[i] for each in runs] for runs in found] for i in (0, 1))
        more = [100 * (b / a - 1) for a, b in zip(*returns, strict=True)]
        columns = dict(zip(HEADER[1:], (*returns, more, *logs), strict=True))
        means = means_over_seeds(pd.DataFrame(columns))
        rows.append((f"{task}, {late} steps late", *(shown(means, name) for name in columns)))
    print(markdown_table(HEADER, rows))


if __name__ == "__main__":
    main()
