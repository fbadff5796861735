"""Requests of clients for messages: rates of streams, and single messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import chain

from firmware_py.ground.command import ACCEPTED, DENIED, UNSUPPORTED, Answer, Command
from firmware_py.ground.system import NS_PER_S, Arrival, Handler, System
from firmware_py.ground.telemetry import DEFAULT_HZ, STREAMS

GET_HOME_POSITION, GET_MESSAGE_INTERVAL, SET_MESSAGE_INTERVAL, REQUEST_MESSAGE, REQUEST_CAPABILITIES = 410, 510, 511, 512, 520
"""MAV_CMD; the last is REQUEST_AUTOPILOT_CAPABILITIES."""
_STOP, _START = 0, 1
_GROUPS: Mapping[int, tuple[str, ...]] = {
    1: ("SCALED_PRESSURE", "SCALED_PRESSURE2"),  # RAW_SENSORS
    2: ("SYS_STATUS", "MISSION_CURRENT", "GPS_RAW_INT", "NAMED_VALUE_FLOAT"),  # EXTENDED_STATUS
    3: ("SERVO_OUTPUT_RAW",),  # RC_CHANNELS
    6: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),  # POSITION
    10: ("ATTITUDE",),  # EXTRA1
    11: ("VFR_HUD",),  # EXTRA2
    12: ("SYSTEM_TIME", "BATTERY_STATUS"),  # EXTRA3
}
"""Messages of each MAV_DATA_STREAM in ArduSub, as far as they exist here."""
_ALL = 0
_NAMES_OF = {_ALL: tuple(chain.from_iterable(_GROUPS.values())), **_GROUPS}


class MessageRequests:
    """Requests for messages of one system."""

    def __init__(self, system: System, extra: Mapping[str, Callable[[Arrival], bool]]) -> None:
        """`extra` answers REQUEST_MESSAGE for messages that are not streamed; False means that it cannot."""
        self._system, self._extra = system, extra

    def table(self) -> dict[int, Callable[[Command], Answer]]:
        """Command handlers by command number."""
        return {
            GET_HOME_POSITION: lambda c: self._request(c, "HOME_POSITION"),
            GET_MESSAGE_INTERVAL: self._get_interval,
            SET_MESSAGE_INTERVAL: self._set_interval,
            REQUEST_MESSAGE: self._request_message,
            REQUEST_CAPABILITIES: lambda c: self._request(c, "AUTOPILOT_VERSION"),
        }

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {"REQUEST_DATA_STREAM": self._set_group}

    def _set_group(self, arrival: Arrival) -> None:
        """Takes REQUEST_DATA_STREAM, the old way of QGroundControl, MAVProxy and many scripts with an ArduSub; it has no answer."""
        m, rates = arrival.message, self._system.channels[arrival.channel]
        if m["start_stop"] not in (_STOP, _START):
            return
        hz = m["req_message_rate"] * m["start_stop"]
        for name in _NAMES_OF.get(m["req_stream_id"], ()):
            rates.set(name, round(NS_PER_S / hz) if hz else 0, arrival.time_ns)

    def _set_interval(self, command: Command) -> Answer:
        name = self._name(command.get(1))
        if name not in STREAMS:
            return UNSUPPORTED
        interval_us = command.get(2)
        rates = self._system.channels[command.arrival.channel]
        if interval_us == 0:
            hz = DEFAULT_HZ.get(name, 0.0)
            interval_ns = round(NS_PER_S / hz) if hz else 0
        else:
            interval_ns = max(round(interval_us * 1e3), 0)
        if name == "HEARTBEAT" and not 0 < interval_ns <= NS_PER_S:
            return DENIED  # without it clients lose the vehicle
        rates.set(name, interval_ns, command.arrival.time_ns)
        return ACCEPTED

    def _get_interval(self, command: Command) -> Answer:
        name = self._name(command.get(1))
        if name not in STREAMS:
            return UNSUPPORTED
        interval_ns = self._system.channels[command.arrival.channel].intervals_ns.get(name, 0)
        interval_us = interval_ns // 1000 if interval_ns else -1
        values = {"message_id": int(command.get(1)), "interval_us": interval_us}
        self._system.send(command.arrival.channel, "MESSAGE_INTERVAL", values)
        return ACCEPTED

    def _request_message(self, command: Command) -> Answer:
        return self._request(command, self._name(command.get(1)), command.get(2))

    def _request(self, command: Command, name: str, index: float = 0.0) -> Answer:
        if name in self._extra:
            message = replace(command.arrival.message, values={"index": int(index)})
            return ACCEPTED if self._extra[name](command.arrival._replace(message=message)) else DENIED
        if name not in STREAMS or self._system.body not in self._system.subject.picture.records:
            return UNSUPPORTED
        for values in STREAMS[name](self._system.subject):
            self._system.send(command.arrival.channel, name, values)
        return ACCEPTED

    def _name(self, number: float) -> str:
        return self._system.outbox.name_of(int(number))
