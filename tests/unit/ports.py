"""The behaviour of every kind of bus, as a test suite that the tests of each kind subclass, with its helpers."""

import os
import select
import threading
import time
import tty

import can
import pytest

from firmware_py.bus.codec import Frame
from firmware_py.bus.port import PortError, open_port

UDP = f"udp:239.74.163.2:{40_000 + os.getpid() % 20_000}"
"""A port of its own for each process: test processes run side by side."""
PATIENCE_NS = 20_000_000_000
"""Time that a frame may take on a busy machine before a test fails. No passing test waits that long."""
FRAMES = [Frame(0x000, b""), Frame(0x7FF, bytes(range(8))), *(Frame(0x81, bytes(range(n))) for n in range(9))]


def left_open(buses):
    """The python-can buses out of `buses` that nobody shut down."""
    return [bus for bus in buses if not bus._is_shutdown]


@pytest.fixture(autouse=True)
def no_channel_left_open(monkeypatch):
    """Fails a test that leaves a python-can bus open, of whatever kind."""
    buses = []
    construct = can.BusABC.__init__

    def remember(self, *args, **kwargs):
        buses.append(self)
        construct(self, *args, **kwargs)

    monkeypatch.setattr(can.BusABC, "__init__", remember)
    yield buses
    left = left_open(buses)
    for bus in left:
        bus.shutdown()
    assert left == []


def poll(condition):
    """Returns the value of `condition` as soon as that is true, or the last one after `PATIENCE_NS`."""
    deadline = time.monotonic_ns() + PATIENCE_NS
    while not (met := condition()) and time.monotonic_ns() < deadline:
        pass
    return met


def receive(port, count):
    """Returns the frames received as soon as they are at least `count`: a bus between processes needs some time."""
    frames = []
    poll(lambda: frames.extend(port.receive()) or len(frames) >= count)
    return frames


def faults(port):
    return {kind: count for kind, count in port.faults.items() if count}


class PortSuite:
    """Tests for every kind of bus. A subclass provides `address_pair`: two addresses of the same bus."""

    @pytest.fixture
    def pair(self, address_pair):
        with open_port(address_pair[0]) as one, open_port(address_pair[1]) as other:
            yield one, other

    @pytest.fixture
    def readers(self, address_pair):
        options = dict(reader=True, now_ns=time.monotonic_ns)
        with open_port(address_pair[0], **options) as one, open_port(address_pair[1], **options) as other:
            yield one, other

    @pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: f"{frame.id:03x}-{len(frame.data)}")
    def test_frame_arrives_unchanged(self, pair, frame):
        one, other = pair
        one.send(frame)
        (received,) = receive(other, 1)
        assert received == frame
        assert (type(received), type(received.data)) == (Frame, bytes)

    def test_frames_arrive_in_order(self, pair):
        one, other = pair
        frames = [Frame(0x100 + n % 7, bytes((n,))) for n in range(150)]
        for frame in frames:
            one.send(frame)
        assert receive(other, len(frames)) == frames
        assert not any(one.faults.values())
        assert not any(other.faults.values())

    def test_sender_does_not_hear_itself(self, pair):
        one, other = pair
        one.send(Frame(0x101, b"one"))
        other.send(Frame(0x102, b"other"))
        assert receive(other, 1) == [Frame(0x101, b"one")]
        assert receive(one, 1) == [Frame(0x102, b"other")]
        assert one.receive() == other.receive() == []

    def test_silent_bus_gives_nothing_and_does_not_block(self, pair):
        assert pair[0].receive() == []

    def test_closed_port_is_refused(self, address_pair):
        port = open_port(address_pair[0])
        port.close()
        port.close()
        for use in (port.receive, lambda: port.send(FRAMES[0])):
            with pytest.raises(PortError, match="is closed"):
                use()

    def test_reader_wakes_who_waits(self, readers):
        one, other = readers
        one.send(Frame(0x101, b"wake"))
        assert other.wait(time.monotonic_ns() + PATIENCE_NS)
        assert other.receive() == [Frame(0x101, b"wake")]
        assert other.receive() == []

    def test_reader_hands_over_frames_in_order(self, readers):
        one, other = readers
        frames = [Frame(0x100, bytes((n,))) for n in range(150)]
        for frame in frames:
            one.send(frame)
        assert receive(other, len(frames)) == frames
        assert one.receive() == []


class Cable:
    """Two slcan adapters and the wire between them: passes frames from each serial device to the other.

    The devices are pseudo-terminals behind links in `folder`, in the way that udev names an adapter.
    """

    def __init__(self, folder):
        ends = [os.openpty() for _ in range(2)]
        self.masters = [master for master, _ in ends]
        for master in self.masters:
            os.set_blocking(master, False)
        self.links = [folder / name for name in ("one", "other")]
        for (_, slave), link in zip(ends, self.links, strict=True):
            tty.setraw(slave)
            link.symlink_to(os.ttyname(slave))
        self.addresses = tuple(f"slcan:{link}" for link in self.links)
        self.shut = set()
        """Ends whose adapter was reset: its channel is closed until it is opened again."""
        self.stop_read, self.stop_write = os.pipe()
        self.files = [*self.masters, *(slave for _, slave in ends), self.stop_read, self.stop_write]
        os.write(self.stop_write, b"x")
        self.go_on()

    def pass_on(self):
        partial = dict.fromkeys(self.masters, b"")
        while True:
            ready, _, _ = select.select([*self.masters, self.stop_read], [], [])
            if self.stop_read in ready:
                return
            for master in ready:
                *lines, partial[master] = (partial[master] + os.read(master, 4096)).split(b"\r")
                other = self.masters[master == self.masters[0]]
                self.shut -= {master} if b"O" in lines else set()
                rest = b"".join(line + b"\r" for line in lines if line[:1] == b"t" and not self.shut)
                while rest:
                    stopped, _, _ = select.select([self.stop_read], [other], [])
                    if stopped:  # also if nobody reads the other end any more
                        return
                    rest = rest[os.write(other, rest) :]

    def stop(self):
        """Stops passing frames until `go_on`."""
        os.write(self.stop_write, b"x")
        self.passes.join()

    def go_on(self):
        os.read(self.stop_read, 1)
        self.passes = threading.Thread(target=self.pass_on, daemon=True)
        self.passes.start()

    def unplug(self):
        self.stop()
        while self.files:
            os.close(self.files.pop())
        for link in self.links:
            link.unlink(missing_ok=True)
