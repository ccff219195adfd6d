"""Points in time as people type them."""

from __future__ import annotations

import argparse
import re
from datetime import datetime, timedelta
from typing import Final

from handfast.deploy.console.arguments import InputError

FORMS: Final = '"10 min", "2 h", 14:30, today, yesterday, "2026-11-20 14:00"'
_AGO: Final = re.compile(r"(\d{1,9}) ?(s|min|h|d)")
_SECONDS: Final = {"s": 1, "min": 60, "h": 3600, "d": 86_400}
_FORMATS: Final = ("%Y-%m-%d %H:%M:%S", "%Y-%m-%d %H:%M", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M", "%Y-%m-%d")
_CLOCK: Final = ("%H:%M:%S", "%H:%M")


def point_in_time(text: str, now_s: float) -> float:
    """Seconds since the Unix epoch of what `text` means: so long ago, or a time of this machine's zone.

    Raises:
        ValueError: it means none; the text says what would be right.
    """
    text = text.strip()
    ago = _AGO.fullmatch(text.removesuffix(" ago"))
    if ago is not None:
        return now_s - int(ago[1]) * _SECONDS[ago[2]]
    midnight = datetime.fromtimestamp(now_s).replace(hour=0, minute=0, second=0, microsecond=0)
    if text in ("today", "yesterday"):
        return (midnight - timedelta(days=text == "yesterday")).timestamp()
    for form in _FORMATS + _CLOCK:
        try:
            found = datetime.strptime(text, form)
            if form in _CLOCK:
                found = datetime.combine(midnight.date(), found.time())
            return found.timestamp()
        except (ValueError, OverflowError):
            continue
    raise ValueError(f"must be such as {FORMS}, got {text!r}")


def time_option(options: argparse.Namespace, name: str, now_s: float) -> float | None:
    """Return the point in time that the option `name` gives, None without it.

    Raises:
        InputError: it means no point in time.
    """
    text = getattr(options, name)
    if text is None:
        return None
    try:
        return point_in_time(text, now_s)
    except ValueError as error:
        raise InputError(f"--{name} {error}") from None
