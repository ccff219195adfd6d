"""Exit statuses of commands and processes (PURE)."""

from __future__ import annotations

from typing import Final

PASSED: Final = 0
"""Done as asked, or asked to end; where there is a verdict, it passed."""
FAILED: Final = 1
"""The verdict failed, or something was not done; what and why was printed."""
BAD_INPUT: Final = 2
"""One message named what is wrong; nothing was begun."""
INTERRUPTED: Final = 130
"""After Ctrl-C, with everything that was started stopped."""
UNREAD: Final = 141
"""Who read its output left before the end (`handfast ... | head`): as of a program that SIGPIPE ends."""
