"""The one place that says on which devices the amount of work may depend on data."""

import torch


def data_dependent(device: torch.device) -> bool:
    """Whether shapes and branches may depend on data, so that only the rows that need it are worked on.

    On a CPU this saves work. Any other device would have to finish all of its work first, to tell the CPU how
    many rows there are: there, all rows are worked on, and a mask chooses. So does a compiled graph, except
    for its custom operators.
    """
    return device.type == "cpu"
