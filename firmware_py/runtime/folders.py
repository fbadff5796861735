"""Parsing of folders given on the command line."""

from __future__ import annotations

from pathlib import Path

import typer


def folder_of(text: str) -> Path:
    """The folder named `text`. Rejects an empty text, as an unset shell variable gives."""
    if not text:
        raise typer.BadParameter("'' is no folder; give one, or . for this one")
    return Path(text)
