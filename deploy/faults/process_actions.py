"""What the rules of a scenario do to processes and when: the plan of kills, pauses and restarts (PURE).

`deploy.drive.drive` carries it out on real processes (`deploy.processes.local`),
`deploy.simulate.simulation` on nodes in virtual time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, Literal, NamedTuple

from handfast.agent.fleet.fault_rules import ACTION_FIELDS, Rule
from handfast.agent.messages.key_expressions import ROLES

What = Literal["kill", "start", "stop", "continue"]
Process = tuple[int, str]
"""(robot, role)"""

WORDS: Final = {"kill": "killed", "start": "started", "stop": "paused", "continue": "continued"}
"""What was done, by the name of the action."""
_BEGIN, _RESTART, _END = range(3)


class Action(NamedTuple):
    """One thing to do to one process, `time_s` after the epoch.

    `what`: ``kill`` (SIGKILL: it is gone, with all it knew), ``start`` (a new one in its place; a simulated
    plant's body stands where it was, at rest), ``stop`` (SIGSTOP: it neither ticks nor reads), ``continue``
    (SIGCONT). `role`: ``agent`` or ``plant``. `rule`: the name of the rule that orders it. `wipe`: what was
    on a killed process's disk is lost, too.
    """

    time_s: float
    robot: int
    role: str
    what: What
    rule: str
    wipe: bool = False


def actions(rules: Sequence[Rule], ids: Sequence[int], end: float) -> list[Action]:
    """All that `rules` do to processes, in the order in which to do it.

    A process is down while any ``kill`` holds for it, and paused while any ``pause`` does: where rules
    overlap the first to begin takes it down and the last to end brings it back, so that no action finds a
    process that it does not fit. A ``restart`` of a process that is down does nothing; one that is started
    within a pause is paused at once. Nothing is planned for `end` or later: what is down or paused then
    stays so, and whoever carries out the plan continues what is paused before it ends the run.

    Args:
        rules: the fleet file's, each with a name (`agent.links.fault_plan.FaultPlan.file_rules`); those
        without kill,
            pause or restart are left out.
        ids: the fleet's robots, for a rule that names none.
        end: end of the drive, s of fleet time.

    Returns actions whose times ascend. Those of one time are in order: a restart is kill, then start.
    """
    down: Counter[Process] = Counter()
    paused: Counter[Process] = Counter()
    plan: list[Action] = []
    for time_s, kind, number, robot, role, field, name in sorted(_changes(rules, ids, end)):
        process = robot, role
        was_down, was_paused = down[process] > 0, paused[process] > 0
        start: tuple[What, ...] = ("start", "stop") if was_paused else ("start",)
        todo: tuple[What, ...] = ()
        if kind == _RESTART:
            todo = () if was_down else ("kill", *start)
        elif field == "pause":
            paused[process] += 1 if kind == _BEGIN else -1
            if not was_down and was_paused != (paused[process] > 0):
                todo = ("stop",) if kind == _BEGIN else ("continue",)
        else:
            down[process] += 1 if kind == _BEGIN else -1
            if was_down != (down[process] > 0):
                todo = ("kill",) if kind == _BEGIN else start
        wipe = bool(rules[number].wipe)
        plan += [Action(time_s, robot, role, what, name, wipe and what == "kill") for what in todo]
    return plan


def _changes(
    rules: Sequence[Rule], ids: Sequence[int], end: float
) -> Iterator[tuple[float, int, int, int, str, str, str]]:
    """Begin, restart and end of every time that a rule holds: (time, kind, rule, robot, role, field, name).

    Sorted, what begins comes before what ends at the same time: a process that stays down is not started
    in between.
    """
    for number, rule in enumerate(rules):
        for field in rule.given(ACTION_FIELDS):
            named = getattr(rule, field)
            for robot in ids if rule.robots is None else rule.robots:
                for role in ROLES if named == "both" else (named,):
                    for begin_s, end_s in rule.windows(end):
                        kind = _RESTART if field == "restart" else _BEGIN
                        yield begin_s, kind, number, robot, role, field, rule.name
                        if kind == _BEGIN and rule.duration is not None and end_s < end:
                            yield end_s, _END, number, robot, role, field, rule.name
