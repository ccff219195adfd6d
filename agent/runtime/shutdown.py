"""When a process is asked to end: by a signal, or because the process that started it is gone."""

from __future__ import annotations

import os
import signal
from argparse import ArgumentParser
from typing import Final

from handfast.agent.common.time import NS_PER_S

PARENT_PERIOD_NS: Final = 2 * NS_PER_S // 5
"""How often is looked for the parent process, ns."""


class Shutdown:
    """Whether the process was asked to end: by SIGTERM, SIGINT or SIGHUP (unless that is ignored, as nohup(1)
    has it), or because its parent is gone.

    A signal handler only sets a flag: Zenoh must be closed by the main thread.

    Args:
        with_parent: the process with which it ends, by its number: it may be gone already. 0: the one that is
            its parent now; None: none.
    """

    def __init__(self, *, with_parent: int | None) -> None:
        self.asked = False
        self.why = ""
        self._parent = None if with_parent is None else with_parent or os.getppid()
        ignores_hangup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        for number in (signal.SIGTERM, signal.SIGINT, *([] if ignores_hangup else [signal.SIGHUP])):
            signal.signal(number, self._on_signal)
        self.look_for_parent()

    def _on_signal(self, number: int, _frame: object) -> None:
        self.asked, self.why = True, signal.Signals(number).name
        self.look_for_parent()  # its end may be why the kernel sent it

    def look_for_parent(self) -> None:
        """Asks the process to end when its parent is gone, if it is to end with it."""
        if self._parent is not None and os.getppid() != self._parent:
            self.asked, self.why = True, "the process that started it is gone"


def add_parent_argument(parser: ArgumentParser) -> None:
    """Has a process's command line take what `Shutdown` has as `with_parent`, as ``exit_with_parent``."""
    parser.add_argument(
        "--exit-with-parent",
        type=int,
        nargs="?",
        const=0,
        metavar="PID",
        help="end when the process that started it is gone, whose number may be given",
    )
