"""For tools/bench.py: the cost of dock detection for eight docked modules, from raw frames on."""

from __future__ import annotations

from time import perf_counter_ns

import numpy as np
from bench_fleet import PERIOD_NS, cube_of

from firmware_py.bus.codec import Codec, Frame, pack_quaternion
from firmware_py.bus.mapping import InputCollector
from firmware_py.core.docking_detector import ModulePoses, PairBank, tag_table
from firmware_py.core.joints import joints_of
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.parameters import Docking
from firmware_py.runtime.realtime import quiet_garbage

TICKS = 480
MODULES_OF_A_BUS = 4
CURRENT_MA = 100
CURRENT_EVERY, PICTURES_PER_TICK, DELAY_TICKS = 4, 0.6, 4
"""Currents at 25 Hz, and pictures at 60 Hz that arrive 40 ms late."""


class DetectorBench:
    """A 2x2x2 cube of docked modules on two buses, with their magnet currents and top tags."""

    def __init__(self, detects: bool = True) -> None:
        """`detects`: with currents and detector; otherwise the tags alone, which the estimator needs anyway."""
        self._detects = detects
        self._codec, self._body = Codec.load(), cube_of(2)
        self._addresses = [(m // MODULES_OF_A_BUS, 1 + m % MODULES_OF_A_BUS) for m in self._body.modules]
        self._fleet = Fleet(module=tuple(Module(number=number, bus=bus) for bus, number in self._addresses), buses=("a", "b"))
        self._ticks = [[[f for at, f in frames if at == bus] for bus in range(2)] for frames in map(self._frames_of, range(TICKS))]
        self._table = tag_table([self._body])
        self.frames = sum(len(frames) for tick in self._ticks for frames in tick) / TICKS
        """Mean number of frames per tick."""

    def tick_us(self) -> float:
        """Duration per tick from raw frames to Inputs and on to the state of the twelve joints, us.
        Raises RuntimeError when a joint is not found docked.
        """
        collector = InputCollector(self._fleet, self._codec)
        bank = PairBank([joint.pair for joint in joints_of(self._body)], Docking())
        poses = ModulePoses(self._table, len(self._body.modules))
        with quiet_garbage():
            began = perf_counter_ns()
            for tick, frames in enumerate(self._ticks):
                time_ns = tick * PERIOD_NS
                collector.sync_sent(tick, time_ns)
                for bus in range(2):
                    collector.take(bus, frames[bus])
                inputs = collector.collect(tick, time_ns)
                if self._detects:
                    poses.take(inputs.modules)
                    bank.step(time_ns, inputs.modules, poses)
            took_ns = perf_counter_ns() - began
        if self._detects and not bank.rows["holds"].all():
            raise RuntimeError(f"not all of {len(bank.rows)} joints were found docked")
        return 1e-3 * took_ns / TICKS

    def _frames_of(self, tick: int) -> list[tuple[int, Frame]]:
        frames = []
        picture = int(PICTURES_PER_TICK * tick)
        for m, (bus, number) in enumerate(self._addresses):
            for offset, name in enumerate(("DOCK_CURRENT_ABC", "DOCK_CURRENT_DEF")):
                if self._detects and (tick + m + 2 * offset) % CURRENT_EVERY == 0:
                    values = (CURRENT_MA,) * 3 + (1,) * 3
                    frames.append((bus, self._codec.message(name).encode(number, values, tick // CURRENT_EVERY & 15)))
            if tick >= DELAY_TICKS and picture > int(PICTURES_PER_TICK * (tick - 1)):
                frames += [(bus, frame) for frame in self._see(m, number, tick, picture & 15)]
        return frames

    def _see(self, m: int, number: int, tick: int, counter: int) -> list[Frame]:
        body = self._body
        k = int(np.flatnonzero(body.tag_module == m)[-1])
        place, quaternion = tuple(body.r_bt[k].tolist()), pack_quaternion(body.q_bt[k].tolist())
        attitude = (*quaternion, int(body.tag_ids[k]), 7, tick - DELAY_TICKS & 0xFF, 2.0)
        values = (("TAG_POSITION", place), ("TAG_ATTITUDE", attitude))
        return [self._codec.message(name).encode(number, of, counter) for name, of in values]
