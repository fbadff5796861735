"""One firmware process without its clock: frames in, frames out. Lockstep and real time both drive this object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware_py.bus.codec import Codec, Frame
from firmware_py.bus.mapping import InputCollector, OutputEncoder
from firmware_py.core.body import Body
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import Outputs, Request
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import Vehicle, load_vehicle
from firmware_py.prepare.assembly import assemble

BusFrame = tuple[int, Frame]
"""Index of the bus, and the frame."""


@dataclass(slots=True)
class Firmware:
    """The parts of one process: collector -> pipeline -> encoder."""

    fleet: Fleet
    parameters: Parameters
    collector: InputCollector
    pipeline: Pipeline
    encoder: OutputEncoder

    def sync(self, tick: int, time_ns: int) -> list[BusFrame]:
        """The SYNC frames that start tick `tick` on each bus."""
        self.collector.sync_sent(tick, time_ns)
        return self.encoder.sync(tick)

    def step(
        self, tick: int, time_ns: int, received: Sequence[BusFrame], requests: Sequence[Request]
    ) -> tuple[Outputs, list[BusFrame]]:
        """Steps the fleet with the frames that came since the last tick; returns the outputs and the frames to send."""
        for bus, frame in received:
            self.collector.take(bus, frame)
        outputs = self.pipeline.step(self.collector.collect(tick, time_ns, list(requests)))
        return outputs, self.encoder.frames(outputs)


def vehicles_of(fleet: Fleet, folder: Path | None = None) -> list[Vehicle]:
    """The vehicle of each module, in fleet order; each file is read once."""
    loaded = {name: load_vehicle(name, folder) for name in dict.fromkeys(m.vehicle for m in fleet.module)}
    return [loaded[m.vehicle] for m in fleet.module]


def bodies_of(fleet: Fleet, vehicles: list[Vehicle]) -> list[Body]:
    """The bodies that the fleet file docks at the start, in the order of their first modules."""
    groups: dict[int, list[int]] = {}
    for index, module in enumerate(fleet.module):
        groups.setdefault(module.body if module.body >= 0 else -1 - index, []).append(index)
    return [
        assemble(
            cells=[fleet.module[i].cell for i in group],
            rotations=[fleet.module[i].rotation for i in group],
            vehicles=[vehicles[i] for i in group],
            modules=group,
            pitch_m=fleet.pitch_m,
        )
        for group in groups.values()
    ]


def compose(fleet: Fleet, parameters: Parameters, vehicles: list[Vehicle] | None = None) -> Firmware:
    """The firmware of `fleet`, ready to step. Raises DescriptionError for a fleet or vehicle that is wrong."""
    codec = Codec.load()
    bodies = bodies_of(fleet, vehicles if vehicles is not None else vehicles_of(fleet))
    return Firmware(
        fleet=fleet,
        parameters=parameters,
        collector=InputCollector(fleet, codec),
        pipeline=Pipeline(bodies, parameters, fleet.period_ns),
        encoder=OutputEncoder(fleet, codec),
    )
