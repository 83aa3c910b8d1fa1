"""Reinforcement learning. Importing the package registers every learner that a file of this folder has."""

from importlib import import_module
from pkgutil import iter_modules

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
