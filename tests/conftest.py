"""Settings of every test: one thread, because many small tensors are slower on more."""

import torch

torch.set_num_threads(1)
