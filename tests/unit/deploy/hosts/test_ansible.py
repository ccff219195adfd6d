"""The folder for Ansible: its texts, and what Ansible's own validators say to it."""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from agent.fleet.hosts import HostSection
from agent.fleet.loading import load_fleet, parse_fleet, to_dict
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from deploy.check.finding import Finding
from deploy.commands.hosts import export_deployment
from deploy.console.data_files import FLEETS
from deploy.hosts.ansible import (
    GROUP,
    Batches,
    DeploymentError,
    Pack,
    in_words,
    parse_batches,
    parse_platform,
    texts,
)
from deploy.hosts.artifacts.bundle import Bundle, Platform
from deploy.hosts.connection import Clock
from deploy.hosts.setup import prepare
from deploy.inventory.hosts import located, robots_on, robots_text

PI = Platform((3, 11), "aarch64", ("glibc", "2.36"))
ROOT = "/home/pi/.local/share/handfast"
WHEELS = {"pip-26.3-py3-none-any.whl": "a", "numpy-2-cp311.whl": "b"}


def fleet(hosts: Mapping[str, Mapping[str, Any]] | None = None, **tables: dict[str, Any]) -> Fleet:
    """The bundled fleet on two hosts."""
    raw = tomllib.loads((FLEETS / "delta.toml").read_text(encoding="utf-8"))
    raw["host"] = hosts or {"rover1": {"address": "10.0.0.1"}, "rover2": {"address": "10.0.0.2"}}
    for index, robot in enumerate(raw["robot"]):
        robot["host"] = list(raw["host"])[index % len(raw["host"])]
    return located(resolved(parse_fleet(tomli_w.dumps(raw | tables), source="here")))


def written(fleet: Fleet, *platforms: Platform, batches: Batches | None = None) -> dict[str, str]:
    packs = [Pack(platform, Bundle(Path(), WHEELS, b"program")) for platform in platforms or (PI,)]
    batches = batches or parse_batches([], None, len(fleet.hosts))
    return texts(fleet, "here", robots_text(fleet), tomli_w.dumps(to_dict(fleet)), packs, batches)


def rendered(value: str, version: str) -> str:
    return value.replace("{{handfast_root}}", ROOT).replace("{{handfast_version}}", version)


class UpsHost:
    """A host as `handfast up` talks to it, on which all is there but the units."""

    def __init__(self, host: HostSection) -> None:
        self.host, self.units, self.files = host, {}, set()
        about = {"python": [3, 11, 2], "machine": "aarch64", "system": "Linux", "libc": ["glibc", "2.36"]}
        fine = dict.fromkeys(("writable", "systemd", "lingers", "journal"), True)
        self.about = {**about, **fine, "root": ROOT, "user": "pi"}

    def clock(self) -> Clock:
        return Clock(0.0, 0.001)

    def ask(self, what: str, **asked: Any) -> Any:
        if what == "compare":
            self.units = asked["wanted"]
        if what == "missing":
            self.files |= set(asked["paths"])
        compared = {"stale": [], "unwritten": [], "unwanted": [], "open": []}
        return {"installed": True, "missing": [], "compare": compared}[what]


def ups(fleet: Fleet, host: HostSection, monkeypatch: pytest.MonkeyPatch) -> UpsHost:
    """What `handfast up` brings to a host."""
    there = UpsHost(host)
    monkeypatch.setattr("deploy.hosts.setup.bundle_for", lambda _, program: Bundle(Path(), WHEELS, program))
    keys = (lambda *_, robots: None) if fleet.is_secured else None
    prepare(there, fleet, robots_text(fleet), b"program", lambda _: None, keys, lambda: None)  # type: ignore[arg-type]
    return there


@pytest.mark.parametrize(("security", "realtime"), [("mtls", False), ("off", False), ("off", True)])
def test_a_host_gets_what_up_brings_it(security: str, realtime: bool, monkeypatch: pytest.MonkeyPatch):
    pair = fleet(network={"security": security}, process={"realtime": realtime})
    found = written(pair)
    of_all = json.loads(found[f"group_vars/{GROUP}.json"])
    version = of_all["handfast_bundles"][0]["version"]
    for host in pair.hosts:
        there = ups(pair, host, monkeypatch)
        told = json.loads(found[f"host_vars/{host.name}.json"])
        assert told["handfast_robots"] == [str(robot) for robot in robots_on(pair, host)]
        by_robot = told["handfast_units"].values()
        got = {name: rendered(text, version) for row in by_robot for name, text in row.items()}
        assert got == there.units
        assert len(got) == 9
        assert sum("LimitRTPRIO=42" in text for text in got.values()) == (6 if realtime else 0)
        assert not told["handfast_router_units"]
        assert of_all["handfast_fleet_path"] in there.files


def test_a_host_with_a_router_gets_what_up_brings_it(monkeypatch: pytest.MonkeyPatch):
    addresses = {"rover1": "10.0.0.1", "rover2": "10.0.0.2", "base": "10.0.0.9"}
    hosts = {name: {"address": address} for name, address in addresses.items()}
    routed = fleet(host=hosts, network={"routers": ["base", "rover2"]})
    found = written(routed)
    version = json.loads(found[f"group_vars/{GROUP}.json"])["handfast_bundles"][0]["version"]
    assert set(json.loads(found["inventory.json"])["all"]["children"][GROUP]["hosts"]) == {
        "base",
        "rover1",
        "rover2",
    }
    for name, units, number in (("base", 1, 1), ("rover2", 10, 2)):
        (host,) = (each for each in routed.hosts if each.name == name)
        told = json.loads(found[f"host_vars/{name}.json"])
        wanted = [*told["handfast_units"].values(), told["handfast_router_units"]]
        got = {unit: rendered(text, version) for row in wanted for unit, text in row.items()}
        assert got == ups(routed, host, monkeypatch).units
        assert len(got) == units
        assert f"delta.router.{number}.crt" in got["handfast-delta-router.service"]
        assert told["handfast_certified"][-1] == f"router.{number}"
        asked = told["handfast_certificate_requests"][-1]["arguments"]
        assert asked[asked.index("--router") + 1] == str(number)


def test_the_operators_fleet_file_gives_robots_the_same_text(tmp_path: Path):
    pair = fleet({"rover1": {"address": "10.0.0.1", "user": "pi", "port": 2222, "key": "~/.ssh/fleet"}})
    found = written(pair)
    file = tmp_path / "fleet.toml"
    file.write_text(found["fleet.toml"])
    again = located(resolved(load_fleet(file)))
    assert robots_text(again) == found["files/robots-fleet.toml"]
    assert "user" not in found["files/robots-fleet.toml"]


def test_hosts_are_reached_as_ssh_reaches_them():
    pair = fleet(
        {
            "rover1": {"address": "[fe80::1]", "user": "pi", "port": 2222, "key": "~/.ssh/fleet"},
            "rover2": {"address": "10.0.0.2", "python": "/opt/python3.12"},
        }
    )
    found = written(pair)
    one, two = (json.loads(found[f"host_vars/{name}.json"]) for name in ("rover1", "rover2"))
    assert one["ansible_ssh_common_args"].endswith("-o HostName=fe80::1")
    assert "-o BatchMode=yes" in one["ansible_ssh_common_args"], "nothing hangs at a question"
    assert [one[f"ansible_{key}"] for key in ("user", "port", "ssh_private_key_file")] == [
        "pi",
        2222,
        "~/.ssh/fleet",
    ]
    assert not {"ansible_host", "ansible_user", "ansible_port"} & set(two), "ssh's configuration holds"
    assert '"/opt/python3.12"' in two["handfast_bootstrap"]
    assert two["ansible_python_interpreter"] == "/opt/python3.12"


def test_robots_of_a_secured_fleet_ask_and_are_answered_by_id():
    told = json.loads(written(fleet())["host_vars/rover2.json"])
    asked, answered = told["handfast_certificate_requests"], told["handfast_certificate_answers"]
    assert told["handfast_robots"] == ["2", "4", "6"]
    for robot, one, other in zip(told["handfast_robots"], asked, answered, strict=True):
        assert one["arguments"][one["arguments"].index("--robot") + 1] == robot
        assert one["arguments"][-4:] == ["--addresses", "10.0.0.2", "--ca", "-"]
        assert other["text"] == f"{{{{handfast_signed.signed['{robot}'] | default('')}}}}"
    open_to_all = written(fleet(network={"security": "off"}))
    assert "handfast_certificate_requests" not in json.loads(open_to_all["host_vars/rover2.json"])
    assert "handfast keys" not in open_to_all["README.md"]
    assert "handfast keys fleet.toml" in written(fleet())["README.md"]


@pytest.mark.parametrize(
    ("text", "platform"),
    [
        ("3.11 aarch64 glibc2.36", Platform((3, 11), "aarch64", ("glibc", "2.36"))),
        ("3.12 x86_64 musl", Platform((3, 12), "x86_64", ("", ""))),
        ("3.13  armv7l glibc2.9", Platform((3, 13), "armv7l", ("glibc", "2.9"))),
    ],
)
def test_platforms_are_read_as_they_are_said(text: str, platform: Platform):
    assert parse_platform(text) == platform


@pytest.mark.parametrize(
    "text", ["", "aarch64", "3.11 aarch64", "3.11 aarch64 glibc", "2.7 x86_64 musl", "3.11 x musl ."]
)
def test_what_is_no_platform_is_refused(text: str):
    with pytest.raises(DeploymentError, match="is no platform: give Python, processor and C library"):
        parse_platform(text)


def test_an_old_python_is_refused():
    with pytest.raises(DeploymentError, match=r"'3.9 x86_64 musl': robots need Python 3.11 or later"):
        parse_platform("3.9 x86_64 musl")


def test_what_ansible_would_read_as_a_template_is_refused():
    with pytest.raises(
        DeploymentError, match=r"host.rover1.key: Ansible would read '\{\{x\}\}' as a template"
    ):
        written(fleet({"rover1": {"address": "10.0.0.1", "key": "{{x}}"}}))


@pytest.mark.parametrize(
    ("serial", "limit", "hosts", "batches"),
    [
        ([], None, 20, Batches(("100%",), 100)),
        ([], None, 21, Batches((1, "10%", "100%"), 30)),
        ([], 5, 20, Batches(("100%",), 5)),
        (["1", "10%", "50%"], None, 2, Batches((1, "10%", "50%"), 30)),
        (["1, 10% 50%"], 0, 300, Batches((1, "10%", "50%"), 0)),
        (["25"], 100, 300, Batches((25,), 100)),
    ],
)
def test_batches_are_read_as_they_are_said(
    serial: list[str], limit: int | None, hosts: int, batches: Batches
):
    assert parse_batches(serial, limit, hosts) == batches


@pytest.mark.parametrize("text", ["0", "-1", "0%", "101%", "10.5%", "%", "", " ", "half", "1;2", "\u0661"])
def test_what_is_no_batch_is_refused(text: str):
    with pytest.raises(DeploymentError, match="is no batch: give a number of hosts or 1% to 100%"):
        parse_batches(["1", text], None, 300)


@pytest.mark.parametrize("limit", [-1, 101])
def test_a_limit_that_is_none_is_refused(limit: int):
    with pytest.raises(DeploymentError, match=f"--max-fail-percentage must be from 0 to 100, got {limit}"):
        parse_batches([], limit, 300)


def test_batches_are_said():
    assert in_words(parse_batches([], None, 2)) == "all hosts at once"
    assert in_words(parse_batches([], None, 300)) == (
        "hosts in batches (1 host, then 10%, then 100%), which end where more than 30% of one fail"
    )
    assert "(5 hosts)" in in_words(parse_batches(["5"], None, 300))
    assert "@" not in written(fleet())["README.md"]


# ---------------------------------------------------------------------- the command


@pytest.fixture
def export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """`handfast export-deployment` of a fleet, with wheels that need not be fetched."""
    wheels = tmp_path / "cache"
    wheels.mkdir()
    for name in WHEELS:
        (wheels / name).write_text(name)
    monkeypatch.setattr(
        "deploy.hosts.artifacts.bundle.bundle_for", lambda _, program: Bundle(wheels, WHEELS, program)
    )
    file = tmp_path / "fleet.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet())))
    parser = argparse.ArgumentParser()
    export_deployment.add_arguments(parser)

    def run(*arguments: str) -> int:
        options = parser.parse_args([str(file), *arguments])
        status: int = options.command(options)
        return status

    return run


def test_what_check_finds_wrong_is_refused_as_by_up(
    export: Callable[..., int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr("deploy.check.check.check", lambda _: [Finding("error", "x", "too near")])
    assert export("--out", str(tmp_path / "out")) == 2
    assert not (tmp_path / "out").exists()
    assert "because of the errors above" in capsys.readouterr().err
    assert export("--out", str(tmp_path / "out"), "--no-check") == 0


def test_the_folder_is_whole(export: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "new" / "folder"
    assert (
        export("--out", str(out), "--platform", "3.11 aarch64 glibc2.36", "--platform", "3.12 x86_64 musl")
        == 0
    )
    said = capsys.readouterr().out
    assert said.startswith(
        f"wrote {out}: 2 hosts, 6 robots, wheels for Python 3.11, aarch64, glibc 2.36; Python"
    )
    of_all = json.loads((out / f"group_vars/{GROUP}.json").read_text())
    assert [row["libc_minor"] for row in of_all["handfast_bundles"]] == [36, 0]
    for row in of_all["handfast_bundles"]:
        archive = row["install"]["program"]
        assert set(row["files"]) == {*row["install"]["wheels"], row["install"]["pip"], archive}
        assert {f"wheels/{path.name}" for path in (out / "files/wheels").iterdir()} == set(row["files"])
        data = (out / "files" / archive).read_bytes()
        assert hashlib.sha256(data).hexdigest() == row["files"][archive]
    program = (out / "files/host_program.py").read_bytes()
    assert len(program) == of_all["handfast_program_bytes"]
    assert not [path for path in out.iterdir() if path.name.startswith(".")], "nothing is left of its making"


def test_a_folder_that_is_not_empty_is_left_alone(
    export: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert export("--out", str(tmp_path)) == 2
    assert (
        capsys.readouterr()
        .err.strip()
        .endswith("is not an empty folder: name another one with --out, or remove it")
    )
    assert export("--out", "/proc/nothing") == 2
    assert capsys.readouterr().err == "handfast: cannot write /proc/nothing: no such file or directory\n"
    assert export("--out", str(tmp_path / "x"), "--platform", "pi") == 2
    assert "'pi' is no platform" in capsys.readouterr().err
    assert export("--out", str(tmp_path / "x"), "--serial", "many") == 2
    assert capsys.readouterr().err.startswith("handfast: --serial 'many' is no batch: give a number of hosts")
    assert export("--out", str(tmp_path / "x"), "--max-fail-percentage", "101") == 2
    assert capsys.readouterr().err.startswith("handfast: --max-fail-percentage must be from 0 to 100")
    assert not (tmp_path / "x").exists()


def test_a_fleet_for_one_machine_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    parser = argparse.ArgumentParser()
    export_deployment.add_arguments(parser)
    options = parser.parse_args(["delta", "--out", str(tmp_path / "x")])
    assert options.command(options) == 2
    assert "no robot has a host" in capsys.readouterr().err


# ---------------------------------------------------------------------- Ansible's validators

ansible = pytest.mark.skipif(
    importlib.util.find_spec("ansible") is None, reason="ansible-core is not installed"
)


def play(folder: Path, *words: str) -> str:
    """What an Ansible command says that ends well and warns of nothing."""
    done = subprocess.run(
        [sys.executable, "-m", "ansible", *words],
        cwd=folder,
        env=os.environ | {"HOME": str(folder), "LC_ALL": "C.UTF-8", "ANSIBLE_NOCOLOR": "1"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    return done.stdout


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in written(fleet(), PI, Platform((3, 12), "x86_64", ("", ""))).items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


@ansible
def test_ansible_reads_the_inventory(folder: Path):
    told = json.loads(play(folder, "inventory", "--list"))
    assert told[GROUP]["hosts"] == ["rover1", "rover2"]
    of_one = told["_meta"]["hostvars"]["rover1"]
    assert of_one["handfast_robots"] == ["1", "3", "5"]
    assert of_one["handfast_fleet"] == "delta"


@ansible
def test_ansible_reads_the_playbook(folder: Path):
    play(folder, "playbook", "--syntax-check", "playbook.yml")
    tasks = play(folder, "playbook", "--list-tasks", "playbook.yml")
    names = (
        "Ask the authority",
        "Refuse a host that will not do",
        "Send wheels and program",
        "See who drives",
    )
    assert all(name in tasks for name in names)


@ansible
def test_ansible_renders_units_as_they_are_meant(folder: Path):
    """Templates within variables, as they are resolved on the way to a host."""
    facts = {
        "ansible_connection": "local",
        "ansible_python_interpreter": sys.executable,
        "handfast_root": ROOT,
        "handfast_version": "1-abc",
    }
    test = [
        {
            "hosts": "rover2",
            "gather_facts": False,
            "tasks": [
                {"copy": {"content": "{{ handfast_units | to_json }}", "dest": f"{folder}/units.json"}}
            ],
        }
    ]
    (folder / "try.json").write_text(json.dumps(test))
    play(folder, "playbook", "try.json", "-e", json.dumps(facts))
    wanted = json.loads((folder / "host_vars/rover2.json").read_text())["handfast_units"]
    assert json.loads((folder / "units.json").read_text()) == {
        robot: {name: rendered(text, "1-abc") for name, text in row.items()} for robot, row in wanted.items()
    }


HOSTS = [f"rover{number}" for number in range(1, 7)]
FAILS = {"ansible.builtin.fail": {"msg": "no"}, "when": "inventory_hostname in failing"}


def batched(
    folder: Path, *words: str, failing: tuple[str, ...] = (), **changed: Any
) -> tuple[int, list[str]]:
    """Ends the playbook's play with other tasks: the exit status, and on which hosts they ended well."""
    import yaml  # which comes with Ansible

    pair = fleet({name: {"address": f"10.0.0.{number}"} for number, name in enumerate(HOSTS, 1)})
    limits = parse_batches(["1", "50%"], None, len(HOSTS))
    for name, text in written(pair, batches=limits).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (play,) = yaml.safe_load((folder / "playbook.yml").read_text())
    play["tasks"] = [FAILS, {"ansible.builtin.debug": {"msg": "well"}}]
    (folder / "playbook.yml").write_text(yaml.safe_dump([play]))
    given = {"failing": failing, "ansible_connection": "local", **changed}
    done = subprocess.run(
        [sys.executable, "-m", "ansible", "playbook", "playbook.yml", "-e", json.dumps(given), *words],
        cwd=folder,
        env=os.environ | {"HOME": str(folder), "LC_ALL": "C.UTF-8", "ANSIBLE_NOCOLOR": "1"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "WARNING" not in done.stderr, done.stderr
    recap = done.stdout.partition("PLAY RECAP")[2]
    return done.returncode, re.findall(r"(rover\d) +: ok=1", recap)


@pytest.mark.slow
@ansible
def test_hosts_are_brought_up_in_batches(tmp_path: Path):
    assert batched(tmp_path / "a") == (0, HOSTS)
    assert batched(tmp_path / "b", failing=("rover1",)) == (2, []), "the canary"
    assert batched(tmp_path / "c", failing=("rover2",)) == (2, ["rover1"]), "a third is more than 30%"
    changed = {"handfast_max_fail_percentage": 40}
    rest = [host for host in HOSTS if host != "rover2"]
    assert batched(tmp_path / "d", failing=("rover2",), **changed) == (2, rest)
    assert batched(tmp_path / "e", failing=("rover1",), handfast_serial=["100%"])[1] == HOSTS[1:]
    assert batched(tmp_path / "f", failing=("rover2",), rolling=True) == (2, ["rover1"])
    assert batched(tmp_path / "g", "--check", failing=("rover1",))[1] == HOSTS[1:], "a look is at all of them"


@pytest.mark.slow
@ansible
@pytest.mark.parametrize(
    ("of_2", "asked", "why"),
    [
        ({"authority": "x"}, ["1", "2", "3", "4", "5", "6"], "another authority"),
        ({"request": "PEM" * 10_000}, ["1", "3", "5"], "requests for certificates are too long"),
    ],
)
def test_a_batch_is_signed_for_together_and_each_refusal_is_a_hosts_own(
    folder: Path, of_2: dict[str, str], asked: list[str], why: str
):
    """One command of the authority's for all hosts; what one robot lacks is no other's."""
    import yaml

    authority = folder / "authority.py"
    authority.write_text(
        "import json, sys\n"
        "asked = json.load(sys.stdin)\n"
        f"open({str(folder / 'asked')!r}, 'a').write(json.dumps(asked) + '\\n')\n"
        "refused = {robot: 'another authority' for robot in asked if asked[robot]['authority'] == 'x'}\n"
        "signed = {robot: 'PEM ' + robot for robot in asked if robot not in refused}\n"
        "print(json.dumps({'authority': 'CA', 'signed': signed, 'refused': refused}))\n"
        "sys.exit(1 if refused else 0)\n"
    )
    # What asks the hosts is left out: they want certificates for these robots.
    tasks = yaml.safe_load((folder / "tasks/certificates.yml").read_text())
    first = next(k for k, task in enumerate(tasks) if task["name"].startswith("Refuse requests"))
    last = next(k for k, task in enumerate(tasks) if task["name"] == "Store")
    (folder / "tasks/signed.yml").write_text(yaml.safe_dump(tasks[first:last]))
    value = "{'wanting': 'none', 'request': 'PEM', 'authority': ''} | combine(of_2 if item == '2' else {})"
    wanting = {"ansible.builtin.set_fact": {"handfast_wanting": (
        "{{ (handfast_wanting | default([])) + [{'key': item, 'value': " + value + "}] }}"
    )}, "loop": "{{ handfast_robots }}"}  # fmt: skip
    show = {"ansible.builtin.copy": {
        "content": "{{ handfast_robots | map('extract', handfast_signed.signed) | join(',') }}",
        "dest": f"{folder}/signed-{{{{ inventory_hostname }}}}",
    }}  # fmt: skip
    trial = [{"hosts": "all", "gather_facts": False, "tasks": [
        wanting, {"ansible.builtin.import_tasks": "tasks/signed.yml"}, show,
    ]}]  # fmt: skip
    (folder / "try.json").write_text(json.dumps(trial))
    given = {
        "ansible_connection": "local",
        "ansible_python_interpreter": sys.executable,
        "handfast_command": [sys.executable, str(authority)],
        "of_2": of_2,
    }
    done = subprocess.run(
        [sys.executable, "-m", "ansible", "playbook", "try.json", "-e", json.dumps(given)],
        cwd=folder,
        env=os.environ | {"HOME": str(folder), "LC_ALL": "C.UTF-8", "ANSIBLE_NOCOLOR": "1"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    (sent,) = map(json.loads, (folder / "asked").read_text().splitlines())
    assert sorted(sent) == asked
    assert (done.returncode, why in " ".join(done.stdout.split())) == (2, True), done.stdout
    assert (folder / "signed-rover1").read_text() == "PEM 1,PEM 3,PEM 5"
    assert not (folder / "signed-rover2").exists()
