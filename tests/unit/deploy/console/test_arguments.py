"""What FLEET and SCENARIO mean on the command line."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

import pytest

from handfast.deploy.console.arguments import InputError, fleet_path, report_arguments, scenario_path
from handfast.deploy.console.data_files import FLEETS


def test_a_file_goes_before_a_bundled_fleet_and_a_folder_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fleet_path("delta") == FLEETS / "delta.toml"
    Path("delta").mkdir()  # such as a run's folder
    assert fleet_path("delta") == FLEETS / "delta.toml"
    Path("delta").rmdir()
    Path("delta").touch()
    assert fleet_path("delta") == Path("delta")


def test_a_folder_that_is_no_fleet_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is a folder, not a fleet file$"):
        fleet_path(str(tmp_path))
    (tmp_path / "fleet.toml").touch()
    with pytest.raises(InputError, match=r"is a folder, not a fleet file: give .*/fleet\.toml$"):
        fleet_path(str(tmp_path))
    with pytest.raises(InputError, match=r"is a folder, not a scenario file$"):
        scenario_path(str(tmp_path))


def test_a_name_that_nothing_has() -> None:
    with pytest.raises(InputError, match=r"^other: no such file, and no bundled fleet .*: delta, "):
        fleet_path("other")
    assert fleet_path("dleta.toml") == Path("dleta.toml")  # the one who reads it says that it is not there


def test_a_name_that_is_like_one_there_is() -> None:
    for path, name, what, meant in (
        (fleet_path, "dleta", "fleet", "delta"),
        (fleet_path, "obs", "fleet", "obstacles"),
        (scenario_path, "partitoin", "scenario", "partition"),
    ):
        with pytest.raises(InputError) as caught:
            path(name)
        said = f"{name}: no such file, and no bundled {what} of that name; did you mean {meant}?"
        assert str(caught.value) == said


@pytest.mark.parametrize("name", ["a" * 300, "x/" * 3000, "é" * 200])
def test_a_name_that_no_file_can_have_is_refused_in_one_line(name: str):
    with pytest.raises(InputError, match="too long for the name"):
        fleet_path(name)


def test_formats_of_figures_are_told_in_one_option(capsys: pytest.CaptureFixture[str]) -> None:
    parser = ArgumentParser()
    report_arguments(parser)
    assert parser.parse_args([]).figures == ()
    assert parser.parse_args(["--figures", "png, PDF,pdf"]).figures == ("png", "pdf")
    for wrong in ("eps", "pdf,", ""):
        with pytest.raises(SystemExit) as ended:
            parser.parse_args(["--figures", wrong])
        assert ended.value.code == 2
        *_, said = capsys.readouterr().err.splitlines()
        assert said.endswith(
            f'"{wrong.removeprefix("pdf,")}": no format of figures; there are: png, svg, pdf'
        )
    with pytest.raises(SystemExit):
        parser.parse_args(["--no-report", "--figures", "pdf"])
    assert "not allowed with" in capsys.readouterr().err
