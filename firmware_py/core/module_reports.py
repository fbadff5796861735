"""Last report of each module of a body, kept by `health_monitor`; tells the modules behind a figure of `health`."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_py.core.types import NEVER_NS


class ModuleReports:
    """By fleet index: the last report of each module of the body, and its time, ns. A body inherits every table in it with its modules."""

    def __init__(self, modules: Sequence[int]) -> None:
        never = dict.fromkeys(modules, NEVER_NS)
        self.heard_ns, self.hears_ns, self.answered_ns, self.late_ns = (never.copy() for _ in range(4))
        self.imu_ns, self.battery_ns, self.cabin_ns, self.wet_ns = (never.copy() for _ in range(4))
        self.pressure_ns = dict[int, int]()
        self.unfit, self.leak, self.wet = (dict.fromkeys(modules, False) for _ in range(3))
        self.voltage_share, self.cabin_c, self.cabin_start_pa, self.cabin_change_pa = (dict[int, float]() for _ in range(4))

    def take_over(self, other: ModuleReports) -> None:
        """Takes over every report of the modules of this body from a body before."""
        mine = self.heard_ns.keys()
        for name, reports in vars(self).items():
            reports.update({module: told for module, told in getattr(other, name).items() if module in mine})

    @property
    def is_of_several(self) -> bool:
        """Whether the body has several modules, so that a text must say which one it means."""
        return len(self.heard_ns) > 1

    def ages_s(self, now_ns: int, *tables: str) -> dict[int, float]:
        """Returns the age of each module's last report, s; of several tables of times that of the oldest."""
        ages: dict[int, float] = {}
        for table in tables:
            ages |= {module: max((now_ns - at_ns) * 1e-9, ages.get(module, 0.0)) for module, at_ns in getattr(self, table).items()}
        return ages
