"""One firmware process without its clock: frames in, frames out. Lockstep and real time both drive this object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware_py.bus.codec import Codec, Frame
from firmware_py.bus.mapping import InputCollector, OutputEncoder
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import Inputs, Outputs, Request
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import Vehicle, load_vehicle
from firmware_py.prepare.assembly import assemble_fleet

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
    ) -> tuple[Inputs, Outputs, list[BusFrame]]:
        """Steps the fleet with the frames that came since the last tick; returns inputs, outputs and the frames to send."""
        for bus, frame in received:
            self.collector.take(bus, frame)
        inputs = self.collector.collect(tick, time_ns, requests)
        outputs = self.pipeline.step(inputs)
        return inputs, outputs, self.encoder.frames(outputs)


def vehicles_of(fleet: Fleet, folder: Path | None = None) -> dict[str, Vehicle]:
    """The vehicles that a fleet names; each file is read once."""
    return {name: load_vehicle(name, folder) for name in dict.fromkeys(m.vehicle for m in fleet.module)}


def compose(fleet: Fleet, parameters: Parameters, vehicles: Mapping[str, Vehicle] | None = None) -> Firmware:
    """The firmware of `fleet`, ready to step. Raises DescriptionError for a fleet or vehicle that is wrong."""
    codec = Codec.load()
    bodies = assemble_fleet(fleet, vehicles if vehicles is not None else vehicles_of(fleet))
    return Firmware(
        fleet=fleet,
        parameters=parameters,
        collector=InputCollector(fleet, codec),
        pipeline=Pipeline(bodies, parameters, fleet.period_ns),
        encoder=OutputEncoder(fleet, codec),
    )
