"""A golden log: a flight's log, thinned and packed. `pack` makes one, `unpack` restores a folder for `modcube replay`.

Every frame is kept; the signals of bodies and docks are kept in some ticks only.
"""

import json
import lzma
from pathlib import Path

from firmware_py.runtime.log_recovery import rewrite
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG

KEEP_EVERY = {"/firmware/body": 50, "/firmware/docks": 10}
"""Tick interval of the messages kept, by prefix of the topic; other topics keep every message."""


def pack(log: Path, golden: Path, period_ns: int) -> None:
    """Makes the folder `golden` from the log in the folder `log`."""
    golden.mkdir(exist_ok=True)
    thin = log / "thin.mcap"

    def every(topic: str) -> int:
        return next((ticks for begin, ticks in KEEP_EVERY.items() if topic.startswith(begin)), 1)

    rewrite(
        log / SIGNAL_LOG,
        thin,
        lambda topic, message: message.log_time // period_ns % every(topic) == 0,
        lambda data: json.dumps(json.loads(data) | {"thinned": True}, sort_keys=True).encode(),
    )
    for name, path in ((CAN_LOG, log / CAN_LOG), (SIGNAL_LOG, thin)):
        (golden / f"{name}.xz").write_bytes(lzma.compress(path.read_bytes(), preset=9))


def unpack(golden: Path, log: Path) -> None:
    """Writes the log of `golden` into the folder `log`."""
    for name in (CAN_LOG, SIGNAL_LOG):
        (log / name).write_bytes(lzma.decompress((golden / f"{name}.xz").read_bytes()))
