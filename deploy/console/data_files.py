"""Where the files lie that come with the program, in `deploy/data/`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[3]
"""Folder that holds the package `handfast`: a checkout, or site-packages of an installation."""
_DATA: Final = ROOT / "handfast" / "deploy" / "data"
FLEETS: Final = _DATA / "fleets"
SCENARIOS: Final = _DATA / "scenarios"
TEMPLATE: Final = _DATA / "template.toml"
PAGE: Final = _DATA / "page"
FOXGLOVE_LAYOUT: Final = _DATA / "foxglove" / "handfast.json"
ROBOT_REQUIREMENTS: Final = _DATA / "robot_requirements.txt"


def bundled(folder: Path = FLEETS) -> list[str]:
    """Names of the fleets, or the scenarios, that come with the program."""
    return sorted(path.stem for path in folder.glob("*.toml"))
