"""Configuration of the ground side: links, identity, storage. Fixed for one run; tunables are parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, quantity, read_toml
from firmware_py.description.vehicle import FACE_NAMES
from firmware_py.ground.identity import IDENTITIES, Identity


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundConfig:
    """Configuration of one ground side."""

    links: tuple[str, ...] = quantity(
        ("udpout:127.0.0.1:14550",),
        help="udpin:, udpout:, tcpin:HOST:PORT, /dev/NAME,BAUD; `+trusted` permits a link to set the signing key",
    )
    identity: str = quantity(
        "generic", choices=tuple(IDENTITIES), help="modes shown to ground stations; generic: PX4's; ardusub: ArduSub's"
    )
    first_system: int = quantity(1, low=1, high=200, help="MAVLink system id of a body led by module 1; one led by module n has n - 1 more")
    watch_system: int = quantity(
        0, low=0, high=255, help="system id of the ground station whose loss counts and which may steer; 0: the first one heard"
    )
    watch_component: int = quantity(
        0, low=0, high=255, help="component id of the ground station whose loss counts and which may steer; 0: the first one heard"
    )
    store: str = quantity("", help="folder for parameters and signing key; empty: nothing is stored")
    dock_button: tuple[int, ...] = quantity(
        (), low=0, high=64, help="request of the dock buttons: module, face, target module, target face; modules count from 1; empty: none"
    )
    logs: str = quantity("", help="folder of the logs that ground stations may download; empty: none")

    def __post_init__(self) -> None:
        if not self.links:
            raise DescriptionError("has no links; a ground side needs at least one", "links")
        if len(self.dock_button) not in (0, 4):
            raise DescriptionError("dock_button needs four numbers: module, face, target module, target face", "dock_button")
        if wrong := [face for face in self.dock_button[1::2] if face >= len(FACE_NAMES)]:
            what = f"dock_button names face {wrong[0]}; faces are 0 to {len(FACE_NAMES) - 1}: {', '.join(FACE_NAMES)}"
            raise DescriptionError(what, "dock_button")

    def watches(self, system: int, component: int) -> bool:
        """Whether a ground station may be the watched one, which must not be lost, and may steer."""
        return self.watch_system in (0, system) and self.watch_component in (0, component)

    @property
    def encoding(self) -> Identity:
        """The identity, with its encoding of modes."""
        return IDENTITIES[self.identity]

    @property
    def parameter_file(self) -> Path | None:
        """File of the stored parameters; None without a store."""
        return Path(self.store) / "parameters.toml" if self.store else None

    @property
    def key_file(self) -> Path | None:
        """File of the signing key and time stamp; None without a store."""
        return Path(self.store) / "signing.json" if self.store else None


def load_ground(path: Path, modules: int) -> GroundConfig:
    """Reads `path` for a fleet of so many modules; values left out keep their defaults. Raises DescriptionError, one line."""
    table, source = read_toml(path)
    config: GroundConfig = build(GroundConfig, table, source)
    docked = config.dock_button[::2]
    if docked and (not 1 <= min(docked) < max(docked) <= modules):
        what = f"module {docked[0]} to module {docked[1]}; it needs two modules of the fleet, which has {modules}, from 1 on"
        raise source.error(("dock_button",), what)
    return config


def check_store(store: str) -> None:
    """Checks that the folder can be created or written to. An empty name and a failing disk pass. Raises DescriptionError."""
    if not store:
        return
    nearest = next(place for place in (Path(store), *Path(store).parents) if place.exists())
    try:
        TemporaryFile(dir=nearest).close()
    except (FileNotFoundError, NotADirectoryError, PermissionError) as error:  # the first: in /proc nothing can be created
        raise DescriptionError(f"store {store}: {nearest}: {error.strerror}; it needs a folder that this user may write to") from None
    except OSError:
        return
