"""The simulation that is built from the settings of a scenario."""

from damian.common import checks
from damian.settings.scenario import ScenarioConfig
from damian.world.simulation import Simulation


def make_simulation(scenario: ScenarioConfig, seed: int) -> Simulation:
    """Build the physics of a scenario.

    Args:
        scenario: all settings.
        seed: of the regions, the start positions and the source's walks; at least 0.
    """
    checks.seed("seed", seed, 0)
    return Simulation(scenario, scenario.clock.dt, scenario.observation.window, seed)
