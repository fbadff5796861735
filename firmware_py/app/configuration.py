"""Converts a firmware to the configuration that its log carries, and that configuration back to a firmware."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_py.app.firmware import Firmware, compose
from firmware_py.description.builder import build
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError, Source
from firmware_py.description.toml_text import to_plain
from firmware_py.description.vehicle import Vehicle
from firmware_py.runtime.worker import Worker


def configuration_of(firmware: Firmware, **notes: Any) -> dict[str, Any]:
    """Fleet, parameters and vehicles of `firmware`, and further `notes` on the run for the log."""
    vehicles = {module.vehicle: to_plain(v) for module, v in zip(firmware.fleet.module, firmware.vehicles, strict=True)}
    described = {"fleet": to_plain(firmware.fleet), "parameters": to_plain(firmware.parameters), "vehicles": vehicles}
    return {**notes, **described}


def firmware_of(configuration: Mapping[str, Any], source: str, worker: Worker | None = None) -> Firmware:
    """The firmware that a result of `configuration_of` describes; `source` names the log in errors. Raises DescriptionError."""
    missing = [key for key in ("fleet", "parameters", "vehicles") if key not in configuration]
    if missing:
        raise DescriptionError(f"{source}: its configuration has no {', '.join(missing)}; this version's logs have them")
    return compose(*_described(configuration, source), worker)


def _described(configuration: Mapping[str, Any], source: str) -> tuple[Fleet, Parameters, dict[str, Vehicle]]:
    text = Source(source, "")
    try:
        fleet: Fleet = build(Fleet, configuration["fleet"], text, ("fleet",))
        parameters: Parameters = build(Parameters, configuration["parameters"], text, ("parameters",))
        vehicles = {name: build(Vehicle, table, text, ("vehicles", name)) for name, table in configuration["vehicles"].items()}
    except DescriptionError as error:
        what = str(error).removeprefix(f"{source}:1: ")  # a log has no line numbers
        raise DescriptionError(f"{source}: its configuration is of another version of modcube: {what}") from None
    return fleet, parameters, vehicles
