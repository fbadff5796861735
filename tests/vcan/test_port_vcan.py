"""The port suite on real SocketCAN, and a port's behaviour when its interface goes down, disappears or is full.

Outside the virtual machine one test runs this file inside it; all other tests exist only there.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

from firmware_py.bus.codec import Frame
from firmware_py.bus.port import PortError, open_port
from tests.unit.ports import FRAMES, PortSuite, faults, no_channel_left_open, poll, receive

pytestmark = pytest.mark.vcan
ROOT = Path(__file__).resolve().parents[2]
IN_GUEST = "IN_VCAN_GUEST" in os.environ
__all__ = ["no_channel_left_open"]


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True)


if not IN_GUEST:

    def test_port_on_real_socketcan():
        command = [ROOT / "hil/guest/run", sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", "-m", "vcan"]
        result = subprocess.run([*command, Path(__file__)], cwd=ROOT, capture_output=True, text=True)
        assert result.returncode == 0, result.stdout + result.stderr

else:

    class TestSocketcan(PortSuite):
        @pytest.fixture
        def address_pair(self):
            return ("socketcan:vcan0", "socketcan:vcan0")

        def test_all_listeners_hear_a_frame(self, pair):
            with open_port("socketcan:vcan0") as third, open_port("socketcan:vcan1") as stranger:
                pair[0].send(FRAMES[1])
                assert receive(pair[1], 1) == receive(third, 1) == [FRAMES[1]]
                assert stranger.receive() == []

    @pytest.fixture
    def vcan2():
        """An interface for this test alone to break."""
        ip("link", "add", "vcan2", "type", "vcan")
        ip("link", "set", "vcan2", "up")
        yield "socketcan:vcan2"
        subprocess.run(["ip", "link", "del", "vcan2"], capture_output=True)

    @pytest.mark.parametrize("reader", [False, True])
    def test_link_that_goes_down_and_up_is_counted_and_works_again(vcan2, reader):
        with open_port(vcan2, reader=reader, now_ns=time.monotonic_ns) as one, open_port(vcan2) as other:
            ip("link", "set", "vcan2", "down")
            for _ in range(3):
                one.send(FRAMES[1])
                assert one.receive() == other.receive() == []
            assert one.faults["down"] >= 3
            ip("link", "set", "vcan2", "up")
            # The first call after a flap may still report it.
            assert poll(lambda: one.send(FRAMES[1]) and other.receive())
            assert poll(lambda: other.send(FRAMES[2]) and one.receive())
            assert one.faults["gone"] == one.faults["send"] == 0

    @pytest.mark.parametrize("reader", [False, True])
    def test_interface_that_is_made_again_is_opened_again(vcan2, reader):
        with open_port(vcan2, reader=reader, now_ns=time.monotonic_ns) as one, open_port(vcan2) as other:
            ip("link", "del", "vcan2")
            one.send(FRAMES[1])
            assert one.receive() == other.receive() == []
            ip("link", "add", "vcan2", "type", "vcan")
            ip("link", "set", "vcan2", "up")
            assert poll(lambda: one.receive() or one.faults["reopened"])
            assert poll(lambda: other.receive() or other.faults["reopened"])
            one.send(FRAMES[1])
            assert receive(other, 1) == [FRAMES[1]]
            other.send(FRAMES[2])
            assert receive(one, 1) == [FRAMES[2]]

    def test_listener_notices_an_interface_that_was_made_again_while_it_looked_away(vcan2):
        with open_port(vcan2) as listener:
            ip("link", "del", "vcan2")
            ip("link", "add", "vcan2", "type", "vcan")
            ip("link", "set", "vcan2", "up")
            assert poll(lambda: listener.receive() or listener.faults["reopened"])
            with open_port(vcan2) as speaker:
                speaker.send(FRAMES[1])
                assert receive(listener, 1) == [FRAMES[1]]

    def test_full_send_queue_is_counted_and_empties():
        """A slow queue in front of vcan1 stands for a bus on which no node acknowledges."""
        subprocess.run(
            ["tc", "qdisc", "add", "dev", "vcan1", "root", "netem", "delay", "300ms", "limit", "5"], check=True
        )
        try:
            with open_port("socketcan:vcan1") as one, open_port("socketcan:vcan1") as other:
                for n in range(400):
                    one.send(Frame(0x100, bytes((n & 0xFF,))))
                assert one.faults["full"] > 0
                assert receive(other, 1)[0] == Frame(0x100, b"\x00")
                assert poll(lambda: other.receive() == [] and one.send(FRAMES[1]) and receive(other, 1))
        finally:
            subprocess.run(["tc", "qdisc", "del", "dev", "vcan1", "root"], check=True)

    def test_error_frames_are_counted_and_not_passed_on():
        with open_port("socketcan:vcan0") as port, can.Bus(interface="socketcan", channel="vcan0") as injector:
            for classes in (0x004, 0x040):
                injector.send(can.Message(arbitration_id=classes, is_error_frame=True, is_extended_id=False, dlc=8))
            injector.send(can.Message(arbitration_id=0x102, data=b"good", is_extended_id=False))
            assert receive(port, 1) == [Frame(0x102, b"good")]
            assert faults(port) == {"error_frame": 1, "bus_off": 1}

    def test_missing_interface_is_refused_and_those_that_exist_are_named():
        with pytest.raises(PortError, match=r"no such interface; there are vcan0, vcan1"):
            open_port("socketcan:can0")

    def test_interface_that_is_no_can_is_refused():
        with pytest.raises(PortError, match="not a CAN interface"):
            open_port("socketcan:lo")
