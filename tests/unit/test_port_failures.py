"""What a port does while it waits, and when its bus fails: it counts the fault, goes on, and reopens the bus."""

import errno
import threading
import time
from collections import deque

import can
import pytest

from firmware_py.bus.codec import Frame
from firmware_py.bus.port import Port, PortError, open_port
from firmware_py.bus.port.links import Link
from tests.unit.ports import FRAMES, PATIENCE_NS, UDP, faults, no_channel_left_open, poll, receive

__all__ = ["no_channel_left_open"]

# ------------------------------------------------------------------ waiting


class Clock:
    """A clock that moves only when it is read: to the next of the given times."""

    def __init__(self, *times_ns):
        self.times_ns = deque(times_ns)

    def __call__(self):
        return self.times_ns.popleft()


def test_wait_ends_at_the_deadline():
    with open_port("virtual:wait", reader=True, now_ns=Clock(0, 999_000, 1_000_000)) as port:
        assert not port.wait(1_000_000)


def test_wait_ends_when_the_caller_is_content():
    answers = iter((False, True))
    with open_port("virtual:wait", reader=True, now_ns=Clock(0)) as port:
        assert port.wait(1000, lambda: next(answers))


def test_one_wait_serves_several_buses():
    arrival = threading.Event()
    options = dict(reader=True, now_ns=time.monotonic_ns, arrival=arrival)
    with open_port("virtual:a", **options) as a, open_port("virtual:b", **options) as b, open_port("virtual:b") as far:
        far.send(FRAMES[0])
        assert a.wait(time.monotonic_ns() + PATIENCE_NS, lambda: a.has_frames() or b.has_frames())
        assert b.receive() == [FRAMES[0]]


def test_port_that_nothing_could_wake_refuses_to_wait():
    with open_port("virtual:wait") as port, pytest.raises(PortError, match="needs a reader and a clock"):
        port.wait(0)


# ------------------------------------------------------------------ failing


class Wire(can.BusABC):
    """A scripted python-can bus: an entry of `sends` or `reads` that is an exception is raised, any other is the outcome."""

    def __init__(self):
        super().__init__(channel="wire")
        self.sends, self.reads, self.sent = deque(), deque(), []

    def send(self, msg, timeout=None):
        if self.sends and (error := self.sends.popleft()) is not None:
            raise error
        self.sent.append(msg)

    def recv(self, timeout=None):
        item = self.reads.popleft() if self.reads else None
        if isinstance(item, Exception):
            raise item
        return item


class WireLink(Link):
    """Opens Wires; `present` and `same` simulate an interface that is deleted and created again."""

    def __init__(self):
        super().__init__("wire")
        self.wires, self.present, self.same, self.refusals = [], True, True, 0

    def open(self):
        if self.refusals:
            self.refusals -= 1
            raise PortError("wire: refused")
        self.wires.append(Wire())
        self.same = True
        return self.wires[-1]

    def is_present(self):
        return self.present

    def is_same(self):
        return self.same


class SlowLink(WireLink):
    """Takes until the port is being closed to let go of a bus."""

    def __init__(self):
        super().__init__()
        self.lets_go, self.port = threading.Event(), None

    def close(self, bus):
        self.lets_go.set()
        while not self.port._closed:
            time.sleep(0.001)
        super().close(bus)


def test_port_that_is_closed_while_its_bus_dies_ends_its_reader_quietly():
    """An exception there is written to the console of a vehicle that ends as it should, and in a test it is a failure."""
    link = SlowLink()
    link.port = port = Port("wire:", link, True, None, threading.Event())
    link.wires[0].sends.append(OSError(errno.ENODEV, "gone"))
    port.send(FRAMES[0])
    assert link.lets_go.wait(5.0)
    port.close()
    assert not port._thread.is_alive()
    with pytest.raises(PortError, match="is closed"):
        port.receive()


@pytest.fixture
def link():
    return WireLink()


@pytest.fixture
def port(link):
    with Port("wire:", link, False, None, threading.Event()) as port:
        yield port


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (can.CanOperationError("Failed to transmit", errno.ENETDOWN), "down"),
        (OSError(errno.ENETDOWN, "down"), "down"),
        (caused(can.CanOperationError("failed to send"), OSError(errno.ENETUNREACH, "no route")), "down"),
        (can.CanOperationError("Failed to transmit", errno.ENOBUFS), "full"),
        (caused(can.CanOperationError("failed to send"), BlockingIOError(errno.EAGAIN, "again")), "full"),
        (can.CanOperationError("Transmit buffer full"), "full"),
        (can.CanTimeoutError(), "full"),
        (can.CanOperationError("odd"), "send"),
        (ValueError("odd"), "send"),
    ],
)
def test_frame_that_cannot_be_sent_is_counted_and_the_next_one_goes_out(port, link, error, kind):
    link.wires[0].sends.append(error)
    port.send(FRAMES[0])
    port.send(FRAMES[1])
    assert faults(port) == {kind: 1}
    assert [bytes(message.data) for message in link.wires[0].sent] == [FRAMES[1].data]


@pytest.mark.parametrize("number", [errno.ENXIO, errno.ENODEV, errno.EBADF])
def test_port_comes_back_with_its_interface(port, link, number):
    link.present = False
    link.wires[0].sends.append(can.CanOperationError("Failed to transmit", number))
    port.send(FRAMES[0])
    port.send(FRAMES[0])
    assert port.receive() == []
    assert faults(port) == {"gone": 2}
    assert link.wires[0]._is_shutdown
    link.present = True
    assert port.receive() == []
    port.send(FRAMES[1])
    assert [bytes(message.data) for message in link.wires[1].sent] == [FRAMES[1].data]
    assert faults(port) == {"gone": 2, "reopened": 1}


def test_interface_made_again_under_the_same_name_is_noticed_by_a_listener(port, link):
    link.same = False
    port.receive()
    port.receive()
    link.wires[1].reads.append(can.Message(arbitration_id=0x101, is_extended_id=False, data=b"back"))
    assert port.receive() == [Frame(0x101, b"back")]
    assert faults(port) == {"reopened": 1}


def test_interface_that_does_not_open_yet_is_tried_again(port, link):
    link.same, link.refusals = False, 2
    reads = 0
    while not port.faults["reopened"] and reads < 100:
        port.receive()
        reads += 1
    assert len(link.wires) == 2
    # One attempt, then one every 17th read, because opening is slow.
    assert reads == 1 + 1 + 2 * 17


def test_link_that_goes_down_and_up_costs_no_frame_after_it(port, link):
    link.wires[0].reads.append(can.CanOperationError("Error receiving", errno.ENETDOWN))
    assert port.receive() == []
    link.wires[0].reads.append(can.Message(arbitration_id=0x101, is_extended_id=False))
    assert port.receive() == [Frame(0x101, b"")]
    assert faults(port) == {"down": 1}


def test_frames_before_a_failure_are_kept(port, link):
    message = can.Message(arbitration_id=0x101, is_extended_id=False)
    link.wires[0].reads.extend((message, OSError(errno.ENETDOWN, "down"), message))
    assert port.receive() == [Frame(0x101, b"")]
    assert port.receive() == [Frame(0x101, b"")]


def test_what_is_no_classic_frame_is_counted_by_kind(port, link):
    link.wires[0].reads.extend((
        can.Message(arbitration_id=0x101, is_extended_id=True),
        can.Message(arbitration_id=0x101, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x101, is_extended_id=False, is_fd=True, data=bytes(12)),
        can.Message(arbitration_id=0x800, is_extended_id=False, check=False),
        Frame(0x901, b"one wrong bit in the line of an adapter"),
        can.Message(arbitration_id=-1, is_extended_id=False),
        can.Message(arbitration_id=0x004, is_extended_id=False, is_error_frame=True, data=bytes(8)),
        can.Message(arbitration_id=0x040, is_extended_id=False, is_error_frame=True, data=bytes(8)),
        can.Message(arbitration_id=0x102, is_extended_id=False, data=b"good"),
    ))
    assert port.receive() == [Frame(0x102, b"good")]
    assert faults(port) == {"foreign": 6, "error_frame": 1, "bus_off": 1}


@pytest.mark.parametrize("number", [1.5, -0.0, True])
def test_datagram_whose_id_is_no_whole_number_ends_no_flight(number):
    with open_port(UDP) as port, open_port(UDP) as other:
        other._link.send(other._bus, Frame(number, b"odd"))
        other.send(FRAMES[2])
        assert receive(port, 1) == [FRAMES[2]]
        assert faults(port) == {"foreign": 1}


def test_reader_outlives_a_failing_bus_and_reopens_it(link):
    with Port("wire:", link, True, time.monotonic_ns, threading.Event()) as port:
        link.wires[0].reads.append(OSError(errno.ENODEV, "gone"))
        assert port.wait(time.monotonic_ns() + PATIENCE_NS, lambda: poll(lambda: len(link.wires) == 2))
        link.wires[1].reads.append(can.Message(arbitration_id=0x101, is_extended_id=False))
        assert receive(port, 1) == [Frame(0x101, b"")]
        assert faults(port) == {"gone": 1, "reopened": 1}
