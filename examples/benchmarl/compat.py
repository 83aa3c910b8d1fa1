"""Lets BenchMARL 1.5.2, made for TorchRL 0.10 and 0.11, run on TorchRL 0.14; imported before
BenchMARL.

Two things have changed in TorchRL since:

- ``SyncDataCollector`` is called ``Collector`` now, and asks whether to add transforms; it adds
  none here.
- ``QValueModule`` checks the shape of the actions by their spec. From BenchMARL's spec, which is of
  shape [N] for actions [B, N], it expects [B, N, N]. The values are computed before this check;
  QMIX, VDN and IQL do without it here, as in TorchRL 0.11.
"""

from functools import partial
from importlib import import_module

import torchrl.collectors
from torchrl.modules import QValueModule

torchrl.collectors.SyncDataCollector = partial(
    torchrl.collectors.Collector, auto_register_policy_transforms=False
)

for _name in ("iql", "qmix", "vdn"):
    import_module(f"benchmarl.algorithms.{_name}").QValueModule = partial(
        QValueModule, strict_shape=False
    )
