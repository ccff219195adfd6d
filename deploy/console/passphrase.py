"""A passphrase, asked for at the terminal or taken from the environment; never shown, nor an argument."""

from __future__ import annotations

import getpass
import os
import sys
from typing import Final

from handfast.deploy.console.arguments import InputError

PASSPHRASE: Final = "HANDFAST_PASSPHRASE"
"""Variable of the environment for programs, which have no terminal."""
LENGTH_MIN: Final = 12


def passphrase(what: str, *, new: bool) -> str:
    """The passphrase of `what`.

    Args:
        new: it is chosen now: it must be long enough, and is asked for twice.

    Raises:
        InputError: there is neither a terminal nor the variable, or what is given will not do.
    """
    given = os.environ.get(PASSPHRASE, "")
    if not given:
        given = _asked(what, new=new)
    if new and len(given) < LENGTH_MIN:
        raise InputError(f"the passphrase of {what} must have at least {LENGTH_MIN} characters")
    return given


def _asked(what: str, *, new: bool) -> str:
    if not sys.stdin.isatty():
        raise InputError(f"{what} has a passphrase: set {PASSPHRASE}, or say this at a terminal")
    try:
        first = getpass.getpass(f"Passphrase of {what}: ")
        if new and getpass.getpass("The same again: ") != first:
            raise InputError("the two passphrases are not the same")
    except EOFError:
        raise InputError(f"no passphrase of {what} was given") from None
    return first
