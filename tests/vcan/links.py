"""Link control: one vcan interface that goes down, comes up, is deleted, made again, or whose send buffer is full."""

import subprocess
from pathlib import Path

IFF_UP = 0x1
"""Flag of linux/if.h."""
HELD_FRAMES = 1
"""Frames that a full buffer holds before it refuses with ENOBUFS."""
HOLD = "200s"
"""How long it holds them; tc takes at most 274 s."""


def _run(*words: str) -> None:
    result = subprocess.run(words, capture_output=True, text=True, check=False)
    if result.returncode:
        raise OSError(f"{' '.join(words)}: {result.stderr.strip()}")


def can_make_interfaces() -> bool:
    """Whether this machine's kernel has vcan and lets us make interfaces."""
    probe = Interface("vcanprobe")
    try:
        probe.create()
    except OSError:
        return False
    probe.delete()
    return True


class Interface:
    """A vcan interface, by name (at most 15 characters). Each method returns when the kernel has done it.

    Raises:
        OSError: the kernel refused, with the words of `ip` or `tc`.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._flags = Path("/sys/class/net", name, "flags")

    def exists(self) -> bool:
        return self._flags.exists()

    def is_up(self) -> bool:
        return self.exists() and bool(int(self._flags.read_text(), 16) & IFF_UP)

    def create(self) -> None:
        """A new interface of the name, down."""
        _run("ip", "link", "add", "dev", self.name, "type", "vcan")

    def delete(self) -> None:
        """Away with it; nothing to do when there is none."""
        if self.exists():
            _run("ip", "link", "delete", "dev", self.name)

    def up(self) -> None:
        _run("ip", "link", "set", self.name, "up")

    def down(self) -> None:
        _run("ip", "link", "set", self.name, "down")

    def make_again(self) -> None:
        """Deleted, made and up in one go: a new interface of the old name."""
        self.delete()
        self.create()
        self.up()

    def fill(self) -> None:
        """From now on the buffer keeps HELD_FRAMES frames and refuses the next, like a bus that nobody acknowledges."""
        _run("tc", "qdisc", "replace", "dev", self.name, "root", "netem", "delay", HOLD, "limit", str(HELD_FRAMES))

    def empty(self) -> None:
        """Ends `fill`; the frames held are lost."""
        _run("tc", "qdisc", "delete", "dev", self.name, "root")
