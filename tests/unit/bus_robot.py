"""An input collector and the nodes that feed it, without a bus."""

from firmware_py.bus.codec import Codec, pack_quaternion
from firmware_py.bus.mapping import InputCollector
from firmware_py.description.fleet import Fleet, Module, single

MS = 1_000_000
TICK_NS = 10 * MS
CODEC = Codec.load()
TWO_BUSES = Fleet(module=(Module(number=1, bus=0), Module(number=1, bus=1), Module(number=2, bus=1)), buses=("a", "b"))


class Robot:
    """An input collector with the nodes' side of the bus; each message has its own counter, as in the real nodes."""

    def __init__(self, fleet=None):
        self.collector = InputCollector(fleet or single(), CODEC)
        self.counters = {}

    def say(self, name, values, number=1, bus=0, counter=None):
        count = self.counters.get((name, number, bus), -1) + 1 if counter is None else counter
        self.counters[name, number, bus] = count
        self.collector.take(bus, [CODEC.message(name).encode(number, values, count)])

    def see_tag(self, tag=4, counter=0, tick=0, offset_ms=0.0, halves="PA", number=1, p=(1.0, 2.0, 3.0)):
        for half in halves:
            if half == "P":
                self.say("TAG_POSITION", p, number, counter=counter)
            else:
                attitude = (*pack_quaternion((1.0, 0.0, 0.0, 0.0)), tag, 7, tick & 0xFF, offset_ms)
                self.say("TAG_ATTITUDE", attitude, number, counter=counter)

    def tick(self, tick, delay_ns=0):
        """Returns the Inputs of a tick whose SYNC was sent at tick * TICK_NS."""
        self.collector.sync_sent(tick, tick * TICK_NS)
        return self.collector.collect(tick, tick * TICK_NS + delay_ns)

    @property
    def faults(self):
        return {kind: count for kind, count in self.collector.faults.items() if count}
