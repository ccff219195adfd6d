"""Errors that a user can cause, missing packages, and exit statuses (PURE)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_OPERATOR: Final = "handfast.deploy"
_EXTRAS: Final = {
    "cryptography": "security",
    "distributed": "cluster",
    "foxglove": "foxglove",
    "pyarrow": "tables",
    "pymap3d": "rover",
    "rosbags": "ros2",
    "serial": "rover",
}
"""The extra that brings a package; it is ``operator`` for all others."""


class Error(Exception):
    """What a user asked for cannot be; the text says what is wrong, and what would be right."""


class MissingPackageError(Error, ImportError):
    """Something needs a package that is not installed; the text says how to install it."""


@contextmanager
def packages_named(what: str = "this") -> Iterator[None]:
    """A context, or a decorator, in which a package that `what` needs and that is not installed becomes a
    `MissingPackageError`. That one of our own is missing stays what it is, but for `deploy` as a whole, which
    robots do not have."""
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if not name or (name == "handfast" and error.name != _OPERATOR):
            raise
        raise MissingPackageError(f"{what} needs the package {error.name}: {install(name)}") from None


def install(package: str) -> str:
    """Return the command that installs a package together with handfast."""
    return f"pip install 'handfast[{_EXTRAS.get(package, 'operator')}]'"


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
