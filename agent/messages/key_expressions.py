"""Key expressions of the bus: the only place where they are written.

``{fleet}`` is the fleet's name, ``{id}`` a robot's number. ``*`` stands for one segment.
"""

from __future__ import annotations

ROLES = ("agent", "plant")
"""Processes of a robot that have a liveliness token."""


def of_robot(fleet: str, robot: int) -> str:
    """Prefix of the keys on which one robot's agent and plant publish."""
    return f"{fleet}/robot/{robot}/"


def of_any_robot(key: str) -> str:
    """The subscription that hears what `key` is, of every robot; other keys as they are."""
    fleet, _, rest = key.partition("/robot/")
    return f"{fleet}/robot/*/{rest.partition('/')[2]}" if rest else key


def hand(fleet: str, robot: int | str) -> str:
    """Hand state of one robot, from its agent to its neighbours."""
    return f"{fleet}/robot/{robot}/hand"


def robot_of_hand(fleet: str, key: str) -> int | None:
    """Whose hand states come on a key; None for another key."""
    before, _, last = key.rpartition("/")
    number = before.removeprefix(f"{fleet}/robot/")
    return int(number) if last == "hand" and number.isdecimal() else None


def status(fleet: str, robot: int | str) -> str:
    """What one agent is doing, for operators."""
    return f"{fleet}/robot/{robot}/status"


def plant_state(fleet: str, robot: int | str) -> str:
    """What the plant measures of its body, for its agent."""
    return f"{fleet}/robot/{robot}/plant/state"


def plant_truth(fleet: str, robot: int | str) -> str:
    """Where a simulated body really is; sent only when its measurements are noisy, for operators."""
    return f"{fleet}/robot/{robot}/plant/truth"


def wrench(fleet: str, robot: int | str) -> str:
    """Force and torque that the agent asks of its plant."""
    return f"{fleet}/robot/{robot}/plant/wrench"


def mission(fleet: str) -> str:
    """The common epoch and what is to be driven, from the operator to every agent."""
    return f"{fleet}/mission"


def stop(fleet: str) -> str:
    """Operator's stop, to every agent."""
    return f"{fleet}/stop"


def resume(fleet: str) -> str:
    """Operator's resume, to every agent and plant."""
    return f"{fleet}/resume"


def orders(fleet: str) -> tuple[str, ...]:
    """All on which only operators publish, sealed in a secured fleet."""
    return tuple(key(fleet) for key in (mission, stop, resume, faults, heartbeat, ask))


def relayed(fleet: str, robot: int | str) -> str:
    """Operators' missions, stops and resumes as one agent relays them, byte by byte, to everybody.

    Only operators publish on `mission`, `stop` and `resume`; a robot has this key, of its own.
    """
    return f"{fleet}/robot/{robot}/told"


def beacon(fleet: str, robot: int | str) -> str:
    """Where one robot is, from its agent to all others."""
    return f"{fleet}/robot/{robot}/beacon"


def beacon_batch(fleet: str) -> str:
    """Beacons of many robots, from a router to all agents (`agent.messages.batch`).

    Chunks that begin with ``@`` are matched by no wildcard (Zenoh): who listens to everything has each
    message as its robot said it.
    """
    return f"{fleet}/@batch/beacon"


def hand_batch(fleet: str) -> str:
    """Hand states of many robots, likewise."""
    return f"{fleet}/@batch/hand"


def batches(fleet: str) -> list[str]:
    """Every key on which routers publish."""
    return [beacon_batch(fleet), hand_batch(fleet)]


def router_alive(fleet: str, name: str) -> str:
    """Liveliness token of one router that can pass beacons on in batches."""
    return f"{fleet}/alive/router/{name}"


def heartbeat(fleet: str) -> str:
    """Sign of life of an operator, to every agent."""
    return f"{fleet}/heartbeat"


def ask(fleet: str) -> str:
    """Operator's question for the mission and the last stop or resume, to every agent."""
    return f"{fleet}/ask"


def checks(fleet: str, robot: int | str) -> str:
    """A plant's checks of its body before a drive, for operators."""
    return f"{fleet}/robot/{robot}/plant/checks"


def status_texts(fleet: str, robot: int | str) -> str:
    """What the vehicle behind a plant says itself, for operators and recordings."""
    return f"{fleet}/robot/{robot}/plant/statustext"


def faults(fleet: str) -> str:
    """Live fault rules of one author, from the operator to every agent and plant."""
    return f"{fleet}/faults"


def faults_held(fleet: str, robot: int | str, role: str) -> str:
    """Live fault rules that one process holds, for operators; `role` is one of `ROLES`."""
    return f"{_process(fleet, robot, role)}/faults"


def links(fleet: str, robot: int | str) -> str:
    """What one agent did to messages under its fault rules, for operators."""
    return f"{_process(fleet, robot, 'agent')}/links"


def plant_links(fleet: str, robot: int | str) -> str:
    """What one plant did to messages under its fault rules, for operators."""
    return f"{_process(fleet, robot, 'plant')}/links"


def _process(fleet: str, robot: int | str, role: str) -> str:
    return f"{fleet}/robot/{robot}/plant" if role == "plant" else f"{fleet}/robot/{robot}"


def events(fleet: str) -> str:
    """What an operator did to processes on purpose, for the recording."""
    return f"{fleet}/events"


def near(fleet: str, robot: int) -> list[str]:
    """Keys between agent and plant of one robot, which go directly even where there are routers."""
    return [plant_state(fleet, robot), wrench(fleet, robot), relayed(fleet, robot)]


def said_by(fleet: str, robot: int) -> list[str]:
    """All keys on which one robot's agent and plant publish, but that on which they relay orders."""
    return [
        *(key(fleet, robot) for key in (hand, status, plant_state, plant_truth, wrench, beacon, checks)),
        *(key(fleet, robot) for key in (status_texts, links, plant_links)),
        *(faults_held(fleet, robot, role) for role in ROLES),
    ]


def alive(fleet: str, robot: int | str, role: str) -> str:
    """Liveliness token of one process; `role` is one of `ROLES` (or ``*``)."""
    return f"{fleet}/alive/robot/{robot}/{role}"


def published(fleet: str, robot: int) -> list[str]:
    """Every key on which one robot's agent or plant publishes; its recorder publishes nothing."""
    return [
        hand(fleet, robot),
        beacon(fleet, robot),
        status(fleet, robot),
        relayed(fleet, robot),
        wrench(fleet, robot),
        links(fleet, robot),
        plant_state(fleet, robot),
        plant_truth(fleet, robot),
        checks(fleet, robot),
        status_texts(fleet, robot),
        plant_links(fleet, robot),
        *(faults_held(fleet, robot, role) for role in ROLES),
    ]


def everything(fleet: str) -> str:
    """Every message of the fleet (liveliness tokens are not messages)."""
    return f"{fleet}/**"


def router_of_alive(key: str) -> str | None:
    """Name of the router that a liveliness token stands for, None for another's."""
    parts = key.rsplit("/", 3)
    return parts[3] if len(parts) == 4 and parts[1:3] == ["alive", "router"] else None


def robot_of_alive(key: str) -> tuple[int, str] | None:
    """Robot and role of a liveliness token's key, None when it is not one."""
    parts = key.rsplit("/", 4)
    if len(parts) != 5 or parts[1] != "alive" or parts[2] != "robot" or parts[4] not in ROLES:
        return None
    # Anybody can declare a token: int() would raise for other scripts' digits and for thousands of them.
    number = parts[3]
    return (int(number), parts[4]) if number.isascii() and number.isdigit() and len(number) <= 9 else None
