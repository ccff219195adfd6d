"""Values, keys and types in words, as messages to people show them (PURE)."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import is_dataclass
from types import UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin

from handfast.agent.common.settings import Setting

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,60}")
_BEGINNING_MIN: Final = 3
"""What is shorter begins too many names to be one of them, cut off."""


def show(value: object, limit: int = 60) -> str:
    """A value as TOML writes it, on one line and cut at `limit` characters."""
    text = printable(_show(value, 3))
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _show(value: object, depth: int) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and value.bit_length() > 200:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, str):
        return json.dumps(value[:200], ensure_ascii=False)
    if isinstance(value, (list, tuple, Mapping)):
        if depth == 0:
            return "..."
        if isinstance(value, Mapping):
            pairs = list(value.items())[:10]
            return "{" + ", ".join(f"{key_text(k)} = {_show(v, depth - 1)}" for k, v in pairs) + "}"
        return "[" + ", ".join(_show(item, depth - 1) for item in value[:30]) + "]"
    return str(value)


def printable(text: str) -> str:
    """The text on one line and safe to print: control characters and lone surrogates are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def key_text(key: object) -> str:
    """A key as TOML writes it: bare where that is allowed, else quoted and cut short."""
    text = str(key)
    return text if _BARE_KEY.fullmatch(text) else show(text, 30)


def did_you_mean(name: str, names: Iterable[str], spelled: Callable[[str], str] = str, most: int = 1) -> str:
    """The question "did you mean A or B?" with the names that are most like a name that nothing has; "" when
    none is like it.

    Args:
        spelled: how a name is shown.
        most: so many of them.
    """
    from difflib import get_close_matches  # here: a robot starts faster without it

    if len(name) > 60:  # slow to compare
        return ""
    known = list(names)
    near = get_close_matches(name, known, n=most, cutoff=0.6)
    if len(name) >= _BEGINNING_MIN:
        near += [each for each in known if each.startswith(name) and each not in near][: most - len(near)]
    if not near:
        return ""
    *first, last = map(spelled, near)
    return f"did you mean {', '.join(first)}{' or ' if first else ''}{last}?"


def joined(place: str, key: object) -> str:
    """The place of `key` in the table at `place`, "" for the root: ``control.kp``."""
    return f"{place}.{key_text(key)}" if place else key_text(key)


def example(hint: Any, said: Setting, default: object = None) -> str:
    """TOML text of one value that a field would accept."""
    if said.example is not None:
        return said.example
    if default is not None:
        return show(default)
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return example(args[0], said)
    if origin is Literal:
        return show(args[0])
    if origin is tuple:
        items = args[:1] if args[-1] is Ellipsis else args
        # Not the same number twice: as a pair of robots that is refused.
        parts = [str(n) if item is int else example(item, said) for n, item in enumerate(items, 1)]
        return "[" + ", ".join(parts) + "]"
    return {float: "1.0", int: "1", bool: "true"}.get(hint, '"text"')


def describe(hint: Any, unit: str | None = None) -> str:
    """A type in words: "a number (s)", "an array of pairs ..."."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(describe(arg, unit) for arg in args)
    if origin is Literal:
        return "one of " + ", ".join(show(arg) for arg in args)
    if is_dataclass(hint):
        return "a table"
    if origin is tuple:
        if args[-1] is not Ellipsis:
            return f"an array of {len(args)} {_plural(args[0], unit)}"
        return f"an array of {_plural(args[0], unit)}"
    if hint is bool:
        return "true or false"
    if hint is str:
        return "a string"
    return ("a whole number" if hint is int else "a number") + (f" ({unit})" if unit else "")


def _plural(hint: Any, unit: str | None) -> str:
    if get_origin(hint) is tuple:
        args = get_args(hint)
        return f"arrays of {len(args)} {_plural(args[0], unit)}"
    if is_dataclass(hint):
        return "tables"
    if hint is str:
        return "strings"
    return ("whole numbers" if hint is int else "numbers") + (f" ({unit})" if unit else "")
