"""The command ``handfast export-deployment``: a fleet as a folder for Ansible."""

from __future__ import annotations

import argparse
import platform as this_machine
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from agent.common.exit import PASSED
from deploy.console.arguments import InputError, describe, fleet_path, load, no_changes, place_for
from deploy.inventory.running import handled

if TYPE_CHECKING:
    from agent.fleet.model import Fleet
    from deploy.hosts.ansible import Pack
    from deploy.hosts.artifacts.bundle import Platform


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast export-deployment`` takes."""
    describe(
        parser,
        ": inventory, playbook, and all that hosts need, so that "
        "`ansible-playbook` does there what `handfast up` does; every other command works as after it. No "
        "secret is in it. Exit status: 0; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="fleet file with [host.NAME] tables")
    parser.add_argument(
        "--out",
        type=place_for,
        metavar="DIR",
        help="where to (default: FLEET-deployment); must be empty or new",
    )
    parser.add_argument(
        "--platform",
        dest="platforms",
        action="append",
        default=[],
        metavar="P",
        help='Python, processor and C library of hosts, such as "3.11 aarch64 glibc2.36", once for each kind '
        "that the fleet has (default: those of this machine)",
    )
    parser.add_argument(
        "--serial",
        action="append",
        default=[],
        metavar="N",
        help="how many hosts are brought up at a time, as Ansible's serial: a number or a percentage, once "
        "for each batch, the last for all that are left, such as --serial 1 --serial 10%% --serial 50%% "
        "(default: up to 20 hosts at once; of more one, then 10%%, then the rest)",
    )
    parser.add_argument(
        "--max-fail-percentage",
        type=int,
        metavar="P",
        help="leave the others alone when more than so many percent of a batch fail (default: 30; 100 where "
        "all are brought up at once)",
    )
    parser.add_argument(
        "--no-check", dest="check", action="store_false", help="go on even where `check` finds errors"
    )
    parser.set_defaults(command=handled(_export), quiet=False, **no_changes())


def _export(options: argparse.Namespace) -> int:
    import tomli_w

    from agent.fleet.loading import to_dict
    from deploy.drive.outcome import refuse_errors
    from deploy.hosts.ansible import DeploymentError, in_words, parse_batches, texts
    from deploy.hosts.artifacts.bundle import BundleError
    from deploy.inventory.folders import refuse_full
    from deploy.inventory.hosts import hosts_of, located, refuse_simulated, robots_text

    fleet = load(options)
    source = str(fleet_path(options.fleet))
    hosts = hosts_of(fleet, source)
    refuse_simulated(fleet, source)
    try:
        batches = parse_batches(options.serial, options.max_fail_percentage, len(hosts))
    except DeploymentError as error:
        raise InputError(str(error)) from None
    out = Path(options.out or f"{fleet.fleet.name}-deployment").expanduser()
    refuse_full(out)
    refuse_errors(options, fleet)
    fleet = located(fleet)
    try:
        packs = _packs(fleet, options.platforms)
        written = texts(fleet, source, robots_text(fleet), tomli_w.dumps(to_dict(fleet)), packs, batches)
    except (BundleError, DeploymentError) as error:
        raise InputError(str(error)) from None
    _write(out, written, packs)
    kinds = "; ".join(str(pack.platform) for pack in packs)
    print(
        f"wrote {out}: {len(hosts)} hosts, {len(fleet.ids)} robots, wheels for {kinds}; it brings up "
        f"{in_words(batches)}; next: {out}/README.md"
    )
    return PASSED


def _packs(fleet: Fleet, asked: list[str]) -> list[Pack]:
    """What hosts of each platform get; raises `BundleError` and `DeploymentError`."""
    from deploy.hosts.ansible import Pack, parse_platform
    from deploy.hosts.artifacts.bundle import bundle_for, program_archive
    from deploy.hosts.artifacts.plugin_files import plugin_modules

    program = program_archive(plugin_modules(fleet))
    platforms = list(dict.fromkeys(map(parse_platform, asked))) or [_this_machine()]
    return [Pack(platform, bundle_for(platform, program)) for platform in platforms]


def _this_machine() -> Platform:
    from deploy.hosts.artifacts.bundle import BundleError, Platform

    try:
        return Platform.of(
            {
                "system": this_machine.system(),
                "python": sys.version_info[:3],
                "machine": this_machine.machine(),
                "libc": this_machine.libc_ver(),
            }
        )
    except BundleError:
        raise InputError("robots run Linux, and this machine does not: name theirs, --platform") from None


def _write(out: Path, written: dict[str, str], packs: list[Pack]) -> None:
    """Writes the folder; what is interrupted leaves next to nothing there."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".handfast-") as hidden:
            folder = Path(hidden)
            wheels = folder / "files" / "wheels"
            wheels.mkdir(parents=True)
            for name, text in written.items():
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
            for pack in packs:
                (wheels / pack.bundle.program_name).write_bytes(pack.bundle.program)
                for name in pack.bundle.wheels:
                    shutil.copyfile(pack.bundle.folder / name, wheels / name)
            for path in folder.iterdir():
                path.rename(out / path.name)
    except OSError as error:
        raise InputError(f"cannot write {out}: {(error.strerror or str(error)).lower()}") from None
