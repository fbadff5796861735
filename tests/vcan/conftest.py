"""Where the tests of this folder run: here if this machine can make vcan interfaces, otherwise inside the guest.

`test_in_guest` boots the guest once and runs the whole folder inside. Tests with the fixture `guest` boot their own guest
and run outside only; their files end in `_in_guest.py`. Everything in the folder carries the marker `vcan`.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.vcan.guest import Guest, missing_packages
from tests.vcan.links import Interface, can_make_interfaces

HERE = Path(__file__).resolve().parent
IN_GUEST = "IN_VCAN_GUEST" in os.environ
collect_ignore_glob = ["*_in_guest.py"] if IN_GUEST else []  # their imports take long in the guest


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    ours = [item for item in items if HERE in item.path.parents]
    for item in ours:
        item.add_marker("vcan")
    outside = [item for item in ours if "guest" in getattr(item, "fixturenames", ())]
    whole_folder = [item for item in outside if item.path.name == "test_in_guest.py"]
    direct = [item for item in ours if item not in outside and item.get_closest_marker("vcan")]
    if IN_GUEST:
        dropped = []
    elif can_make_interfaces():
        dropped = whole_folder
    elif whole_folder:
        dropped = direct
    else:
        dropped = []
        for item in direct:
            item.add_marker(pytest.mark.skip(reason="this machine has no vcan: hil/guest/run pytest ... (its README)"))
    if dropped:
        config.hook.pytest_deselected(items=dropped)
        items[:] = [item for item in items if item not in dropped]


@pytest.fixture(scope="session")
def guest() -> Guest:
    """The virtual machine, from outside; skips if its Debian packages are missing."""
    if missing := missing_packages():
        pytest.skip(f"missing Debian packages: {' '.join(missing)} (make setup-system)")
    return Guest()


@pytest.fixture
def link() -> Iterator[Interface]:
    """A vcan interface for this test alone to break; up at first."""
    interface = Interface("vcanlink")
    interface.delete()
    interface.create()
    interface.up()
    yield interface
    interface.delete()


@pytest.fixture(scope="session")
def vcan0() -> str:
    """The shared bus: made if the machine has none of that name, otherwise used as it is. Brought up if it is down."""
    bus = Interface("vcan0")
    if not bus.exists():
        bus.create()
    if not bus.is_up():
        bus.up()
    return bus.name
