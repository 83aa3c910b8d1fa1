"""The bridge between the service and one copter with ArduPilot: a state machine without sockets or
clock.

``Bridge.step`` takes the time, and the MAVLink messages and answers of the service that have come;
it returns the messages and requests to send. What is missing is read off the telemetry: a command
is sent again until its effect is seen or its acknowledgement has come.

| state | commands | ends | limit |
|:--|:--|:--|:--|
| connect | nothing | an ArduPilot copter tells where it is: *join*, or on with the flight in hand | |
| join | nothing | the service knows the UAV, which may join a fleet that flies: *ground* | |
| ground | nothing; reports, then asks | there is an answer: *accept*; the UAV is to leave: *left* | |
| accept | nothing | the service confirms: *guided*; or refuses: *ground* | 30 s: *ground* |
| guided | mode GUIDED | the vehicle says so: *arm* | 15 s: *landing* |
| arm | motors on | the vehicle says so: *climb* | 15 s: *landing* |
| climb | takeoff | it is as high as told: *cruise* | 30 s, and 2 s for each metre: *landing* |
| cruise | reposition, then speed | it is slow at its goal: *landing* | twice as told, and 60 s: *landing* |
| landing | land; or motors off | it is on the ground, its motors off: *ground* | 30 s there: *watch* |
| watch | nothing; reports on the ground | the pilot hands over: *join* | |
| left | nothing | | |

**The pilot has the last word**: a mode, motors on or off, or an aim in the air that the bridge has
not commanded, a move of the mode switch, a restart of the vehicle, and before the flight a refusal
or a failsafe, lead to *watch* from every state; so does what may have changed while it was off.
Nothing is commanded unless mode and motors were heard since the last command; if they are not for 5
s: *watch*. Where a vehicle is in the air in GUIDED and nobody is known to command it, the bridge is
silent: so its failsafe lands it. **To hand over again**, the pilot switches the vehicle from
another mode to GUIDED, on the ground with its motors off. An operator's hold leads from each state
of a flight to *landing*; a missing answer of the service ends none. In a state that lasts, the log
says every 30 s what is waited for.
"""

import logging
import math
import os
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel

from damian_fleet.order import Order
from damian_fleet.rows import Advice

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import ardupilotmega as mavlink

STATION, AUTOPILOT = (255, 191), 1
"""MAVLink system and component of the bridge, beside a pilot's station; component of the
vehicle."""
GUIDED, LAND = 4, 9
"""Custom modes of ArduCopter."""
COPTERS = (2, 3, 4, 13, 14, 15, 29, 35)
"""MAV_TYPE of what ArduCopter flies: 4 rotors, coaxial, helicopter, 6, 8, 3, 12 and 10 rotors."""
SILENCE = 5.0  # age of the newest message above which a link counts as lost [s]
FRESH = 2.5  # age of mode and motors above which nothing is commanded [s]
ABOUT = 0.3  # how well it is known when a heartbeat was sent, which has no time [s]
ALONE = (
    15.0  # how long a vehicle may be in the air in GUIDED while nobody is known to command it [s]
)
AIM = 3.0  # difference of its aim to its goal from which somebody else has given it [m]
SETTLED = 3.0  # how long a switch of a pilot may be told late after he has handed over [s]
IDENTITY = 60.0  # how long it is asked at most which vehicle it is, if it does not say that it cannot tell [s]
TIMEOUT = 10.0  # when an answer counts as missing [s]
NEAR, THERE = 2.0, 10.0  # how near to its goal it begins to land, and must have landed [m]
LEVEL = 1.0  # difference to its flight level at which it has climbed enough [m]
TOP_SPEED, SCATTER = (
    40.0,
    20.0,
)  # a place farther away than this speed [m/s] and scatter [m] explain ...
STEADY = 10.0  # ... counts after so long there [s]
FALL = 3.0  # descent above which a vehicle whose motors go off has fallen, not landed [m/s]
GRACE = 3.0  # what was refused may have been done before: its effect counts for so long [s]
QUIET = 10.0  # a command does not come later than this [s]
RETRY = 2.0  # after which a command that nobody has acknowledged is sent again [s]
WORD = 30.0  # how often the log says what a state waits for [s]
LIMITS = {"accept": 30.0, "guided": 15.0, "arm": 15.0, "landing": 30.0}
"""Longest times in states [s], as the table of states says."""
MOTORS = dict.fromkeys(("join", "ground", "accept", "guided"), False) | {
    "climb": True,
    "cruise": True,
}
"""Whether the motors are on in a state, unless somebody else has a hand in it."""
FAILSAFES = (mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY)
"""States of a vehicle in which it does not take off."""
INTERVALS = {
    "GLOBAL_POSITION_INT": (33, 0.25),
    "EXTENDED_SYS_STATE": (245, 0.5),
    "SYS_STATUS": (1, 1.0),
}
INTERVALS |= {"GPS_RAW_INT": (24, 1.0), "BATTERY_STATUS": (147, 2.0), "RC_CHANNELS": (65, 0.5)}
INTERVALS |= {"POSITION_TARGET_GLOBAL_INT": (87, 0.5)}
"""Messages that it asks for while they do not come: their numbers, and the time between two [s]."""
FLIGHT = ("guided", "arm", "climb", "cruise", "landing")
"""States in which it commands."""
SWITCH = (1230, 1360, 1490, 1620, 1749)
"""Between these [us] of channel 5 stand the positions of a pilot's switch (FLTMODE_CH=5)."""
_LOG = logging.getLogger("damian_mavlink")


class Request(NamedTuple):
    """A request to the service; its answer has the same ``number``.

    ``take`` gets the status and the content of an answer that came at all; it was asked ``at`` a
    time [s].
    """

    method: str
    path: str
    body: Any = None
    take: Callable[[int, Any], None] = lambda status, body: None
    number: int = 0
    at: float = 0.0


class Answer(NamedTuple):
    """The answer to a request: status and JSON; None if there is none
    (no link, time-out, garbage)."""

    status: int | None
    body: Any
    number: int


class Memory(BaseModel):
    """What a bridge that is started again must know."""

    bridge: str = ""  # tells this bridge from all others
    system: int | None = None  # MAVLink system of the vehicle
    vehicle: str = ""  # identity of its autopilot, if it tells one
    number: int = 0  # of the next report
    state: str = ""  # of the bridge
    mode: int = -1  # in which the vehicle was in this state, by command of the bridge or before
    switch: int | None = None  # where a pilot's switch stood, counted from 0
    goal: Advice | None = None  # what it has accepted and not ended
    taken_off: bool = False  # to that goal
    lands: bool = False  # whether the vehicle has accepted its command to land
    stops: list[tuple[float, float]] = []  # where it landed, or held, newest first [deg] ...
    landed: list[float] = []  # ... and when [s since 1970]
    motions: int = 0  # decisions since it last detected the source before
    outbox: list[tuple[str, dict[str, Any]]] = []  # what the service must be told: paths and bodies


def way(origin: Sequence[float], goal: Sequence[float]) -> tuple[float, float]:
    """Distance [m] and heading, clockwise from north [deg], between near latitudes and longitudes
    [deg]."""
    east = math.radians(goal[1] - origin[1]) * 6_378_137 * math.cos(math.radians(origin[0]))
    north = math.radians(goal[0] - origin[0]) * 6_378_137
    return math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360


def name_of(enum: str, number: int) -> str:
    """What MAVLink calls a number."""
    found = mavlink.enums[enum].get(number)
    return found.name.removeprefix("COPTER_MODE_") if found else f"{enum} {number}"


class Bridge:
    """The bridge of one vehicle.

    Args:
        uav: ID of the UAV at the service.
        fleet: name of its fleet there.
        uavs: the UAVs with which the fleet is created if there is none.
        listen: how long a landed vehicle listens before it reports [s].
        system: MAVLink system of the vehicle; the first copter that is heard if not given.
        memory: that of an earlier bridge of this vehicle.
    """

    def __init__(
        self,
        uav: str,
        fleet: str,
        uavs: Sequence[str] = (),
        listen: float = 0.0,
        system: int | None = None,
        memory: Memory | None = None,
    ) -> None:
        self.uav = uav
        self.path = f"/fleets/{fleet}"
        self.uavs = [*uavs] or [uav]
        self.period, self.listen = 5.0, listen
        """``period``: between two reports of a vehicle on the ground [s]; a step of the service."""
        self.memory = memory or Memory()
        self.memory.system = system or self.memory.system
        self.memory.bridge = self.memory.bridge or secrets.token_hex(8)
        self.state, self.leaving = "connect", False
        """``leaving``: it ends the flight in hand and leaves the fleet."""
        self.why = "no heartbeat of a copter with ArduPilot"
        """What the state waits for."""
        self.mode = -1
        self.height = 0.0
        self.battery = None
        self.time = math.nan
        self.armed = self.on_ground = self.in_air = self.is_linked = False
        self.is_ready = True
        self.ahead, self._trip, self._timed = math.nan, math.inf, -math.inf
        """How far the clock of the service is ahead [s]; how long that answer took [s], and when it
        came."""
        self.order = Order()
        self.seen: dict[str, Any] = {}
        """The newest messages of the vehicle by their types."""
        self.here: tuple[float, float] | None = None
        """Where the vehicle was at last [deg]."""
        self.now = self._since = self._place_at = self._steady = self._reported = -math.inf
        self._retry = self._asked_at = self._landed_at = self._commanded = -math.inf
        self._heard_at = self._climbs_from = self._handed_at = self._stood_since = -math.inf
        self._down = math.inf
        self._number = 0
        self._boots = 0
        self._came: dict[str, float] = {}
        self._due: dict[str, float] = {}
        self._raw: tuple[tuple[float, float], float] = ((0.0, 0.0), -math.inf)
        self._falls: deque[tuple[float, float]] = deque()
        self._levels: dict[int, tuple[float, int]] = {}
        self._sent: dict[int, float] = {}
        self._results: dict[int, tuple[bool, float]] = {}
        self._is_flying = not self.memory.stops or self.memory.taken_off
        self._was_linked = self._has_switched = self._has_joined = self._is_other = (
            self._is_quiet
        ) = False
        self._is_nameless = False  # whether the vehicle cannot tell which one it is
        self._spotted = self._was_spotted = False
        self._track = self._turned = self._held = None
        self._offer: Advice | None = None
        self._pending: Request | None = None
        self._wish: Request | None = None
        self._fresh_from = self.memory.number
        self._out: list[Any] = []

    def step(
        self, now: float, messages: Iterable[Any] = (), answers: Iterable[Answer] = ()
    ) -> tuple[list[Any], list[Request]]:
        """Take what has come, and return the messages and requests to send; ``now`` [s] never goes
        back."""
        if self.state == "left":
            return [], []
        if self._since == -math.inf:
            self._since, self._due["word"] = now, now + WORD
        self.now = now
        self._out = []
        self._wish = None
        for message in messages:
            self._hear(message)
        self._look()
        if self.is_linked != self._was_linked:
            self._was_linked = self.is_linked
            self._say(
                "the vehicle is heard" if self.is_linked else "the vehicle is not heard any more"
            )
            self._need_fresh()
        if self.is_linked:
            self._is_flying = self._is_flying or self.in_air
            if reason := self._act_of_pilot():
                self._hands_off(reason)
        for answer in answers:  # after the acts of a pilot, so that none is taken for its own
            self._hear_answer(answer)
        self._check_limit()
        if self.state == "join" or (self.is_linked and self.state != "left"):
            getattr(self, f"_{self.state}")()
        self._keep_in_touch()
        if self._is_due("word", WORD):
            lost = "" if self.is_linked else "the vehicle is not heard; "
            self._say(f"{self.state} for {self.now - self._since:.0f} s: {lost}{self.why}")
        return self._out, self._talk()

    def _say(self, text: str) -> None:
        _LOG.info("%s: %s", self.uav, text)

    def _is_due(self, what: str, period: float) -> bool:
        """Whether something is due, which then is so again after a period [s]."""
        if self.now < self._due.get(what, -math.inf) - 1e-6:
            return False
        self._due[what] = self.now + period
        return True

    # Telemetry.

    def _look(self) -> None:
        """What the newest messages say."""
        seen = self.seen
        low = mavlink.MAV_LANDED_STATE_ON_GROUND
        self.time = self.now + self.ahead
        levels = [left for at, left in self._levels.values() if left >= 0 and self.now < at + 30]
        self.battery = min(levels, default=None)
        self._heard_at = self._came.get("HEARTBEAT", -math.inf)
        is_heard = self.now < self._heard_at + SILENCE  # else the mode is of long ago
        self.is_linked = is_heard and self.here is not None
        if "HEARTBEAT" in seen and "GLOBAL_POSITION_INT" in seen:
            self.mode = seen["HEARTBEAT"].custom_mode
            self.armed = bool(seen["HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.height = seen["GLOBAL_POSITION_INT"].relative_alt / 1e3
            said = seen["EXTENDED_SYS_STATE"].landed_state if "EXTENDED_SYS_STATE" in seen else 0
            self.on_ground = said == low or (not self.armed and self.height < 0.5)
            self.in_air = not self.on_ground and (said > low or (self.armed and self.height > 1))
        if "SYS_STATUS" in seen:  # has a bit for the pre-arm checks
            status = seen["SYS_STATUS"]
            bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
            passed = ~status.onboard_control_sensors_present | status.onboard_control_sensors_health
            self.is_ready = bool(passed & bit)

    def _hear(self, message: Any) -> None:
        """Take a message, if it is one of the vehicle."""
        kind = message.get_type()
        system = message.get_srcSystem()
        if (
            kind == "NAMED_VALUE_FLOAT"
            and system == self.memory.system
            and message.name == "spotted"
        ):
            self._spotted = message.value >= 0.5  # the payload may be a component of its own
        if message.get_srcComponent() != AUTOPILOT or kind == "BAD_DATA":
            return
        if self.memory.system is None and kind == "HEARTBEAT" and self._is_copter(message):
            self.memory.system = system
        if self.memory.system != system:
            if kind == "HEARTBEAT" and self._is_due(f"system {system}", 600):
                self._say(
                    f"system {system} is on this link; commands go to {self.memory.system} alone"
                )
            return
        if kind == "HEARTBEAT" and not self._is_copter(message):
            return
        if kind == "TIMESYNC":
            self.order.hear_time(message.ts1, message.tc1 / 1e9)
            return
        of = {"BATTERY_STATUS": "id", "COMMAND_ACK": "command", "STATUSTEXT": "text"}.get(kind)
        late = self.order.lateness((kind, of and getattr(message, of)), message, self.now)
        if late is None:
            return  # an older one, which came on a longer way, or the same again
        self._came[kind] = max(self.now - late, self._came.get(kind, -math.inf))
        self.seen[kind] = message
        if take := getattr(self, f"_hear_{kind.lower()}", None):
            take(message)

    def _hear_sys_status(self, message: Any) -> None:
        self._levels[-1] = self.now, message.battery_remaining

    def _hear_battery_status(self, message: Any) -> None:
        self._levels[message.id] = self.now, message.battery_remaining

    def _hear_statustext(self, message: Any) -> None:
        self._say(f"the vehicle says (severity {message.severity}): {message.text}")

    def _hear_autopilot_version(self, message: Any) -> None:
        board = bytes(message.uid2) if any(message.uid2) else message.uid.to_bytes(8, "little")
        self.memory.vehicle = board.hex() if any(board) else ""

    def _is_copter(self, heartbeat: Any) -> bool:
        if heartbeat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA and heartbeat.type in COPTERS:
            return True
        names = name_of("MAV_AUTOPILOT", heartbeat.autopilot), name_of("MAV_TYPE", heartbeat.type)
        self.why = f"{', '.join(names)} is no copter with ArduPilot, and is refused"
        if self._is_due("refused", 60):
            self._say(self.why)
        return False

    def _hear_global_position_int(self, message: Any) -> None:
        """Take a position if it is one: no sentinel, after a fix, no jump."""
        place = (message.lat / 1e7, message.lon / 1e7)
        fix = self.seen.get("GPS_RAW_INT")
        at = self._came["GLOBAL_POSITION_INT"]
        self._falls.append((self.now, message.vz / 100))
        while self._falls[0][0] < self.now - 3:
            self._falls.popleft()
        is_none = max(map(abs, place)) < 1e-3 or abs(place[0]) > 90 or abs(place[1]) > 180
        if is_none or fix is None or fix.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX:
            self.why = "no position of the vehicle" if self.here is None else self.why
            return
        (before, then), self._raw = self._raw, (place, at)
        if way(before, place)[0] > SCATTER + TOP_SPEED * (at - then):
            self._steady = self.now
        away = way(self.here, place)[0] if self.here is not None else 0.0
        if away > SCATTER + TOP_SPEED * (at - self._place_at) and self.now < self._steady + STEADY:
            if self._is_due("jump", 10):
                self._say(f"a position is {away:.0f} m away at once, and not taken")
            return
        self.here = place
        self._place_at = at

    def _hear_rc_channels(self, message: Any) -> None:
        """Note where a pilot's switch stands, and that he has moved it."""
        if not 800 < message.chan5_raw < 2200:
            return  # no receiver, or no pilot
        stands = sum(message.chan5_raw > edge for edge in SWITCH)
        memory = self.memory
        is_settled = (
            self.state not in ("connect", "watch", "left") and self.now > self._handed_at + SETTLED
        )
        self._has_switched |= is_settled and memory.switch not in (None, stands)
        memory.switch = stands if is_settled or self.state != "connect" else memory.switch

    # Commands.

    def _hear_command_ack(self, ack: Any) -> None:
        """Note what the vehicle says of a command of this state; none of other stations."""
        refuses = ack.result not in (
            mavlink.MAV_RESULT_ACCEPTED,
            mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
        )
        self._is_nameless |= ack.command == mavlink.MAV_CMD_REQUEST_MESSAGE and refuses
        if (ack.target_system, ack.target_component) != STATION or ack.command not in self._sent:
            return
        self.memory.lands |= ack.command == mavlink.MAV_CMD_NAV_LAND and ack.result == 0
        if ack.result not in (
            mavlink.MAV_RESULT_IN_PROGRESS,
            mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
        ):
            self._results.setdefault(
                ack.command, (ack.result == mavlink.MAV_RESULT_ACCEPTED, self.now)
            )
        if ack.result != mavlink.MAV_RESULT_ACCEPTED:
            self._say(f"{name_of('MAV_CMD', ack.command)}: {name_of('MAV_RESULT', ack.result)}")

    def _command(
        self, command: int, *params: float, place: tuple[float, float] | None = None
    ) -> bool:
        """Send a command, and again until there is a result; returns whether it was accepted.

        None is sent on an old picture: mode and motors were heard since the command before, and
        lately.
        """
        if command in self._results:
            return self._results[command][0]
        is_fresh = self._heard_at > self._commanded + ABOUT and self.now < self._heard_at + FRESH
        if not is_fresh or self.now < self._sent.get(command, -math.inf) + RETRY:
            return False
        self._sent[command] = self._commanded = self.now
        own = (*params, *[0.0] * 7)[:7]
        target = (self.memory.system, AUTOPILOT)
        if place is None:
            self._out.append(mavlink.MAVLink_command_long_message(*target, command, 0, *own))
        else:
            about = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, command, 0, 0
            x, y = (round(each * 1e7) for each in place)
            self._out.append(
                mavlink.MAVLink_command_int_message(*target, *about, *own[:4], x, y, own[6])
            )
        return False

    def _is_refused(self, command: int) -> bool:
        """Whether a command was refused, and shows no effect of an earlier try."""
        is_accepted, at = self._results.get(command, (True, self.now))
        return not is_accepted and self.now > at + GRACE

    def _keep_in_touch(self) -> None:
        """Heartbeats, and the messages that do not come; silent where its failsafe shall land the
        vehicle."""
        if self._is_alone() != self._is_quiet:
            self._is_quiet = not self._is_quiet
            if self._is_quiet:
                self._warn("nobody commands it in the air: silent, for its failsafe to land it")
        if self.memory.system is not None and self._is_due("clock", 1.0):
            self._out.append(mavlink.MAVLink_timesync_message(0, self.order.ask_time(self.now)))
        if not self._is_quiet and self._is_due("heartbeat", 1.0):
            kind = mavlink.MAV_TYPE_GCS
            none = mavlink.MAV_AUTOPILOT_INVALID
            self._out.append(
                mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
            )
        if self.memory.system is None or not self._is_due("intervals", SILENCE):
            return
        for kind, (number, interval) in INTERVALS.items():
            if self.now > self._came.get(kind, -math.inf) + max(SILENCE, 3 * interval):
                asked = (
                    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                    0,
                    number,
                    interval * 1e6,
                    0,
                    0,
                    0,
                    0,
                    0,
                )
                self._out.append(
                    mavlink.MAVLink_command_long_message(self.memory.system, AUTOPILOT, *asked)
                )

    def _is_alone(self) -> bool:
        """Whether the vehicle may have been in the air in GUIDED for long while nobody commands
        it."""
        is_left = self.state == "watch" and self.mode == GUIDED and self.armed and self.in_air
        position = self.seen.get("GLOBAL_POSITION_INT")
        flies_on = is_left and math.hypot(position.vx, position.vy) > 100  # somebody lets it [cm/s]
        if self.state != "watch" or flies_on or not self.in_air:
            self._stood_since = self.now
        is_lost = (self.state in FLIGHT or is_left) and self.now > self._heard_at + ALONE
        return is_lost or (is_left and self.now > self._stood_since + ALONE)

    def _warn(self, text: str) -> None:
        """Say something to the pilot's station as well."""
        self._say(text)
        said = f"{self.uav}: {text}".encode("ascii", "replace")[:50]
        self._out.append(mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_ALERT, said))

    # The service.

    def _talk(self) -> list[Request]:
        """The next request, one at a time: the time, what has happened, then what the state
        wants."""
        if self._pending is not None and self.now > self._pending.at + TIMEOUT:
            self._hear_answer(Answer(None, None, self._pending.number))
        if self._pending is not None or self.now < self._retry:
            return []
        if self._is_due("time", 1.0 if math.isnan(self.ahead) else 10.0):
            self._wish = Request("GET", "/time", None, self._hear_time)
        elif self.memory.outbox:
            path, body = self.memory.outbox[0]
            self._wish = Request("POST", self.path + path, body, self._hear_delivery)
        if self._wish is None:
            return []
        self._number += 1
        self._pending = self._wish._replace(number=self._number, at=self.now)
        return [self._pending]

    def _hear_answer(self, answer: Answer) -> None:
        """Take an answer; an error of the service, or what is not as it should be, is a missing
        one."""
        request = self._pending
        if request is None or answer.number != request.number:
            return
        self._pending = None
        self._asked_at = request.at
        known = (200, 201, 400, 409, 413, 422, 404 if request.method == "GET" else 200)
        try:
            if answer.status not in known or not isinstance(answer.body, dict):
                raise ValueError(f"status {answer.status}")
            request.take(answer.status, answer.body)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            self._retry = self.now + 1.0
            if self._is_due("no service", 10):
                problem = " ".join(str(error).split())[:200]
                self._say(
                    f"no answer of the service to {request.method} {request.path} ({problem})"
                )

    def _hear_time(self, _: int, body: dict[str, Any]) -> None:
        """Note how far the clock of the service is ahead, as of the middle of the trip.

        Worked timeline: asked at 10.0 s, answered 1000.2 s, came in at 10.4 s: it is 990 s ahead,
        give or take 0.2 s. A later answer counts if it came as fast, contradicts the one that
        counts (a clock was set), or if that is older than 5 minutes (clocks drift).
        """
        if not 0 < (said := float(body["time"])) < 4e9:
            raise ValueError(f"{said} is no time [s since 1970]")
        trip = self.now - self._asked_at
        ahead = said - (self._asked_at + self.now) / 2
        contradicts = abs(ahead - self.ahead) > (trip + self._trip) / 2 + 0.1
        if trip <= self._trip or contradicts or self.now > self._timed + 300:
            self.ahead = ahead
            self._trip = trip
            self._timed = self.now

    def _hear_delivery(self, status: int, body: dict[str, Any]) -> None:
        path, _ = self.memory.outbox.pop(0)
        if status >= 400 and self._is_due(f"refused {path}", WORD):
            self._say(f"the service refuses {path}: {body.get('error')}")
        if body.get("warning"):
            self._say(f"the service warns: {body['warning']}")

    def _say_fact(self, answer: str | None, status: str) -> None:
        """Tell the service, as soon as it is reached, what has happened."""
        self.memory.outbox.append(("/acknowledgements", self._row(answer, status)))

    def _row(self, answer: str | None, status: str) -> dict[str, Any]:
        return {"ID": self.uav, "answer": answer, "status": status, "bridge": self.memory.bridge}

    def _need_fresh(self) -> None:
        """Before it asks again, it reports."""
        self._fresh_from = self.memory.number
        self._due.pop("report", None)

    def _report(self) -> None:
        """Report what the newest telemetry says, unless that has been reported."""
        memory = self.memory
        flies = self.in_air
        if math.isnan(self.time) or self.here is None or self._place_at <= self._reported:
            return
        memory.number = (
            memory.number or int(self.time) % 2**30
        )  # mostly none of a lost memory; < 2**31
        row = {"ID": self.uav, "number": memory.number, "time": self._place_at + self.ahead}
        row |= {
            "lat": self.here[0],
            "lon": self.here[1],
            "FLA": self.height,
            "on ground": int(not flies),
        }
        row |= {"battery": self.battery, "source spotted": int(self._spotted and not flies)}
        row |= {"track": self._track, "takeoff-landing time": self._turned}
        row |= {"bridge": memory.bridge, "vehicle": memory.vehicle or None}
        row |= {"previous": memory.stops[1:], "landed": memory.landed, "motions": memory.motions}
        self._was_spotted = self._spotted and not flies
        self._reported = self._place_at
        memory.number += 1
        memory.outbox.append(("/reports", row))

    def _report_in_turn(self) -> None:
        if (
            self._place_at > self._reported
            and not self.memory.outbox
            and self._is_due("report", self.period)
        ):
            self._report()

    def _want(self, period: float, take: Any, method: str, path: str, body: Any = None) -> None:
        """Request something once in a period, if nothing else is under way."""
        is_free = (
            self._pending is None is self._wish
            and self.now >= self._retry
            and not self.memory.outbox
        )
        if is_free and self._is_due("want", period):
            self._wish = Request(method, self.path + path, body, take)

    def _ask(self) -> None:
        """Ask for advice, after a fresh report."""
        if self.memory.number == self._fresh_from:
            self._report()  # it goes before all that is wanted
        else:
            period = min(self.period / 4, 1.0) if self.state == "ground" else min(self.period, 2.0)
            asked = {"uavs": [self.uav], "bridge": self.memory.bridge}
            self._want(period, self._hear_advice, "POST", "/advice", asked)

    def _hear_advice(self, status: int, body: dict[str, Any]) -> None:
        if status >= 400:
            self.why = f"the service says {body.get('error')}"
            return
        told = Advice.model_validate(body["advice"][0])
        goal = self.memory.goal
        if told.state not in ("hold", "none") and None in (
            told.answer,
            told.lat,
            told.lon,
            told.altitude,
        ):
            raise ValueError("a flight needs answer, lat, lon and altitude")
        is_new = told.answer not in (None, self._held, goal and goal.answer)
        if self.state == "ground":
            self.why = f"it is told {told.state}" + (
                f" because {told.reason}" if told.reason else ""
            )
            self._offer = told if is_new and told.state != "none" else None
            if self._offer is not None and told.state != "hold":
                self._turn("accept", f"the service to confirm {told.state} {told.answer}")
        elif goal is not None and is_new and told.state == "hold":
            self._say_fact(told.answer, "accepted")
            self._turn("landing", f"it is told to hold because {told.reason}")

    def _hear_confirmation(self, status: int, body: dict[str, Any]) -> None:
        if self._offer is None or self.here is None:
            return
        told = self._offer
        come = body["status"][0] if status < 400 else "refused"
        self._offer = None
        if told.state == "hold":
            self._held = told.answer
            if come == "landed" and told.reason is None:  # the policy has chosen to hold
                self._decided()
            return
        if come in ("accepted", "taken off"):
            self.memory.goal = told
            self.memory.taken_off = come == "taken off"
            self._track = way(self.here, (told.lat, told.lon))[1]
        if come == "accepted":
            self._turn("guided", f"mode GUIDED for {told.answer}")
        else:
            self._end()  # what was taken off in an earlier life of the bridge has landed since
            self._turn("ground", f"{told.answer} is {come}")

    # Flights.

    def _turn(self, state: str, why: str) -> None:
        """Go over to another state, which waits for something."""
        self._say(f"{self.state} -> {state}: {why}")
        before = self.state
        self.state, self.why, self._since, self._due["word"] = state, why, self.now, self.now + WORD
        self.memory.state = state
        self.memory.mode = self.mode
        self._sent = {}
        self._results = {}
        self._down = math.inf
        self._is_other = False
        self._has_switched = False
        if state == "join" and before == "watch":
            self._handed_at = self.now
        elif state == "watch" and before == "connect":
            self._stood_since = (
                -math.inf
            )  # who commands it in the air is heard by it without this bridge
        elif state == "guided":
            self.memory.lands = False
        elif state == "climb":
            self._climbs_from = self.now
        self._due.pop("want", None)

    def _act_of_pilot(self) -> str:
        """What somebody else has done with the vehicle in this state; empty if nothing."""
        has_booted = self.order.boots > self._boots
        self._boots = self.order.boots
        if self.state not in MOTORS and self.state not in FLIGHT:
            return ""
        lands = self.state == "landing"
        memory = self.memory
        own = {GUIDED} if self.state in ("join", "ground", "accept", "guided") else set()
        if lands:
            own = {GUIDED} if memory.mode != LAND else set()
            own |= {LAND} if mavlink.MAV_CMD_NAV_LAND in self._sent else set()
        if self.mode in own and (self.mode == LAND or self.state in ("join", "ground", "accept")):
            memory.mode = self.mode  # from now on no other
        failed = self.seen["HEARTBEAT"].system_status in FAILSAFES and not MOTORS.get(
            self.state, True
        )
        is_other = self.mode not in {memory.mode, *own}
        has_armed = self.armed != MOTORS.get(self.state, self.armed)
        acts = {
            "it has booted again": has_booted,
            "the mode switch was moved": self._has_switched,
            f"mode {name_of('COPTER_MODE', self.mode)} by somebody else": is_other,
            "a failsafe of the vehicle": failed,
            f"motors {'on' if self.armed else 'off'} by somebody else": has_armed,
            "sent elsewhere by somebody else": self._aims_elsewhere(),
        }
        return next((what for what, is_so in acts.items() if is_so), "")

    def _aims_elsewhere(self) -> bool:
        """Whether the vehicle flies to a place that is not its goal, because another station has
        told it."""
        aim = self.seen.get("POSITION_TARGET_GLOBAL_INT")
        goal = self.memory.goal
        flies = self.state in ("climb", "cruise", "landing") and self.mode == GUIDED and self.in_air
        if (
            not flies
            or aim is None
            or goal is None
            or self._came[aim.get_type()] < self._climbs_from
        ):
            return False
        here = self.seen["GLOBAL_POSITION_INT"]
        height = aim.alt - (here.alt - here.relative_alt) / 1e3
        away = way((aim.lat_int / 1e7, aim.lon_int / 1e7), (goal.lat, goal.lon))[0]
        return away > AIM or abs(height - goal.altitude) > AIM

    def _hands_off(self, reason: str) -> None:
        """The pilot has it."""
        if self._offer is not None:
            self._say_fact(self._offer.answer, "aborted")
            self._offer = None
        self._end()
        self._turn(
            "watch", f"{reason}: a pilot to land it, and to hand over by GUIDED with its motors off"
        )
        self._warn(f"watches: {reason}")

    def _check_limit(self) -> None:
        """End what has taken too long."""
        if self.state in FLIGHT and self._heard_at - ABOUT <= self._commanded < self.now - SILENCE:
            self._hands_off(f"mode and motors not heard for {SILENCE:.0f} s after a command")
        goal = self.memory.goal
        lasting = self.now - self._since
        limit = LIMITS.get(self.state, math.inf)
        if self.state == "climb":
            limit = 30 + 2 * goal.altitude
        elif self.state == "cruise":
            limit = 60 + 2 * (goal.duration or 60.0)
        if self.state == "landing":
            if self.now > self._down + limit:
                self._hands_off(f"motors on, on the ground for {limit:.0f} s")
        elif lasting > limit and (self.is_linked or self.state == "accept"):
            self._offer = None
            state = "ground" if self.state == "accept" else "landing"
            self._turn(state, f"not within {limit:.0f} s: {self.why}")

    def _end(self) -> None:
        """End the flight in hand, and say how by where the vehicle stands."""
        goal = self.memory.goal
        memory = self.memory
        if goal is None or self.here is None:
            return
        away = way(self.here, (goal.lat, goal.lon))[0]
        is_there = memory.taken_off and self.on_ground and away <= THERE
        how = "landed" if is_there else "aborted"
        self._say(f"{goal.answer} {how}, {away:.0f} m from its goal")
        self._say_fact(goal.answer, how)
        memory.goal = None
        memory.taken_off = False

    def _decided(self) -> None:
        """Note that a decision has been followed: where, and when."""
        memory = self.memory
        memory.motions = (0 if self._was_spotted else memory.motions) + bool(memory.stops)
        memory.stops = [self.here, *memory.stops][:17]
        memory.landed = [self.time, *memory.landed][:17]

    def _stand(self) -> bool:
        """Note when it has come to stand on the ground; returns whether it does, and has
        listened."""
        if self._is_flying and self.on_ground and not self.armed and not math.isnan(self.time):
            self._decided()
            self._landed_at = self.now
            self._turned = self.time
            self._is_flying = False
            self._spotted = False
            self._need_fresh()
        return not self._is_flying and self.now >= self._landed_at + self.listen

    # States.

    def _connect(self) -> None:
        if not (self.on_ground or self.in_air):
            return
        if not (self.memory.vehicle or self._is_nameless) and self.now < self._since + IDENTITY:
            self.why = "which vehicle it is"
            if self._is_due("identity", 1.0):
                asked = mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 148, *[0.0] * 6
                self._out.append(
                    mavlink.MAVLink_command_long_message(self.memory.system, AUTOPILOT, *asked)
                )
            return
        state = self.memory.state
        mode = self.memory.mode
        is_told = self.memory.goal is not None
        if state in ("watch", "cruise", "landing") or (is_told and self.in_air):
            self._turn(state, "on as before")
            self.memory.mode = mode  # what has changed since, somebody else has done
        elif state in ("arm", "climb") and self.on_ground and not self.armed:
            self._hands_off("motors may have been on: off by somebody else")
        elif is_told and self.on_ground:
            self._turn("landing", "on the ground as before")
            self.memory.mode = mode
        elif self.armed or (mode not in (-1, self.mode) and state != "left"):
            self._hands_off(
                f"motors on or mode {name_of('COPTER_MODE', self.mode)} by somebody else"
            )
        else:
            self._turn("join", "the service to know the UAV")

    def _join(self) -> None:
        self._want(1.0, self._hear_fleet, "GET", "")

    def _hear_fleet(self, status: int, body: dict[str, Any]) -> None:
        """Create the fleet, join it, or go on as its member."""
        if status == 404:
            self._wish = Request("PUT", self.path, {"uavs": self.uavs}, self._hear_change)
        elif (
            status == 200
            and not self._has_joined
            and self.uav not in [row["ID"] for row in body["uavs"]]
        ):
            self._wish = Request(
                "POST", f"{self.path}/uavs", {"join": [self.uav]}, self._hear_change
            )
        elif status == 200 and self.state == "join" and self.is_linked:
            self._has_joined = True
            self.period = float(body["dt"])
            self._turn("ground", "a report to be taken")

    def _leave(self) -> None:
        leave = {"leave": [self.uav], "bridge": self.memory.bridge}
        self._want(1.0, self._hear_change, "POST", "/uavs", leave)

    def _hear_change(self, _: int, body: dict[str, Any]) -> None:
        self._has_joined = True
        self._turn(
            "join" if self.state == "join" else "left",
            f"the service says {body.get('error', 'welcome')}",
        )

    def _ground(self) -> None:
        if self.in_air:
            self._hands_off("it flies, by somebody else")
        elif self._stand():
            self._report_in_turn()
            if self.leaving:
                self._leave()
            elif not self.is_ready:
                self.why = "the vehicle's checks before arming"
            elif self._offer is not None:
                self._accept()
            else:
                self._ask()

    def _accept(self) -> None:
        row = self._row(self._offer.answer, "accepted")
        self._want(0.0, self._hear_confirmation, "POST", "/acknowledgements", row)

    def _change(self, command: int, *params: float) -> None:
        """Command something before the flight; what is refused gives the vehicle back."""
        if self._is_refused(command):
            self._hands_off(f"{name_of('MAV_CMD', command)} is refused")
        elif self.now < self._came["GLOBAL_POSITION_INT"] + 1:  # so that acts of others are seen
            self._command(command, *params)
            self._ask()

    def _guided(self) -> None:
        set_mode = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, GUIDED
        self._turn("arm", "motors on") if self.mode == GUIDED else self._change(*set_mode)

    def _arm(self) -> None:
        arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1
        self._turn("climb", "its level") if self.armed else self._change(*arm)

    def _climb(self) -> None:
        goal = self.memory.goal
        memory = self.memory
        if not self.in_air:
            self._change(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, goal.altitude)
        elif not memory.taken_off:
            memory.taken_off = True
            self._turned = None if math.isnan(self.time) else self.time
            self._say_fact(goal.answer, "taken off")
            self._report()
        elif self.height >= goal.altitude - LEVEL:
            self._turn("cruise", f"{goal.lat:.6f}, {goal.lon:.6f}")
        else:
            self._ask()

    def _cruise(self) -> None:
        goal = self.memory.goal
        position = self.seen["GLOBAL_POSITION_INT"]
        place = (goal.lat, goal.lon)
        pace = math.hypot(position.vx, position.vy) / 100
        is_near = way(self.here, place)[0] < NEAR and self.now < self._place_at + 2
        if self.on_ground:
            self._hands_off("on the ground in cruise")
        elif self._is_refused(mavlink.MAV_CMD_DO_REPOSITION):
            self._turn("landing", "the vehicle refuses the goal")
        elif is_near and pace < 1.0:
            self._turn("landing", "at its goal")
        else:
            go = mavlink.MAV_CMD_DO_REPOSITION, -1, 0, 0, math.nan, 0, 0, goal.altitude or 0.0
            if self._command(*go, place=place) and goal.speed:  # the reposition sets the speed anew
                self._command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, goal.speed, -1)
            self._ask()

    def _landing(self) -> None:
        if not self.on_ground:
            self._results.clear()  # whatever it says: again, until it lands
            self._down = math.inf
            if self.mode != LAND:
                self._command(mavlink.MAV_CMD_NAV_LAND)
            return
        self._down = min(self._down, self.now)
        if self.armed and self.mode not in (GUIDED, LAND):
            self._hands_off("motors on by somebody else")
        elif self.armed and self.mode == GUIDED:  # LAND does so itself
            self._results.clear()
            self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0)
        elif self.armed:
            self.why = "the vehicle to turn its motors off"
        elif (
            self.now > self._down + 2 and max((fall for _, fall in self._falls), default=0.0) > FALL
        ):
            self._hands_off("its motors went off in the air")
        elif self.now > self._down + 2 and self.memory.mode == LAND and not self.memory.lands:
            self._hands_off("it has landed, and has not said that it did so for the bridge")
        elif self.now > self._down + 2:
            self._end()
            self._turn("ground" if self._has_joined else "join", "a report to be taken")

    def _watch(self) -> None:
        if self._stand():
            self._report_in_turn()
            if self.leaving:
                self._leave()
        if (
            self.mode != GUIDED or self.now < self._commanded + QUIET
        ):  # or by a command that came late
            self._is_other = self.mode != GUIDED
        elif self._is_other and self.on_ground and not self.armed:
            self._need_fresh()
            self._turn("join", "the pilot has handed over")
        elif self._is_other and self._is_due("hand over", 60):
            self._say(
                "GUIDED in flight hands nothing over: land it, motors off, another mode, GUIDED"
            )
