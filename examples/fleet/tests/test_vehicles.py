"""The copter model against what ArduPilot's documentation says that ArduCopter does and refuses."""

import pytest

from damian_fleet import vehicles
from damian_fleet.vehicles import ACCEPTED, DENIED, FAILED, GUIDED, LAND, LOITER, Copter, mavlink

STATION = mavlink.MAVLink(None, 255, 190)


class Field:
    """A copter, its ground station and virtual time."""

    def __init__(self, **copter):
        self.now = 0.0
        self.copter = Copter((52.8110, -4.1283), **copter)
        self.received = []

    def run(self, seconds, until=lambda: False):
        end = self.now + seconds
        while self.now < end and not until():
            self.now = round(self.now + 0.1, 3)
            self.received += self.copter.step(self.now)
        return until()

    def ask(self, message):
        """The result of a command, None without an acknowledgement."""
        message.pack(STATION)
        answers = self.copter.step(self.now, [message])
        self.received += answers
        return next((m.result for m in answers if m.get_type() == "COMMAND_ACK"), None)

    def long(self, number, *params, system=1):
        params = (*params, *[0.0] * (7 - len(params)))
        return self.ask(mavlink.MAVLink_command_long_message(system, 1, number, 0, *params))

    def mode(self, mode):
        return self.long(mavlink.MAV_CMD_DO_SET_MODE, 1, mode)

    def arm(self, arm=1, force=0):
        return self.long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, arm, force)

    def takeoff(self, height=20):
        return self.long(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height)

    def reposition(self, place, flags=0, frame=6):
        at = [round(each * 1e7) for each in self.copter.degrees(place)]
        number = mavlink.MAV_CMD_DO_REPOSITION
        params = frame, number, 0, 0, -1, flags, 0, 0, *at, 20
        return self.ask(mavlink.MAVLink_command_int_message(1, 1, *params))

    def flying(self):
        assert [self.mode(GUIDED), self.arm(), self.takeoff()] == [ACCEPTED] * 3
        assert self.run(30, lambda: self.copter.height > 19.9)
        return self


def test_it_takes_off_armed_and_guided_flies_there_lands_and_disarms_itself():
    field = Field()
    goal = 100 + 50j
    copter = field.copter
    assert field.takeoff() == FAILED
    assert [field.mode(GUIDED), field.arm(), copter.change_mode(LOITER)] == [
        ACCEPTED,
        ACCEPTED,
        True,
    ]
    assert field.takeoff() == FAILED
    assert field.flying().takeoff(40) == FAILED, "it flies already"
    for speed in (10, 4):  # a speed holds only after the reposition that enters position control
        assert field.long(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 4, -1) == ACCEPTED
        assert (field.reposition(goal), copter.speed) == (ACCEPTED, speed)
    assert field.run(60, lambda: abs(copter.place - goal) < 0.1)
    assert [field.mode(LAND), field.run(60, lambda: not copter.armed)] == [ACCEPTED, True]
    assert (copter.landed, abs(copter.place - goal) < 1) == (True, True)
    assert [field.mode(GUIDED), field.arm(), field.run(9.5, lambda: not copter.armed)] == [
        0,
        0,
        False,
    ]
    assert field.run(1, lambda: not copter.armed), "after ten seconds on the ground"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mode": LAND}, "Mode not armable"),
        ({"fix": False}, "Need Position Estimate"),
        ({"battery": [90.0, 10.0]}, "Battery"),
        ({"prearm": "Compass not calibrated"}, "Compass"),
    ],
)
def test_arming_is_refused_with_a_text_that_says_why(change, text):
    field = Field()
    field.mode(GUIDED)
    vars(field.copter).update(change)
    assert field.arm() == FAILED
    assert text in next(m.text for m in field.received if m.get_type() == "STATUSTEXT")


def test_what_is_addressed_to_another_or_unknown_or_wrong_is_not_done():
    field = Field().flying()
    assert field.long(mavlink.MAV_CMD_NAV_LAND, system=7) is None
    assert field.long(mavlink.MAV_CMD_DO_PARACHUTE, 2) == vehicles.UNSUPPORTED
    assert [field.reposition(100, frame=8), field.arm(0)] == [DENIED, FAILED]
    assert field.copter.change_mode(LOITER)
    assert field.reposition(100) == DENIED, "without the flag that changes the mode"
    assert (field.reposition(100, flags=1), field.copter.mode) == (ACCEPTED, GUIDED)


def test_failsafes_land_it_and_forced_disarming_lets_it_fall():
    field = Field().flying()
    field.reposition(100)
    field.run(20)
    field.copter.battery[0] = 10.0
    assert field.run(120, lambda: not field.copter.armed)
    assert abs(field.copter.place) < 1, "by RTL"
    assert [field.mode(GUIDED), field.arm()] == [ACCEPTED, FAILED], "until it is restarted"

    field = Field().flying()
    field.copter.fix = False
    field.copter.wind = 3 + 0j
    field.run(2)
    assert (field.copter.mode, field.mode(GUIDED)) == (LAND, FAILED)
    assert field.run(60, lambda: field.copter.landed)
    assert field.copter.place.real > 50, "it drifted"

    field = Field(station=255).flying()
    field.ask(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    assert not field.run(4, lambda: field.copter.mode == LAND)
    assert field.run(2, lambda: field.copter.mode == LAND)

    field = Field().flying()
    assert (field.arm(0, vehicles.FORCE), field.copter.armed) == (ACCEPTED, False)
    assert field.run(3, lambda: not field.copter.height)


def test_streams_are_off_after_a_restart_and_zeros_stand_for_the_place_before_the_first_fix():
    field = Field()
    assert [
        field.long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 5e5) for number in (33, 147)
    ] == [0, 0]
    field.copter.battery = [80.0, 60.0]
    field.run(2)
    assert {m.id for m in field.received if m.get_type() == "BATTERY_STATUS"} == {0, 1}
    field.copter.reboot(field.now)
    field.received = []
    field.run(3)
    assert {m.get_type() for m in field.received} == {"HEARTBEAT"}
    field.long(mavlink.MAV_CMD_REQUEST_MESSAGE, 33)
    assert [(m.lat, m.lon) for m in field.received if m.get_type() == "GLOBAL_POSITION_INT"] == [
        (0, 0)
    ]


@pytest.mark.parametrize(("wind", "carried"), [(12, False), (20, True)])
def test_wind_stronger_than_its_airspeed_carries_it_away(wind, carried):
    field = Field().flying()
    field.copter.wind = wind + 0j
    field.run(20)
    assert (abs(field.copter.place) > 80, abs(field.copter.place) < 1) == (carried, not carried)
