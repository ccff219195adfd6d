"""agent/common/compiled.py: which form of the program runs."""

from __future__ import annotations

from importlib import reload

import pytest

from handfast.agent.common import compiled, time


@pytest.mark.parametrize(
    ("file", "form"),
    [
        ("agent/common/time.py", "pure Python"),
        ("agent/common/time.pyc", "pure Python"),
        ("agent/common/time.cpython-311-x86_64-linux-gnu.so", "compiled"),
    ],
)
def test_the_form_is_told_by_a_module_that_is_always_compiled(
    file: str, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        with monkeypatch.context() as patch:
            patch.setattr(time, "__file__", file)
            assert form == reload(compiled).FORM
            assert (form == "compiled") == compiled.COMPILED
    finally:
        reload(compiled)
