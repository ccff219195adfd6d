"""The process of a worker on a host: what it makes of its settings."""

from __future__ import annotations

import asyncio
from typing import Any

import distributed
import pytest

from handfast.deploy.cluster.on_hosts import credentials
from handfast.deploy.cluster.worker_process import DEATH_TIMEOUT_S, serve


class Nanny:
    made: dict[str, Any]
    finished_called = False

    def __init__(self, scheduler: str, **options: Any) -> None:
        Nanny.made = options | {"scheduler": scheduler}

    async def __aenter__(self) -> Nanny:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def finished(self) -> None:
        Nanny.finished_called = True


def test_a_nanny_is_started_as_the_settings_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "Nanny", Nanny)
    key, certificate = credentials()
    settings = {
        "scheduler": "tls://192.0.2.1:1", "host": "192.0.2.2", "name": "host1", "threads": 3,
        "folder": "/tmp/x", "key": key, "certificate": certificate,
    }  # fmt: skip
    asyncio.run(serve(settings))
    made = Nanny.made
    assert (made["scheduler"], made["host"], made["name"]) == ("tls://192.0.2.1:1", "192.0.2.2", "host1")
    assert (made["nthreads"], made["memory_limit"], made["death_timeout"]) == (3, 0, DEATH_TIMEOUT_S)
    assert made["security"].tls_worker_key == key
    assert Nanny.finished_called
