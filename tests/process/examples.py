"""The package of examples, `docs/examples`, installed beside this source tree for the processes of a test."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from tests.process.harness import ROOT

PIP: Final = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index")


@contextmanager
def installed(folder: Path) -> Iterator[None]:
    """A context in which all processes find the package, which is installed into a folder."""
    source = str(ROOT / "docs/examples")
    subprocess.run([*PIP, "--no-build-isolation", "--target", str(folder), source], check=True, timeout=120)
    with pytest.MonkeyPatch.context() as patch:
        path = os.environ.get("PYTHONPATH")
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(folder), path])))
        yield
