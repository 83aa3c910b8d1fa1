"""The simulation and the server node that are built from the settings of a scenario."""

from damian.common import checks
from damian.server.server import Server
from damian.settings.scenario import ScenarioConfig
from damian.world.simulation import Simulation


def make_simulation(scenario: ScenarioConfig, seed: int) -> Simulation:
    """Build the physics of a scenario.

    Args:
        scenario: all settings.
        seed: of the regions, the start positions and the source's walks; at least 0.

    Raises:
        InputError: the scenario asks for something impossible, or the seed is no whole number.
    """
    checks.seed("seed", seed, 0)
    return Simulation(scenario, scenario.clock.dt, scenario.observation.window, seed)


def make_server(scenario: ScenarioConfig, simulation: Simulation) -> Server:
    """Build the server node of a scenario for the regions of a simulation.

    Raises:
        InputError: there are more landing points than a message can number.
    """
    return Server(
        scenario.observation,
        scenario.reward,
        scenario.episode,
        scenario.battery,
        simulation.airspace,
        radius=simulation.radius,
        dt=scenario.clock.dt,
        time_scale=scenario.time_scale,
        readings={name: sensor.width for name, sensor in simulation.sensors.items()},
        stops=not simulation.vehicles.instant,
        source=scenario.source,
        goals=simulation.candidates.goals() if "belief_gain" in scenario.observation.belief else None,
    )
