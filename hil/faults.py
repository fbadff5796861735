"""Fault injection in the plant and on its wire, from the scenario's [[fault]]s or live.

Faults begin and end on the plant's clock. Each direction of the wire draws from its own random stream, so that an additional fault
in one leaves the other unchanged. The controller is never modified.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from firmware_py.bus.codec import Frame
from firmware_py.core import rotations
from firmware_py.description.schema import DescriptionError
from hil.mcu import Mcu
from hil.nodes import Nodes
from hil.plant.camera import Sighting
from hil.plant.docking import RELAY
from hil.plant.draw import stream
from hil.plant.fault_spec import ALL, DIRECTIONS, FACES, FRAME_KINDS, NS, THRUSTER_KINDS, Fault

NUMBER = 0x1F
"""Mask of the module number in a CAN id."""
LOWEST_BABBLE_ID = 0x040
"""Lowest id of a babbling node, above ESTOP and SYNC, which have fault kinds of their own."""
SYNC = Frame(0x020, bytes(4))
"""Frame of a second bus master."""
PUSH_LEVER_M = 0.03
"""Lever from the hull's centre to the point of an external push."""


class Wire:
    """Faults on the frames of one direction."""

    def __init__(self, seed: int, direction: str) -> None:
        self._direction = direction
        self._rng = stream(seed, "faults", DIRECTIONS.index(direction))
        self._late: deque[tuple[int, Frame]] = deque()
        self._changes: dict[str, Callable[[list[Frame]], list[Frame]]] = {
            "frame_loss": lambda copies: [],
            "frame_duplicate": lambda copies: copies + copies,
            "frame_corrupt": lambda copies: [self._corrupted(copy) for copy in copies],
        }

    @property
    def kinds(self) -> set[str]:
        """Kinds of fault of a wire."""
        return {*self._changes, "frame_delay", "babble"}

    def pass_on(self, frames: Iterable[Frame], faults: Sequence[Fault], time_ns: int) -> list[Frame]:
        """Returns the frames that leave the wire now, those due after a delay first."""
        mine = [f for f in faults if f.direction in (self._direction, "both")]
        if not mine and not self._late:
            return list(frames)
        out = [frame for due, frame in self._late if due <= time_ns]
        self._late = deque((due, frame) for due, frame in self._late if due > time_ns)
        for frame in frames:
            out += self._one(frame, [f for f in mine if f.module in (0, frame.id & NUMBER)], time_ns)
        for fault in mine:
            if fault.kind == "babble" and self._direction == "from_plant":
                out += [self._babble() for _ in range(round(fault.value))]
        return out

    def _one(self, frame: Frame, faults: Sequence[Fault], time_ns: int) -> list[Frame]:
        """Returns the frames that leave at once for one frame sent. Delays add up and are applied last, whatever their order."""
        copies, late_ns = [frame], 0
        for fault in faults:
            if fault.kind == "frame_delay":
                late_ns += round(1e6 * fault.value)
            elif fault.kind != "babble" and self._rng.random() < fault.value:
                copies = self._changes[fault.kind](copies)
        if not late_ns:
            return copies
        self._late += [(time_ns + late_ns, copy) for copy in copies]
        return []

    def _corrupted(self, frame: Frame) -> Frame:
        """Flips one random bit of the data; returns a frame without data unchanged."""
        if not frame.data:
            return frame
        data = bytearray(frame.data)
        bit = int(self._rng.integers(8 * len(data)))
        data[bit // 8] ^= 1 << (bit % 8)
        return Frame(frame.id, bytes(data))

    def _babble(self) -> Frame:
        length = int(self._rng.integers(0, 9))
        return Frame(int(self._rng.integers(LOWEST_BABBLE_ID, 0x800)), self._rng.bytes(length))


class Faults:
    """All faults of one run, on one bus."""

    def __init__(self, nodes: Nodes, faults: Sequence[Fault] = ()) -> None:
        self._nodes, self._world = nodes, nodes.world
        self._faults = list(faults)
        self._on: list[Fault] = []
        seed = self._world.seed
        self._to_plant, self._from_plant = Wire(seed, "to_plant"), Wire(seed, "from_plant")
        self._tags = stream(seed, "faults", 1024)
        axis = self._tags.standard_normal(3)
        self._bias_axis = axis / np.linalg.norm(axis)
        vectors = stream(seed, "push").standard_normal((2, 3))
        self._push_direction, self._push_arm = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        self._breaks: dict[str, Callable[[Fault, Mcu], None]] = {
            **dict.fromkeys(THRUSTER_KINDS, self._break_thrusters),
            "imu_frozen": lambda fault, mcu: setattr(mcu, "imu_frozen", True),
            "pressure_jump": lambda fault, mcu: mcu.depth.err(fault.value, 0.0, 0),
            "pressure_drift": lambda fault, mcu: mcu.depth.err(0.0, fault.value, round(fault.at_s * NS)),
            "pressure_frozen": lambda fault, mcu: setattr(mcu.depth, "frozen", True),
            "pressure_absent": lambda fault, mcu: setattr(mcu.depth, "absent", True),
            "leak": lambda fault, mcu: setattr(mcu, "leaks", True),
            "readings_absent": lambda fault, mcu: setattr(mcu, "readings_absent", True),
            "battery_sag": lambda fault, mcu: self._world.sag(mcu.module, fault.value),
            "magnet": self._stick_magnets,
            "jets": lambda fault, mcu: setattr(self._world, "jet_strength", fault.value),
            "push": self._push,
        }
        self._intruders: dict[str, Callable[[], list[Frame]]] = {
            "foreign_sync": lambda: [SYNC],
            "foreign_command": self._command_relays,
        }
        """Frames of each foreign node in a tick."""
        self._box = {"estop": "pressed", "estop_box_silent": "silent"}
        """Attribute of the e-stop box that is true during the fault."""
        self._misreads: dict[str, Callable[[Sighting, float], Sighting | None]] = {
            "tag_flip": lambda sighting, share: sighting._replace(q_wt=_flipped(sighting)) if self._tags.random() < share else sighting,
            "tag_jump": lambda sighting, north_m: sighting._replace(p_wt=sighting.p_wt + np.array([north_m, 0.0, 0.0])),
            "tag_absent": lambda sighting, _: None,
            "camera_bias": lambda sighting, off_m: sighting._replace(p_wt=sighting.p_wt + off_m * self._bias_axis),
        }
        """What cameras make of a sighting, by the value of the fault; None: lost."""
        self._commands = 0
        self._dock_command = nodes.codec.message("DOCK_CMD")
        for camera in nodes.cameras:
            camera.change = self._change_tag

    @property
    def carried_out(self) -> set[str]:
        """Kinds of fault that have an effect: in the plant, before the cameras, by other nodes, on the wire, or of the process."""
        return {*self._breaks, *self._misreads, *self._intruders, *self._box, *self._to_plant.kinds, "process_killed"}

    def add(self, fault: Fault) -> None:
        """Adds a fault live. Raises DescriptionError for one that would have no effect."""
        thrusters = {number: len(self._world.vehicles[mcu.module].thruster) for number, mcu in self._nodes.mcus.items()}
        if not thrusters:
            raise DescriptionError(f"fault.kind: no MCU of the plant's own is there for {fault.kind}; C nodes have no faults")
        for key, what in fault.mistakes(thrusters, self._nodes.box.beats):
            raise DescriptionError(f"fault.{key}: {what}")
        self._faults.append(fault)

    def clear(self, kind: str = "") -> None:
        """Ends all faults of a kind; of every kind when `kind` is empty."""
        self._faults = [f for f in self._faults if kind and f.kind != kind]
        self.update(self._world.time_ns)

    def process_killed(self, time_ns: int) -> bool:
        """Whether the firmware's process should be dead now; the bench kills it."""
        return any(f.kind == "process_killed" and f.is_on(time_ns) for f in self._faults)

    def update(self, time_ns: int) -> None:
        """Begins and ends faults that are due. Call after every advance of the world."""
        on = [f for f in self._faults if f.is_on(time_ns)]
        if on != self._on:
            self._on = on
            self._break_plant()

    def incoming(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns the frames to the plant as they arrive."""
        return self._to_plant.pass_on(frames, [f for f in self._on if f.kind in FRAME_KINDS], time_ns)

    def outgoing(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns the frames from the plant as they leave."""
        return self._from_plant.pass_on(frames, [f for f in self._on if f.kind in FRAME_KINDS and f.kind != "babble"], time_ns)

    def unasked(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns `frames`, those of foreign nodes and the other nodes' answers to them. The lower CAN id wins arbitration."""
        kinds = {f.kind for f in self._on}
        foreign = [frame for kind, speak in self._intruders.items() if kind in kinds for frame in speak()]
        frames = sorted([*frames, *foreign], key=lambda frame: frame.id)
        frames += [answer for frame in frames for answer in self._nodes.take(frame, time_ns)]
        return self._from_plant.pass_on(frames, [f for f in self._on if f.kind in FRAME_KINDS], time_ns)

    def _command_relays(self) -> list[Frame]:
        """Frames of a second controller that commands every relay off."""
        self._commands += 1
        return [self._dock_command.encode(number, [0] * FACES, self._commands & 15) for number in self._nodes.mcus]

    # ------------------------------------------------------------ in the plant

    def _modules(self, fault: Fault) -> list[int]:
        return [mcu.module for number, mcu in self._nodes.mcus.items() if fault.module in (0, number)]

    def _break_plant(self) -> None:
        """Applies the active faults from scratch, independent of history: repairs everything, then applies each fault.

        Of two faults on the same part the later in the list wins; sags, pushes and errors of a pressure add up.
        """
        self._world.jet_strength = self._world.spec.jet_strength
        for kind, attribute in self._box.items():
            setattr(self._nodes.box, attribute, any(fault.kind == kind for fault in self._on))
        for number, mcu in self._nodes.mcus.items():
            mcu.imu_frozen = mcu.leaks = mcu.readings_absent = False
            mcu.depth.repair()
            self._world.clear_faults(mcu.module)
            for fault in self._on:
                if fault.kind in self._breaks and fault.module in (0, number):
                    self._breaks[fault.kind](fault, mcu)
            self._world.docks.apply_stuck(mcu.module)

    def _break_thrusters(self, fault: Fault, mcu: Mcu) -> None:
        for t in range(len(self._world.vehicles[mcu.module].thruster)):
            if fault.index in (ALL, t):
                self._world.break_thruster(mcu.module, t, fault.kind.removeprefix("thruster_"), fault.value)

    def _push(self, fault: Fault, mcu: Mcu) -> None:
        """Adds an external push on a point off the hull's centre: a force and a moment."""
        moment = PUSH_LEVER_M * np.cross(self._push_arm, self._push_direction)
        self._world.push[mcu.module] += fault.value * np.concatenate([self._push_direction, moment])

    def _stick_magnets(self, fault: Fault, mcu: Mcu) -> None:
        for face in range(FACES) if fault.index == ALL else (fault.index,):
            self._world.docks.stick_relay(mcu.module, face, RELAY.index(fault.value))

    def _change_tag(self, sighting: Sighting, carrier: int) -> Sighting | None:
        """Applies the faults to a sighting, world frame, by a camera on the module `carrier` (-1: a fixed camera); None: lost.

        Faults of the carrier are skipped: they are already in its own sighting, by which this one was placed, and must count only once.
        """
        for fault in self._on:
            modules = self._modules(fault)
            if fault.kind not in self._misreads or sighting.module not in modules or carrier in modules:
                continue
            seen = self._misreads[fault.kind](sighting, fault.value)
            if seen is None:
                return None
            sighting = seen
        return sighting


TILT_RAD = math.radians(40.0)
"""A flipped tag appears turned about an axis in its plane by twice the angle of incidence; here for an incidence of 20 deg."""


def _flipped(sighting: Sighting) -> np.ndarray:
    """(4,) attitude of the ambiguous second pose of a planar tag: the sighting's, turned by `TILT_RAD` about the tag's x axis."""
    tilt = rotations.exp(np.array([TILT_RAD, 0.0, 0.0]))
    return np.asarray(rotations.normalise(rotations.multiply(sighting.q_wt, tilt)))
