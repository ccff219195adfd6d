"""Whether what runs in every tick is C, made by `make compiled`, or the Python that it is made of (PURE)."""

from __future__ import annotations

from typing import Final

from handfast.agent.common import time

COMPILED: Final = not (time.__file__ or "").endswith((".py", ".pyc"))
FORM: Final = "compiled" if COMPILED else "pure Python"
