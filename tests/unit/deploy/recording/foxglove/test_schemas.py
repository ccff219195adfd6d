"""Topics and schemas: complete, and none that a bus could have."""

from __future__ import annotations

from typing import Any

import foxglove.messages
import pytest

from handfast.agent.messages.types import CLASSES
from handfast.agent.recorder.message_json import schema_name
from handfast.deploy.recording.foxglove.schemas import SCHEMAS, TOPICS


def test_every_topic_has_a_schema_of_its_name_and_every_schema_a_topic() -> None:
    assert set(TOPICS.values()) == set(SCHEMAS)
    assert all(schema["title"] == name for name, schema in SCHEMAS.items())
    assert all(topic.startswith("/foxglove/") for topic in TOPICS)  # no key of Zenoh's begins with a slash


def test_no_schema_is_that_of_a_message() -> None:
    """A reader of the recording takes what it finds under those names for messages."""
    assert not set(SCHEMAS) & {schema_name(cls) for cls in CLASSES}


@pytest.mark.parametrize("name", [name for name in SCHEMAS if name.startswith("foxglove.")])
def test_what_is_described_of_a_well_known_schema_is_in_it(name: str) -> None:
    """By the fields of the SDK's own classes, which are made of the same declarations."""

    def check(described: dict[str, Any]) -> None:
        title = described.get("title", "")
        known = getattr(foxglove.messages, title.removeprefix("foxglove."), None)
        if title.startswith("foxglove."):
            assert known is not None, title
            for field in described["properties"]:
                assert f" {field}=" in known.__text_signature__, (title, field)
        for inside in described.get("properties", {}).values():
            check(inside.get("items", inside))

    check(SCHEMAS[name])
