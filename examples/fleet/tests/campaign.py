"""Seeded faults over a fleet of five in virtual time: service, five bridges and five copters in
this process.

``python tests/campaign.py`` plays 1,000 faults and prints the tables of the README
(`make fleet-campaign`). What counts is what the copters do, whatever the programs believe. A person
sees to vehicles that are not the bridge's.
"""

import argparse
import asyncio
import logging
import shutil
import sys
import tempfile
from collections import Counter
from itertools import combinations
from pathlib import Path
from unittest import mock

import httpx2
import numpy as np
import shapely
import torch

from damian.baselines.random import random_policy
from damian_fleet import program
from damian_fleet.bridge import FLIGHT, Answer, Bridge, Memory
from damian_fleet.order import LATEST
from damian_fleet.program import config_of, make_fleets
from damian_fleet.service import Clock, make_app
from damian_fleet.store import Fleets
from damian_fleet.vehicles import (
    ARMED,
    GUIDED,
    LAND,
    LOITER,
    MODES,
    RTL,
    STABILIZE,
    SWITCH,
    Copter,
    mavlink,
)

UAVS = "ABCDE"
TICK = 0.25
HOUR = 3600.0
ORIGIN = (52.8110, -4.1283)
STARTS = (0j, 170 + 0j, 340 + 0j, 510 + 0j, -170 + 0j)
SAME_POINT, CLEARANCE = (
    15.0,
    5.0,
)  # [m]; 10 m are set, and a copter stands up to 2 m beside its landing point
HOVER, LONGEST = (
    30.0,
    600.0,
)  # [s] that a copter may stand in the air in GUIDED, and that it may fly
HEED, APART = 3.0, 25.0  # [s] after which a bridge watches, and between commands of two bridges
OLD = 3.5  # how old mode and motors may be when something is commanded [s]
ASIDE = 30.0  # how far beside STARTS copters begin [m]
HARMLESS = (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE)
TOKEN = "campaign-campaign"
WORDS = ["region=llanbedr", "motion=polynomial", "motion.max_speed=8", "battery.enabled=true"]
WORDS += ["region.lattice_step=170", "actions.distances=[260,390]", "levels=[20,25,30]"]
ZONE = [[110, -50], [150, -50], [150, -10], [110, -10]]
WORDS += [f"region.zones=[{ZONE}]".replace(" ", "")]
"""15 landing points, long flights and three levels for five, so that UAVs meet often; a zone
between two."""


class Line:
    """A link that delays, loses and doubles what it carries; ``slowest`` is the longest delay
    [s]."""

    def __init__(self, rng, slowest):
        self.rng = rng
        self.items = []
        self.usual = {"loss": 0.02, "double": 0.02, "slowest": slowest}
        vars(self).update(self.usual)

    def send(self, now, *things):
        for thing in things:
            for _ in range(1 + (self.rng.random() < self.double)):
                if self.rng.random() >= self.loss:
                    self.items.append((now + self.rng.uniform(0.01, self.slowest), thing))

    def due(self, now):
        due = sorted((item for item in self.items if item[0] <= now), key=lambda item: item[0])
        self.items = [item for item in self.items if item[0] > now]
        return [thing for _, thing in due]


class Service:
    """The service, which can be killed: what is started again has the files that lay on the
    disk."""

    def __init__(self, folder):
        self.config, words = config_of([*WORDS, f"database={folder / 'fleets.0'}"])
        with mock.patch.object(program, "script_policy", random_policy):  # its UAVs meet often
            self.fleets = make_fleets(self.config, words)
            self.fleets.make([*UAVS], "", 0.0)  # the policy is made once for so many UAVs
        self.now = 0.0
        self.jump = 0.0
        self.down_until = 0.0
        self.starts = 0
        self.loop = asyncio.new_event_loop()
        self.serve()

    def serve(self):
        clock = Clock(self.fleets.latest, lambda: 1.7e9 + self.now + self.jump, lambda: self.now)
        transport = httpx2.ASGITransport(make_app(self.fleets, TOKEN, clock))
        headers = {"authorization": f"Bearer {TOKEN}"}
        self.client = httpx2.AsyncClient(
            transport=transport, base_url="http://fleet", headers=headers
        )

    def restart(self):
        before = Path(self.config.database)
        self.starts += 1
        after = before.with_suffix(f".{self.starts}")
        for end in ("", "-wal"):
            if Path(f"{before}{end}").exists():
                shutil.copy(f"{before}{end}", f"{after}{end}")
        self.config.database = str(after)
        self.fleets = Fleets(self.fleets.make, after, self.fleets.about)
        self.serve()

    def ask(self, method, path, body=None):
        """Status and JSON."""
        answer = self.loop.run_until_complete(self.client.request(method, path, json=body))
        return answer.status_code, answer.json()


class Link:
    """A bridge, and its links with a copter and with the service."""

    def __init__(self, name, copter, rng):
        self.name = name
        self.copter = copter
        self.bridge = None
        self.down, self.up, self.asked, self.answered = [
            Line(rng, slowest) for slowest in (0.3, 0.3, 1.5, 1.5)
        ]
        self.mute_until = 0.0  # no heartbeat comes through

    def start(self, memory=None):
        own = {"system": self.copter.system, "memory": memory}
        self.bridge = Bridge(self.name, "north", [*UAVS], **own)


class Uav(Link):
    """A copter, its bridge, what a pilot has done with it, and another bridge that somebody
    starts."""

    def __init__(self, name, number, rng):
        aside = ASIDE * np.sqrt(rng.random()) * np.exp(2j * np.pi * rng.random())
        super().__init__(
            name, Copter(ORIGIN, STARTS[number] + aside, system=number + 1, station=255), rng
        )
        self.memory = None
        self.epoch = 0.0
        self.started = 0.0
        self.boots = set()  # of its copter
        self.off_until = 0.0
        self.act = None
        self.seen_at = None
        self.changed = set()
        self.shown = {}
        self.after = {}  # how an act has left it
        self.second = None
        self.second_until = 0.0
        self.ambush = None
        self.others = 0
        self.wait = None
        self.strayed = False
        self.known = 0.0
        self.confirmed = 0.0
        self.accepted = 0.0
        self.way = None
        self.last_command = self.hover_since = self.air_since = self.idle_since = None
        self.commander = None
        self.commanded = -np.inf
        self.commanded_at, self.heartbeat_at = (
            -np.inf,
            -np.inf,
        )  # when those that have come were sent
        self.flights, self.told_at = 0, -np.inf  # when the service has taken what its bridge says

    def stop_bridge(self, until):
        if self.bridge is not None:
            self.memory = self.bridge.memory.model_dump_json()
        self.bridge = None
        self.off_until = until

    def start_bridge(self, epoch, now):
        self.epoch = epoch
        self.started = now
        self.start(Memory.model_validate_json(self.memory) if self.memory else None)

    @property
    def state(self):
        """Of the bridge, or in which it was ended."""
        return self.bridge.state if self.bridge else Memory.model_validate_json(self.memory).state

    def acted(self, now, why, *changed):
        """Somebody else has changed mode, motors, switch or aim: once that is heard, the bridge is
        quiet."""
        copter = self.copter
        fell = copter.crashed and copter.height > 2
        ends = self.state == "landing"  # as the bridge wants it
        wanted = {
            "mode": copter.mode == LAND and (ends or self.last_command == LAND),
            "motors": ends and copter.landed and copter.height < 1,
        }
        changed = [each for each in changed if fell or not wanted.get(each)]
        if changed:
            self.act = (now, why)
            self.seen_at = None
            self.changed = {*changed}
            aim = copter.goal and tuple(
                round(each * 1e7) for each in copter.degrees(copter.goal[0])
            )
            self.after = {"mode": copter.mode, "motors": ARMED * copter.armed, "aim": aim}
        if (changed or fell) and (fell or not copter.landed):
            self.strayed = True
            self.known = np.inf

    def hear(self, at, message, now):
        """Note whether a message that comes in shows what somebody else has done."""
        match message.get_type():
            case "HEARTBEAT":
                shows = {"mode": message.custom_mode, "motors": message.base_mode & ARMED}
                self.heartbeat_at = max(self.heartbeat_at, at)
            case "RC_CHANNELS":
                shows = {"switch": message.chan5_raw}
            case "POSITION_TARGET_GLOBAL_INT":
                shows = {"aim": (message.lat_int, message.lon_int)}
            case _:
                return
        for what, value in shows.items():
            is_new = what in self.changed and self.shown.get(what) != value
            is_new = is_new and value == self.after.get(what, value)  # not what came later
            if self.act is not None and self.seen_at is None and at >= self.act[0] and is_new:
                self.seen_at = now
            self.shown[what] = value


class Campaign:
    """One fleet with faults at random times; ``broken`` tells which invariants did not hold, and
    how."""

    def __init__(self, seed, folder):
        self.rng = np.random.default_rng(seed)
        torch.manual_seed(seed)  # the script draws
        self.now = 0.0
        self.later = []
        self.station = mavlink.MAVLink(None, 255, 191)
        self.service = Service(Path(folder))
        self.uavs = [Uav(name, number, self.rng) for number, name in enumerate(UAVS)]
        self.broken = {}
        self.faults = Counter()
        self.answers = {}
        self.reported = {}
        self.service.fleets.create("north", [*UAVS])
        self.ground = self.service.fleets["north"].ground

    def play(self, faults, every=10.0):
        """Let it fly, with a fault every so many seconds, then without, until every UAV has flown
        again."""
        self.run(30.0)
        for _ in range(faults):
            kind = FAULTS[self.rng.integers(len(FAULTS))]
            self.faults[kind.__name__.replace("_", " ")] += 1
            uav = self.uavs[self.rng.integers(len(self.uavs))]
            seconds = self.rng.uniform(2, 30)
            logging.info("%.2f s: %s, %s, %.1f s", self.now, kind.__name__, uav.name, seconds)
            kind(self, uav, seconds)
            self.run(self.rng.exponential(every))
        self.run(60.0)
        waiting = {uav: uav.flights for uav in self.uavs}
        end = self.now + 900.0
        while waiting and self.now < end:
            self.run(30.0)
            waiting = {uav: flights for uav, flights in waiting.items() if uav.flights == flights}
        rows = {row["ID"]: row for row in self.service.ask("GET", "/fleets/north")[1]["uavs"]}
        for uav in waiting:
            state = uav.bridge and (uav.bridge.state, uav.bridge.why)
            self.break_("flies again", f"{uav.name}: {state}, {rows[uav.name]}")
        for name, numbers in self.reported.items():
            if rows[name]["reports"] < len(numbers):
                self.break_(
                    "no report is lost", f"{name}: {rows[name]['reports']} of {len(numbers)}"
                )
        return self

    def break_(self, invariant, how):
        self.broken.setdefault(invariant, f"at {self.now:.0f} s: {how}")

    def run(self, seconds):
        for _ in range(round(seconds / TICK)):
            self.now = round(self.now + TICK, 6)
            self.service.now = self.now
            for item in [item for item in self.later if item[0] <= self.now]:
                self.later.remove(item)
                item[1]()
            for uav in self.uavs:
                self.step(uav)
            if self.now % 1 == 0:
                self.check()

    def after(self, seconds, action):
        self.later.append((self.now + seconds, action))

    def lines(self, lines, seconds, **change):
        """Change links for so long [s]."""
        for line in lines:
            vars(line).update(change)
            self.after(seconds, lambda line=line: vars(line).update(line.usual))

    def command(self, command, uavs, seconds=None):
        """An operator, who asks again until the service answers, and lets UAVs go on after so long
        [s]."""
        if self.now < self.service.down_until:
            self.after(1.0, lambda: self.command(command, uavs, seconds))
            return
        self.service.ask("POST", "/fleets/north/command", {"command": command, "uavs": uavs})
        if seconds is not None:
            self.after(seconds, lambda: self.command("resume", uavs))

    # One step of one UAV.

    def step(self, uav):
        copter = uav.copter
        now = self.now
        if uav.bridge is None and now >= uav.off_until:
            uav.start_bridge(self.rng.uniform(-HOUR, HOUR), now)
            uav.shown = {}
        links = [uav, uav.second] if uav.second else [uav]
        for link in links:
            for request in link.asked.due(now):
                link.answered.send(now, Answer(*self.serve(uav, link, request), request.number))
            heard = link.up.due(now)
            answers = link.answered.due(now)
            if link.bridge is None:
                continue
            if link is uav:
                for at, message in heard:
                    uav.hear(at, message, now)
            before = link.bridge.state
            messages, requests = link.bridge.step(
                now + uav.epoch, [message for _, message in heard], answers
            )
            why = link.bridge.why
            is_as_told = copter.armed and copter.mode == GUIDED
            is_told = before in ("climb", "cruise") and is_as_told and "by somebody else" in why
            is_told &= uav.act is None and before != link.bridge.state == "watch"
            uav.boots.add(copter.booted)
            boots = sum(at > uav.started - LATEST for at in uav.boots)
            if link is uav and (is_told or link.bridge.order.boots > boots):
                self.break_("no act that was none", f"{uav.name} {before}: {why}, {boots} boots")
            for message in messages:
                message.pack(self.station)
            link.down.send(now, *(each for each in messages if self.goes_through(uav, link, each)))
            link.asked.send(now, *requests)
        was_landed = copter.landed
        failsafe = set(copter.failsafe)
        before = {"mode": copter.mode, "motors": copter.armed}
        sent = copter.step(now, [each for link in links for each in link.down.due(now)])
        copter.mav.seq = (copter.mav.seq + uav.others) % 256
        for link in links:
            heartbeats = now < link.mute_until
            link.up.send(
                now, *((now, m) for m in sent if not heartbeats or m.get_type() != "HEARTBEAT")
            )
        if copter.failsafe - failsafe:
            after = {"mode": copter.mode, "motors": copter.armed}
            uav.acted(
                now, f"failsafe {copter.failsafe}", *(i for i in after if after[i] != before[i])
            )
        if copter.landed or (copter.position_control and uav.way is None):
            goal, level = copter.goal or (copter.place, 0.0)
            path = shapely.LineString([(end.real, end.imag) for end in (copter.place, goal)])
            uav.way = None if copter.landed else (level, path)
            if uav.way and not uav.act and self.is_too_near_the_zone(copter.place, goal):
                self.break_("no way through a zone", f"{uav.name} from {copter.place} to {goal}")
        if was_landed and not copter.landed:
            uav.flights = uav.flights + 1
            uav.air_since = now
            uav.strayed = uav.strayed and uav.act is not None
            uav.accepted = uav.confirmed
        if uav.second and now > uav.second_until:
            uav.second = None
        if uav.wait and uav.bridge and uav.bridge.state == uav.wait[0]:
            (_, act), uav.wait = uav.wait, None
            act()
        self.see_to(uav)

    def is_too_near_the_zone(self, *places):
        """Whether a way comes nearer to the zone than it begins and ends, and than CLEARANCE."""
        ground = self.ground
        copter = self.uavs[0].copter
        zone = shapely.Polygon(ZONE)
        path = shapely.LineString([ground.local(copter.degrees(place)) for place in places])
        ends = (zone.distance(shapely.Point(end)) for end in path.coords)
        return zone.distance(path) < min(CLEARANCE, *ends) - 0.1

    def goes_through(self, uav, link, message):
        """Look at a message of a bridge; returns whether it goes on its way."""
        if message.get_type() not in ("COMMAND_LONG", "COMMAND_INT", "SET_MODE"):
            return True
        number = getattr(message, "command", mavlink.MAV_CMD_DO_SET_MODE)
        if number in HARMLESS:
            return True
        is_other = uav.commander not in (None, link.bridge.memory.bridge)
        if is_other and (self.now < uav.commanded + APART or not uav.copter.landed):
            self.break_("one bridge a UAV", f"{uav.name}: {link.name} {message}")
        uav.commander = link.bridge.memory.bridge
        uav.commanded = self.now
        to_land = number == mavlink.MAV_CMD_NAV_LAND or (number == 176 and message.param2 == LAND)
        uav.last_command = LAND if to_land else number
        if to_land and uav.seen_at is None and uav.copter.mode == LAND and uav.changed <= {"mode"}:
            uav.act = None  # both at once: it has what it wanted
        if uav.seen_at is not None:
            self.break_("no command after a pilot's act", f"{uav.name} {uav.act}: {message}")
        if link is uav and not uav.commanded_at < uav.heartbeat_at >= self.now - OLD:
            self.break_("no command on an old picture", f"{uav.name}: {message}")
        uav.commanded_at = self.now if link is uav else uav.commanded_at
        if uav.ambush and link is uav:
            (seconds, is_lost, act), uav.ambush = uav.ambush, None
            uav.mute_until = self.now + seconds
            if act:
                self.after(self.rng.uniform(0.3, seconds), act)
            return not is_lost
        return True

    def serve(self, uav, link, request):
        """Status and body of an answer of the service, None without one."""
        if self.now < self.service.down_until:
            return None, None
        status, body = self.service.ask(request.method, request.path, request.body)
        if status >= 500:
            self.break_("no error of the service", f"{request}: {status} {body}")
        is_taken = status == 200 and request.path.endswith(("/reports", "/acknowledgements"))
        if (
            link is not uav
            and is_taken
            and (link.name not in UAVS or self.now < uav.told_at + APART)
        ):
            self.break_("one bridge a UAV", f"{link.name} speaks for {uav.name}: {request}")
        if link is uav and is_taken:
            uav.told_at = self.now
        if link.name in UAVS and status == 200 and request.path.endswith("/reports"):
            self.reported.setdefault(request.body["ID"], set()).add(request.body["number"])
            at = uav.copter.metres(request.body["lat"], request.body["lon"])
            if (
                uav.copter.landed
                and uav.known > self.now
                and abs(at - uav.copter.place) < SAME_POINT
            ):
                uav.known = self.now
        if body.get("status") == ["accepted"]:
            uav.confirmed = self.now
        for row in body.get("advice", []) if status == 200 else []:
            told = {key: value for key, value in row.items() if key not in ("state", "age")}
            if row["answer"] and self.answers.setdefault(row["answer"], told) != told:
                self.break_(
                    "an answer never changes", f"{row}, before {self.answers[row['answer']]}"
                )
        return status, body

    def see_to(self, uav):
        """What a person does: lands what he has taken over, mends it, and hands it over again."""
        copter = uav.copter
        stands = shapely.Point(self.ground.local(copter.degrees(copter.place)))
        is_out = (
            copter.landed and not copter.armed and not self.ground.region.polygon.contains(stands)
        )
        if is_out and self.now % 60 == 0:  # in the zone, or outside: he carries it back
            copter.place = STARTS[ord(uav.name) - ord("A")]
            uav.strayed = True
            uav.known = np.inf
        knows = uav.bridge and uav.bridge.is_linked and uav.bridge.state != "connect"
        if uav.seen_at is not None and not knows:
            uav.seen_at = self.now
        is_heeded = not knows or uav.bridge.state in ("watch", "left")
        if uav.seen_at is not None and not is_heeded and self.now > uav.seen_at + HEED:
            self.break_("a pilot's act is heeded", f"{uav.name} {uav.act}: {uav.bridge.state}")
        if not (uav.act or copter.failsafe or (uav.bridge and uav.bridge.state == "watch")):
            uav.idle_since = None
        elif not copter.landed:
            uav.idle_since = self.now
            if uav.act and copter.mode not in (LAND, RTL) and self.now > uav.act[0] + 20:
                copter.change_mode(LAND)
                uav.strayed = True
                uav.known = np.inf
        elif uav.idle_since is None or copter.armed:
            uav.idle_since = self.now
        elif self.now == uav.idle_since + 20:
            if copter.failsafe:
                copter.reboot(self.now)
            copter.crashed = False
            copter.battery = [100.0]
            copter.change_mode(STABILIZE)
        elif self.now >= uav.idle_since + 35:
            uav.act = None
            uav.seen_at = None
            uav.changed = set()
            uav.idle_since = self.now
            copter.change_mode(GUIDED)

    # What must hold.

    def check(self):
        for uav in self.uavs:
            copter = uav.copter
            stands = (
                copter.mode == GUIDED and abs(copter.velocity) < 0.3 and abs(copter.climb) < 0.1
            )
            if copter.landed or not stands:
                uav.hover_since = self.now
            elif self.now > uav.hover_since + HOVER:
                self.break_(
                    "airborne is commanded", f"{uav.name} stands, {uav.bridge and uav.bridge.state}"
                )
            if not copter.landed and self.now > uav.air_since + LONGEST:
                self.break_("airborne is commanded", f"{uav.name} flies too long: {copter.mode}")
        for one, other in combinations(self.uavs, 2):
            if any(a.strayed and a.known > b.accepted for a, b in ((one, other), (other, one))):
                continue  # nobody knew where it would be
            sites = [site(uav.copter) for uav in (one, other)]
            if None not in sites and abs(sites[0] - sites[1]) < SAME_POINT:
                self.break_("no two at one point", f"{one.name}, {other.name} at {sites}")
            levels, paths = zip(*(uav.way or (uav.name, None) for uav in (one, other)), strict=True)
            if levels[0] == levels[1] and shapely.distance(*paths) < CLEARANCE:
                self.break_("no two paths too near", f"{one.name}, {other.name} on {paths}")
        if self.now % 5:
            return
        told = [
            row["advice"] or {}
            for row in self.service.ask("GET", "/fleets/north")[1].get("uavs", [])
        ]
        bound = [row for row in told if row.get("state") in ("fly", "return", "bound")]
        for one, other in combinations(bound, 2):
            if (one["lat"], one["lon"]) == (other["lat"], other["lon"]):
                self.break_("no two bound to one point", f"{one}, {other}")


def site(copter):
    """Where a copter stands or will land by what it was commanded, None in the climb."""
    if copter.landed or copter.mode == LAND:
        return copter.place
    return copter.goal[0] if copter.position_control and copter.goal else None


class Faults:
    """What happens to a UAV, or to the service, for some seconds."""

    def messages_lost(field, uav, seconds):
        lines = ([uav.down, uav.up], [uav.down], [uav.up])[field.rng.integers(3)]
        field.lines(lines, seconds, loss=1.0)

    def messages_doubled_and_late(field, uav, seconds):
        field.lines([uav.down, uav.up], seconds, double=0.5, slowest=2.0)

    def messages_late_at_fifty_a_second(field, uav, seconds):
        uav.others = 9
        field.lines([uav.up], seconds, slowest=5.0)
        field.after(seconds + 10, lambda: vars(uav).update(others=0))

    def heartbeats_lost_around_a_command(field, uav, seconds):
        act = [None, lambda: Faults.pilot_chooses(field, uav)][field.rng.integers(2)]
        uav.ambush = seconds / 4 + 1, field.rng.random() < 0.5, act

    def another_bridge(field, uav, seconds):
        """Of the same name, or of another one, for the same vehicle."""
        name = uav.name if field.rng.random() < 0.5 else f"{uav.name}2"
        uav.second = Link(name, uav.copter, field.rng)
        uav.second_until = field.now + 3 * seconds
        uav.second.start()

    def requests_lost(field, uav, seconds):
        field.lines([uav.asked], seconds, loss=1.0)

    def answers_lost(field, uav, seconds):
        field.lines([uav.answered], seconds, loss=1.0)

    def requests_doubled_and_late(field, uav, seconds):
        field.lines([uav.asked, uav.answered], seconds, double=0.5, slowest=5.0)

    def service_restarted(field, _, seconds):
        field.service.down_until = field.now + seconds
        field.after(seconds, field.service.restart)

    def bridge_restarted(field, uav, seconds):
        uav.stop_bridge(field.now + seconds)

    def vehicle_restarted(field, uav, _):
        if uav.copter.landed:
            before = {"mode": uav.copter.mode, "motors": uav.copter.armed}
            uav.copter.reboot(field.now)
            after = {"mode": uav.copter.mode, "motors": uav.copter.armed}
            uav.acted(field.now, "reboot", *(i for i in after if after[i] != before[i]))

    def clock_set_an_hour(field, _, seconds):
        jump = HOUR * field.rng.choice([-1, 1])
        field.service.jump += jump
        if field.rng.random() < 0.5:
            Faults.service_restarted(field, None, seconds)
        field.after(60, lambda: vars(field.service).update(jump=field.service.jump - jump))

    def wind(field, _, seconds):
        for uav in field.uavs:
            uav.copter.wind = field.rng.uniform(4, 13) * np.exp(2j * np.pi * field.rng.random())
            field.after(2 * seconds, lambda uav=uav: vars(uav.copter).update(wind=0j))

    def wrong_acknowledgements(field, uav, seconds):
        """For another station, from another vehicle; and one of an answer that nobody gave."""
        for command in (176, 400, 22, 192, 178, 21):
            for system, target in ((uav.copter.system, (255, 190)), (77, (255, 191))):
                message = mavlink.MAVLink_command_ack_message(
                    command, field.rng.integers(5), 0, 0, *target
                )
                message.pack(mavlink.MAVLink(None, system, 1))
                late = seconds * field.rng.random()
                field.after(late, lambda m=message: uav.up.send(field.now, (field.now, m)))
        row = {"ID": uav.name, "answer": "none-such", "status": "landed"}
        if field.now >= field.service.down_until:
            field.service.ask("POST", "/fleets/north/acknowledgements", row)

    def pilot_chooses(field, uav):
        """A mode by his switch, or by another station (BRAKE)."""
        modes = [mode for mode in MODES if mode != GUIDED]
        mode = modes[field.rng.integers(len(modes))]
        changed = [*["mode"] * (uav.copter.mode != mode), *["switch"] * (mode in SWITCH)]
        if uav.copter.change_mode(mode):
            uav.acted(field.now, f"mode {mode}", *changed)

    def another_station_sends_it_elsewhere(field, uav):
        copter = uav.copter
        place = uav.copter.place + 60 * np.exp(2j * np.pi * field.rng.random())
        latitude, longitude = (round(each * 1e7) for each in copter.degrees(place))
        go = mavlink.MAV_CMD_DO_REPOSITION, 0, 0, -1, 0, 0, 0, latitude, longitude, 20.0
        message = mavlink.MAVLink_command_int_message(copter.system, 1, 6, *go)
        message.pack(mavlink.MAVLink(None, 255, 190))
        if copter.mode == GUIDED and not copter.landed:
            copter.receive(message)
            uav.acted(field.now, "go-to", "aim")

    def pilot_takes_over(field, uav, seconds):
        field.after(seconds, lambda: Faults.pilot_chooses(field, uav))

    def pilot_acts_in_any_state(field, uav, _):
        acts = [Faults.pilot_chooses, Faults.another_station_sends_it_elsewhere]
        act = acts[field.rng.integers(2)]
        states = ["ground", "accept", *FLIGHT] if act is acts[0] else ["climb", "cruise"]
        wait = field.rng.uniform(0, 8)
        then = lambda: field.after(wait, lambda: act(field, uav))  # noqa: E731
        uav.wait = states[field.rng.integers(len(states))], then

    def pilot_takes_over_as_the_motors_start(field, uav, seconds, tries=400):
        if uav.copter.armed and uav.copter.landed and uav.copter.change_mode(LOITER):
            uav.acted(field.now, "mode", "mode", "switch")
        elif tries:
            again = Faults.pilot_takes_over_as_the_motors_start
            field.after(TICK, lambda: again(field, uav, seconds, tries - 1))

    def pilot_stops_the_motors(field, uav, _):
        if uav.copter.armed:
            uav.copter.disarm(force=field.rng.random() < 0.3) and uav.acted(
                field.now, "disarm", "motors"
            )

    def position_lost(field, uav, seconds):
        uav.copter.fix = False
        field.after(seconds, lambda: vars(uav.copter).update(fix=True))

    def position_jumps(field, uav, seconds):
        uav.copter.glitch = 400 * np.exp(2j * np.pi * field.rng.random())
        field.after(seconds / 4, lambda: vars(uav.copter).update(glitch=0j))

    def battery_low(field, uav, _):
        uav.copter.battery = [90.0, 10.0]
        field.after(120, lambda: vars(uav.copter).update(battery=[100.0]))

    def arming_refused(field, uav, seconds):
        uav.copter.prearm = "Compass not calibrated"
        field.after(seconds, lambda: vars(uav.copter).update(prearm=None))

    def operator_holds(field, uav, seconds):
        field.command("hold", [uav.name], 3 * seconds)

    def operator_sends_all_home(field, _, seconds):
        field.command("return", None, 30 + 3 * seconds)


ACTS = (Faults.pilot_chooses, Faults.another_station_sends_it_elsewhere)
FAULTS = [
    each for name, each in vars(Faults).items() if not name.startswith("_") and each not in ACTS
]
INVARIANTS = (
    "no two bound to one point",
    "no two at one point",
    "no two paths too near",
    "one bridge a UAV",
    "no way through a zone",
    "no command on an old picture",
    "no command after a pilot's act",
    "a pilot's act is heeded",
    "no act that was none",
    "airborne is commanded",
    "an answer never changes",
    "no report is lost",
    "no error of the service",
    "flies again",
)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("seeds", 20), ("first", 21000), ("faults", 50)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--log", action="store_true", help="what bridges say")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO if given.log else logging.CRITICAL, format="%(message)s")
    logging.getLogger("httpx2").setLevel(logging.WARNING)
    faults = Counter()
    broken = Counter()
    totals = Counter()
    for seed in range(given.first, given.first + given.seeds):
        with tempfile.TemporaryDirectory() as folder:
            field = Campaign(seed, folder).play(given.faults)
        faults.update(field.faults)
        broken.update([*field.broken])
        totals.update(flights=sum(uav.flights for uav in field.uavs), hours=field.now / 3600)
        print(f"seed {seed}: {field.now:.0f} s, {field.broken or 'everything held'}", flush=True)
    print(
        f"\n{faults.total()} faults, {totals['flights']} flights in {totals['hours']:.1f} h of "
        "flying\n"
    )
    for title, rows in (("fault", faults), ("broken", {i: broken[i] for i in INVARIANTS})):
        print(
            f"| {title} | |",
            "|:--|--:|",
            *(f"| {name} | {n} |" for name, n in rows.items()),
            "",
            sep="\n",
        )
    sys.exit(bool(broken))


if __name__ == "__main__":
    main()
