"""The basis of the other tests here: a bus that passes frames, can-utils that see them, links that break on demand."""

import errno
import socket
import struct
from pathlib import Path

import pytest

from tests.vcan.can_utils import LoggedFrame, candump, cangen, cangen_flood, canplayer, cansend, read_log, write_log
from tests.vcan.links import Interface

CAN_FRAME = struct.Struct("=IB3x8s")
"""struct can_frame of linux/can.h: id, length, payload."""


def open_socket(interface: str) -> socket.socket:
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.bind((interface,))
    raw.setblocking(False)
    return raw


def send(raw: socket.socket, identifier: int = 0x123) -> None:
    raw.send(CAN_FRAME.pack(identifier, 2, b"\x01\x02"))


def test_bus_is_there_and_up(vcan0: str) -> None:
    assert Interface(vcan0).is_up()


def test_candump_sees_what_cansend_sends(vcan0: str) -> None:
    with candump(vcan0) as heard:
        cansend(vcan0, 0x440, bytes.fromhex("0011223344556677"))
        cansend(vcan0, 0x000, b"")
        frames = heard.take(2)
    assert [(frame.interface, frame.identifier, frame.data.hex()) for frame in frames] == [
        (vcan0, 0x440, "0011223344556677"),
        (vcan0, 0x000, ""),
    ]


def test_log_played_back_is_heard_frame_for_frame(link: Interface, tmp_path: Path) -> None:
    recorded = [LoggedFrame(1.0 + 1e-3 * n, "can0", 0x080 + n % 30, bytes(range(n % 9))) for n in range(100)]
    write_log(tmp_path / "flight.log", recorded)
    assert read_log(tmp_path / "flight.log") == recorded
    with candump(link.name) as heard:
        canplayer(tmp_path / "flight.log", link.name, logged="can0")
        frames = heard.take(len(recorded))
    assert [frame[2:] for frame in frames] == [frame[2:] for frame in recorded]


def test_cangen_at_full_speed_loses_no_frame_on_the_way_to_candump(link: Interface) -> None:
    count = 2000
    with candump(link.name) as heard:
        cangen(link.name, count, identifier=0x321)
        frames = heard.take(count)
    assert {frame.identifier for frame in frames} == {0x321}
    assert [int.from_bytes(frame.data, "little") for frame in frames] == list(range(count))


def test_flood_goes_on_until_it_is_stopped(link: Interface) -> None:
    with candump(link.name) as heard, cangen_flood(link.name, identifier=0x7FF, gap_ms=1.0):
        assert len(heard.take(100)) == 100


def test_link_that_is_down_refuses_frames_and_takes_them_again_when_up(link: Interface) -> None:
    with open_socket(link.name) as speaker:
        send(speaker)
        link.down()
        assert not link.is_up()
        with pytest.raises(OSError) as refused:
            send(speaker)
        assert refused.value.errno == errno.ENETDOWN
        link.up()
        send(speaker)


def test_interface_made_again_leaves_the_old_socket_dead_and_serves_a_new_one(link: Interface) -> None:
    with open_socket(link.name) as orphan:
        link.delete()
        assert not link.exists()
        with pytest.raises(OSError) as refused:
            send(orphan)
        assert refused.value.errno == errno.ENXIO
        link.make_again()
        with pytest.raises(OSError) as still_refused:
            send(orphan)
        assert still_refused.value.errno == errno.ENXIO
    with open_socket(link.name) as speaker, candump(link.name) as heard:
        send(speaker, 0x456)
        assert [frame.identifier for frame in heard.take(1)] == [0x456]


def test_full_buffer_refuses_frames_until_it_is_emptied(link: Interface) -> None:
    with open_socket(link.name) as speaker, candump(link.name) as heard:
        link.fill()
        send(speaker)
        with pytest.raises(OSError) as refused:
            send(speaker)
        assert refused.value.errno == errno.ENOBUFS
        link.empty()
        send(speaker, 0x456)
        assert [frame.identifier for frame in heard.take(1)] == [0x456]


def test_link_events_have_happened_when_their_call_returns(link: Interface) -> None:
    for _ in range(20):
        link.down()
        assert not link.is_up()
        link.up()
        assert link.is_up()
        link.make_again()
        assert link.is_up()
    with pytest.raises(OSError, match="File exists"):
        link.create()
