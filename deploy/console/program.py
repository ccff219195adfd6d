"""This program once more, in a process of its own."""

from __future__ import annotations

import sys
from typing import Final

_RUN: Final = (
    "import sys; from handfast.deploy.cli import process; sys.argv[0] = 'handfast'; sys.exit(process())"
)


def handfast(*arguments: str) -> list[str]:
    """The command line of ``handfast ARGUMENTS`` by this Python, whatever is on the path; nothing is imported
    from the folder that it is called in."""
    return [sys.executable, "-P", "-c", _RUN, *arguments]
