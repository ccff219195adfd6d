"""A flood of connections (`tests.process.flood`) in a process of its own, for as long as a test wants it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from tests.process.harness import environment

Target = tuple[str, int]
"""Address and port."""


class Flooding:
    """A flood that goes on."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def end(self) -> int:
        """Ends it; returns how many connections it opened."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        return int(self._process.stdout.readline())


def targets_of(endpoints: Iterable[str]) -> list[Target]:
    """Where endpoints such as ``tls/127.0.0.1:7600`` are."""
    places = [endpoint.partition("/")[2].rpartition(":") for endpoint in endpoints]
    return [(address, int(port)) for address, _, port in places]


@contextmanager
def flooding(
    targets: Sequence[Target], per_s: int, kind: str, *, sources: int = 0, inside: Sequence[str] = ()
) -> Iterator[Flooding]:
    """Strangers that try all the while, from when they are ready until the context's end.

    Args:
        targets: where to, in turn.
        per_s: connections a second, of all targets together.
        kind, sources: see `tests.process.flood`.
        inside: a command that runs the one behind it, in another network.
    """
    options = {"targets": targets, "rate": per_s, "sources": sources, "kind": kind}
    with subprocess.Popen(
        [*inside, sys.executable, "-m", "tests.process.flood", json.dumps(options)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment(),
        start_new_session=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            yield Flooding(process)
        finally:
            process.kill()
