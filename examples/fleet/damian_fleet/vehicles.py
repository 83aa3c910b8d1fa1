"""A copter in virtual time that refuses what ArduCopter refuses, for tests and trials without
hardware.

Written from ArduPilot's documentation (flight modes, arming, prearm checks, MAV_CMD pages, crash
check, failsafes of battery, EKF and ground station) with its default parameters. It is a point that
flies: no attitude, no rotor, no sensor. A place is north + 1j east [m] of the origin; heights are
above flat ground.

``python -m damian_fleet.vehicles 52.811,-4.1283 127.0.0.1:14550 127.0.0.1:14551`` flies a copter
for each address of a bridge, over UDP, 60 m apart.
"""

import itertools
import math
import os
import sys
import time

os.environ.setdefault("MAVLINK20", "1")
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

STABILIZE, ALT_HOLD, GUIDED, LOITER, RTL, LAND, BRAKE = MODES = 0, 2, 4, 5, 6, 9, 17
NEED_POSITION = {GUIDED, LOITER, RTL, BRAKE}
ARMABLE = {STABILIZE, ALT_HOLD, GUIDED, LOITER}  # by a ground station
ACCEPTED, DENIED, UNSUPPORTED, FAILED, COMMAND_INT_ONLY = 0, 2, 3, 4, 8  # MAV_RESULT
FORCE = 21196  # second parameter of a disarming that is done in the air as well
CUSTOM_MODE, ARMED, CHANGE_MODE = 1, 128, 1  # flags of the base mode and of DO_REPOSITION
RELATIVE_ALTITUDE, AMSL = (3, 6), (0, 5)  # MAV_FRAME
GROUND_AMSL = 50.0  # [m], so that the heights of the two frames differ
STREAMS, GPS_RAW = (0, 1, 24, 33, 65, 87, 147, 148, 245), 24  # messages that can be asked for
SWITCH = dict(
    zip((STABILIZE, ALT_HOLD, GUIDED, LOITER, RTL, LAND), range(1165, 2000, 150), strict=True)
)
"""Where a pilot's switch stands for a mode [us] of channel 5 (FLTMODE_CH)."""
BY_PILOT = (STABILIZE, ALT_HOLD, LOITER)  # modes that a pilot's sticks fly
BOARDS = itertools.count(1)
"""Serial numbers of autopilots."""

METRES_PER_DEGREE = 111_319.49
CLIMB_SPEED, DESCENT_SPEED, LANDING_SPEED = 2.5, 1.5, 0.5  # [m/s]; the last below LANDING_HEIGHT
DEFAULT_SPEED, MAX_AIRSPEED, ACCELERATION, GRAVITY = (
    10.0,
    15.0,
    2.5,
    9.8,
)  # [m/s], [m/s], [m/s^2], [m/s^2]
LANDING_HEIGHT, RTL_HEIGHT, RTL_WAIT = 10.0, 15.0, 5.0  # [m], [m], [s]
DISARM_DELAY, LAND_DETECTOR, SPOOL_UP, FIX_AFTER_BOOT = 10.0, 1.0, 2.0, 10.0  # [s]
BATTERY_LOW, EKF_FAILSAFE, STATION_FAILSAFE = 15.0, 1.0, 5.0  # [%], [s], [s]


class Copter:
    """One ArduCopter: `step(now, messages)` obeys messages that arrived and returns those that it
    sends.

    Public state is the truth: `mode`, `armed`, `landed`, `place`, `height`, `velocity`, `crashed`.
    A pilot calls `change_mode`, which moves his `switch` (None: no receiver), `arm` and `disarm`;
    faults are `crash()`, `reboot(now)` and the fields `wind` [m/s], `fix`, `glitch`
    [m, of what it says], `prearm` (a text that refuses arming), `battery` [%] of each.

    ``origin`` is latitude and longitude [deg] of place 0, ``drain`` what a second in the air costs
    [%]. It returns on a low battery (BATT_FS_LOW_ACT=2), and lands if the MAVLink system
    ``station`` is silent for 5 s (MAV_GCS_SYSID, FS_GCS_ENABLE=5), if one is given, unless a
    pilot's sticks fly it (FS_OPTIONS=16).
    """

    def __init__(self, origin, place=0j, *, system=1, now=0.0, drain=0.05, station=None):
        self.origin = origin
        self.place = complex(place)
        self.height = 0.0
        self.landed = True
        self.system = system
        self.drain = drain
        self.station = station
        self.wind = 0j
        self.fix = True
        self.glitch = 0j
        self.prearm = None
        self.battery = [100.0]
        self.crashed = False
        self.board = next(BOARDS)
        self.switch = SWITCH[STABILIZE]
        self.aside = -math.inf  # until then the switch is off its place
        self.mav = mavlink.MAVLink(None, system, 1)
        self.sent = []
        self.now = now
        self.reboot(now - FIX_AFTER_BOOT)  # it has stood there for a while

    def reboot(self, now):
        """Start the autopilot: disarmed, no fix for some seconds, streams off. In the air it
        falls."""
        if not self.landed:
            self.crash()
        self.mode = STABILIZE
        self.armed = False
        self.failsafe = set()
        self.speed = DEFAULT_SPEED
        self.goal = None
        self.taking_off = False
        self.position_control = False
        self.home = self.place
        self.velocity = 0j
        self.climb = 0.0
        self.booted = now
        self.on_ground_since = now
        self.heard = self.lost_since = self.home_since = None
        self.has_origin = False
        self.streams = {0: [1.0, now]}

    @property
    def has_position(self):
        return self.fix and self.now - self.booted >= FIX_AFTER_BOOT

    def arm(self):
        """Whether the motors turn; what refuses it is said in a text."""
        if self.armed:
            return True
        checks = {
            "Mode not armable": self.mode not in ARMABLE,
            "Need Position Estimate": not self.has_position,
            "Battery below minimum": min(self.battery) <= BATTERY_LOW or "battery" in self.failsafe,
            self.prearm: self.prearm,
        }
        refusal = next((text for text, refuses in checks.items() if refuses), None)
        self.text(f"Arm: {refusal}" if refusal else "Arming motors")
        if not refusal:
            self.armed = True
            self.home = self.place
            self.on_ground_since = self.now
        return self.armed

    def disarm(self, force=False):
        """Whether the motors stand: in the air only if forced, and then it falls."""
        if not self.landed and force:
            self.crash()
        if self.landed:
            self.armed = False
            self.stop()
        return self.landed

    def crash(self):
        """The motors stop in the air. It falls, and counts as landed at once, as in ArduCopter."""
        self.velocity = 0j
        self.armed = False
        self.landed = True
        self.crashed = True
        self.stop()

    def change_mode(self, mode):
        """A pilot chooses a mode; whether it flies in that. A switch that stands there is moved and
        back."""
        if mode in SWITCH and self.switch is not None:
            if self.switch == SWITCH[mode]:
                self.aside = self.now + 1.0
            self.switch = SWITCH[mode]
        return self.enter(mode)

    def enter(self, mode):
        """Whether it flies in that mode."""
        if mode == self.mode:
            return True
        if mode not in MODES or (self.armed and mode in NEED_POSITION and not self.has_position):
            self.text(f"Mode change to {mode} failed: requires position")
            return False
        self.mode = mode
        self.home_since = None
        self.speed = DEFAULT_SPEED
        self.position_control = False
        self.stop()
        self.send(*self.stream(0))
        return True

    def stop(self):
        self.goal = None
        self.taking_off = False

    def step(self, now, messages=()):
        """Fly until `now` [s], obey what arrived, and return what was sent: messages of pymavlink,
        packed."""
        dt = max(now - self.now, 0.0)
        self.now = now
        for message in messages:
            self.receive(message)
        self.watch_failsafes()
        while dt > 0 and (self.armed or self.height > 0):
            self.move(min(dt, 0.25))
            dt -= 0.25
        for number, stream in self.streams.items():
            if now >= stream[1]:
                stream[1] = now + stream[0]
                self.send(*self.stream(number))
        sent = self.sent
        self.sent = []
        return sent

    # What it is told.

    def receive(self, message):
        kind = message.get_type()
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if kind == "HEARTBEAT" and sender[0] == self.station:
            self.heard = self.now
        if kind == "TIMESYNC" and not message.tc1:
            since_boot = round((self.now - self.booted) * 1e9)
            self.send(mavlink.MAVLink_timesync_message(since_boot, message.ts1))
        targets = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if targets[0] not in (0, self.system) or targets[1] not in (0, 1):
            return
        if kind == "COMMAND_LONG":
            result = self.obey(message, message.param7, RELATIVE_ALTITUDE[0])
        elif kind == "COMMAND_INT":
            result = self.obey(message, message.z, message.frame)
        else:
            return
        self.send(mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))

    def obey(self, command, altitude, frame):  # noqa: PLR0911
        """MAV_RESULT of a command."""
        first = command.param1
        second = command.param2
        modes = {
            mavlink.MAV_CMD_DO_SET_MODE: int(second) if int(first) & CUSTOM_MODE else None,
            mavlink.MAV_CMD_NAV_LAND: LAND,
        }
        if command.command in modes:
            return ACCEPTED if self.enter(modes[command.command]) else FAILED
        match command.command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                done = self.arm() if first == 1 else first == 0 and self.disarm(second == FORCE)
                return ACCEPTED if done else FAILED
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                if frame not in RELATIVE_ALTITUDE:
                    return DENIED
                if not (
                    self.armed and self.landed and self.mode == GUIDED and altitude > self.height
                ):
                    return FAILED
                self.goal = (self.place, altitude)
                self.taking_off = True
                self.position_control = False
                return ACCEPTED
            case mavlink.MAV_CMD_DO_REPOSITION:
                return self.reposition(command, frame)
            case mavlink.MAV_CMD_DO_CHANGE_SPEED:
                if (
                    self.mode == GUIDED and second > 0 and first in (0, 1)
                ):  # no speed of climb or descent
                    self.speed = second
                return DENIED if second <= 0 else ACCEPTED if self.mode == GUIDED else FAILED
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL if int(first) in STREAMS:
                self.streams.pop(int(first), None)
                if second >= 0:
                    self.streams[int(first)] = [second / 1e6 or 1.0, self.now]
                return ACCEPTED
            case mavlink.MAV_CMD_REQUEST_MESSAGE if int(first) in STREAMS:
                self.send(*self.stream(int(first)))
                return ACCEPTED
        return UNSUPPORTED

    def reposition(self, command, frame):
        if command.get_type() != "COMMAND_INT":
            return COMMAND_INT_ONLY
        latitude = command.x / 1e7
        longitude = command.y / 1e7
        if self.mode != GUIDED and not int(command.param2) & CHANGE_MODE:
            return DENIED
        if frame not in RELATIVE_ALTITUDE + AMSL or abs(latitude) > 90 or abs(longitude) > 180:
            return DENIED
        if not self.enter(GUIDED):
            return FAILED
        if not self.position_control:  # entering it resets the speed: only a later one holds
            self.speed = DEFAULT_SPEED
            self.position_control = True
        self.goal = (
            self.metres(latitude, longitude),
            command.z - (GROUND_AMSL if frame in AMSL else 0),
        )
        return ACCEPTED

    # Failsafes and motion.

    def watch_failsafes(self):
        if self.has_position:
            self.lost_since = None
            self.has_origin = True
        elif self.lost_since is None:
            self.lost_since = self.now
        lost = self.lost_since is not None and self.now - self.lost_since >= EKF_FAILSAFE
        silent = None not in (self.station, self.heard) and self.now - self.heard > STATION_FAILSAFE
        silent = silent and self.mode not in BY_PILOT
        causes = {
            "EKF": (lost and not self.landed and self.mode in NEED_POSITION, LAND),
            "battery": (min(self.battery) <= BATTERY_LOW, RTL),
            "station": (silent, LAND),
        }
        for name, (cause, mode) in causes.items():
            if not cause and name != "battery":  # that of the battery holds until a restart
                self.failsafe.discard(name)
            elif cause and self.armed and name not in self.failsafe:
                self.failsafe.add(name)
                self.text(f"{name} failsafe")
                if self.landed:
                    self.disarm()
                elif self.mode != LAND:
                    _ = self.enter(mode) or self.enter(LAND)

    def move(self, dt):
        if not self.armed:
            self.height = max(self.height + self.climb * dt, 0.0)
            self.climb = self.climb - GRAVITY * dt if self.height else 0.0
            return
        if self.landed and not self.taking_off:
            self.velocity = 0j
            self.climb = 0.0
            if self.mode in (LAND, RTL) or self.now - self.on_ground_since >= DISARM_DELAY:
                self.disarm()
            return
        if self.landed and self.now - self.on_ground_since < SPOOL_UP:
            return
        self.battery = [left - self.drain * dt for left in self.battery]
        place, height = self.target()
        self.fly_to(place, dt)
        low = self.mode in (LAND, RTL) and self.height <= LANDING_HEIGHT
        descent = LANDING_SPEED if low else DESCENT_SPEED
        self.climb = min(CLIMB_SPEED, max(-descent, (height - self.height) / dt))
        self.height = max(self.height + self.climb * dt, 0.0)
        if self.height > 0:
            self.landed = False
            self.taking_off = False
            self.on_ground_since = self.now
        elif self.now - self.on_ground_since >= LAND_DETECTOR and not self.landed:
            self.landed = True
            self.velocity = 0j
            self.on_ground_since = self.now
            self.stop()

    def target(self):
        """Place (None: it drifts) and height that it flies to."""
        if self.mode in (STABILIZE, ALT_HOLD):
            return None, self.height
        if self.mode == LAND:
            return self.place, 0.0
        if self.mode != RTL:
            return self.goal or (self.place, self.height)
        if self.home_since is None and self.height < RTL_HEIGHT:
            return self.place, RTL_HEIGHT
        if self.home_since is None and abs(self.place - self.home) < 1:
            self.home_since = self.now
        there = self.home_since is not None and self.now - self.home_since >= RTL_WAIT
        return self.home, 0.0 if there else self.height

    def fly_to(self, target, dt):
        """Fly at the ground speed it wants as far as its airspeed allows; without a position it
        drifts."""
        if target is None or not self.has_position:
            self.velocity = self.wind
        else:
            way = target - self.place
            speed = min(self.speed, math.sqrt(2 * ACCELERATION * abs(way)), abs(way) / dt)
            change = (way / abs(way) * speed if way else 0j) - self.velocity
            air = (
                self.velocity
                + change * min(1.0, ACCELERATION * dt / (abs(change) or 1.0))
                - self.wind
            )
            self.velocity = air * min(1.0, MAX_AIRSPEED / (abs(air) or 1.0)) + self.wind
        self.place += self.velocity * dt

    def degrees(self, place):
        """Latitude and longitude [deg] of a place."""
        across = METRES_PER_DEGREE * math.cos(math.radians(self.origin[0]))
        return self.origin[0] + place.real / METRES_PER_DEGREE, self.origin[1] + place.imag / across

    def metres(self, latitude, longitude):
        """The place of a latitude and longitude [deg]."""
        across = METRES_PER_DEGREE * math.cos(math.radians(self.origin[0]))
        north = latitude - self.origin[0]
        east = longitude - self.origin[1]
        return complex(north * METRES_PER_DEGREE, east * across)

    # What it sends.

    def send(self, *messages):
        for message in messages:
            message.pack(self.mav)
            self.mav.seq = (self.mav.seq + 1) % 256
            self.sent.append(message)

    def text(self, text):
        self.send(
            mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, text.encode()[:50])
        )

    def stream(self, number):
        """The messages of an id, which must be one of ``STREAMS``."""
        known = self.has_position if number == GPS_RAW else self.has_origin
        latitude, longitude = self.degrees(self.place + self.glitch) if known else (0.0, 0.0)
        amsl = self.height + GROUND_AMSL if known else 0.0
        above_home = round(self.height * 1000)
        place = (
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(amsl * 1000),
        )  # zeros while it knows none
        left = [max(0, round(level)) for level in self.battery]
        match number:
            case 0:  # HEARTBEAT
                base = CUSTOM_MODE | ARMED * self.armed
                state = 5 if self.failsafe else 3 if self.landed else 4
                yield mavlink.MAVLink_heartbeat_message(2, 3, base, self.mode, state, 3)
            case 1:  # SYS_STATUS
                yield mavlink.MAVLink_sys_status_message(
                    0, 0, 0, 300, 12000, 1000, left[0], *[0] * 6
                )
            case 24:  # GPS_RAW_INT
                fix, satellites = (3, 12) if known else (1, 3)
                rest = 100, 100, 65535, 65535, satellites
                yield mavlink.MAVLink_gps_raw_int_message(int(self.now * 1e6), fix, *place, *rest)
            case 33:  # GLOBAL_POSITION_INT
                boot = round((self.now - self.booted) * 1000)
                speed = (
                    round(100 * v) for v in (self.velocity.real, self.velocity.imag, -self.climb)
                )
                yield mavlink.MAVLink_global_position_int_message(
                    boot, *place, above_home, *speed, 65535
                )
            case 65 if self.switch is not None:  # RC_CHANNELS
                boot = round((self.now - self.booted) * 1000)
                aside = (self.now < self.aside) * (
                    150 if self.switch == SWITCH[STABILIZE] else -150
                )
                channels = [1500, 1500, 1000, 1500, self.switch + aside, *[65535] * 13]
                yield mavlink.MAVLink_rc_channels_message(boot, 5, *channels, 255)
            case 87 if self.position_control and self.goal and self.mode == GUIDED:
                boot = round((self.now - self.booted) * 1000)
                latitude, longitude = (round(each * 1e7) for each in self.degrees(self.goal[0]))
                aim = latitude, longitude, self.goal[1] + GROUND_AMSL
                yield mavlink.MAVLink_position_target_global_int_message(
                    boot, 0, 0xFFF8, *aim, *[0] * 8
                )
            case 148:  # AUTOPILOT_VERSION
                rest = *[0] * 5, *[[0] * 8] * 3, *[0] * 3, [*self.board.to_bytes(18, "little")]
                yield mavlink.MAVLink_autopilot_version_message(*rest)
            case 147:  # BATTERY_STATUS
                for battery, level in enumerate(left):
                    rest = 32767, [12000] + [65535] * 9, 1000, -1, -1, level
                    yield mavlink.MAVLink_battery_status_message(battery, 0, 0, *rest)
            case 245:  # EXTENDED_SYS_STATE
                state = 1 if self.landed else 4 if self.mode == LAND else 2
                yield mavlink.MAVLink_extended_sys_state_message(0, state)


def main():
    """Fly copters over UDP in real time, until the program is ended."""
    origin, *addresses = sys.argv[1:]
    place = tuple(map(float, origin.split(",")))
    links = []
    for number, address in enumerate(addresses):
        copter = Copter(place, 60j * number, system=number + 1, now=time.monotonic(), station=255)
        links.append((mavutil.mavlink_connection(f"udpout:{address}"), copter))
    while True:
        for link, copter in links:
            for message in copter.step(time.monotonic(), iter(link.recv_msg, None)):
                link.write(message.get_msgbuf())
        time.sleep(0.02)


if __name__ == "__main__":
    main()
