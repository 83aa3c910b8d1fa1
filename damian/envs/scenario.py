"""The simulation that is built from the settings of a scenario."""

from damian.common import checks
from damian.settings.scenario import ScenarioConfig
from damian.world.simulation import Simulation


def make_simulation(scenario: ScenarioConfig, seed: int) -> Simulation:
    """Build the physics of a scenario; ``seed`` is that of regions, start positions and walks."""
    checks.seed("seed", seed, 0)
    return Simulation(scenario, scenario.clock.dt, scenario.observation.window, seed)
