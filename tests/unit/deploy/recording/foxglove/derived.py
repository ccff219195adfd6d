"""What is derived of made-up messages, and whether it is as its schema says."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from handfast.agent.messages.types import Message
from handfast.deploy.recording.foxglove.channels import Channels
from handfast.deploy.recording.foxglove.schemas import SCHEMAS, TOPICS
from tests.unit.deploy.synthetic_run import Sent

Shown = dict[str, list[tuple[int, Any]]]
"""By topic: when it was shown, and the content."""
_KINDS = {"string": str, "boolean": bool, "integer": int}
OPTIONAL = {"place_error_m", "nearest_m", "age_ms", "tick_us"} | {
    f"{name}_m" for name in ("least_distance", "worst_edge_error", "worst_place_error")
}
"""Left out where they are not known."""


def conforms(value: Any, schema: dict[str, Any]) -> bool:
    """Whether `value` has all that its JSON schema describes, and no more: by the few words that we use."""
    kind = schema["type"]
    if kind == "object":
        inside = schema["properties"]
        return (
            set(value) <= set(inside)
            and set(inside) - set(value) <= OPTIONAL
            and all(conforms(value[name], inside[name]) for name in value)
        )
    if kind == "array":
        return isinstance(value, list) and all(conforms(item, schema["items"]) for item in value)
    if kind == "number":
        return type(value) in (int, float)
    return type(value) is _KINDS[kind]


def of(channels: Channels, sent: Iterable[Sent]) -> Shown:
    """What `channels` shows of these messages; each is as its schema says."""
    shown: Shown = {}
    for now_ns, key, message in sent:
        for topic, name, content in channels.feed(now_ns, key, message):
            assert name == TOPICS[topic]
            value = json.loads(content, parse_constant=lambda text: 1 / 0)
            assert conforms(value, SCHEMAS[name]), (topic, value)
            shown.setdefault(topic, []).append((now_ns, value))
    return shown


def lines(shown: Shown) -> list[tuple[int, str, str]]:
    """Level, name and message of what was logged."""
    return [(value["level"], value["name"], value["message"]) for _, value in shown.get("/foxglove/log", [])]


def last(channels: Channels, now_ns: int, key: str, message: Message) -> dict[str, Any]:
    """By topic the last content that one message leads to."""
    return {topic: values[-1][1] for topic, values in of(channels, [(now_ns, key, message)]).items()}
