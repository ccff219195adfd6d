"""What the small objects of a tick hold, to compare them."""

from __future__ import annotations

from inspect import signature
from typing import Any


def values(made: Any) -> tuple[Any, ...]:
    """What an object was made of, in the order in which its class takes it."""
    return tuple(getattr(made, name) for name in list(signature(type(made)).parameters))
