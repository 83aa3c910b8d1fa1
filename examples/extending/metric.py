"""A metric of your own, in the results of a training, an evaluation, a sweep and a comparison.

    damian evaluate checkpoint=runs/first "metrics=[examples.extending.metric:apart]"
    damian compare experiment=delays "overrides=['metrics=[examples.extending.metric:apart]']" \\
        score=examples.extending.metric:apart

A metric is a function of ``damian.runs.metrics.Flights``, whose numbers are averaged.
"""

import torch
from torch import Tensor

from damian import keys, metric
from damian.keys import next_key
from damian.runs.metrics import Flights

NEAR = 50.0
"""UAVs that are closer than this are near each other [m]."""


@metric("higher", share=True)
def apart(flights: Flights) -> Tensor:
    """Share of the steps in which no two UAVs are near each other."""
    sent = flights.server.messages(flights.rollout[next_key(keys.MESSAGE)])
    place = sent.position[flights.in_episode]  # [M, N, 2], in M steps
    itself = torch.eye(place.shape[1], dtype=torch.bool, device=place.device)
    near = (torch.cdist(place, place) < NEAR) & ~itself
    return ~near.flatten(1).any(1)
