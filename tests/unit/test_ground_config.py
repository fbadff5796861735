"""How the command line and a file say what the ground side is."""

from pathlib import Path

import pytest

from firmware_py.cli import ground_config
from firmware_py.description.schema import DescriptionError

FILE = """links = ["udpin::14550+trusted"]
identity = "ardusub"
watch_system = 255
dock_button = [0, 0, 1, 1]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "ground.toml"
    path.write_text(FILE)
    return path


def test_without_link_and_file_there_is_no_ground_side(tmp_path: Path) -> None:
    assert ground_config(None, [], "generic", "", tmp_path) is None


def test_command_line_gives_links_identity_store_and_the_folder_of_the_logs(tmp_path: Path) -> None:
    config = ground_config(None, ["udpin::14550"], "ardusub", "kept", tmp_path)
    assert config is not None
    assert (config.links, config.identity, config.store, config.logs) == (("udpin::14550",), "ardusub", "kept", str(tmp_path))


def test_file_gives_the_buttons_and_whom_to_watch_and_the_command_line_other_links(file: Path) -> None:
    config = ground_config(file, ["udpout::14551"], "generic", "", None)
    assert config is not None
    assert (config.links, config.identity, config.logs) == (("udpout::14551",), "ardusub", "")
    assert (config.watch_system, config.dock_button) == (255, (0, 0, 1, 1))
    alone = ground_config(file, [], "generic", "", None)
    assert alone is not None and alone.links == ("udpin::14550+trusted",)


@pytest.mark.parametrize(
    ("line", "wrong"),
    [("dock_button = [0, 0, 1]", "needs four numbers"), ("first_system = 0", "permitted: 1 to 200"), ("links = []", "has no links")],
)
def test_wrong_file_is_refused_in_one_line_that_names_it(tmp_path: Path, line: str, wrong: str) -> None:
    path = tmp_path / "ground.toml"
    path.write_text(line + "\n")
    with pytest.raises(DescriptionError, match=wrong) as error:
        ground_config(path, [], "generic", "", None)
    assert "ground.toml" in str(error.value) and "\n" not in str(error.value)


def test_unknown_identity_is_refused() -> None:
    with pytest.raises(DescriptionError, match="identity 'px4' is unknown; there are generic, ardusub"):
        ground_config(None, ["udpin::14550"], "px4", "", None)
