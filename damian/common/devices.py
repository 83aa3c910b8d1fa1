"""What depends on the device."""

import torch


def data_dependent(device: torch.device) -> bool:
    """Whether shapes and branches may depend on data, so that only the rows that need it are worked on.

    Any device but a CPU would first have to finish all work to tell how many: there a mask chooses.
    """
    return device.type == "cpu"
