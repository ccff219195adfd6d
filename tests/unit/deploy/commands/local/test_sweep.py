"""The command ``handfast sweep`` with plugins: that fail while they drive, or are not installed any more."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.deploy import cli
from tests.passing_law import PassingLaw


@pytest.mark.parametrize(
    "named", [["--law", "gone_of_sweep:Gone"], ["--set", "control.law=gone_of_sweep:Gone"]]
)
def test_a_finished_sweep_is_looked_at_without_its_plugins(
    named: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    law, out = PassingLaw(tmp_path, monkeypatch, "gone_of_sweep"), tmp_path / "out"
    varied = ["--over", "control.gone.gain=0.5,1"]
    arguments = [
        "sweep",
        "pair",
        *named,
        *varied,
        "--duration",
        "1s",
        "--no-check",
        "--out",
        str(out),
        "--jobs=1",
    ]
    assert cli.main(arguments) == 0
    first = capsys.readouterr().out
    summary = (out / "summary.json").read_bytes()
    (out / "summary.json").unlink()
    law.leave()
    assert cli.main(["sweep", str(out), "--quiet"]) == 0
    assert capsys.readouterr().out == first
    assert (out / "summary.json").read_bytes() == summary, "with the digest of what was driven"

    assert cli.main(["sweep", str(out), "--write", "0"]) == 2, (
        "a file without the plugin's table helps nobody"
    )
    rows = (out / "results.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (out / "results.csv").write_text("".join(rows[:-1]), encoding="utf-8")
    capsys.readouterr()
    assert cli.main(["sweep", str(out), "--quiet"]) == 2
    assert "there is no module gone_of_sweep" in capsys.readouterr().err


def test_a_law_that_fails_in_mid_drive_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "late_of_sweep.py").write_text(
        "import handfast\n"
        "class Late(handfast.Law):\n"
        "    def acceleration(self, now):\n"
        "        if self.fleet.control.kp > 1.0 and now.time > 0.5:\n"
        "            raise RuntimeError('too late')\n"
        "        return now.navigation\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    named = ["pair", "--law", "late_of_sweep:Late", "--over", "control.kp=1,2", "--duration", "1s"]
    told = ["--quiet", "--no-check", "--jobs=1", "--out", str(tmp_path / "out")]
    assert cli.main(["sweep", *named, *told]) == 0
    assert (
        "\n1 of 2 runs ended with robots in fault; run 1: Robots 1 and 2 ended the drive in state fault: "
        "they did not drive on, as something of their own was wrong (law late_of_sweep:Late: RuntimeError: "
        "too late"
    ) in capsys.readouterr().out
