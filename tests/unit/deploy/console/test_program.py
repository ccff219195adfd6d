"""The program calls itself once more, whatever folder it is called in."""

from __future__ import annotations

import subprocess
from pathlib import Path

from handfast.deploy.console.data_files import handfast


def test_it_is_this_program_in_any_folder(tmp_path: Path) -> None:
    (tmp_path / "deploy").mkdir()
    (tmp_path / "deploy" / "cli.py").write_text("raise SystemExit('another program')")
    done = subprocess.run(
        handfast("check", "dalta"), cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("handfast: dalta: ")
