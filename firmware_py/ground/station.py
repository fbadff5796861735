"""The ground side without clock and sockets: takes bytes, returns requests, frames and telemetry. Pure; time is passed in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from pathlib import Path
from typing import NamedTuple

from firmware_py.core.body import Body
from firmware_py.core.types import WARNING, DockRequest, Inputs, Outputs, Request
from firmware_py.description.fleet import Fleet, module_index
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.commands import CommandService
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.dialect import Message, load_dialect
from firmware_py.ground.geodesy import Origin
from firmware_py.ground.identity import COMPONENT_AUTOPILOT
from firmware_py.ground.logs import LogService
from firmware_py.ground.message_requests import MessageRequests
from firmware_py.ground.mission_flight import MissionFlight
from firmware_py.ground.missions import MissionService
from firmware_py.ground.outbox import Outbox, Outgoing
from firmware_py.ground.parameters import ParameterService, ParameterStore
from firmware_py.ground.picture import Picture
from firmware_py.ground.pilots import Sender
from firmware_py.ground.plan_jobs import Plan, PlanJob
from firmware_py.ground.presence import Presence, Watch
from firmware_py.ground.signing import Signing
from firmware_py.ground.steering import Steering
from firmware_py.ground.subject import Subject
from firmware_py.ground.system import NEVER_WAITS, Arrival, System
from firmware_py.ground.wire import Framer, Packet

_SENDERS = 256
_LAST_SYSTEM = 254
"""Highest system id of a body; ground stations use 255."""
_MAY_STOP = ("COMMAND_LONG", "COMMAND_INT", "SET_MODE", "MANUAL_CONTROL")
"""Messages that may carry a stop, accepted even for a body that is gone; their services tell what stops."""
_STEERS_ONE = ("RC_CHANNELS_OVERRIDE", "SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET")
"""Messages that may address all systems only while there is one body: several would be steered to one place. DroneKit addresses all."""
_OF_NO_BODY = ("LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END", "REQUEST_DATA_STREAM")
"""Messages that concern no body. Logs belong to the process: a client keeps fetching from the same system when its body docks. Rates
belong to the link: some clients request them again and again.
"""
_NEVER_SIGNED = ("RADIO_STATUS",)
"""Messages accepted unsigned from everybody, also with a key."""
_TARGETS = frozenset({"target_system", "target"})
"""Fields by which a message addresses one system or all."""
_NEVER_FORWARDED = ("SETUP_SIGNING", *_NEVER_SIGNED)
_STREAM_NS = 1_000_000_000
"""A message that recurs within this time counts as streaming."""
_TORN_NS = 500_000_000
"""Silence after which an incomplete frame counts as torn; radios that take turns pause for less within a frame."""


class _Heard(NamedTuple):
    """Channel on which a sender was heard, and when each of its messages without target fields came last."""

    channel: int
    came_ns: dict[str, int]


class Services:
    """The services of one system."""

    def __init__(self, station: GroundStation, system: System) -> None:
        config, store = station.config, station.store
        self.system = system
        self.flight = MissionFlight(system, lambda: store.values)
        self.missions = MissionService(system, self.flight)
        self.steering = Steering(system, lambda: store.values, _dock_of(config), config.watches)
        self.presence = Presence(system, config, lambda: store.values, station.signing, station.watch)
        self.logs = LogService(system, Path(config.logs) if config.logs else None)
        self.parameters = ParameterService(system, store, station.present)
        extra = {
            "AUTOPILOT_VERSION": self.presence.autopilot_version,
            "AVAILABLE_MODES": self.presence.available_modes,
        }
        messages = MessageRequests(system, extra)
        self.commands = CommandService(system, self.flight, self.steering, messages)
        parts = (self.commands, messages, self.parameters, self.missions, self.steering, self.presence, self.logs)
        self._handlers = {name: handler for part in parts for name, handler in part.handlers().items()}

    def take(self, arrival: Arrival, addressed: bool) -> None:
        """Takes a message for this system (`addressed`) or for all. If the body is gone, only addressed messages are taken that may stop it
        or that request logs or rates; others that are addressed are refused.
        """
        name = arrival.message.name
        handler = self._handlers.get(name)
        if handler is None:
            return
        if self.system.body_is_known or (addressed and name in (*_MAY_STOP, *_OF_NO_BODY)):
            handler(arrival)
        elif addressed:
            self.system.refuse(arrival.time_ns)

    def step(self, time_ns: int) -> None:
        """Advances everything that takes longer than one message."""
        self.commands.step(time_ns)
        self.logs.step()
        if not self.system.body_is_known:
            self.flight.lose_body()
            return
        self.parameters.step()
        self.missions.step(time_ns)
        self.flight.step(time_ns)
        self.steering.step(time_ns)


class GroundStation:
    """All systems of one fleet."""

    def __init__(
        self, config: GroundConfig, fleet: Fleet, parameters: Parameters, signing: Signing | None = None
    ) -> None:
        """Raises DescriptionError when the stored parameters are invalid, or there are more bodies than system ids."""
        last = config.first_system + len(fleet.module) - 1
        if last > _LAST_SYSTEM:
            most = _LAST_SYSTEM - len(fleet.module) + 1
            raise DescriptionError(f"first_system {config.first_system}: {len(fleet.module)} modules lead to {last}; it is {most} at most")
        self.config = config
        self.signing = signing if signing is not None else Signing()
        self.store = ParameterStore(parameters, config.parameter_file)
        self.counts: Counter[str] = Counter()
        self.picture = Picture(len(fleet.module), lambda: self.store.values.supervision)
        self.watch = Watch()
        self._dialect = load_dialect()
        self._busy: set[int] = set()
        self._frames: list[Outgoing] = []
        self._framers: dict[int, Framer] = {}
        self._last_bytes: dict[int, tuple[int, bool]] = {}
        """Time of the last bytes on each stream that is not silent, and whether its link may set the key."""
        self._routes: dict[Sender, _Heard] = {}
        origin = Origin(fleet.latitude_deg, fleet.longitude_deg, fleet.altitude_m)
        self.services: dict[int, Services] = {}
        for body in range(len(fleet.module)):
            number = config.first_system + body
            outbox = Outbox(self._dialect, self.signing, number, self._frames)
            self.services[number] = Services(self, System(Subject(body, self.picture, config.encoding, origin), outbox, self._busy))

    # ------------------------------------------------------------ in

    def observe(self, inputs: Inputs, outputs: Outputs, bodies: Sequence[Body]) -> None:
        """Takes in the results of one tick."""
        self.picture.observe(inputs, outputs, bodies)
        for event in outputs.events:
            for services in self.services.values():
                if event.body in (None, services.system.body, services.system.subject.leader):
                    services.commands.hear(event)
                    services.flight.hear(event)
        self._send_event_texts()
        self._flush_torn_frames(outputs.time_ns)
        for services in self.services.values():
            services.step(outputs.time_ns)

    def _send_event_texts(self) -> None:
        """Sends events as texts of the body that they concern; the first present system reports those of no present body."""
        present: dict[int | None, System] = {system.body: system for system in self.present()}
        while present and self.picture.events:
            event = self.picture.events.popleft()
            speaker = present.get(event.body, next(iter(present.values())))
            speaker.say(event.severity, event.text)

    def set_busy(self, busy: Set[int]) -> None:
        """Treats these channels as busy until the next call."""
        self._busy.clear()
        self._busy.update(busy)

    def join(self, channel: int, time_ns: int) -> None:
        """Adds a channel, which gets the default telemetry."""
        for services in self.services.values():
            services.system.add_channel(channel, time_ns)

    def leave(self, channel: int) -> None:
        """Removes a channel."""
        self._framers.pop(channel, None)
        self._last_bytes.pop(channel, None)
        self._routes = {sender: heard for sender, heard in self._routes.items() if heard.channel != channel}
        for services in self.services.values():
            services.system.remove_channel(channel)

    def take(self, channel: int, data: bytes, time_ns: int, datagram: bool = True, trusted: bool = False) -> bool:
        """Takes bytes from a channel. Returns whether a frame in them was believed. Never raises on their contents."""
        if channel not in self._framers:
            self._framers[channel] = Framer(self._dialect, self.signing, self.counts)
        if not datagram:
            self._last_bytes[channel] = time_ns, trusted
        return self._feed(channel, data, not datagram, time_ns, trusted)

    def _feed(self, channel: int, data: bytes, goes_on: bool, time_ns: int, trusted: bool) -> bool:
        packets = self._framers[channel].feed(data, goes_on)
        for packet in packets:
            self._take_packet(packet, channel, time_ns, trusted)
        return any(packet.message.name not in _NEVER_SIGNED for packet in packets)

    def _flush_torn_frames(self, time_ns: int) -> None:
        """Abandons incomplete frames of streams that have fallen silent: a stop may follow in the same bytes."""
        silent = [channel for channel, (heard_ns, _) in self._last_bytes.items() if time_ns - heard_ns > _TORN_NS]
        for channel in silent:
            self._feed(channel, b"", False, time_ns, self._last_bytes.pop(channel)[1])

    def planned(self, body: int, plan: Plan) -> None:
        """Takes the finished plan of a job."""
        self.services[self.config.first_system + body].flight.planned(plan)

    # ------------------------------------------------------------ out

    def present(self) -> list[System]:
        """Returns the systems whose body exists: one for each body."""
        return [s.system for s in self.services.values() if s.system.body_is_known]

    def requests(self) -> list[Request]:
        """Returns the requests for the next tick made since the last call."""
        asked: list[Request] = []
        for services in self.services.values():
            asked += services.system.requests
            services.system.requests.clear()
        return asked

    def jobs(self) -> list[PlanJob]:
        """Returns the planning jobs added since the last call."""
        jobs: list[PlanJob] = []
        for services in self.services.values():
            jobs += services.flight.jobs.waiting
            services.flight.jobs.waiting.clear()
        return jobs

    def awaited(self) -> list[int]:
        """Returns for each body the serial number of the job whose plan it waits for; 0: none."""
        return [services.flight.awaited for services in self.services.values()]

    def frames(self, time_ns: int) -> list[Outgoing]:
        """Returns the frames to send now: due telemetry, answers and forwarded messages."""
        for system in self.present():
            system.stream(time_ns)
        sent = list(self._frames)
        self._frames.clear()
        return sent

    @property
    def reboot_asked(self) -> bool:
        """Whether a client has requested a restart of the process."""
        return any(services.commands.reboot_asked for services in self.services.values())

    def say(self, text: str) -> None:
        """Broadcasts a warning."""
        for system in self.present()[:1]:
            system.say(WARNING, text)

    # ------------------------------------------------------------ routes

    def _take_packet(self, packet: Packet, channel: int, time_ns: int, trusted: bool) -> None:
        message = packet.message
        if message.system == 0 or (message.system in self.services and message.component == COMPONENT_AUTOPILOT):
            return  # no sender, or our own echo; other components of our systems are companions
        self._route(sender=(message.system, message.component), channel=channel)
        self.join(channel, time_ns)
        target = message.values.get("target_system", message.values.get("target", 0))
        arrival = Arrival(message, channel, time_ns, trusted)
        component = message.values.get("target_component", 0)
        is_for_autopilots = component in (0, COMPONENT_AUTOPILOT)
        self._forward(packet, target, component, channel, time_ns)
        if is_for_autopilots and not self._is_for_too_many(arrival, target):
            for number, services in self.services.items():
                if target in (0, number):
                    services.take(arrival, target == number)

    def _is_for_too_many(self, arrival: Arrival, target: int) -> bool:
        """Whether a message would steer several bodies at once; if so, reports it."""
        present = self.present()
        if target or arrival.message.name not in _STEERS_ONE or len(present) <= 1:
            return False
        for system in present:
            system.refuse(arrival.time_ns, f"target 0, and there are {len(present)} bodies")
        return True

    def _route(self, sender: Sender, channel: int) -> None:
        """Records that a sender was heard on a channel. Beyond the limit the longest silent sender is forgotten."""
        before = self._routes.pop(sender, None)
        self._routes[sender] = _Heard(channel, {} if before is None else before.came_ns)
        if len(self._routes) > _SENDERS:
            del self._routes[next(iter(self._routes))]

    def _forward(self, packet: Packet, target: int, component: int, channel: int, time_ns: int) -> None:
        """Forwards a packet to the channels on which its target system was heard (of ours: the target component, 0: all). A packet for all
        systems goes to every other channel on which a sender was heard.

        Streaming messages are not sent to busy channels: a companion computer's streams are too much for a radio.
        """
        if packet.message.name in _NEVER_FORWARDED:
            return
        wanted = {
            heard.channel for (system, part), heard in self._routes.items()
            if target in (0, system) and (target not in self.services or component in (0, part))
        }  # fmt: skip
        waits = self._busy if self._streams(packet.message, time_ns) else set()
        self._frames += [Outgoing(other, packet.raw) for other in wanted - {channel} - waits]

    def _streams(self, message: Message, time_ns: int) -> bool:
        """Whether a message has no target fields and came a moment ago too. A rare one may be an answer: some answers have no target."""
        if message.name in NEVER_WAITS or not _TARGETS.isdisjoint(message.values):
            return False
        came_ns = self._routes[message.system, message.component].came_ns
        before_ns, came_ns[message.name] = came_ns.get(message.name), time_ns
        return before_ns is not None and time_ns - before_ns < _STREAM_NS


def _dock_of(config: GroundConfig) -> DockRequest | None:
    if not config.dock_button:
        return None
    module, face, target_module, target_face = config.dock_button
    return DockRequest(module_index(module), face, module_index(target_module), target_face)
