"""Where the files lie that come with the program, and how to start the program once more."""

from __future__ import annotations

import sys
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


_RUN: Final = (
    "import sys; from handfast.deploy.cli import process; sys.argv[0] = 'handfast'; sys.exit(process())"
)


def handfast(*arguments: str) -> list[str]:
    """The command line of ``handfast ARGUMENTS`` by this Python, whatever is on the path; nothing is imported
    from the folder that it is called in."""
    return [sys.executable, "-P", "-c", _RUN, *arguments]
