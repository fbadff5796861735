"""How the previous process ended, from its log and e-stop note: which modules were in flight, which magnets pulled, whether an e-stop
stood. Decides which modules are therefore armed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.app.estop_note import estop_stands
from firmware_py.app.firmware import Firmware
from firmware_py.bus.codec import Codec
from firmware_py.core.joints import joints_of, sides
from firmware_py.core.transitions import State
from firmware_py.core.types import Mode
from firmware_py.description.fleet import Fleet
from firmware_py.description.signals import read_attachment
from firmware_py.runtime.flight_log import LoggedFrame, frame_of
from firmware_py.runtime.guarded_file import DATED_BACK_NS
from firmware_py.runtime.log_end import last_bodies
from firmware_py.runtime.log_folder import log_folders
from firmware_py.runtime.recorder import CAN_LOG, CONFIGURATION, SIGNAL_LOG

RECENT_NS = 60_000_000_000
"""Age beyond which a log says nothing about the present: the vehicle may be out of the water, in somebody's hands."""
TAIL_BYTES = 32_768
"""Bytes read from the end of can.log per module: 80 ticks. At 400 Hz DOCK_CMD comes every 40th tick, thruster commands every tick."""
_THRUSTERS = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
_ARMED = 1
_PULLS = 1

DOCKED_SINCE = (
    "were docked, or about to be, and their magnets let go: "
    "the fleet file has to say so (body, cell) before they fly as one or REARM arms them"
)
PARTED_SINCE = (
    "were told to let go of joints that the fleet file has: "
    "where they are apart it has to say so (body, cell); nobody is armed without a person"
)

STOPPED = (
    "the e-stop of the flight before was not cleared: nobody is armed without a person, "
    "who arms, sends CLEAR_ESTOP, or without a ground station types modcube clear-estop FOLDER (that of --out) before the next start"
)

TESTED = "were armed, but not in flight, when the process before ended (a motor test): a person arms them"

Face = tuple[int, int]
"""Fleet index and face."""


class LastFlight(NamedTuple):
    """The last commands of the previous process to its modules."""

    armed: frozenset[int] = frozenset()
    """Fleet indices of armed modules; empty if the machine was rebooted since, because no clock then tells how long ago that was."""
    pulling: frozenset[Face] = frozenset()
    """Every magnet that pulled."""
    let_go: frozenset[Face] = frozenset()
    """Every magnet whose last command was not to pull, and the faces of joints that were open when that process started, of modules that
    it did not fly."""
    stopped: bool = False
    """Whether an e-stop stands, from that process or an earlier one, that no person has cleared or armed after. Does not expire."""
    grounded: frozenset[int] = frozenset()
    """Numbers of the bodies that by their last record were not in flight, whatever their modules were told: a motor test arms too."""

    def docked(self, firmware: Firmware) -> frozenset[Face]:
        """Faces that are docked but belong to no joint of the fleet file."""
        return self.pulling - _joined_faces(firmware)

    def apart(self, firmware: Firmware) -> frozenset[Face]:
        """Faces of joints of the fleet file that were undocked."""
        return self.let_go & _joined_faces(firmware)


def last_flight(out: Path, fleet: Fleet, codec: Codec, now_ns: int, boot: str) -> LastFlight:
    """The end of the newest log under `out` in which anything was sent, and whether the note there says that an e-stop stands.

    An unreadable or old log says nothing, and nor do the logs before it.

    Args:
        now_ns: the time of day, to compare with that of the file.
        boot: identifies this boot of the machine, to compare with the log's.
    """
    stopped = estop_stands(out)
    for folder in log_folders(out):
        sent = _last_sent(folder, now_ns, TAIL_BYTES * len(fleet.module))
        if sent is None:
            break
        if sent:
            told = _told(sent, _notes_of(folder), fleet, codec, boot)._replace(stopped=stopped, grounded=_grounded(folder))
            return told._replace(armed=frozenset()) if _is_dated_back(folder / SIGNAL_LOG) else told
    return LastFlight(stopped=stopped)


def outdate(out: Path, now_ns: int) -> None:
    """Dates recent logs under `out` back to 1970, for a process that keeps no log: none of them tells how the last flight ended."""
    for folder in log_folders(out):
        with suppress(OSError):
            if _is_recent((folder / CAN_LOG).stat(), now_ns):
                os.utime(folder / CAN_LOG, ns=(DATED_BACK_NS, DATED_BACK_NS))


def _is_recent(status: os.stat_result, now_ns: int) -> bool:
    """Whether a log was written lately and not dated back; just after a start in 1970 its age does not tell the two apart."""
    return status.st_mtime_ns != DATED_BACK_NS and 0 <= now_ns - status.st_mtime_ns < RECENT_NS


def _is_dated_back(path: Path) -> bool:
    """Whether a log file was ended before its flight by an error (runtime.guarded_file), although the other may go on to its end."""
    try:
        return path.stat().st_mtime_ns == DATED_BACK_NS
    except OSError:
        return False


def to_arm(before: LastFlight, firmware: Firmware, hold: bool, say: Callable[[str], None]) -> set[int]:
    """Modules to arm without a person: all with `hold`; with REARM, those that were in flight when the previous process was killed.

    A body in a motor test was not in flight: it may lie on a bench. REARM arms none if modules were docked in flight: the fleet file has
    them apart, and its relays release them. Neither option arms any if modules were undocked in flight, because the fleet file has them as
    one body that no longer exists, or if an e-stop stands.
    """
    fleet, docked, apart = firmware.fleet, before.docked(firmware), before.apart(firmware)
    for faces, what in ((docked, DOCKED_SINCE), (apart, PARTED_SINCE)):
        if faces:
            modules = ", ".join(map(fleet.label, sorted({module for module, _ in faces})))
            say(f"warning: modules {modules} {what}")
    if before.stopped and (hold or firmware.parameters.supervision.rearm):
        say(f"warning: {STOPPED}")
        return set()
    if hold and not apart:
        return set(range(len(fleet.module)))
    if docked or apart or not firmware.parameters.supervision.rearm:
        return set()
    tested = before.armed & {module for body in firmware.pipeline.bodies if body.index in before.grounded for module in body.modules}
    if tested:
        say(f"warning: modules {', '.join(map(fleet.label, sorted(tested)))} {TESTED}")
    if before.armed - tested:
        say("the process before ended in flight: holding as soon as the vehicle may (REARM)")
    return set(before.armed - tested)


def _told(sent: Sequence[LoggedFrame], notes: dict[str, Any], fleet: Fleet, codec: Codec, boot: str) -> LastFlight:
    indices = {(module.bus, module.number): index for index, module in enumerate(fleet.module)}
    armed: dict[int, bool] = {}
    pulls: dict[Face, bool] = {}
    for frame in sent:
        message, index = codec.by_id(frame.id), indices.get((frame.bus, frame.id & 31))
        if message is None or index is None:
            continue
        if message.name in _THRUSTERS:
            armed[index] = dict(zip(message.fields, message.decode(frame.data), strict=True))["Mode"] == _ARMED
        elif message.name == "DOCK_CMD":
            pulls.update({(index, face): state == _PULLS for face, state in enumerate(message.decode(frame.data))})
    flown = frozenset(index for index, on in armed.items() if on)
    pulling = frozenset(face for face, on in pulls.items() if on)
    open_before = frozenset((module, face) for module, face in notes.get("apart", ()) if module not in flown)
    let_go = frozenset() if _magnets_rest(notes) else frozenset(pulls) - pulling
    return LastFlight(flown if boot and notes.get("boot") == boot else frozenset(), pulling, let_go | open_before)


def _grounded(folder: Path) -> frozenset[int]:
    """Numbers of the bodies whose last record in a log is of a motor test, or disarmed. An unreadable log names none; nor does it tell of
    the boot that `LastFlight.armed` needs."""
    with suppress(OSError):
        ends = last_bodies(folder / SIGNAL_LOG)
        return frozenset(body for body, end in ends.items() if end.mode == Mode.MOTOR_DETECT or end.state != State.ARMED)
    return frozenset()


def _magnets_rest(notes: dict[str, Any]) -> bool:
    """Whether the limiter switched magnets of joints off in turns, so that a magnet that is off was not necessarily told to let go."""
    try:
        return float(notes["parameters"]["limiter"]["relay_duty"]) < 1.0
    except (KeyError, TypeError, ValueError):
        return False


def _joined_faces(firmware: Firmware) -> frozenset[Face]:
    """Both faces of every joint in the fleet file."""
    return frozenset(side for body in firmware.pipeline.bodies for joint in joints_of(body) for side in sides(joint.request))


def _notes_of(folder: Path) -> dict[str, Any]:
    """The configuration attached to a log; empty where the log was torn before it."""
    with suppress(OSError, ValueError):
        found = json.loads(read_attachment(folder / SIGNAL_LOG, CONFIGURATION) or b"{}")
        return found if isinstance(found, dict) else {}
    return {}


def _last_sent(folder: Path, now_ns: int, most_bytes: int) -> list[LoggedFrame] | None:
    """Frames sent, from the end of a log; partial lines at either end are left out. None where the log is unreadable or old."""
    try:
        with (folder / CAN_LOG).open("rb") as file:
            status = os.fstat(file.fileno())
            file.seek(max(0, status.st_size - most_bytes))
            lines = file.read().decode("ascii", errors="replace").splitlines(keepends=True)
    except FileNotFoundError:
        return []  # that process ended while it started
    except OSError:
        return None
    if not _is_recent(status, now_ns):
        return None
    sent = []
    for line in lines:
        with suppress(ValueError):
            if line.endswith(" T\n"):
                sent.append(frame_of(line))
    return sent
