"""Folders, as a command line names them."""

from __future__ import annotations

from pathlib import Path

import typer


def folder_of(text: str) -> Path:
    """The folder called `text`; nothing, as an unset variable of a shell gives, is none."""
    if not text:
        raise typer.BadParameter("'' is no folder; give one, or . for this one")
    return Path(text)
