"""Commands that need no fleet that runs: what they take, and what they need to be installed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Final

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.check.capacity import Machine
from handfast.deploy.check.check import check
from handfast.deploy.cli import COMMANDS, GROUPS, _parser, main
from handfast.deploy.console.data_files import FLEETS

ROOT = Path(__file__).parents[3]
OPERATORS = ("matplotlib", "mcap", "orjson", "pyarrow", "rich", "shtab", "websockets")
WITHOUT = """
import sys
sys.modules |= dict.fromkeys(sys.argv[1].split(","))
from handfast.deploy.cli import main
sys.exit(main(sys.argv[2:]))
"""


def without(packages: Sequence[str], *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command where these packages are not installed."""
    words = [sys.executable, "-c", WITHOUT, ",".join(packages), *arguments]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("package", "extra", "arguments"),
    [
        ("orjson", "operator", ("report", "runs")),
        ("matplotlib", "operator", ("export", "runs", "--format", "gif")),
        ("websockets", "operator", ("view", "runs")),
        ("shtab", "operator", ("completion", "bash")),
        ("pyarrow", "tables", ("export", "runs", "--format", "parquet")),
        ("rosbags", "ros2", ("export", "runs", "--format", "rosbag2")),
        ("distributed", "cluster", ("sweep", "pair", "--cluster", "tcp://127.0.0.1:1")),
        ("cryptography", "security", ("keys", "pair")),
        ("pymap3d", "rover", ("rover-simulator", "--listen", "nowhere")),
    ],
)
def test_a_command_names_the_extra_that_it_lacks_in_one_line(
    package: str, extra: str, arguments: tuple[str, ...]
) -> None:
    ran = without([package], *arguments)
    assert (ran.returncode, ran.stdout) == (2, ""), ran.stderr
    assert re.fullmatch(rf"handfast: .*\b{package}\b.*pip install 'handfast\[{extra}\]'.*\n", ran.stderr)


def test_without_a_recorder_a_simulation_says_so_and_is_judged(tmp_path: Path) -> None:
    out = tmp_path / "run"
    ran = without(OPERATORS, "simulate", "pair", "--duration", "12s", "--quiet", "--out", str(out))
    assert (ran.returncode, ran.stdout.split()[0]) == (0, "PASSED"), ran.stderr
    assert ran.stderr == (
        "handfast: there will be no recording and no report: the package mcap is not installed: "
        "pip install 'handfast[operator]'\n"
    )
    assert {path.name for path in out.iterdir()} == {"events.txt", "fleet.toml", "metrics.json"}


def test_a_rover_can_be_simulated_without_the_operators_packages() -> None:
    ran = without(OPERATORS, "rover-simulator", "--listen", "nowhere")
    assert ran.returncode == 2
    assert "nowhere" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_the_simulators_options_are_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["rover-simulator", "--help"])
    assert ended.value.code == 0
    assert "--hand-over" in capsys.readouterr().out


def test_a_fleet_of_simulated_robots_has_nothing_to_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["preflight", "pair"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines() == [
        "robots 1 and 2  simulated: nothing to check",
        "CLEAR",
    ]


@pytest.mark.parametrize(
    "arguments",
    [
        ("stop", "--reason", "x"),
        ("resume",),
        ("change join", "--robot", "7", "--edges", "3,5"),
        ("change leave", "--robot", "4"),
        ("change replace", "--robot", "3", "--by", "7"),
        ("change remove", "--robot", "3", "--robot", "7"),
        ("change reshape", "--scale", "1.5"),
        ("heartbeat",),
    ],
)
def test_there_is_nobody_to_order(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    command, *options = arguments
    assert main([*command.split(), "no-such-fleet-runs", *options]) == 2
    assert 'no fleet of the name "no-such-fleet-runs" runs here' in capsys.readouterr().err


def test_a_reshaping_must_change_something(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["change", "reshape", "delta", "--over", "5s"]) == 2
    assert capsys.readouterr().err == ("handfast: reshape changes nothing: give --scale, --from or --set\n")
    assert main(["change", "reshape", "delta", "--from", "no-such-fleet"]) == 2
    assert "no bundled fleet of that name" in capsys.readouterr().err


def test_a_fleet_without_a_switch_needs_no_heartbeats(capsys: pytest.CaptureFixture[str]) -> None:
    """A fleet file that runs nowhere here is taken as it is."""
    assert main(["heartbeat", str(FLEETS / "pair.toml")]) == 2
    assert "pair has no dead-man's switch" in capsys.readouterr().err


HEAVY = (
    "zenoh",
    "pymavlink",
    "serial",
    "pymap3d",
    "cryptography",
    "msgpack",
    "matplotlib",
    "mcap",
    "pyarrow",
    "rich",
    "tomli_w",
    "importlib.metadata",
    "statistics",
)
LOADED = """
import sys
from contextlib import redirect_stdout, suppress
from io import StringIO
from handfast.deploy.cli import main
with redirect_stdout(StringIO()), suppress(SystemExit):
    main(sys.argv[1:])
print(*sys.modules)
"""


def loaded_by(*arguments: str) -> set[str]:
    """Modules that a command loads."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


@pytest.mark.parametrize("arguments", [("--help",), ()])
def test_help_loads_no_command_and_nothing_of_fleets(arguments: tuple[str, ...]) -> None:
    loaded = loaded_by(*arguments)
    assert not loaded & {*HEAVY, "numpy", "handfast.bridges", "handfast.plant"}
    light = {"handfast.agent.common", "handfast.agent.common.errors"}
    assert {name for name in loaded if name.startswith("handfast.agent.")} == light
    assert not [name for name in loaded if name.startswith("handfast.deploy.commands.")]


def test_check_loads_only_what_it_computes_with() -> None:
    loaded = loaded_by("check", "delta")
    assert not loaded & (set(HEAVY) - {"msgpack"})
    assert not loaded & {
        "handfast.agent.core",
        "handfast.deploy.recording.recording",
        "handfast.deploy.drive",
        "handfast.deploy.hosts",
    }
    commands = {name for name in loaded if name.startswith("handfast.deploy.commands.")}
    assert commands == {"handfast.deploy.commands.local", "handfast.deploy.commands.local.check"}


def test_a_simulation_without_a_report_loads_only_what_it_records_and_judges_with(tmp_path: Path) -> None:
    where = ("--out", str(tmp_path / "run"), "--no-check", "--quiet", "--no-report")
    loaded = loaded_by("simulate", "pair", "--duration", "12s", *where)
    assert not loaded & (set(HEAVY) - {"msgpack", "mcap", "tomli_w", "importlib.metadata"})
    assert not loaded & {"mcap.reader", "numpy.ma", "scipy", "pandas", "handfast.deploy.report.report"}


def test_a_command_loads_no_other() -> None:
    """A stop must be quick: no numpy, and nothing of how fleets are driven or drawn."""
    loaded = loaded_by("stop", "--help")
    assert not loaded & ({*HEAVY, "numpy"} - {"msgpack"})  # a stop is encoded with it
    commands = {name for name in loaded if name.startswith("handfast.deploy.commands.")}
    assert commands == {"handfast.deploy.commands.running", "handfast.deploy.commands.running.stop"}


def test_every_command_has_one_line_of_help_and_a_module() -> None:
    names = [command.name for command in COMMANDS]
    assert len(set(names)) == len(names)
    _parser()  # takes the arguments of all of them
    assert all(command.help and "\n" not in command.help for command in COMMANDS)


def test_help_has_each_command_once_in_the_group_of_what_it_is_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    listed, _, after = capsys.readouterr().out.partition("\noptions:\n")
    parts = re.findall(r"^(\w.*):\n((?:  .*\n)+)", listed, re.MULTILINE)
    shown = [(title, [tuple(line.split(None, 1)) for line in part.splitlines()]) for title, part in parts]
    assert shown == [(title, [(each.name, each.help) for each in group]) for title, group in GROUPS.items()]
    assert {title.split()[0] for title in GROUPS} == {"try", "study", "watch,", "prepare", "drive", "set"}
    assert "--version" in after
    assert "FLEET is a fleet file" in after


def test_without_a_command_it_says_what_to_begin_with(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert told.out.startswith("Drives a group of mobile robots in formation")
    assert "`handfast --help` lists all commands" in told.out
    shown = re.findall(r"^  handfast (\w+ \w+)  ", told.out, re.MULTILINE)
    assert [line.split()[0] for line in shown] == ["check", "run", "new"]
    for line in shown:
        _parser().parse_args(line.split())


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("rnu", "did you mean run? "),
        ("sim", "did you mean simulate? "),
        ("re", ""),
        ("repot", "did you mean report or export? "),
        ("join", "did you mean change join? "),
        ("list", "did you mean status? "),
        ("signing", "did you mean keys --signing? "),
        ("film", "did you mean export --format gif? "),
        ("reshape", "did you mean change reshape? "),
        ("help", ""),
        ("", ""),
    ],
)
def test_a_command_that_there_is_not(name: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "delta"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err == f'handfast: there is no command "{name}": {hint}`handfast --help` lists all\n'


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["check", "delta", "--duratoin", "3"], " (did you mean --duration?)"),
        (["run", "delta", "--durations", "3"], " (did you mean --duration?)"),
        (["run", "delta", "--durations=3"], " (did you mean --duration?)"),
        (["run", "delta", "more"], ""),
        (["keys", "delta", "--al"], " (did you mean --law?)"),
    ],
)
def test_an_option_that_a_command_has_not_is_refused_with_its_own_usage(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"usage: handfast {words[0]} ")
    unknown = " ".join(words[2:])
    assert told.endswith(f"handfast {words[0]}: error: unrecognized arguments: {unknown}{hint}\n")


@pytest.mark.parametrize("given", ["-5s", "-5", "-0.5"])
def test_an_option_that_is_given_less_than_nothing_says_what_would_be_right(
    given: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "pair", "--duration", given]) == 2
    assert "--set fleet.duration_s: must be more than 0 " in capsys.readouterr().err


def test_the_fleet_with_a_reserve_can_be_driven() -> None:
    fleet = load_fleet(FLEETS / "reserve.toml")
    assert [robot.id for robot in fleet.robots if robot.reserve] == [7]
    assert [finding for finding in check(fleet) if finding.level in ("error", "warning")] == []


def test_whoever_reads_the_output_may_go() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, "-m", "handfast.deploy.cli", "check", "delta"]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    try:
        done = subprocess.run(
            words, stdout=writer, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=buffered, timeout=60
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_terminal_that_cannot_show_a_name_is_no_failure(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    text = (
        (FLEETS / "delta.toml").read_text().replace("[fleet]", '[fleet]\ndescription = "Räder → Feld ✓"', 1)
    )
    file.write_text(re.sub(r'^description = "The.*\n', "", text, flags=re.MULTILINE), encoding="utf-8")
    words = [sys.executable, "-m", "handfast.deploy.cli", "check", str(file)]
    env = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, env=env, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert "R\\xe4der" in done.stdout


def test_a_notebooks_backend_for_figures_is_not_taken_over(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "handfast.deploy.cli", "simulate", "delta", "--duration", "1s", "--quiet"]
    env = {**os.environ, "MPLBACKEND": "module://no_such.backend"}
    done = subprocess.run(
        [*words, "--out", str(tmp_path / "run")],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=env,
        timeout=60,
    )
    assert done.returncode == 1, "it had not settled after a second"
    assert "Traceback" not in done.stderr
    assert (tmp_path / "run/report.html").exists()


def command_line(
    *arguments: str, path: Path = ROOT, stdout: int | IO[str] = subprocess.PIPE
) -> subprocess.CompletedProcess[str]:
    """A command as a process that looks for modules in `path` first."""
    words = [sys.executable, "-P", "-m", "handfast.deploy.cli", *arguments]
    environment = {**os.environ, "PYTHONPATH": f"{path}{os.pathsep}{ROOT}"}
    return subprocess.run(
        words, stdout=stdout, stderr=subprocess.PIPE, text=True, env=environment, timeout=60
    )


@pytest.mark.slow
@pytest.mark.parametrize("closed", [1, 2])
def test_what_is_said_to_a_stream_that_is_closed_goes_nowhere(closed: int, tmp_path: Path) -> None:
    """And not to the other stream, nor into a file that has got its number."""
    out = tmp_path / "out"
    shell = (
        f'"$0" -P -c "from handfast.deploy.cli import process; raise SystemExit(process())" "$@" {closed}>&-'
    )
    simulated = ["simulate", "delta", "--no-report", "--duration", "15s", "--out", str(out)]
    for arguments, status in ((simulated, 0), (["check", "nobody"], 2)):
        done = subprocess.run(
            ["/bin/sh", "-c", shell, sys.executable, *arguments],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            timeout=60,
        )
        assert done.returncode == status, done
        assert (done.stdout, done.stderr)[closed - 1] == ""
        assert "no bundled fleet of that name" not in done.stdout
    assert {path.name for path in out.iterdir()} == {"events.txt", "fleet.toml", "metrics.json", "run.mcap"}


@pytest.mark.parametrize("arguments", [("check", "delta"), ("--help",)])
def test_an_output_without_room_is_one_line(arguments: tuple[str, ...]) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("Linux has it")
    with full.open("w") as stream:
        done = command_line(*arguments, stdout=stream)
    assert (done.returncode, done.stderr) == (1, "handfast: cannot write: No space left on device\n")


THREADED: Final = """
import threading
from handfast import Law
threading.Thread(target=threading.Event().wait, name="endless").start()
threading.Thread(target=threading.Event().wait, args=(0.01,), name="short").start()
class Threaded(Law):
    def acceleration(self, now):
        return now.navigation
"""


def test_a_plugins_threads_do_not_keep_a_command(tmp_path: Path) -> None:
    (tmp_path / "threaded.py").write_text(THREADED)
    done = command_line("check", "delta", "--law", "threaded:Threaded", path=tmp_path)
    assert done.returncode == 0
    assert "threaded:Threaded cannot be predicted" in done.stdout
    assert done.stderr == "handfast: ends threads that a plugin left running: endless\n"


def test_a_lattice_of_many_robots_is_written_as_a_fleet_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "many", "--lattice", "30"]) == 0
    assert capsys.readouterr().out == "wrote many.toml; next: handfast check many.toml\n"
    assert len(load_fleet(tmp_path / "many.toml").robots) == 30
    for robots in ("2", "1001"):
        assert main(["new", "few", "--lattice", robots]) == 2
        assert f"--lattice: must be 3 to 1000 robots, got {robots}" in capsys.readouterr().err
    assert not (tmp_path / "few.toml").exists()


def test_more_robots_than_this_machine_carries_are_refused_with_what_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("handfast.deploy.processes.machine.measured", lambda: Machine(2.0, 0.7))
    monkeypatch.setattr("handfast.deploy.processes.machine.PAUSE_S", 0.0)
    assert main(["new", "many", "--lattice", "90"]) == 0
    assert main(["run", "many.toml"]) == 2
    told = capsys.readouterr().err
    assert re.search(
        r"many\.toml: not started: 90 robots at 10 Hz need about [\d.]+ cores, and this machine \(2 cores\) "
        r"carries about \d+ robots like these at 10 Hz; all 90 fit at \d Hz: --set fleet\.rate_hz=\d .* "
        r"\(--no-check drives all the same\)\n$",
        told,
    ), told
    assert not (tmp_path / "runs").exists()
    assert main(["check", "many.toml"]) == 0
    assert "warning: fleet.rate_hz: `handfast run` refuses it here: 90 robots" in capsys.readouterr().out
