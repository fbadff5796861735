"""The mission protocol: upload, download, clear, set current. An upload that breaks off leaves the old mission unchanged.

Source: MAVLink developer guide, "Mission Protocol". The vehicle requests each item, and repeats the request when no item arrives.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from firmware_py.core.types import WARNING
from firmware_py.ground.mission_flight import MissionFlight
from firmware_py.ground.mission_items import CHANGE_SPEED, DELAY, JUMP, Item, item_of
from firmware_py.ground.system import Arrival, Handler, System

MOST_ITEMS = 500
_MISSION, _EVERY_KIND = 0, 255
"""MAV_MISSION_TYPE."""
_ACCEPTED, _UNSUPPORTED, _NO_SPACE, _INVALID_SEQUENCE, _DENIED, _CANCELLED = 0, 3, 4, 13, 14, 15
_ASK_AGAIN_NS, _MOST_ASKED = 250_000_000, 20
_ASKED_ALIKE = 4
"""Requests for an item in one form, INT or old, before the other form is tried. DroneKit understands only the old form; other clients
answer it with float32 degrees, which resolve a place to a metre, or refuse it.
"""
_FLIES = "it flies, and is not changed in part"
_SENDING = "another station is sending one"
_IMMEDIATE_CURRENT = (2, 3)
"""Values of `current` in an item outside a mission: ArduPilot's way to go to a place or to an altitude at once."""


@dataclass(slots=True)
class _Upload:
    """A mission upload in progress."""

    arrival: Arrival
    count: int
    """Number of items to be uploaded, plus those that stay before them."""
    items: list[Item] = field(default_factory=list)
    rest: tuple[Item, ...] = ()
    """Items that stay after the uploaded ones."""
    in_part: bool = False
    asked_ns: int = 0
    asked: int = 0
    """Requests made so far for the next item."""

    @property
    def in_old_form(self) -> bool:
        """Whether the last request was in the old form, MISSION_REQUEST."""
        return (self.asked - 1) // _ASKED_ALIKE % 2 == 1


class _Ended(NamedTuple):
    """The end of the last upload."""

    item: Arrival
    """The item that ended it."""
    result: int


class MissionService:
    """The transfers of one system."""

    def __init__(self, system: System, flight: MissionFlight) -> None:
        self._system, self._flight = system, flight
        self._upload: _Upload | None = None
        self._ended: _Ended | None = None

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {
            "MISSION_COUNT": self._count,
            "MISSION_WRITE_PARTIAL_LIST": self._write_part,
            "MISSION_REQUEST_PARTIAL_LIST": lambda a: self._acknowledge(a, _UNSUPPORTED),
            "MISSION_ITEM_INT": self._item,
            "MISSION_ITEM": self._item,
            "MISSION_REQUEST_LIST": self._list,
            "MISSION_REQUEST_INT": self._request,
            "MISSION_REQUEST": self._request,
            "MISSION_ACK": self._acknowledged,
            "MISSION_CLEAR_ALL": self._clear,
            "MISSION_SET_CURRENT": self._set_current,
        }

    def step(self, time_ns: int) -> None:
        """Repeats the request for an item that did not arrive; gives the upload up after too many requests."""
        upload = self._upload
        if upload is None or time_ns - upload.asked_ns < _ASK_AGAIN_NS:
            return
        if upload.asked >= _MOST_ASKED:
            self._upload = None
            self._system.say(WARNING, "mission transfer broke off: the old mission stays")
            self._acknowledge(upload.arrival, _CANCELLED)
        else:
            self._ask(upload, time_ns)

    # ------------------------------------------------------------ upload

    def _count(self, arrival: Arrival) -> None:
        count = arrival.message["count"]
        if not _is_of_mission(arrival):  # fences and rally points are not stored; an empty list is accepted
            self._acknowledge(arrival, _UNSUPPORTED if count else _ACCEPTED)
        elif count > MOST_ITEMS:
            self._acknowledge(arrival, _NO_SPACE)
        elif reason := self._upload_refusal(arrival):
            self._deny(arrival, reason)
        elif count == 0:
            self._drop_mission(arrival)
        else:
            self._upload = _Upload(arrival, count)
            self._ask(self._upload, arrival.time_ns)

    def _write_part(self, arrival: Arrival) -> None:
        """Starts to replace a range of items in a mission that is not being flown; the items before and after the range stay."""
        first, last, known = arrival.message["start_index"], arrival.message["end_index"], self._flight.items
        if not _is_of_mission(arrival):
            self._acknowledge(arrival, _UNSUPPORTED)
        elif not 0 <= first <= last < len(known):
            self._acknowledge(arrival, _INVALID_SEQUENCE)
        elif reason := _FLIES if self._flight.flies else self._upload_refusal(arrival):
            self._deny(arrival, reason)
        else:
            self._upload = _Upload(arrival, last + 1, list(known[:first]), known[last + 1 :], in_part=True)
            self._ask(self._upload, arrival.time_ns)

    def _upload_refusal(self, arrival: Arrival) -> str:
        """Returns why this client may not upload a mission now; empty if it may."""
        if self._system.is_ambiguous_broadcast(arrival):
            return "it is for all, and there are several bodies"  # they would fly to the same place
        return _SENDING if self._upload is not None and not _same(self._upload.arrival, arrival) else ""

    def _is_of_another_station(self, arrival: Arrival, upload: _Upload) -> bool:
        """Whether a message comes from another station than an upload: another sender, or its namesake on another channel that is there."""
        other_channel = arrival.channel != upload.arrival.channel and upload.arrival.channel in self._system.channels
        return other_channel or not _same(upload.arrival, arrival)

    def _deny(self, arrival: Arrival, reason: str) -> None:
        self._system.say(WARNING, f"mission refused: {reason}")
        self._acknowledge(arrival, _DENIED)

    def _ask(self, upload: _Upload, time_ns: int) -> None:
        upload.asked, upload.asked_ns = upload.asked + 1, time_ns
        values = {"seq": len(upload.items), "mission_type": _MISSION, **upload.arrival.sender}
        self._system.send(upload.arrival.channel, "MISSION_REQUEST" if upload.in_old_form else "MISSION_REQUEST_INT", values)

    def _item(self, arrival: Arrival) -> None:
        upload = self._upload
        if upload is None or not _belongs_to(arrival, upload):
            self._item_outside_upload(arrival)
            return
        sequence = arrival.message["seq"]
        if sequence != len(upload.items):
            return  # a duplicate, or an item was lost: the missing one is requested again
        item, fault = item_of(arrival.message)
        why = f"command {item.command}, frame {item.frame}"
        if not fault:
            fault, why = self._flight.check_fence(item)
        if fault:
            self._system.say(WARNING, f"mission refused: item {sequence}, {why}")
            self._end(arrival, fault)
            return
        upload.items.append(item)
        upload.asked = 0
        if len(upload.items) < upload.count:
            self._ask(upload, arrival.time_ns)
            return
        if upload.in_part and self._flight.flies:  # the mission was started meanwhile
            self._system.say(WARNING, f"mission refused: {_FLIES}")
            self._end(arrival, _DENIED)
            return
        (self._flight.amend if upload.in_part else self._flight.replace)((*upload.items, *upload.rest))
        self._end(arrival, _ACCEPTED)

    def _item_outside_upload(self, arrival: Arrival) -> None:
        """Answers an item outside the upload in progress: a repeat of the item that ended the last one, or a place to go to at once.

        An item is repeated when the answer to it was lost.
        """
        if self._ended is not None and _is_repeat(arrival, self._ended.item):
            self._acknowledge(arrival, self._ended.result)
        elif arrival.message["current"] in _IMMEDIATE_CURRENT:
            self._system.say(WARNING, "a place is gone to at once by DO_REPOSITION, as COMMAND_INT")
            self._acknowledge(arrival, _UNSUPPORTED)

    def _end(self, arrival: Arrival, result: int) -> None:
        self._upload, self._ended = None, _Ended(arrival, result)
        self._acknowledge(arrival, result)

    def _clear(self, arrival: Arrival) -> None:
        if arrival.message["mission_type"] not in (_MISSION, _EVERY_KIND):
            self._acknowledge(arrival, _ACCEPTED)
        elif self._upload is not None and self._is_of_another_station(arrival, self._upload):
            self._deny(arrival, _SENDING)
        else:
            self._drop_mission(arrival)

    def _drop_mission(self, arrival: Arrival) -> None:
        self._upload = self._ended = None
        self._flight.replace(())
        self._acknowledge(arrival, _ACCEPTED)

    def _acknowledged(self, arrival: Arrival) -> None:
        """Takes MISSION_ACK: no effect after a download; cancels an upload, unless it concerns fences or rally points."""
        upload, m = self._upload, arrival.message
        if upload is None or not _belongs_to(arrival, upload) or m["type"] == _ACCEPTED:
            return
        if not (m["type"] == _UNSUPPORTED and upload.in_old_form):  # MAVSDK refuses the old form this way, and continues
            self._upload = None

    # ------------------------------------------------------------ download

    def _list(self, arrival: Arrival) -> None:
        count = len(self._flight.items) if _is_of_mission(arrival) else 0
        values = {"count": count, "mission_type": arrival.message["mission_type"], **arrival.sender}
        self._system.send(arrival.channel, "MISSION_COUNT", values)

    def _request(self, arrival: Arrival) -> None:
        sequence = arrival.message["seq"]
        if not _is_of_mission(arrival) or sequence not in range(len(self._flight.items)):
            self._acknowledge(arrival, _INVALID_SEQUENCE)
            return
        item = self._flight.items[sequence]
        whole = arrival.message.name == "MISSION_REQUEST_INT"
        values = {
            "seq": sequence, "command": item.command, "frame": _sent_frame(item, whole),
            "autocontinue": item.autocontinue,
            "current": int(sequence == self._system.subject.progress.current),
            **{f"param{i + 1}": value for i, value in enumerate(item.parameters)},
            "x": item.x if whole or not item.is_place else item.x * 1e-7,
            "y": item.y if whole or not item.is_place else item.y * 1e-7,
            "z": item.z, "mission_type": _MISSION, **arrival.sender,
        }  # fmt: skip
        self._system.send(arrival.channel, "MISSION_ITEM_INT" if whole else "MISSION_ITEM", values)

    def _set_current(self, arrival: Arrival) -> None:
        reason = self._flight.jump(arrival.message["seq"])
        if reason:
            self._system.say(WARNING, f"mission refused: {reason}")

    def _acknowledge(self, arrival: Arrival, result: int) -> None:
        values = {"type": result, "mission_type": arrival.message["mission_type"], **arrival.sender}
        self._system.send(arrival.channel, "MISSION_ACK", values)


def _sent_frame(item: Item, whole: bool) -> int:
    """Returns the item's MAV_FRAME for a download: the INT variant for MISSION_ITEM_INT (`whole`), else the plain one."""
    if item.command in (DELAY, JUMP, CHANGE_SPEED):
        return item.frame
    pairs = {0: 5, 3: 6} if whole else {5: 0, 6: 3}
    return pairs.get(item.frame, item.frame)


def _is_repeat(item: Arrival, before: Arrival) -> bool:
    return _same(item, before) and all(item.message[name] == before.message[name] for name in ("seq", "mission_type"))


def _belongs_to(arrival: Arrival, upload: _Upload) -> bool:
    """Whether a message belongs to the upload. Stations may share a system id, as all QGroundControls do; the channel tells them apart."""
    told = _same(upload.arrival, arrival) and arrival.channel == upload.arrival.channel
    return told and _is_of_mission(arrival)


def _is_of_mission(arrival: Arrival) -> bool:
    """Whether a message is about the mission, and not about fences or rally points."""
    return bool(arrival.message["mission_type"] == _MISSION)


def _same(a: Arrival, b: Arrival) -> bool:
    """Whether both came from the same client."""
    return (a.message.system, a.message.component) == (b.message.system, b.message.component)
