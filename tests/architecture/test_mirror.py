"""Tests mirror the house: what tests/unit/PACKAGE/test_MODULE.py tests is PACKAGE/MODULE.py."""

from __future__ import annotations

from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
UNIT: Final = ROOT / "tests" / "unit"
PACKAGES: Final = ("agent", "plant", "bridges", "deploy")
BY_OTHERS: Final = {
    "an entry point or a command: tests run it as a process, or through the command line": """
        agent/__main__
        agent/admission/__main__
        agent/recorder/__main__
        agent/security/__main__
        bridges/mavlink/__main__
        bridges/mavlink/simulator/__main__
        deploy/commands/hosts/down
        deploy/commands/hosts/export_deployment
        deploy/commands/hosts/fetch
        deploy/commands/hosts/firewall
        deploy/commands/hosts/router
        deploy/commands/local/check
        deploy/commands/local/export
        deploy/commands/local/film
        deploy/commands/local/new
        deploy/commands/local/rover_simulator
        deploy/commands/local/simulate
        deploy/commands/local/view
        deploy/commands/running/heartbeat
        deploy/commands/running/join
        deploy/commands/running/leave
        deploy/commands/running/orders
        deploy/commands/running/remove
        deploy/commands/running/replace
        deploy/commands/running/reshape
        deploy/commands/running/resume
    """,
    "works with processes, sockets or files: tests have real ones, in tests/process and tests/hosts too": """
        agent/runtime/version
        agent/security/certificates
        agent/security/private_files
        bridges/mavlink/session/receiver
        bridges/mavlink/simulator/port
        bridges/mavlink/transport/channels
        bridges/mavlink/transport/lock
        deploy/chaos/run_real
        agent/common/exit
        deploy/drive/fleet_state
        deploy/drive/local
        deploy/drive/standstill
        deploy/faults/live
        deploy/faults/live_rules
        deploy/hosts/arrivals
        deploy/merging/robot_recording
        deploy/hosts/setup
        deploy/hosts/view
        deploy/inventory/running
        deploy/processes/fork_server
        deploy/processes/ports
        deploy/processes/protocol
        deploy/session/author
        deploy/session/fault_injection
        deploy/session/faults
        deploy/session/heartbeat
        deploy/session/operator_session
        deploy/session/order
        deploy/session/resume
        deploy/session/session
        deploy/simulate/worker_pool
        plant/server
    """,
    "what it does with the others matters: tests of the whole package, of properties, of fleets": """
        agent/fleet/mavlink_section
        agent/fleet/trajectory_checks
        agent/impairments/delay_distributions
        agent/impairments/loss_models
        agent/impairments/markov_chains
        agent/impairments/range_model
        agent/impairments/recorded_fates
        agent/links/timed_rules
        agent/messages/codec
        agent/messages/validation
        agent/supervision/order_relay
        bridges/mavlink/ardupilot/constants
        bridges/mavlink/ardupilot/frames
        bridges/mavlink/simulator/commands
        bridges/mavlink/simulator/guided
        bridges/mavlink/simulator/in_memory
        bridges/mavlink/simulator/navigation
        bridges/mavlink/simulator/settings
        deploy/chaos/draw_faults
        deploy/chaos/draw_formation
        deploy/chaos/draw_obstacles
        deploy/chaos/draw_orders
        deploy/chaos/report
        deploy/chaos/run
        deploy/simulate/judged
        deploy/simulate/random_starts
        deploy/verdict/oracles_distance
        deploy/verdict/oracles_drive
        deploy/verdict/oracles_reaction
        deploy/verdict/violations
    """,
    "a part of a neighbour in its package, whose tests go through it": """
        agent/common/models
        agent/common/settings
        agent/fleet/fault_checks
        agent/fleet/fault_targets
        agent/fleet/sections
        agent/formation/points
        bridges/mavlink/session/codec
        bridges/mavlink/session/settings
        deploy/analysis/clearances
        deploy/analysis/desired
        deploy/analysis/stability
        deploy/check/bodies
        deploy/check/description
        deploy/check/finding
        deploy/check/fleet_reference
        deploy/check/loop
        deploy/check/paths
        deploy/check/shape
        deploy/console/data_files
        deploy/console/progress
        deploy/console/terminal
        deploy/drive/display/terminal_view
        deploy/faults/windows
        deploy/faults/wording
        deploy/recording/collector
        deploy/recording/link_table
        deploy/recording/links
        deploy/recording/mcap_reader
        deploy/recording/message_json
        deploy/recording/rows
        deploy/recording/run_files
        deploy/recording/tables
        deploy/report/force_figure
        deploy/report/html
        deploy/report/link_figure
        deploy/report/oracle_section
        deploy/report/timing_figure
        deploy/sweep/figures
        deploy/sweep/summary
        plant/backend
    """,
}
"""Modules without a file of tests of their own, by the reason. It may only shrink: a new module has tests."""


def modules() -> set[str]:
    """Every module of production, such as ``agent/fleet/fleet``; `__init__` holds a docstring and no more."""
    return {"handfast"} | {
        path.relative_to(ROOT).with_suffix("").as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if path.name != "__init__.py"
    }


def has_tests(module: str) -> bool:
    """``test_MODULE.py``, or ``test_MODULE_WHAT.py`` where there is more to test than one file holds."""
    folder, name = UNIT / Path(module).parent, Path(module).name.strip("_")
    return (folder / f"test_{name}.py").exists() or any(folder.glob(f"test_{name}_*.py"))


def test_every_module_has_tests_of_its_own_or_is_listed() -> None:
    lacking = {module for module in modules() if not has_tests(module)}
    listed = [module for lines in BY_OTHERS.values() for module in lines.split()]
    assert len(set(listed)) == len(listed)
    assert lacking - set(listed) == set(), "give these a file of tests: tests/unit/PACKAGE/test_MODULE.py"
    assert set(listed) - lacking == set(), "these have tests now, or are gone: take them off the list"


def test_every_file_of_tests_stands_where_its_module_does() -> None:
    """One that tests a whole package may be called by another name than a module's."""
    packages = {str(Path(module).parent) for module in modules()}
    for path in UNIT.rglob("test_*.py"):
        folder = path.parent.relative_to(UNIT).as_posix()
        assert folder in packages, f"{path.relative_to(ROOT)}: there is no package {folder}"
