"""Configuration of the ground side from the command line and a file."""

from pathlib import Path

import pytest

from firmware_py.cli import ground_config
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.config import GroundConfig, check_store
from firmware_py.ground.station import GroundStation
from tests.unit.ground_world import fleet_of

FILE = """links = ["udpin::14550+trusted"]
identity = "ardusub"
watch_system = 255
dock_button = [1, 0, 2, 1]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "ground.toml"
    path.write_text(FILE)
    return path


def test_without_link_and_file_there_is_no_ground_side(tmp_path: Path) -> None:
    assert ground_config(None, [], None, None, tmp_path, 1) is None


def test_command_line_gives_links_identity_store_and_the_folder_of_the_logs(tmp_path: Path) -> None:
    config = ground_config(None, ["udpin::14550"], "ardusub", str(tmp_path / "kept"), tmp_path, 1)
    assert config is not None
    assert (config.links, config.identity, config.logs) == (("udpin::14550",), "ardusub", str(tmp_path))
    assert config.store == str(tmp_path / "kept")


def test_file_gives_the_buttons_and_whom_to_watch_and_the_command_line_other_links(file: Path) -> None:
    config = ground_config(file, ["udpout::14551"], None, None, None, 2)
    assert config is not None
    assert (config.links, config.identity, config.logs) == (("udpout::14551",), "ardusub", "")
    assert (config.watch_system, config.dock_button) == (255, (1, 0, 2, 1))
    alone = ground_config(file, [], None, None, None, 2)
    assert alone is not None and alone.links == ("udpin::14550+trusted",)


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("dock_button = [1, 0, 2]", "needs four numbers"),
        ("dock_button = [1, 0, 2, 9]", "face 9; faces are 0 to 5"),
        ("dock_button = [0, 0, 2, 1]", "dock_button: module 0 to module 2; it needs two modules of the fleet"),
        ("dock_button = [1, 0, 3, 1]", "dock_button: module 1 to module 3; it needs two modules of the fleet, which has 2"),
        ("dock_button = [1, 0, 1, 1]", "dock_button: module 1 to module 1; it needs two modules"),
        ("first_system = 0", "permitted: 1 to 200"),
        ("links = []", "has no links"),
    ],
)
def test_wrong_file_is_refused_in_one_line_that_names_it(tmp_path: Path, line: str, wrong: str) -> None:
    path = tmp_path / "ground.toml"
    path.write_text(line + "\n")
    with pytest.raises(DescriptionError, match=wrong) as error:
        ground_config(path, [], None, None, None, 2)
    assert "ground.toml" in str(error.value) and "\n" not in str(error.value)


def test_unknown_identity_is_refused() -> None:
    with pytest.raises(DescriptionError, match="identity 'px4' is unknown; there are generic, ardusub"):
        ground_config(None, ["udpin::14550"], "px4", None, None, 1)


def test_command_line_goes_before_the_identity_and_store_of_the_file(file: Path, tmp_path: Path) -> None:
    config = ground_config(file, [], "generic", str(tmp_path), None, 2)
    assert config is not None
    assert (config.identity, config.store, config.watch_system) == ("generic", str(tmp_path), 255)


@pytest.mark.parametrize(("identity", "store"), [("px4", None), (None, "kept"), ("ardusub", "kept")])
def test_identity_and_store_without_a_link_are_refused(identity: str | None, store: str | None) -> None:
    with pytest.raises(DescriptionError, match=r"--identity and --store go with a link.*--ground LINK or --ground-file"):
        ground_config(None, [], identity, store, None, 1)


@pytest.mark.parametrize("inside", ["", "deeper/still"])
def test_store_that_is_a_file_is_refused(inside: str, file: Path) -> None:
    with pytest.raises(DescriptionError, match=r"store .*ground\.toml: Not a directory; it needs a folder"):
        ground_config(None, ["udpin::14550"], None, str(file / inside), None, 1)


def test_store_where_nothing_can_be_made_is_refused() -> None:
    with pytest.raises(DescriptionError, match=r"store /proc/y: /proc: .*; it needs a folder that this user may write to"):
        check_store("/proc/y")


def test_store_that_can_be_made_is_taken_and_not_made_yet(tmp_path: Path) -> None:
    check_store(str(tmp_path / "deeper" / "still"))
    assert list(tmp_path.iterdir()) == []


def test_fleet_that_has_more_bodies_than_system_ids_is_refused() -> None:
    fleet = fleet_of(64)
    with pytest.raises(DescriptionError, match=r"first_system 200: 64 modules lead to 263; it is 191 at most"):
        GroundStation(GroundConfig(first_system=200), fleet, Parameters())
    GroundStation(GroundConfig(first_system=191), fleet, Parameters())
