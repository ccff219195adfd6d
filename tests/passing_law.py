"""A law of others that is installed for a while: for what is looked at where it is not any more."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

import pytest

_TEXT: Final = """
from dataclasses import dataclass
from handfast import Law, setting

@dataclass(frozen=True)
class Settings:
    gain: float = setting(1.0, "Gain.", ge=0)

class Gone(Law):
    section = "gone"
    Settings = Settings

    def acceleration(self, now):
        x, y = now.navigation
        return self.settings.gain * x, self.settings.gain * y
"""


class PassingLaw:
    """A law with the table `[control.gone]` in a module that is there until `leave`.

    Attributes:
        module: its name, of this test alone.
        reference: as a fleet file gives it.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, module: str) -> None:
        self.module, self.reference = module, f"{module}:Gone"
        self._path = folder / f"{module}.py"
        self._path.write_text(_TEXT, encoding="utf-8")
        monkeypatch.syspath_prepend(str(folder))

    def leave(self) -> None:
        """It is not installed any more."""
        self._path.unlink()
        del sys.modules[self.module]  # for good: the next law of this name has another file
