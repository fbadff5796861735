"""Logs: listed, fetched piece by piece, and never in the way of other traffic."""

import os
from pathlib import Path

import pytest

from firmware_py.ground.config import GroundConfig
from firmware_py.ground.logs import LogService
from tests.unit.ground_world import World


def test_each_of_two_clients_has_its_list_of_logs(tmp_path: Path) -> None:
    for number in range(25):
        (tmp_path / f"{number}.log").touch()
    world = World(config=GroundConfig(logs=str(tmp_path)))
    clients = [world.client(), world.client(200)]
    for client in clients:
        client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(5)
    assert [len(client.all("LOG_ENTRY")) for client in clients] == [25, 25]


def test_log_that_is_deleted_while_the_folder_is_listed_hides_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(3):
        (tmp_path / f"{number}.log").touch()
    look = Path.stat

    def look_or_miss(path: Path, **more: bool) -> os.stat_result:
        """The second look at a file: after `is_file`."""
        looks[path] = looks.get(path, 0) + 1
        if path.name == "1.log" and looks[path] > 1:
            raise FileNotFoundError(path)
        return look(path, **more)

    looks: dict[Path, int] = {}
    monkeypatch.setattr(Path, "stat", look_or_miss)
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(5)
    assert [entry.id for entry in client.all("LOG_ENTRY")] == [0, 2]


def test_each_of_two_clients_has_the_log_that_it_fetches(tmp_path: Path) -> None:
    """A LOG_REQUEST_END from a third client ends neither transfer."""
    data = bytes(i % 251 for i in range(20_000))
    (tmp_path / "can.log").write_bytes(data)
    world = World(config=GroundConfig(logs=str(tmp_path)))
    clients = [world.client(), world.client(200)]
    for client in clients:
        client.send("LOG_REQUEST_DATA", 1, 1, 0, 0, 0xFFFFFFFF)
        world.run(1)
    world.client(201).send("LOG_REQUEST_END", 1, 1)
    world.run(20)
    for client in clients:
        assert b"".join(bytes(p.data[: p.count]) for p in client.all("LOG_DATA")) == data


def test_answers_find_their_way_while_a_log_is_fetched_over_a_radio(tmp_path: Path) -> None:
    (tmp_path / "can.log").write_bytes(bytes(1_000_000))
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_DATA", 1, 1, 0, 0, 0xFFFFFFFF)
    world.station.set_busy({client.channel})
    world.run(50)
    assert not client.all("LOG_DATA") and client.all("HEARTBEAT")
    world.station.set_busy(set())
    world.run(2)
    assert len(client.all("LOG_DATA")) == 40


def test_client_that_leaves_with_an_answer_to_come_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "can.log").write_bytes(bytes(1_000_000))
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_DATA", 1, 1, 0, 0, 0xFFFFFFFF)
    client.command(400, 1)
    world.station.leave(client.channel)
    world.run(3)
    services = world.station.services[1]
    assert not services.system.outbox._encoders and not services.logs._transfers and not services.logs._files


def test_flood_of_requests_for_the_list_of_logs_looks_at_the_folder_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client, looks = world.client(), []
    monkeypatch.setattr(LogService, "_find", lambda service: looks.append(1) or [])
    for _ in range(100):
        client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(2)
    assert len(looks) == 1


def test_log_that_is_being_fetched_comes_to_its_end_though_its_body_docks_meanwhile(tmp_path: Path) -> None:
    """Lost pieces are sent again too: a client identifies the log by the system that listed it."""
    data = bytes(i % 251 for i in range(20_000))
    (tmp_path / "can.log").write_bytes(data)
    world = World(2, GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_DATA", 2, 1, 0, 0, 0xFFFFFFFF)
    world.run(2)
    world.robot.dock()
    world.run(20)
    pieces = client.all("LOG_DATA")
    assert b"".join(bytes(p.data[: p.count]) for p in pieces) == data and {p.get_srcSystem() for p in pieces} == {2}
    client.clear()
    client.send("LOG_REQUEST_DATA", 2, 1, 0, 90, 90)
    world.run(2)
    assert bytes(client.last("LOG_DATA").data) == data[90:180] and "is not steered" not in client.texts


@pytest.mark.parametrize(("identity", "first"), [("generic", 0), ("ardusub", 1)])
def test_logs_are_listed_and_fetched(identity: str, first: int, tmp_path: Path) -> None:
    """QGroundControl finds no log whose number equals their count, unless the autopilot is ArduPilot. Regression: it missed the newest."""
    data = bytes(i % 251 for i in range(9_999))
    (tmp_path / "can.log").write_bytes(data)
    (tmp_path / "signals.mcap").write_bytes(b"frames")
    world = World(config=GroundConfig(logs=str(tmp_path), identity=identity))
    client = world.client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(1)
    entries = [(e.id - first, e.size, e.num_logs, e.last_log_num - first) for e in client.all("LOG_ENTRY")]
    assert entries == [(0, 9_999, 2, 1), (1, 6, 2, 1)]
    client.send("LOG_REQUEST_DATA", 1, 1, first, 0, 0xFFFFFFFF)
    world.run(20)
    pieces = {m.ofs: bytes(m.data[: m.count]) for m in client.all("LOG_DATA")}
    assert b"".join(pieces[at] for at in sorted(pieces)) == data
    assert client.last("LOG_DATA").count == 0 or sum(map(len, pieces.values())) == len(data)
    client.clear()
    client.send("LOG_REQUEST_DATA", 1, 1, first, 90, 180)
    world.run(5)
    assert b"".join(bytes(m.data[: m.count]) for m in client.all("LOG_DATA")) == data[90:270]
    client.send("LOG_ERASE", 1, 1)
    world.run(1)
    assert "logs are not erased" in client.texts and (tmp_path / "can.log").exists()


def test_log_beyond_what_the_protocol_can_address_ends_there(tmp_path: Path) -> None:
    """A day of one module is 8 GB. Regression: what lies behind 4 GiB came as pieces of one and the same place."""
    (tmp_path / "signals.mcap").touch()
    os.truncate(tmp_path / "signals.mcap", 2**32 + 1000)  # takes no room on the disk
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    client.send("LOG_REQUEST_DATA", 1, 1, 0, 2**32 - 200, 0xFFFFFFFF)
    world.run(20)
    assert client.last("LOG_ENTRY").size == 2**32 - 1
    assert [(piece.ofs, piece.count) for piece in client.all("LOG_DATA")] == [
        (2**32 - 200, 90), (2**32 - 110, 90), (2**32 - 20, 19), (2**32 - 1, 0),
    ]  # fmt: skip


def test_logs_of_all_runs_are_listed_oldest_first_whatever_their_times(tmp_path: Path) -> None:
    """The first run logs into the folder itself, later ones into numbered folders in it. The clock may be set back."""
    for size, name in enumerate((".", "0002", "0003", "0010", "9999", "10000"), 1):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "can.log").write_bytes(bytes(size))
        os.utime(tmp_path / name / "can.log", (1_000_000 - size, 1_000_000 - size))
    client = (world := World(config=GroundConfig(logs=str(tmp_path)))).client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(1)
    assert [(e.id, e.size) for e in client.all("LOG_ENTRY")] == [(k, k + 1) for k in range(6)]


def test_flight_whose_disk_failed_is_listed_as_the_newest(tmp_path: Path) -> None:
    """Its files are dated back to 1970, so that no later start believes them. Regression: of many flights it was the one left out."""
    for run in range(1, 103):
        folder = tmp_path / f"{run:04d}" if run > 1 else tmp_path
        folder.mkdir(exist_ok=True)
        (folder / "can.log").write_bytes(bytes(run))
    os.utime(tmp_path / "0102" / "can.log", (0, 0))
    client = (world := World(config=GroundConfig(logs=str(tmp_path)))).client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(15)
    assert [(e.id, e.size) for e in client.all("LOG_ENTRY")] == [(k, k + 3) for k in range(100)]


def test_list_for_another_client_changes_no_number_under_which_a_log_is_fetched(tmp_path: Path) -> None:
    """Regression: the rest of a log that was fetched in two requests was that of another file."""
    (tmp_path / "0002").mkdir()
    (tmp_path / "can.log").write_bytes(b"1" * 180)
    (tmp_path / "0002" / "can.log").write_bytes(b"2" * 180)
    world = World(config=GroundConfig(logs=str(tmp_path)))
    fetching, listing = world.client(), world.client(200)
    fetching.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(2)
    fetching.send("LOG_REQUEST_DATA", 1, 1, 1, 0, 90)
    world.run(2)
    (tmp_path / "can.log").unlink()
    listing.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(2)
    fetching.send("LOG_REQUEST_DATA", 1, 1, 1, 90, 90)
    world.run(2)
    assert [entry.num_logs for entry in listing.all("LOG_ENTRY")] == [1]
    assert b"".join(bytes(p.data[: p.count]) for p in fetching.all("LOG_DATA")) == b"2" * 180
