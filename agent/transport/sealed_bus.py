"""The bus of a secured fleet: links prove who is at their ends, and orders who gave them.

Only an operator can give an order, whoever relays it: it comes sealed (`agent.security.sealed_order`) and is
opened here, and those behind this never see one that is not genuine. A robot that relays an order publishes
the operator's own bytes. What is refused, by Zenoh or here, is logged in a few lines.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.credentials import Credentials, load, load_whenever
from handfast.agent.security.identity import Identity, Security
from handfast.agent.security.refusals import FILTER
from handfast.agent.security.sealed_order import Opener, OrderGate, Sealer
from handfast.agent.transport.batches import Batches
from handfast.agent.transport.bus import LINK_TIMEOUT_S, Bus, init_log
from handfast.agent.transport.zenoh_log import ZenohLog

Log = Callable[[str], None]


def secured(fleet: Fleet, found: Credentials) -> Security:
    """How links are secured of whoever has these credentials."""
    return Security(
        found.identity,
        str(found.files.authority),
        str(found.files.certificate),
        str(found.files.key),
        fleet.ids,
        fleet.network.operators,
        tuple(dict.fromkeys(router.identity_name for router in fleet.routers)),
    )


def gate_of(fleet: Fleet, found: Credentials, refused: Log) -> OrderGate:
    """Where orders come in and go out with whoever has these credentials.

    Args:
        refused: writes a line of the log for each order that is not let in.
    """
    sealer = Sealer(found) if found.identity.role == "operator" else None
    name = fleet.fleet.name
    opener = Opener(name, fleet.network.operators, found.authority)
    return OrderGate(name, fleet.ids, opener, sealer, refused)


class SealedBus(Bus):
    """A bus whose links are authenticated and whose orders are sealed. Of several in one process the one that
    was opened last is closed first, and reads what Zenoh refuses.

    Args:
        fleet: whose it is.
        folder: with the files of `identity`: a robot's, or an operator's, who seals what it says.
        log: writes a line of the log for what is refused.
        go_on_waiting: as of a `Bus`; asked after what was refused meanwhile has been said.
        keep_seals: gives orders sealed, as they came, to who keeps them as evidence.
        whenever: tries it with a certificate that is not valid now, too: robots judge by their clocks.
        bus: what else a `Bus` takes.

    Raises:
        handfast.agent.transport.bus.BusError: see `Bus`.
        handfast.agent.security.credentials.CredentialsError: the files are not there, or not valid.
    """

    def __init__(
        self,
        fleet: Fleet,
        folder: Path,
        identity: Identity,
        log: Log,
        go_on_waiting: Callable[[], bool] = lambda: False,
        keep_seals: bool = False,
        whenever: bool = False,
        **bus: Any,
    ) -> None:
        self._log, self._keep_seals = log, keep_seals
        self._zenoh_log = ZenohLog()
        try:
            init_log(FILTER)
            found = load_whenever(folder, identity) if whenever else load(folder, identity, time.time())
            self._gate = gate_of(fleet, found, self._zenoh_log.refusals.add)

            def waits() -> bool:
                self._say_refusals()  # why no router answers, if it is there
                return go_on_waiting()

            super().__init__(security=secured(fleet, found), go_on_waiting=waits, **bus)
        except BaseException:
            self._zenoh_log.close()
            raise

    def close(self) -> None:
        """As `Bus.close`; logs the refusals that still wait."""
        super().close()
        self._say_refusals(10 * NS_PER_S)  # what would have had to wait
        self._zenoh_log.close()

    def publish(self, key: str, payload: bytes) -> None:
        """Publishes; an order sealed: by this operator, or as the operator who gave it did.

        A robot cannot publish an order that it did not hear.
        """
        sealed = self._gate.let_out(key, payload, time.time_ns())
        if sealed is not None:
            super().publish(key, sealed)

    def as_it_came(self, payload: bytes) -> bytes:
        """See `Bus.as_it_came`: sealed. Nothing where the seal is no longer known, as of thousands of others
        since."""
        return self._gate.seal_of(payload) or b""

    def opened(self, came: bytes) -> bytes:
        """See `Bus.opened`: as an order of an operator's, whose certificate may have expired since."""
        return self._gate.recall(came)

    def drain(self) -> Sequence[tuple[str, bytes]]:
        """As `Bus.drain`, with orders opened, unless seals are kept; what is not genuine is left out and
        logged."""
        now_ns, found = time.time_ns(), []
        for key, payload in super().drain():
            opened = self._gate.let_in(key, payload, now_ns)
            if opened is not None:
                found.append((key, payload if self._keep_seals else opened))
        self._say_refusals()
        return found

    def _say_refusals(self, later_ns: int = 0) -> None:
        for line in self._zenoh_log.lines(time.monotonic_ns() + later_ns):
            self._log(line)


def bus_for(
    fleet: Fleet,
    identity: Identity | None,
    folder: Path | None,
    log: Log,
    *,
    listen: Sequence[str],
    connect: Sequence[str],
    near: Collection[str] = (),
    through_routers: bool = True,
    go_on_waiting: Callable[[], bool] = lambda: False,
    is_wanted: Callable[[], bool] | None = None,
    keep_seals: bool = False,
    whenever: bool = False,
    in_batches: bool = False,
) -> Bus:
    """The bus of one process of a fleet, secured or not, through its routers or not; see `Bus`, `SealedBus`.

    Args:
        identity, folder: of a secured fleet; None else.
        through_routers: False for a process that speaks only with its own robot's.
        keep_seals, whenever: as of a `SealedBus`.
        in_batches: for one that listens to other robots all the time.
    """
    routers = fleet.router_endpoints if through_routers else ()
    # Robots find each other again within a second; an operator may be far away, and has the time, for all
    # routers together.
    link_timeout_s = fleet.network.link_timeout_s
    if not listen:
        link_timeout_s = max(link_timeout_s, LINK_TIMEOUT_S / max(1, len(routers)))
    batches = None
    if in_batches and routers and fleet.batches_beacons:
        batches = Batches(fleet.fleet.name, fleet.ids, time.monotonic_ns(), hands=fleet.batches_hands)
    if identity is None or folder is None:
        return Bus(
            listen=listen,
            connect=connect,
            routers=routers,
            near=near,
            go_on_waiting=go_on_waiting,
            is_wanted=is_wanted,
            link_timeout_s=link_timeout_s,
            robots=len(fleet.robots),
            batches=batches,
            lease_ms=fleet.lease_ms,
        )
    return SealedBus(
        fleet,
        folder,
        identity,
        log,
        listen=listen,
        connect=connect,
        routers=routers,
        near=near,
        go_on_waiting=go_on_waiting,
        is_wanted=is_wanted,
        keep_seals=keep_seals,
        whenever=whenever,
        link_timeout_s=link_timeout_s,
        robots=len(fleet.robots),
        batches=batches,
        lease_ms=fleet.lease_ms,
    )
