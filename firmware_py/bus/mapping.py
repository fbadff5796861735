"""Frames <-> the values of a tick: InputCollector makes Inputs from received frames, OutputEncoder makes frames from Outputs.

Sits at both ends of a tick, between the ports and the pipeline. Has no clock: the loop passes the time at which SYNC went out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from operator import truediv

import numpy as np

from firmware_py.bus.codec import Codec, Frame, Receiver, unpack_quaternion
from firmware_py.bus.codec.receiver import COUNTER, MESSAGE, NUMBER, VALUES
from firmware_py.bus.load import BIT_RATE, bits_of
from firmware_py.core.types import CHANNELS, MCU_ESTOP, DockFeedback, EscFeedback, Inputs, ModuleInputs, Outputs, Request, TagObservation
from firmware_py.description.fleet import Fleet

STALE_NS = 500_000_000
"""A tag picture older than this is dropped."""
NS_PER_MS = 1_000_000
REMEMBERED_TICKS = 256
"""CaptureTick has 8 bits."""
OFFSET_SATURATED_MS = 25.5
"""Largest CaptureOffset: sent when the camera missed SYNCs, so the time of the picture is unknown."""
ESTOP_BOX = 30
"""Number of the e-stop box. Nodes with such a number send HEARTBEAT and ESTOP alone."""
WORKING = (1, 2)
"""NodeState OK and WARNING of a HEARTBEAT."""
USABLE_STATUS = (0, 1)
"""Sensor status OK and SATURATED; a stale or failed sensor's values are not passed on."""
SENSOR_FAULT = 15
FOREIGN = frozenset(("ESTOP", "SYNC", "DOCK_CMD", "THRUSTER_CMD_A", "THRUSTER_CMD_B", "HEARTBEAT"))
"""Messages that no module sends; what another node says with them, `InputCollector` takes without a handler."""
THRUSTERS_OF_A_FRAME = 4
WITHOUT_BIT_RATE = ("virtual:", "udp:")
"""Kinds of buses that take as many frames as one sends."""
ESTOP_PERIOD_NS = 50_000_000
"""ESTOP goes out at 20 Hz while it is raised."""

Row = list[float]
"""A checked frame: message, number, counter, values (bus.codec.receiver)."""


class InputCollector:
    """Collects the frames of all buses; `collect` returns those since the previous call, as one Inputs.

    Attributes:
        faults: frames that passed the codec's checks and were not used, by kind: `module` (not in the fleet),
            `tag_unpaired`, `tag_stale`, `tag_future`, `sensor` (its status says fault or stale), `foreign_sync` and
            `foreign_command` (another node controls this bus).
        without_status: fleet indices of modules that have not sent MCU_STATUS yet.
    """

    def __init__(self, fleet: Fleet, codec: Codec) -> None:
        self._receivers = [Receiver(codec) for _ in fleet.buses]
        self._bits = [0] * len(fleet.buses)
        self._bit_rates = [math.inf if address.startswith(WITHOUT_BIT_RATE) else float(BIT_RATE) for address in fleet.buses]
        self._index = {(module.bus, module.number): index for index, module in enumerate(fleet.module)}
        self._modules = [ModuleInputs() for _ in fleet.module]
        self._status_ticks: list[int | None] = [None] * len(fleet.module)
        self._sync_ns: list[int | None] = [None] * REMEMBERED_TICKS
        self._halves: dict[tuple[int, float], tuple[Row, int]] = {}
        self._collections = 0
        self._estop = self._foreign_sync = self._foreign_command = self._estop_box = False
        kinds = ("module", "tag_unpaired", "tag_stale", "tag_future", "sensor", "foreign_sync", "foreign_command")
        self.faults: dict[str, int] = dict.fromkeys(kinds, 0)
        self.without_status = set(range(len(fleet.module)))
        named = self._make_handlers()
        self._handlers = [None if message.name in FOREIGN else named[message.name] for message in codec.messages]
        self._names = [message.name for message in codec.messages]
        self._tag_position = self._names.index("TAG_POSITION")
        self._from_camera = frozenset((self._tag_position, self._names.index("TAG_ATTITUDE")))
        """Messages of the camera: no sign of life of the module whose number they carry."""

    @property
    def dropped(self) -> dict[str, int]:
        """Frames dropped by the codec so far, by kind, all buses together."""
        kinds = self._receivers[0].dropped
        return {kind: sum(receiver.dropped[kind] for receiver in self._receivers) for kind in kinds}

    @property
    def unused(self) -> dict[str, int]:
        """Frames that came so far and were not used, by kind: those of `dropped` and of `faults`."""
        return self.dropped | self.faults

    def sync_sent(self, tick: int, time_ns: int) -> None:
        """Records that SYNC `tick` went out at `time_ns`, from which the capture times of tags count."""
        self._sync_ns[tick % REMEMBERED_TICKS] = time_ns

    def sent(self, frames: Sequence[tuple[int, Frame]]) -> None:
        """Counts frames that go out, each with the index of its bus, among those that occupy it."""
        for bus, frame in frames:
            self._bits[bus] += bits_of((frame,))

    def take(self, bus: int, frames: Sequence[Frame]) -> None:
        """Takes the frames received on bus `bus`, whatever their contents."""
        if not frames:
            return
        self._bits[bus] += bits_of(frames)
        for row in self._receivers[bus].rows(frames).tolist():
            which = int(row[MESSAGE])
            if which < 0:
                continue
            handler = self._handlers[which]
            if handler is None:
                self._take_other(self._names[which], row)
                continue
            index = self._index.get((bus, row[NUMBER]))
            if index is None:
                self.faults["module"] += 1
                continue
            module = self._modules[index]
            module.heard |= which not in self._from_camera
            handler(index, module, row)

    def all_answered(self, tick: int) -> bool:
        """Whether every module's MCU_STATUS of `tick` has arrived, so that the inputs of the tick may close."""
        wanted = tick & 0xFFFF
        return all(status == wanted for status in self._status_ticks)

    def collect(self, tick: int, time_ns: int, requests: Sequence[Request] = ()) -> Inputs:
        """Returns everything received since the previous call as the Inputs of `tick`, and empties the collector."""
        modules, self._modules = self._modules, [ModuleInputs() for _ in self._modules]
        wanted = tick & 0xFFFF
        for index, module in enumerate(modules):
            answer = self._status_ticks[index]
            module.answered, module.late_ticks = answer == wanted, 0 if answer is None else (wanted - answer) & 0xFFFF
            self._status_ticks[index] = None  # an answer counts once: the same 16 bits recur after 65536 ticks
            if module.tags:
                module.tags = [tag for tag in module.tags if self._is_timely(tag, time_ns)]
        self._expire_halves()
        estop, self._estop = self._estop, False
        foreign_sync, self._foreign_sync = self._foreign_sync, False
        foreign_command, self._foreign_command = self._foreign_command, False
        estop_box, self._estop_box = self._estop_box, False
        dropped = sum([receiver.dropped_in_all for receiver in self._receivers])
        busy_s = max(map(truediv, self._bits, self._bit_rates))
        self._bits = [0] * len(self._bits)
        return Inputs(
            tick, time_ns, modules, list(requests), estop, dropped, foreign_sync, foreign_command, estop_box, busy_s=busy_s
        )  # fmt: skip

    def _make_handlers(self) -> dict[str, Callable[[int, ModuleInputs, Row], None]]:
        handlers: dict[str, Callable[[int, ModuleInputs, Row], None]] = {
            "TAG_POSITION": self._take_tag,
            "TAG_ATTITUDE": self._take_tag,
            "GYRO": self._take_gyro,
            "ACCEL": self._take_accel,
            "DEPTH": self._take_depth,
            "DOCK_CURRENT_ABC": _dock_handler(0),
            "DOCK_CURRENT_DEF": _dock_handler(3),
            "POWER": self._take_power,
            "ENVIRONMENT": self._take_environment,
            "MCU_STATUS": self._take_status,
        }
        for pair in range(4):
            handlers[f"ESC_FEEDBACK_{pair + 1}"] = _esc_handler(2 * pair)
        return handlers

    def _take_other(self, name: str, row: Row) -> None:
        if name == "ESTOP":
            self._estop = True
        elif name == "HEARTBEAT":
            self._estop_box |= row[NUMBER] == ESTOP_BOX and row[VALUES] in WORKING
        elif name == "SYNC":
            self._foreign_sync = True
            self.faults["foreign_sync"] += 1
        else:
            self._foreign_command = True
            self.faults["foreign_command"] += 1

    def _take_gyro(self, index: int, module: ModuleInputs, row: Row) -> None:
        if self._is_usable(row[VALUES + 3]):
            module.gyro = np.array(row[VALUES : VALUES + 3])

    def _take_accel(self, index: int, module: ModuleInputs, row: Row) -> None:
        if self._is_usable(row[VALUES + 3]):
            module.accel = np.array(row[VALUES : VALUES + 3])

    def _take_depth(self, index: int, module: ModuleInputs, row: Row) -> None:
        if self._is_usable(row[VALUES + 2]):
            module.pressure_pa, module.water_temperature_c = row[VALUES : VALUES + 2]

    def _take_power(self, index: int, module: ModuleInputs, row: Row) -> None:
        voltage, current, status = row[VALUES : VALUES + 3]
        if status == SENSOR_FAULT:
            self.faults["sensor"] += 1
            return
        module.voltage_v, module.current_a = voltage, current

    def _take_environment(self, index: int, module: ModuleInputs, row: Row) -> None:
        module.cabin_temperature_c, module.cabin_pressure_pa, leak = row[VALUES : VALUES + 3]
        module.leak = bool(leak)

    def _take_status(self, index: int, module: ModuleInputs, row: Row) -> None:
        tick, _, _, state = row[VALUES : VALUES + 4]
        self._status_ticks[index] = int(tick)
        if module.mcu_state != MCU_ESTOP:  # a later status in the same tick must not hide an e-stop
            module.mcu_state = int(state)
        self.without_status.discard(index)

    def _take_tag(self, index: int, module: ModuleInputs, row: Row) -> None:
        """Pairs the two halves of an observation, which share the counter; nothing else marks them as belonging together."""
        key = (index, row[COUNTER])
        other = self._halves.pop(key, None)
        if other is None or other[0][MESSAGE] == row[MESSAGE]:
            self.faults["tag_unpaired"] += other is not None
            self._halves[key] = (row, self._collections)
            return
        position, attitude = (row, other[0]) if row[MESSAGE] == self._tag_position else (other[0], row)
        self._take_observation(module, position[VALUES : VALUES + 3], attitude[VALUES:])

    def _take_observation(self, module: ModuleInputs, position: Row, attitude: Row) -> None:
        offset_ms = attitude[-1]
        largest, a, b, c, tag_id, quality, capture_tick = map(int, attitude[:-1])
        sync_ns = self._sync_ns[capture_tick]
        if sync_ns is None or offset_ms >= OFFSET_SATURATED_MS:
            self.faults["tag_stale"] += 1
            return
        capture_ns = sync_ns + round(offset_ms * NS_PER_MS)
        p_wt, q_wt = np.array(position), unpack_quaternion(largest, a, b, c)
        module.tags.append(TagObservation(tag_id, quality, capture_ns, p_wt, q_wt))

    def _is_timely(self, tag: TagObservation, time_ns: int) -> bool:
        age_ns = time_ns - tag.capture_ns
        if 0 <= age_ns <= STALE_NS:
            return True
        self.faults["tag_stale" if age_ns > 0 else "tag_future"] += 1
        return False

    def _is_usable(self, status: float) -> bool:
        if status in USABLE_STATUS:
            return True
        self.faults["sensor"] += 1
        return False

    def _expire_halves(self) -> None:
        """Drops unpaired halves. Those of an observation may fall on either side of one tick's end; an older half stays alone."""
        if self._halves:
            old = [key for key, half in self._halves.items() if half[1] < self._collections]
            for key in old:
                del self._halves[key]
            self.faults["tag_unpaired"] += len(old)
        self._collections += 1


def _dock_handler(first: int) -> Callable[[int, ModuleInputs, Row], None]:
    def take(index: int, module: ModuleInputs, row: Row) -> None:
        a_ma, b_ma, c_ma, a, b, c = row[VALUES : VALUES + 6]
        module.docks.append(DockFeedback(first, (a_ma, b_ma, c_ma), (int(a), int(b), int(c))))

    return take


def _esc_handler(first: int) -> Callable[[int, ModuleInputs, Row], None]:
    def take(index: int, module: ModuleInputs, row: Row) -> None:
        rpm1, current1, status1, rpm2, current2, status2 = row[VALUES : VALUES + 6]
        module.esc.append(EscFeedback(first, (rpm1, rpm2), (current1, current2), (int(status1), int(status2))))

    return take


class OutputEncoder:
    """Encodes the pipeline's Outputs into frames, each with the bus that it goes out on."""

    def __init__(self, fleet: Fleet, codec: Codec) -> None:
        self._buses = range(len(fleet.buses))
        self._addresses = [(module.bus, module.number) for module in fleet.module]
        self._sync = codec.message("SYNC")
        self._estop = codec.message("ESTOP")
        self._dock = codec.message("DOCK_CMD")
        self._thrusters = (codec.message("THRUSTER_CMD_A"), codec.message("THRUSTER_CMD_B"))
        self._dock_counters = [0] * len(fleet.module)
        self._estop_due_ns: int | None = None

    def sync(self, tick: int) -> list[tuple[int, Frame]]:
        """Returns SYNC of `tick` (modulo 2^32), one frame per bus."""
        frame = self._sync.encode(0, (tick & 0xFFFFFFFF,))
        return [(bus, frame) for bus in self._buses]

    def frames(self, outputs: Outputs, without_status: Collection[int] = ()) -> list[tuple[int, Frame]]:
        """Returns the frames of one tick: ESTOP when due, then for every module its thrusters and, when due, its docking relays.

        Args:
            without_status: modules whose thrusters are not commanded yet: a command would make them release an e-stop that is not known
                here.
        """
        frames: list[tuple[int, Frame]] = []
        if self._estop_is_due(outputs):
            frames += [(bus, self._estop.encode(0)) for bus in self._buses]
        counter = outputs.tick & 15
        half_a, half_b = self._thrusters
        for index, ((bus, number), command) in enumerate(zip(self._addresses, outputs.modules, strict=True)):
            mode = int(command.armed)
            shares = command.thrusters.tolist()
            shares += [0.0] * (CHANNELS - len(shares))
            if index not in without_status:
                frames.append((bus, half_a.encode(number, (*shares[:THRUSTERS_OF_A_FRAME], mode), counter)))
                frames.append((bus, half_b.encode(number, (*shares[THRUSTERS_OF_A_FRAME:], mode), counter)))
            if command.relays is not None:
                frames.append((bus, self._dock.encode(number, command.relays, self._dock_counters[index])))
                self._dock_counters[index] = self._dock_counters[index] + 1 & 15
        return frames

    def _estop_is_due(self, outputs: Outputs) -> bool:
        """Whether ESTOP is due: at once when raised, then at 20 Hz on average whatever the tick rate."""
        if not outputs.estop:
            self._estop_due_ns = None
            return False
        due_ns = outputs.time_ns if self._estop_due_ns is None else self._estop_due_ns
        if outputs.time_ns < due_ns:
            return False
        self._estop_due_ns = due_ns + ESTOP_PERIOD_NS
        return True
