"""Scenarios as text: fleet files with short arrays on one line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

_WIDTH: Final = 110


def scenario_text(tables: Mapping[str, Any]) -> str:
    """Return the fleet file of these tables."""
    top = [_entry(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    sections = [
        "\n".join([f"[{key}]", *(_entry(name, each) for name, each in value.items())])
        for key, value in tables.items()
        if isinstance(value, dict)
    ]
    return "\n\n".join(["\n".join(top), *sections]) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _entry(key: str, value: Any) -> str:
    text = f"{key} = {_value(value)}"
    if len(text) <= _WIDTH or not isinstance(value, list):
        return text
    lines = [""]
    for part in map(_value, value):
        if lines[-1] and len(lines[-1]) + len(part) + 6 > _WIDTH:
            lines.append("")
        lines[-1] += f"{' ' if lines[-1] else ''}{part},"
    return f"{key} = [\n" + "".join(f"    {line}\n" for line in lines) + "]"
