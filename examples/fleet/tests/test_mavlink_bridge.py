"""The bridge between the service and simulated vehicles that speak MAVLink over UDP."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from test_orders import SCENARIO, WEST, Field

from damian.world.config import BatteryConfig, MotionConfig
from damian_fleet.mavlink.bridge import Bridge, ServiceClock, VehicleClock, battery_of, place_of, way
from damian_fleet.mavlink.lockstep import Lockstep
from damian_fleet.mavlink.vehicles import LAND, Airframe, Copter, Radio, Weather, degrees

PLACES = {"A": 200, "B": 300}
"""Landing points on which UAVs stand first; the policy sends each 60 m to the east and back."""
SLOW = replace(SCENARIO, motion=MotionConfig(kind="polynomial", max_speed=8.0, max_acceleration=1.5))
TOLD = ["accepted", "taken off", "landed"]


@pytest.fixture
def fleet_of(request):
    """Makes fleets of simulated copters, with the service that sends them."""

    def make(uavs="A", scenario=SLOW, **copter) -> Lockstep:
        field = Field(None, uavs, scenario)
        places = {uav: field.fleet.ground.place(PLACES[uav]) for uav in uavs}
        flying = Lockstep(field.session, places, **copter)
        flying.field = field
        request.addfinalizer(flying.close)
        return flying

    return make


def in_flight(flying: Lockstep) -> tuple[Lockstep, Copter, Bridge]:
    """The same when its first copter is on its way, with this and its bridge."""
    copter, bridge = flying.copters[0], flying.bridges[0]
    assert flying.run(90, lambda: bridge.state == "cruise" and math.hypot(*copter.velocity) > 3)
    return flying, copter, bridge


def statuses(flying: Lockstep) -> list[str]:
    """What the first bridge has said of flights."""
    bridge = flying.bridges[0]
    flights = [each.answer for each in [*bridge.flights, *filter(None, [bridge.goal])]]
    return [status for answer, status in bridge.said if answer in flights]


def test_times_places_and_batteries_are_converted():
    local = iter([10.0, 10.4, 80.0, 82.0, 99.0])
    clock = ServiceClock(lambda *_: (200, {"time": 1000.2}), lambda: next(local))
    for _ in range(2):  # the second answer is slower, but comes after more than a minute
        clock.watch()
    assert clock() == pytest.approx(99.0 + 1000.2 - 81.0)
    vehicle = VehicleClock()
    vehicle.system_time(0.0, 3.0)
    assert vehicle.time(5.0) is None, "it has no satellites"
    vehicle.system_time(1e9, 100.0)
    assert vehicle.time(101.0) == 1e9 + 1
    vehicle.timesync(50.0, 2000.0, 2001.0)
    vehicle.system_time(1e9, 100.0)
    vehicle.timesync(60.0, 2010.0, 2014.0)  # on a longer way
    assert vehicle.time(50.0) == 2000.5
    assert [battery_of(SimpleNamespace(battery_remaining=left)) for left in (-1, 0, 55)] == [None, 0.0, 55.0]
    here = place_of(SimpleNamespace(lat=528110000, lon=-41283000))
    assert here == (52.811, -4.1283)
    assert way(here, degrees((30.0, -40.0), here)) == pytest.approx((50.0, 143.13), 1e-4)


def test_flights_in_wind_over_a_bad_radio_end_where_they_were_sent_and_are_said_in_order(fleet_of):
    flying = fleet_of("AB", weather=Weather(4, 2, 1.5), radio=Radio(0.1, 0.6, 0.15), seed=3)
    for _ in range(300):
        flying.run(1)
        flying.field.wishes[:2] = [len(bridge.flights) % 2 for bridge in flying.bridges]
    for copter, bridge in zip(flying.copters, flying.bridges, strict=True):
        assert len(bridge.flights) >= 4
        flights = [flight.answer for flight in bridge.flights]
        said = [each for each in bridge.said if each[0] in flights]
        assert said == [(answer, status) for answer in flights for status in TOLD]
        for flight, (_, _, distance, _) in zip(bridge.flights, copter.flights, strict=False):
            assert flight.said_distance == pytest.approx(flight.distance, abs=10)
            assert flight.distance == pytest.approx(distance, abs=3)
            assert 1.0 < flight.time / flight.said_time < 2.5
        assert bridge.timing.booted == pytest.approx(copter.booted, abs=0.4)


@pytest.mark.parametrize(("failsafe", "end"), [(math.inf, "landed"), (5.0, "aborted")])
def test_a_flight_without_a_link_ends_as_it_can_and_is_said_afterwards(fleet_of, failsafe, end):
    flying, copter, bridge = in_flight(fleet_of(airframe=Airframe(failsafe=failsafe)))
    copter.cut = True
    flying.run(60)
    assert copter.landed == (end == "aborted")
    assert statuses(flying) == ["accepted", "taken off"]
    copter.cut, flying.field.wishes[0] = False, WEST
    assert flying.run(90, lambda: bridge.state == "takeoff")
    assert statuses(flying)[2:] == [end, "accepted"]
    point = flying.field.fleet.ground.landing_point(copter.place())
    assert flying.field.fleet.held[0].point == point, "the service knows where it is"


def test_a_flight_without_the_service_ends_at_its_goal_and_is_said_in_order_afterwards(fleet_of):
    flying, copter, _ = in_flight(fleet_of())
    flying.reachable = False
    flying.run(60)
    assert copter.landed
    assert statuses(flying) == ["accepted", "taken off"]
    flying.reachable, flying.field.wishes[0] = True, WEST
    flying.run(30)
    assert statuses(flying)[:4] == [*TOLD, "accepted"]


def test_a_low_battery_sends_it_home_and_keeps_it_there(fleet_of):
    flying, copter, bridge = in_flight(fleet_of(scenario=replace(SLOW, battery=BatteryConfig(enabled=True))))
    copter.battery = 19.0
    assert flying.run(90, lambda: len(bridge.flights) == 2)
    flying.run(30)
    assert (flying.field.fleet.offer(0).reason, bridge.state) == ("battery", "ground")
    assert flying.field.fleet.held[0].point == PLACES["A"]
    assert len(copter.flights) == 2


@pytest.mark.parametrize(("who", "then"), [("pilot", "watch"), ("person at the service", "landing")])
def test_a_flight_that_is_ended_early_is_aborted_and_the_next_one_begins_there(fleet_of, who, then):
    flying, copter, bridge = in_flight(fleet_of())
    if who == "pilot":
        copter.enter(LAND)
    else:
        flying.ask("POST", "/fleets/north/command", {"command": "hold"})
    assert flying.run(5, lambda: bridge.state == then)
    assert flying.run(60, lambda: copter.landed and bridge.state == "ground")
    assert copter.flights[0][2] < bridge.flights[0].said_distance - 15
    flying.ask("POST", "/fleets/north/command", {"command": "resume"})
    flying.field.wishes[0] = WEST
    assert flying.run(120, lambda: len(bridge.flights) == 2)
    assert statuses(flying)[-4:] == ["aborted", *TOLD]
