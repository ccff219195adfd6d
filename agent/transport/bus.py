"""The bus over Zenoh; no other module of the agent imports it.

No callbacks: samples wait in bounded rings until `drain` takes them, so a flood costs its sender's
old messages and never this process's time or memory.
"""

from __future__ import annotations

import ctypes
import json
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from types import TracebackType
from typing import Any, Final, Literal

import zenoh

from handfast.agent.common.errors import Error
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.hosts import LEASE_MS
from handfast.agent.messages.key_expressions import robot_of_alive
from handfast.agent.node import inbox_size
from handfast.agent.security.identity import Security
from handfast.agent.transport.batches import Batches
from handfast.agent.transport.link_watch import PATIENCE_MAX, SOON_NS, LinkWatch
from handfast.agent.transport.tcp_links import TcpLinks

Mode = Literal["peer", "client", "router"]

PAYLOAD_BYTES_MAX: Final = 65_536
"""Larger payloads are dropped at the link. Above `agent.messages.types.BYTES_MAX`, so that most are
counted."""
RECEIVED_BYTES_MAX: Final = 2 * PAYLOAD_BYTES_MAX
"""A message that comes in fragments is put together up to this size: a payload, its key and all around them.
Zenoh would hold a gigabyte for each link before it looks at the size of the payload."""
KEEP_ALIVES: Final = 3
"""So many times within that a sign of life is sent on a link on which nothing else goes: one that is lost may
be lost once more, TCP says it again after 0.2 s and 0.4 s. With Zenoh's default of 4 it is a third of all for
which Zenoh's thread wakes in a robot that drives at 10 Hz, at either end."""
LINK_TIMEOUT_S: Final = 3.0
"""A link that is being opened and on which nothing comes for so long is tried again. Robots have a shorter
one among each other, by their fleet file: the first packet of an attempt is lost where a peer is out of
reach, and not sent again for a second."""
WANTED_S: Final = 0.05
"""So often it is asked whether a session is wanted still while it is being opened."""
TX_QUEUE_SIZE: Final = 16
"""Batches that wait on one link to be sent."""
RUNTIME: Final = (
    "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), "
    "rx: (handover: app), net: (handover: app))"
)
"""One thread for all of Zenoh's work instead of one or two for each kind: a robot's few hundred small
messages a second keep none of them busy, and handing over between threads cost a fifth of the CPU.
Zenoh reads it from the environment; a ``ZENOH_RUNTIME`` that is set already is left alone."""
RETRY_MS: Final = (50, 150)
"""Shortest and longest pause between two attempts to connect."""
OPEN_TIMEOUT_MS: Final = 10_000
"""Zenoh's own limit for opening a link, which may leave one that is never read from where it runs out
(`agent.transport.link_watch`, which is sooner): for what has no socket yet, as a name that is looked for."""
FLUSH_S: Final = 0.02
"""So long Zenoh's thread has to send what was published last, before a process ends."""
PRESENCE_SIZE: Final = 4096
"""Changes of who is there that wait, and that are taken at once."""
M_ARENA_MAX: Final = -8
"""Parameter of glibc's mallopt(3): the number of arenas."""


IsKnown = Callable[[str], object]
"""Gives None for the key of a token that stands for nothing."""

_OPENING: Final[list[threading.Thread]] = []
"""Threads that open sessions."""
_SESSIONS: Final[list[Any]] = []
"""All that are open in this process: a link is one of one of them."""


class BusError(Error):
    """The bus cannot be opened; the text says which endpoint and why."""


def settings_of(
    mode: Mode,
    listen: Sequence[str],
    connect: Sequence[str],
    security: Security | None,
    link_timeout_s: float = LINK_TIMEOUT_S,
    lease_ms: int = LEASE_MS,
) -> dict[str, Any]:
    """Zenoh's settings, by their paths in its configuration.

    Explicit endpoints only: no multicast, no gossip, so links are those that were asked for.
    """
    settings: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "listen/exit_on_failure": True,
        "connect/endpoints": list(connect),
        "connect/exit_on_failure": False,
        **({"connect/timeout_ms": _patience_ms(connect, link_timeout_s)} if mode == "client" else {}),
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
        "transport/link/tx/lease": lease_ms,
        "transport/link/tx/keep_alive": KEEP_ALIVES,
        "transport/unicast/open_timeout": OPEN_TIMEOUT_MS,
        # Messages of one tick wait here while Zenoh's thread has not run; its default of 2 lost some.
        "transport/link/tx/queue/size/data": TX_QUEUE_SIZE,
        "transport/link/rx/max_message_size": RECEIVED_BYTES_MAX,
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
    if security is not None:
        settings |= security.settings()
    return settings


def _patience_ms(routers: Sequence[str], link_timeout_s: float) -> int:
    """How long Zenoh is to try the first router of these again and again before it gives up. Of several it
    tries each once without that, and `LinkWatch` has it give up one that does not answer."""
    return round(link_timeout_s * 1000) if len(routers) < 2 else 0


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def init_log(wanted: str) -> None:
    """Has Zenoh log what `wanted` says, as ``RUST_LOG`` would, unless the environment says otherwise."""
    zenoh.init_log_from_env_or(wanted)


def _share_heap() -> None:
    """Lets Zenoh's threads take their memory from where the main thread does.

    Each thread has an arena of its own otherwise, which a peer that comes and goes leaves in pieces: some
    11 kB for each that starts again, for as long as the process lives; with one arena nothing. Only glibc
    has arenas.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, 1)


def _open(
    mode: Mode,
    listen: Sequence[str],
    connect: Sequence[str],
    security: Security | None,
    link_timeout_s: float = LINK_TIMEOUT_S,
    lease_ms: int = LEASE_MS,
) -> Any:
    """A session; raises `BusError`."""
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    _share_heap()
    try:
        session = zenoh.open(_config(settings_of(mode, listen, connect, security, link_timeout_s, lease_ms)))
        _SESSIONS.append(session)
        return session
    except zenoh.ZError as error:
        text = str(error)
    if mode == "client":
        raise BusError(f"no router answers at {' or '.join(connect)}")
    where = ", ".join(listen)
    if "os error 98" in text or "in use" in text:
        other = "let the router listen on another" if mode == "router" else "set another [network] base_port"
        raise BusError(f"cannot listen on {where}: the port is in use; stop what uses it, or {other}")
    if "os error 99" in text or "assign requested address" in text:
        raise BusError(f"cannot listen on {where}: this machine does not have that address")
    raise BusError(f"cannot open the bus on {where}: {text.split(' at ')[0]}")


def _close(session: Any) -> None:
    with suppress(zenoh.ZError):  # that it took too long
        if not session.is_closed():
            session.close()
    if session in _SESSIONS:
        _SESSIONS.remove(session)


def _open_links() -> set[str]:
    """Own addresses, ``HOST:PORT``, of all links of this process that are open."""
    found: set[str] = set()
    for session in tuple(_SESSIONS):
        with suppress(zenoh.ZError):  # closed meanwhile
            found.update(str(link.src).partition("/")[2] for link in session.info.links())
    return found


def _open_client(
    routers: Sequence[str],
    security: Security | None,
    go_on_waiting: Callable[[], bool],
    link_timeout_s: float,
    is_wanted: Callable[[], bool] | None = None,
    lease_ms: int = LEASE_MS,
) -> Any:
    """A session with the first router that answers. One that was there once is waited for by Zenoh itself.

    One that many ask at once is given more time with each try: whoever gives up costs it as much as who does
    not.
    """
    patience = 1
    while True:
        try:
            what = partial(
                _open, "client", [], routers, security, patience * link_timeout_s, lease_ms=lease_ms
            )
            return what() if is_wanted is None else _while_wanted(what, is_wanted)
        except BusError:
            if not go_on_waiting():
                raise
        time.sleep(RETRY_MS[1] / 1000)
        patience = min(2 * patience, PATIENCE_MAX)


def _while_wanted(opens: Callable[[], Any], is_wanted: Callable[[], bool]) -> Any:
    """What `opens` gives or raises, from a thread of its own: Zenoh waits for seconds, and meanwhile the main
    thread has to answer signals. A `BusError` when it is not wanted any more; the thread is left behind."""
    found: list[Any] = []
    given_up, handing_over = threading.Event(), threading.Lock()

    def open_it() -> None:
        try:
            session = opens()
        except BusError as error:
            found.append(error)
            return
        with handing_over:
            if not given_up.is_set():
                found.append(session)
                return
        _close(session)  # nobody has it, and one that stays open hangs the interpreter

    thread = threading.Thread(target=open_it, daemon=True)
    _OPENING.append(thread)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(WANTED_S)
            if thread.is_alive() and not is_wanted():
                raise BusError("no router has answered until it was not wanted any more")
    except BaseException:  # a KeyboardInterrupt, too
        with handing_over:
            given_up.set()
        for session in found:  # it came at the last moment
            if not isinstance(session, BusError):
                _close(session)
        raise
    _OPENING.remove(thread)
    if isinstance(found[0], BusError):
        raise found[0]
    return found[0]


def is_opening() -> bool:
    """Whether a session is being opened that nobody waits for. An interpreter must not end with such a
    thread: it would take the process down with it."""
    return any(thread.is_alive() for thread in _OPENING)


class Bus:
    """One process's place on the bus. A context manager: a session that stays open hangs the interpreter.

    Without routers it is one session, a peer of those it connects to and of those that connect to it. With
    routers it is a client of one of them for all that concerns others; what is between the processes of one
    robot goes directly, over a session of its own: a robot must not lose its body with its network.

    Args:
        listen: endpoints such as ``tcp/127.0.0.1:7600`` that others connect to.
        connect: endpoints of others; those not there yet are tried again until they are.
        routers: endpoints of routers; the first that answers is taken.
        near: keys that come directly from this robot's own processes, though there are routers.
        security: how links are secured, None for not at all.
        go_on_waiting: asked whether to try again when no router answers.
        is_wanted: asked all the while until one does, from where signals are answered; False: it raises,
            and the process has to end outright (`is_opening`).
        link_timeout_s: a link on which nothing new comes for so long while it is opened is tried again.
        robots: how many the fleet has: so much may come at once.
        lease_ms: who hears nothing of this process for so long takes it to be gone.
        batches: what is heard in batches from a router, None for nothing.

    Raises:
        BusError: an endpoint cannot be listened on, or no router answers.
    """

    def __init__(
        self,
        *,
        listen: Sequence[str],
        connect: Sequence[str],
        routers: Sequence[str] = (),
        near: Collection[str] = (),
        security: Security | None = None,
        go_on_waiting: Callable[[], bool] = lambda: False,
        is_wanted: Callable[[], bool] | None = None,
        link_timeout_s: float = LINK_TIMEOUT_S,
        robots: int = 1,
        batches: Batches | None = None,
        lease_ms: int = LEASE_MS,
    ) -> None:
        self._sessions: list[Any] = []
        self._near_keys = near
        self._robots = robots
        self._links = TcpLinks(
            LinkWatch(listen, [*connect, *routers], link_timeout_s, _open_links, one_of=routers)
        )
        self._were_deaf: list[str] = []
        self._reopened_ns: dict[str, int] = {}
        try:
            if listen or connect or not routers:
                self._sessions.append(_open("peer", listen, connect, security, link_timeout_s, lease_ms))
            if routers:
                with self._looking() if len(routers) > 1 else nullcontext():
                    client = _open_client(
                        routers, security, go_on_waiting, link_timeout_s, is_wanted, lease_ms
                    )
                    self._sessions.append(client)
        except BaseException:
            self.close()
            raise
        self._near, self._far = self._sessions[0], self._sessions[-1]
        self._batches = batches
        self._asked: Sequence[str] = ()
        self._inboxes: dict[str, tuple[str, Callable[[], Any], int, Any]] = {}
        """By subscription: its key where it is one, what takes a message, how many wait, the subscriber."""
        self._publishers: dict[str, list[Callable[[bytes], None]]] = {}
        self._tokens: list[Any] = []

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes its sessions; safe to call twice."""
        if not self._sessions:
            return
        closed = threading.Event()
        # Not a daemon: one that is in Zenoh when the interpreter ends takes the process down with it.
        thread = threading.Thread(target=self._give_up_until, args=(closed,))
        thread.start()
        try:
            for session in self._sessions:
                _close(session)
        finally:
            closed.set()
            thread.join()

    @contextmanager
    def _looking(self) -> Iterator[None]:
        """Within it links are looked at by a thread: this one waits for a router, and the one that is tried
        first may be there and not answer."""
        opened = threading.Event()

        def look() -> None:
            while not opened.wait(SOON_NS / NS_PER_S):
                self._links.look_at_opening()

        thread = threading.Thread(target=look)
        thread.start()
        try:
            yield
        finally:
            opened.set()
            thread.join()

    def _give_up_until(self, closed: threading.Event) -> None:
        """Closing a session waits for the links that are being opened, each as long as Zenoh's own limit."""
        while True:
            self._links.give_up()
            if closed.wait(RETRY_MS[0] / 1000):
                return

    def leave(self) -> None:
        """Instead of `close`, where the process ends outright: the kernel closes its links, which others see
        at once. A session that is closed says goodbye on each, and waits for all that it has begun."""
        time.sleep(FLUSH_S)
        self._sessions.clear()

    def subscribe(self, key: str, size: int | None = None) -> None:
        """Listens to `key`, which may hold wildcards; so many messages wait for `drain`, or as
        `agent.node.inbox_size` says."""
        size = inbox_size(key, self._robots) if size is None else size
        session = self._near if key in self._near_keys else self._far
        subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(size))
        self._inboxes[key] = "" if "*" in key else key, subscriber.handler.try_recv, size, subscriber

    def listen(self, subscriptions: Sequence[str]) -> None:
        """Listens to exactly these keys, and drains them in this order; what waits on others is lost."""
        if self._batches is not None:
            self._asked, subscriptions = subscriptions, self._batches.instead_of(subscriptions)
        for key in self._inboxes.keys() - set(subscriptions):
            self._inboxes.pop(key)[3].undeclare()
        for key in subscriptions:
            if key not in self._inboxes:
                self.subscribe(key)
        self._inboxes = {key: self._inboxes[key] for key in subscriptions}

    def announce(self, key: str) -> None:
        """Declares the liveliness token `key`; it goes when this process does."""
        self._tokens += [session.liveliness().declare_token(key) for session in self._sessions]

    @property
    def name(self) -> str:
        """Nobody else on the bus has the same."""
        return str(self._far.zid())

    def watch(self, key: str, is_known: IsKnown = robot_of_alive) -> Presence:
        """Watches the liveliness tokens that match `key`; those that `is_known` knows."""
        tokens = self._far.liveliness().declare_subscriber(
            key, zenoh.handlers.FifoChannel(PRESENCE_SIZE), history=True
        )
        return Presence(tokens, is_known)

    def declare(self, key: str) -> None:
        """Prepares to publish on `key`. A full link drops messages rather than stall the loop."""
        self._publishers[key] = [
            session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP).put
            for session in self._sessions
        ]

    def publish(self, key: str, payload: bytes) -> None:
        """Publishes on a key that was declared."""
        for put in self._publishers[key]:
            put(payload)

    def as_it_came(self, payload: bytes) -> bytes:
        """The bytes in which an operator's order came that `drain` gave, to keep it."""
        return payload

    def opened(self, came: bytes) -> bytes:
        """The order in the bytes that `as_it_came` gave once.

        Raises:
            ValueError: there is none in them; the text says why.
        """
        return came

    def drain(self) -> Sequence[tuple[str, bytes]]:
        """What has come since the last call, (key, payload), at most an inbox for each subscription."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._links.due_ns:
            self._were_deaf += self._links.look(now_ns)
        found = []
        for key, take, size, _ in self._inboxes.values():
            while (sample := take()) is not None:
                found.append((key or str(sample.key_expr), sample.payload.to_bytes()))
                size -= 1
                if not size:  # a flood that comes faster than it is taken must not keep the loop
                    break
        return found if self._batches is None else self._out_of_batches(found, self._batches, now_ns)

    def _out_of_batches(
        self, found: Sequence[tuple[str, bytes]], batches: Batches, now_ns: int
    ) -> list[tuple[str, bytes]]:
        """What was found, with what is in batches in their place."""
        opened: list[tuple[str, bytes]] = []
        for message in found:
            if message[0] in batches.keys:
                opened += batches.opened(*message, now_ns)
            else:
                opened.append(message)
                if batches.wants_each:
                    batches.came_singly(*message)
        if batches.look(now_ns):
            self.listen(self._asked)
        return opened

    def were_deaf(self) -> list[str]:
        """The endpoints of links on which nothing was read though they stood, and which were shut down since
        the last call, so that they are opened anew; "" stands for one that was opened to this process."""
        found, self._were_deaf = self._were_deaf, []
        return found

    def reopen(self, endpoint: str, pause_ns: int = 0) -> bool:
        """Has the link to an endpoint opened anew, if it is open, and that was not so ordered for `pause_ns`;
        whether it is."""
        now_ns, last_ns = time.monotonic_ns(), self._reopened_ns.get(endpoint)
        if last_ns is not None and now_ns - last_ns < pause_ns:
            return False
        done = self._links.reopen(endpoint)
        if done:
            self._reopened_ns[endpoint] = now_ns
        return done


class Router:
    """A router of a fleet: passes on what its clients say to those who listen. A context manager.

    Args:
        listen: endpoints that clients connect to.
        connect: endpoints of other routers.
        security, link_timeout_s, lease_ms: as of a `Bus`.

    Raises:
        BusError: an endpoint cannot be listened on.
    """

    def __init__(
        self,
        listen: Sequence[str],
        connect: Sequence[str],
        security: Security | None,
        link_timeout_s: float = LINK_TIMEOUT_S,
        lease_ms: int = LEASE_MS,
    ) -> None:
        self._session = _open("router", listen, connect, security, lease_ms=lease_ms)
        self._links = TcpLinks(LinkWatch(listen, connect, link_timeout_s, _open_links))

    def __enter__(self) -> Router:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _close(self._session)

    def look(self, now_ns: int) -> list[str]:
        """To be called often: looks at its links now and then, as a `Bus` does; which were deaf, see
        `Bus.were_deaf`."""
        return self._links.look(now_ns) if now_ns >= self._links.due_ns else []

    def watch(self, key: str) -> Presence:
        """See `Bus.watch`."""
        return Presence(
            self._session.liveliness().declare_subscriber(
                key, zenoh.handlers.FifoChannel(PRESENCE_SIZE), history=True
            )
        )


class Presence:
    """The processes that are alive, by their liveliness tokens; those that `is_known` knows."""

    def __init__(self, subscriber: Any, is_known: IsKnown = robot_of_alive) -> None:
        self._subscriber, self._take, self._is_known = subscriber, subscriber.handler.try_recv, is_known
        self.alive: set[str] = set()

    def close(self) -> None:
        """Watches them no longer."""
        self._subscriber.undeclare()

    def update(self) -> list[tuple[str, bool]]:
        """Changes since the last call: (key of the token, True when it came or False when it went).

        Tokens that stand for no process are neither returned nor kept: anybody may declare as
        many as he likes.
        """
        changes = []
        for _ in range(PRESENCE_SIZE):  # a flood that comes faster than it is taken must not keep the loop
            if (sample := self._take()) is None:
                break
            key, here = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            if self._is_known(key) is None or (here and len(self.alive) >= PRESENCE_SIZE):
                continue
            (self.alive.add if here else self.alive.discard)(key)
            changes.append((key, here))
        return changes
