"""One suite for every kind of bus (tests/vcan runs it on real SocketCAN), and invalid addresses."""

import contextlib
import functools
import os
import subprocess
import sys
import termios
import threading
import time
from typing import Any

import can
import pytest
import serial

from firmware_py.bus.codec import Frame
from firmware_py.bus.port import PortError, open_port
from firmware_py.bus.port.links import WAITING_FRAMES
from firmware_py.bus.port.slcan import SlcanLink
from tests.unit.ports import FRAMES, UDP, Cable, PortSuite, faults, left_open, no_channel_left_open, poll, receive

__all__ = ["no_channel_left_open"]


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

    @pytest.mark.slow
    def test_adapter_serves_one_process_and_the_next_one_when_it_is_done(self, pair, cable):
        """A second process would switch the channel off on opening; and its SYNC would go unnoticed, as an adapter does not echo."""
        one, other = pair
        script = f"from firmware_py.bus.port import open_port; open_port({cable.addresses[0]!r})"
        run = functools.partial(subprocess.run, [sys.executable, "-c", script], capture_output=True, text=True, check=False)
        refused = run()
        assert "PortError" in refused.stderr and "another process uses it" in refused.stderr
        assert one.send(FRAMES[1])
        assert receive(other, 1) == [FRAMES[1]]
        one.close()
        assert run().returncode == 0

    def test_adapter_that_accepts_nothing_any_more_is_closed_at_once(self, cable):
        """Regression: python-can waited for it without end, in the loop that flies the robot."""
        link = SlcanLink(cable.addresses[0].removeprefix("slcan:"))
        bus: Any = link.open()
        cable.stop()
        with pytest.raises(BlockingIOError):
            while True:
                os.write(bus.fileno(), b"x" * 1024)

        def close() -> None:
            with contextlib.suppress(OSError):
                link.close(bus)

        closing = threading.Thread(target=close, daemon=True)
        closing.start()
        closing.join(10.0)
        assert not closing.is_alive()
        assert not bus.serialPortOrig.is_open

    def test_adapter_that_accepts_nothing_is_refused_instead_of_waited_for(self, cable):
        """Regression: python-can waited for it without end: a start was deaf to Ctrl-C, and a reader that reopened it never ended."""
        device = os.open(cable.links[0], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        termios.tcflow(device, termios.TCOOFF)
        refused: list[str] = []

        def start() -> None:
            try:
                open_port(cable.addresses[0])
            except PortError as error:
                refused.append(str(error))

        opening = threading.Thread(target=start, daemon=True)
        opening.start()
        opening.join(10.0)
        os.close(device)
        assert refused == [f"{cable.addresses[0]}: the adapter accepts nothing; unplug it and plug it in again"]

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
        """A ~/.canrc made for another program may set the bus to listen only, or to receive its own frames."""
        monkeypatch.setenv("CAN_CONFIG", '{"listen_only": true, "rtscts": true}')
        link = SlcanLink(cable.addresses[0].removeprefix("slcan:"))
        bus: Any = link.open()
        try:
            assert not bus._listen_only
            assert not bus.serialPortOrig.rtscts
        finally:
            link.close(bus)

    def test_silent_adapter_is_waited_for_asleep(self, cable, monkeypatch):
        """python-can's own wait polls in a loop: at real-time priority nothing else would run on that processor."""
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

    def test_adapter_that_got_the_name_of_another_between_two_reads_is_taken_up(self, pair, cable, tmp_path):
        """The other one, still open, was read for ever, because a device of its name was there."""
        one, other = pair
        for link in cable.links:
            link.unlink()
        again = Cable(tmp_path)
        assert poll(lambda: [one.receive(), other.receive()] and one.faults["reopened"] == other.faults["reopened"] == 1)
        one.send(FRAMES[1])
        assert receive(other, 1) == [FRAMES[1]]
        one.close()
        other.close()
        again.unplug()

    @pytest.mark.slow
    def test_adapter_that_is_reset_while_its_device_stays_is_opened_again(self, address_pair, cable):
        """Regression: it forgets that its channel is open, reports no error, and was silent for ever."""
        with open_port(address_pair[0], reader=True, now_ns=time.monotonic_ns) as one, open_port(address_pair[1]) as other:
            other.send(FRAMES[1])
            assert receive(one, 1) == [FRAMES[1]]
            cable.shut.add(cable.masters[0])
            one.send(FRAMES[1])
            assert poll(lambda: not cable.shut)
            for sender, receiver in ((one, other), (other, one)):
                sender.send(FRAMES[2])
                assert receive(receiver, 1) == [FRAMES[2]]
            assert not faults(one)

    @pytest.mark.slow
    def test_adapter_that_takes_no_more_is_counted_and_tears_no_frame(self, pair, cable):
        one, other = pair
        cable.stop()
        sent = 0
        while one.send(Frame(0x123, sent.to_bytes(8, "little"))):
            sent += 1
        assert faults(one) == {"full": 1}
        cable.go_on()
        assert poll(lambda: one.send(FRAMES[1]))  # and the rest of the frame before it
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
        ("slcan:/dev/null", "slcan:/dev/null: Inappropriate ioctl for device; it takes a serial device"),
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
