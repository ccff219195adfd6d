"""Ctrl-C while the command is loaded ends it in silence."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from tests.process.harness import ROOT

PATH = f"import sys; sys.path.insert(0, {str(ROOT)!r}); "

INTERRUPTED_WHILE_IT_LOADS = """
import os, signal, sys

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == "handfast.deploy.cli":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupts())
sys.argv = ["handfast"]
{more}
from handfast.deploy.start import process
sys.exit(process())
"""


@pytest.mark.parametrize(
    ("more", "status"), [("", -signal.SIGINT), ("signal.signal(signal.SIGINT, signal.SIG_IGN)", 0)]
)
def test_ctrl_c_while_it_loads_says_nothing(more: str, status: int) -> None:
    source = INTERRUPTED_WHILE_IT_LOADS.replace("{more}", more)
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (status, "")
    assert ("handfast check delta" in done.stdout) == (status == 0), "who ignores it begins"


def test_nothing_that_takes_time_is_loaded_before_it() -> None:
    source = "import sys; before = set(sys.modules); import handfast.deploy.start; "
    source += "print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-I", "-S", "-c", PATH + source], capture_output=True, text=True)
    expected = {"__future__", "handfast", "handfast.deploy", "handfast.deploy.start"}
    assert set(done.stdout.split()) <= expected, done.stderr
    assert done.stdout
