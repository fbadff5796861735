"""Presence: watch over the ground station that must not be lost, TIMESYNC, PING, capabilities, set-up of the signing key."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from firmware_py.core.types import INFORMATION, WARNING, Action
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.identity import NAMES, SETTABLE
from firmware_py.ground.pilots import Sender, sender_of
from firmware_py.ground.signing import KEY_BYTES, Signing
from firmware_py.ground.system import NS_PER_S, Arrival, Handler, System

TYPE_GROUND_STATION = 6
_NAK, _OPEN_TO_READ, _UNKNOWN_COMMAND, _FILE_NOT_FOUND = 129, 4, 7, 10
"""Codes of the file transfer protocol."""
_NOT_SELECTABLE = 2
"""MAV_MODE_PROPERTY: a mode that no person may select, named so that a station knows it when it comes."""
CAPABILITIES = 0x2 | 0x4 | 0x8 | 0x40 | 0x80 | 0x800 | 0x2000
"""MAV_PROTOCOL_CAPABILITY: float parameters, MISSION_INT, COMMAND_INT, set-points of attitude and of local position,
flight termination, MAVLINK2. Neither form of integer parameters is claimed."""
VERSION = 0x00010000
"""0.1.0, as FIRMWARE_VERSION_TYPE packs it."""


@dataclass(slots=True)
class Watch:
    """The ground station that must not be lost. Shared by all bodies: a heartbeat that one of them hears counts for all."""

    station: Sender | None = None
    heard_ns: int = 0


class Presence:
    """Presence of one system, and its watch over the ground station."""

    def __init__(
        self, system: System, config: GroundConfig, parameters: Callable[[], Parameters], signing: Signing, watch: Watch
    ) -> None:
        self._system, self._config, self._parameters, self._signing = system, config, parameters, signing
        self._watch = watch

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {
            "HEARTBEAT": self._heartbeat,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
            "SETUP_SIGNING": self._setup_signing,
            "FILE_TRANSFER_PROTOCOL": self._no_files,
        }

    def _heartbeat(self, arrival: Arrival) -> None:
        """Takes a heartbeat, which counts only if it is a ground station's, and exactly that of the watched one."""
        station = system, component = sender_of(arrival)
        if arrival.message["type"] != TYPE_GROUND_STATION or not self._config.watches(system, component):
            return
        watch, patience_ns = self._watch, self._parameters().ground.watch_s * NS_PER_S
        if watch.station is None or arrival.time_ns - watch.heard_ns > patience_ns:
            if watch.station != station:
                self._system.say(INFORMATION, f"ground station {system}/{component} is watched")
            watch.station = station
        if watch.station == station:
            watch.heard_ns = arrival.time_ns
            self._system.ask(Action.GROUND_ALIVE)

    def _timesync(self, arrival: Arrival) -> None:
        if arrival.message["tc1"] == 0:
            values = {"tc1": arrival.time_ns, "ts1": arrival.message["ts1"]}
            self._system.send(arrival.channel, "TIMESYNC", values)

    def _ping(self, arrival: Arrival) -> None:
        m = arrival.message
        if m["target_system"] == 0:
            values = {"time_usec": m["time_usec"], "seq": m["seq"], **arrival.sender}
            self._system.send(arrival.channel, "PING", values)

    def _setup_signing(self, arrival: Arrival) -> None:
        """Sets the signing key, only while every body is disarmed, on a trusted link, and with a store: a key that is forgotten at the next
        start would lock nothing. The message is never forwarded or acknowledged.
        """
        m = arrival.message
        if self._system.subject.picture.any_armed or not arrival.trusted:
            self._system.say(WARNING, "signing refused: only disarmed, and on a trusted link")
            return
        if self._signing.is_ahead(m["initial_timestamp"]):
            self._system.say(WARNING, "signing refused: its time stamp is more than a minute ahead of the clock here")
            return
        key = bytes(m["secret_key"])
        if any(key) and self._config.key_file is None:
            self._system.say(WARNING, "signing refused: no --store to keep the key in")
            return
        if len(key) == KEY_BYTES:
            self._signing.adopt(key, m["initial_timestamp"])
            self._system.say(INFORMATION, "signing key set" if any(key) else "signing is off")

    def _no_files(self, arrival: Arrival) -> None:
        """Refuses file transfer at once, since there is no file service: clients fall back to parameters without a timeout."""
        asked = bytes(arrival.message["payload"])
        low, high = ((asked[0] | asked[1] << 8) + 1 & 0xFFFF).to_bytes(2, "little")
        reason = _FILE_NOT_FOUND if asked[3] == _OPEN_TO_READ else _UNKNOWN_COMMAND
        payload = bytes([low, high, asked[2], _NAK, 1, asked[3], 0, 0, 0, 0, 0, 0, reason]).ljust(len(asked), b"\0")
        values = {"target_network": 0, **arrival.sender, "payload": tuple(payload)}
        self._system.send(arrival.channel, "FILE_TRANSFER_PROTOCOL", values)

    def autopilot_version(self, arrival: Arrival) -> bool:
        """Answers a request for AUTOPILOT_VERSION."""
        values = {
            "capabilities": CAPABILITIES, "flight_sw_version": VERSION, "uid": self._system.body + 1,
        }  # fmt: skip
        self._system.send(arrival.channel, "AUTOPILOT_VERSION", values)
        return True

    def available_modes(self, arrival: Arrival) -> bool:
        """Answers a request for AVAILABLE_MODES: one mode by its index, or all modes for index 0. Returns whether the index exists."""
        index, count = arrival.message["index"], len(NAMES)
        if index not in range(count + 1):
            return False
        for number in [index] if index else range(1, count + 1):
            mode = tuple(NAMES)[number - 1]
            values = {
                "number_modes": count, "mode_index": number, "standard_mode": 0,
                "custom_mode": self._system.subject.identity.custom_mode(mode),
                "properties": 0 if mode in SETTABLE else _NOT_SELECTABLE,
                "mode_name": NAMES[mode],
            }  # fmt: skip
            self._system.send(arrival.channel, "AVAILABLE_MODES", values)
        return True
