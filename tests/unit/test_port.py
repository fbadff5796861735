"""One suite for every kind of bus (tests/vcan runs it on real SocketCAN), then what a port does when its bus fails."""

import errno
import functools
import os
import select
import subprocess
import sys
import threading
import time
import tty
from collections import deque
from typing import Any

import can
import pytest
import serial

from firmware_py.bus.codec import Frame
from firmware_py.bus.port import Port, PortError, open_port
from firmware_py.bus.port.links import WAITING_FRAMES, Link, SlcanLink

UDP = f"udp:239.74.163.2:{40_000 + os.getpid() % 20_000}"
"""A port of its own for each process: test processes run side by side."""
PATIENCE_NS = 20_000_000_000
"""How long a frame may take on a busy machine before a test fails; no test waits for it to pass."""
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
    """What `condition` says as soon as that is true."""
    deadline = time.monotonic_ns() + PATIENCE_NS
    while not (met := condition()) and time.monotonic_ns() < deadline:
        pass
    return met


def receive(port, count):
    """`count` frames, as soon as they are through: a bus between processes takes its time."""
    frames = []
    poll(lambda: frames.extend(port.receive()) or len(frames) >= count)
    return frames


def faults(port):
    return {kind: count for kind, count in port.faults.items() if count}


class PortSuite:
    """What every bus does. A subclass gives `address_pair`: two addresses of the same bus."""

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


class TestVirtual(PortSuite):
    @pytest.fixture
    def address_pair(self):
        return ("virtual:suite", "virtual:suite")

    def test_all_listeners_hear_a_frame(self, pair):
        with open_port("virtual:suite") as third, open_port("virtual:elsewhere") as stranger:
            pair[0].send(FRAMES[1])
            assert pair[1].receive() == third.receive() == [FRAMES[1]]
            assert stranger.receive() == []

    def test_plain_python_can_bus_hears_and_is_heard(self, pair):
        with can.Bus(interface="virtual", channel="suite") as plain:
            pair[0].send(Frame(0x123, b"port"))
            heard = plain.recv(0)
            assert (heard.arbitration_id, bytes(heard.data), heard.is_extended_id) == (0x123, b"port", False)
            plain.send(can.Message(arbitration_id=0x321, data=b"plain", is_extended_id=False))
            assert pair[0].receive() == [Frame(0x321, b"plain")]

    def test_listener_that_never_reads_loses_frames_and_counts_them(self, pair):
        one, other = pair
        for _ in range(WAITING_FRAMES + 5):
            one.send(FRAMES[0])
        assert len(other.receive()) == WAITING_FRAMES
        assert other.receive() == []
        assert other.faults["overrun"] == 5


class TestUdp(PortSuite):
    @pytest.fixture(autouse=True)
    def multicast(self):
        try:
            open_port(UDP).close()
        except PortError as error:
            pytest.skip(str(error))

    @pytest.fixture
    def address_pair(self):
        return (UDP, UDP)

    def test_all_listeners_hear_a_frame(self, pair):
        with open_port(UDP) as third:
            pair[0].send(FRAMES[1])
            assert receive(pair[1], 1) == receive(third, 1) == [FRAMES[1]]

    def test_datagram_that_is_no_frame_is_counted(self, pair, no_channel_left_open):
        no_channel_left_open[-2]._multicast.send(b"\xc1 not msgpack")
        pair[0].send(FRAMES[0])
        assert receive(pair[1], 1) == [FRAMES[0]]
        assert pair[1].faults["receive"] == 1


class Cable:
    """Two slcan adapters and the wire between them: passes the frames of one serial device to the other.

    The devices are pseudo terminals behind links in `folder`, as udev names an adapter.
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
                rest = b"".join(line + b"\r" for line in lines if line[:1] == b"t")
                while rest:
                    stopped, _, _ = select.select([self.stop_read], [other], [])
                    if stopped:  # also where nobody reads at the other end any more
                        return
                    rest = rest[os.write(other, rest) :]

    def stop(self):
        """Nothing passes until `go_on`."""
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


class TestSlcan(PortSuite):
    @pytest.fixture
    def cable(self, tmp_path):
        cable = Cable(tmp_path)
        yield cable
        if cable.files:
            cable.unplug()

    @pytest.fixture
    def address_pair(self, cable):
        return cable.addresses

    def test_adapter_serves_one_process_and_the_next_one_when_it_is_done(self, pair, cable):
        """Another would switch the channel off on opening, and an adapter does not echo: no foreign SYNC is heard."""
        one, other = pair
        script = f"from firmware_py.bus.port import open_port; open_port({cable.addresses[0]!r})"
        run = functools.partial(subprocess.run, [sys.executable, "-c", script], capture_output=True, text=True, check=False)
        refused = run()
        assert "PortError" in refused.stderr and "another process uses it" in refused.stderr
        assert one.send(FRAMES[1])
        assert receive(other, 1) == [FRAMES[1]]
        one.close()
        assert run().returncode == 0

    def test_adapter_whose_device_fails_to_close_can_be_opened_again(self, cable, monkeypatch):
        link = SlcanLink(cable.addresses[0].removeprefix("slcan:"))
        bus: Any = link.open()
        with monkeypatch.context() as broken:
            broken.setattr(bus.serialPortOrig, "close", lambda: 1 // 0)
            with pytest.raises(ZeroDivisionError):
                link.close(bus)
        bus.serialPortOrig.close()
        link.close(link.open())

    def test_settings_of_this_machine_for_python_can_change_nothing(self, cable, monkeypatch):
        """In ~/.canrc a listener of somebody else may be told to send nothing, or to hear its own frames."""
        monkeypatch.setenv("CAN_CONFIG", '{"listen_only": true, "rtscts": true}')
        link = SlcanLink(cable.addresses[0].removeprefix("slcan:"))
        bus: Any = link.open()
        try:
            assert not bus._listen_only
            assert not bus.serialPortOrig.rtscts
        finally:
            link.close(bus)

    def test_silent_adapter_is_waited_for_asleep(self, cable, monkeypatch):
        """python-can's own wait reads in a loop: at real-time priority nothing else would run on that processor."""
        link = SlcanLink(cable.addresses[0].removeprefix("slcan:"))
        bus, reads = link.open(), []
        try:
            monkeypatch.setattr(serial.Serial, "read", lambda device, size=1: reads.append(size) or b"")
            assert link.read(bus, 0.05) is None
        finally:
            link.close(bus)
        assert len(reads) == 0

    def test_adapter_that_is_plugged_in_again_works_again(self, pair, cable, tmp_path):
        one, other = pair
        cable.unplug()
        one.send(FRAMES[1])
        assert one.receive() == other.receive() == []
        one.send(FRAMES[1])
        assert one.faults["gone"] >= 1
        again = Cable(tmp_path)
        assert one.receive() == other.receive() == []
        assert one.faults["reopened"] == other.faults["reopened"] == 1
        one.send(FRAMES[1])
        assert receive(other, 1) == [FRAMES[1]]
        one.close()
        other.close()
        again.unplug()

    def test_adapter_that_takes_no_more_is_counted_and_tears_no_frame(self, pair, cable):
        one, other = pair
        cable.stop()
        sent = 0
        while one.send(Frame(0x123, sent.to_bytes(8, "little"))):
            sent += 1
        assert faults(one) == {"full": 1}
        cable.go_on()
        assert poll(lambda: one.send(FRAMES[1]))  # and what was left of the one before it
        assert receive(other, sent + 1) == [*(Frame(0x123, n.to_bytes(8, "little")) for n in range(sent)), FRAMES[1]]

    @pytest.mark.parametrize("garbage", [b"t1z38\r", b"t\r", b"t1239\r", b"t0\xff\r"])
    def test_garbage_of_an_adapter_is_counted(self, pair, cable, garbage):
        one, other = pair
        os.write(cable.masters[1], garbage)
        assert poll(lambda: other.receive() or other.faults["receive"])
        one.send(FRAMES[1])
        assert receive(other, 1) == [FRAMES[1]]
        assert faults(other) == {"receive": 1}


    def test_line_with_an_id_above_the_largest_is_counted_as_foreign(self, pair, cable):
        one, other = pair
        os.write(cable.masters[1], b"t90110011\r")
        assert poll(lambda: other.receive() or other.faults["foreign"])
        one.send(FRAMES[1])
        assert receive(other, 1) == [FRAMES[1]]
        assert faults(other) == {"foreign": 1}


# ------------------------------------------------------------------ opening


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("can0", "virtual:NAME, udp:GROUP:PORT, socketcan:INTERFACE or slcan:DEVICE"),
        ("", "virtual:NAME"),
        ("virtual:", "virtual:NAME"),
        ("udp:239.74.163.2", "udp:239.74.163.2:43113"),
        ("udp:192.168.1.1:43113", "multicast group"),
        ("udp:239.74.163.2:0", "a port"),
        ("udp:239.74.163.2:http", "a port"),
        ("socketcan:can77", "no such interface"),
        ("socketcan:", "no such interface"),
        ("slcan:/dev/no-such-device", "serial device"),
    ],
)
def test_wrong_address_is_refused_with_one_line_that_says_what_is_right(address, says):
    with pytest.raises(PortError) as refusal:
        open_port(address)
    message = str(refusal.value)
    assert address in message
    assert says in message
    assert "\n" not in message


def test_check_for_open_channels_finds_one(no_channel_left_open):
    port = open_port("virtual:left")
    assert len(left_open(no_channel_left_open)) == 1
    port.close()
    assert left_open(no_channel_left_open) == []


# ------------------------------------------------------------------ waiting


class Clock:
    """Moves only when it is read."""

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
    """A python-can bus that does what the test says: each entry of a script is raised, or is what happens."""

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
    """Opens Wires; `present` and `same` are what an interface does that is deleted and made again."""

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
    # Once, and then every 17th read: opening is slow.
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
