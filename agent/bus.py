"""Zenoh, and the only module of the agent that imports it.

No callbacks: samples wait in bounded rings until `drain` takes them, so a flood costs its sender's
old messages and never this process's time or memory. See `facts/zenoh.md` for what was measured.
"""

from __future__ import annotations

import ctypes
import json
import os
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any, Final

import zenoh

from agent.node import INBOX_SIZE

PAYLOAD_BYTES_MAX: Final = 65_536
"""Larger payloads are dropped at the link. Above `messages.BYTES_MAX`, so that most are counted."""
LEASE_MS: Final = 1000
OPEN_TIMEOUT_MS: Final = 1000
TX_QUEUE_SIZE: Final = 16
RUNTIME: Final = (
    "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), "
    "rx: (handover: app), net: (handover: app))"
)
"""One thread for all of Zenoh's work instead of one or two for each kind: a robot's few hundred small
messages a second keep none of them busy, and handing over between threads cost a fifth of the CPU.
Zenoh reads it from the environment; a ``ZENOH_RUNTIME`` that is set already is left alone."""
RETRY_MS: Final = (50, 200)
M_ARENA_MAX: Final = -8
"""Of glibc's `mallopt`."""


class BusError(RuntimeError):
    """The bus cannot be opened; the text says which endpoint and why."""


def _config(listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
    """A peer on explicit endpoints: no multicast, no gossip, so links are those that were asked for."""
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "listen/exit_on_failure": True,
        "connect/endpoints": list(connect),
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": RETRY_MS[0],
            "period_max_ms": RETRY_MS[1],
            "period_increase_factor": 2,
        },
        # Opening does not wait for anybody: neighbours come when they come.
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        # A frozen process accepts connections but does not answer: nobody waits long for it.
        "transport/unicast/open_timeout": OPEN_TIMEOUT_MS,
        # Messages of one tick wait here while Zenoh's thread has not run; its default of 2 lost some.
        "transport/link/tx/queue/size/data": TX_QUEUE_SIZE,
        "transport/shared_memory/enabled": False,
        "low_pass_filter": [
            {
                "flows": ["ingress"],
                "messages": ["put", "query", "reply"],
                "key_exprs": ["**"],
                "size_limit": PAYLOAD_BYTES_MAX,
            }
        ],
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _share_heap() -> None:
    """Lets Zenoh's threads take their memory from where the main thread does.

    Each thread has an arena of its own otherwise, which a peer that comes and goes leaves in pieces: some
    11 kB for each that starts again, for as long as the process lives; with one arena nothing. Only glibc
    has arenas.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, 1)


class Bus:
    """One session on the bus. Use it as a context manager: a session left open hangs the interpreter.

    Args:
        listen: endpoints such as ``tcp/127.0.0.1:7600`` that others connect to.
        connect: endpoints of others; those not there yet are tried again until they are.

    Raises:
        BusError: an endpoint cannot be listened on.
    """

    def __init__(self, *, listen: Sequence[str], connect: Sequence[str]) -> None:
        os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
        _share_heap()
        try:
            self._session = zenoh.open(_config(listen, connect))
        except zenoh.ZError as error:
            text = str(error)
            where = ", ".join(listen)
            if "os error 98" in text or "in use" in text:
                raise BusError(
                    f"cannot listen on {where}: the port is in use; stop what uses it, "
                    "or set another [network] base_port"
                ) from None
            if "os error 99" in text or "assign requested address" in text:
                raise BusError(f"cannot listen on {where}: this machine does not have that address") from None
            raise BusError(f"cannot open the bus on {where}: {text.split(' at ')[0]}") from None
        self._inboxes: dict[str, tuple[str, Any, int]] = {}
        self._publishers: dict[str, Any] = {}
        self._tokens: list[Any] = []

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the bus; safe to call twice."""
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def subscribe(self, key: str, inbox_size: int = INBOX_SIZE) -> None:
        """Listens to `key`, which may hold wildcards; messages wait for `drain`."""
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(inbox_size))
        self._inboxes[key] = "" if "*" in key else key, subscriber, inbox_size

    def listen(self, subscriptions: Sequence[str]) -> None:
        """Listens to exactly these keys, and drains them in this order; what waits on others is lost."""
        for key in self._inboxes.keys() - set(subscriptions):
            self._inboxes.pop(key)[1].undeclare()
        for key in subscriptions:
            if key not in self._inboxes:
                self.subscribe(key)
        self._inboxes = {key: self._inboxes[key] for key in subscriptions}

    def announce(self, key: str) -> None:
        """Declares the liveliness token `key`; it goes when this process does."""
        self._tokens.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str) -> Presence:
        """Watches the liveliness tokens that match `key`."""
        return Presence(
            self._session.liveliness().declare_subscriber(key, zenoh.handlers.FifoChannel(4096), history=True)
        )

    def declare(self, key: str) -> None:
        """Prepares to publish on `key`. A full link drops messages rather than stall the loop."""
        self._publishers[key] = self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP
        )

    def publish(self, key: str, payload: bytes) -> None:
        """Publishes on a key that was declared."""
        self._publishers[key].put(payload)

    def drain(self) -> Iterator[tuple[str, bytes]]:
        """What has come since the last call, (key, payload), at most an inbox for each subscription."""
        for key, subscriber, inbox_size in self._inboxes.values():
            for _ in range(inbox_size):  # a flood that comes faster than it is taken must not keep the loop
                if (sample := subscriber.try_recv()) is None:
                    break
                yield key or str(sample.key_expr), sample.payload.to_bytes()


class Presence:
    """The processes that are alive, by their liveliness tokens."""

    def __init__(self, subscriber: Any) -> None:
        self._subscriber = subscriber
        self.alive: set[str] = set()

    def update(self) -> list[tuple[str, bool]]:
        """Changes since the last call: (key of the token, True when it came or False when it went)."""
        changes = []
        while (sample := self._subscriber.try_recv()) is not None:
            key, here = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            (self.alive.add if here else self.alive.discard)(key)
            changes.append((key, here))
        return changes
