"""Where a fleet's processes run and how they reach each other, as its file says."""

from __future__ import annotations

import tomllib

import pytest
import tomli_w

from handfast.agent.__main__ import start as agent_start
from handfast.agent.fleet.loading import digest, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.runtime.loop import RealClock
from handfast.plant import server
from handfast.plant.unicycle import from_fleet

FLEET = """
[fleet]
name = "two"
[formation]
edges = [[1, 2]]
distance_m = 1.0
safe_distance_m = 0.22
[control]
[trajectory]
%s
[[robot]]
id = 1
x_m = 0
y_m = 0
%s
[[robot]]
id = 2
x_m = 1
y_m = 0
%s
"""
HOSTS = (
    '[host.left]\naddress = "10.0.0.1"\n[host.right]\naddress = "10.0.0.2"\nlisten = "0.0.0.0"\nuser = "r"\n'
)
LEFT, RIGHT = 'host = "left"', 'host = "right"'
ROUTERS = '[network]\nrouters = ["%s"]'


def fleet(tables: str = HOSTS, first: str = LEFT, second: str = RIGHT, *sets: str) -> Fleet:
    return parse_fleet(FLEET % (tables, first, second), source="here", overrides=sets)


def problems(*arguments: str) -> list[str]:
    with pytest.raises(FleetError) as caught:
        fleet(*arguments)
    return [str(problem) for problem in caught.value.problems]


def test_processes_are_reached_on_their_hosts_and_listen_there():
    secured = fleet()
    assert secured.is_secured
    assert secured.agent_endpoint(1) == secured.agent_listens(1)[0] == "tls/10.0.0.1:7600"
    assert secured.plant_endpoint(2) == "tls/10.0.0.2:7603"
    assert secured.plant_listens(2) == ("tls/0.0.0.0:7603",)
    open_ = fleet(HOSTS + '[network]\nsecurity = "off"')
    assert open_.agent_endpoint(1) == "tcp/10.0.0.1:7600"


def test_a_host_without_an_address_is_where_its_name_says():
    named = fleet('[host.left]\n[host."right.local"]', second='host = "right.local"')
    assert named.agent_endpoint(1) == "tls/left:7600"
    assert named.plant_listens(2) == ("tls/right.local:7603", "tls/127.0.0.1:7603")


@pytest.mark.parametrize(
    ("listen", "listens", "near"),
    [
        ("10.0.0.1", ["10.0.0.1", "127.0.0.1"], "127.0.0.1"),
        ("[fe80::1]", ["[fe80::1]", "127.0.0.1"], "127.0.0.1"),
        ("left.lan", ["left.lan", "127.0.0.1"], "127.0.0.1"),
        ("0.0.0.0", ["0.0.0.0"], "127.0.0.1"),
        ("[::]", ["[::]"], "[::1]"),
        ("127.0.0.2", ["127.0.0.2"], "127.0.0.2"),
        ("[::1]", ["[::1]"], "[::1]"),
        ("localhost", ["localhost"], "localhost"),
    ],
)
def test_a_robot_does_not_lose_its_body_with_an_address(listen: str, listens: list[str], near: str):
    """Its own processes reach each other over the loopback, wherever others reach them."""
    made = fleet(HOSTS.replace("0.0.0.0", listen))
    assert made.agent_listens(2) == tuple(f"tls/{each}:7602" for each in listens)
    assert made.plant_listens(2) == tuple(f"tls/{each}:7603" for each in listens)
    assert (made.agent_near(2), made.plant_near(2)) == (f"tls/{near}:7602", f"tls/{near}:7603")
    assert made.agent_endpoint(2) == "tls/10.0.0.2:7602"


def test_agent_and_plant_listen_on_the_loopback_and_the_plant_dials_it(monkeypatch: pytest.MonkeyPatch):
    made = fleet()
    agent = agent_start(made, 1, RealClock(), print)
    assert (agent.listen, agent.connect) == (("tls/10.0.0.1:7600", "tls/127.0.0.1:7600"), [])
    other = agent_start(made, 2, RealClock(), print)
    assert other.connect == ["tls/10.0.0.1:7600"]
    found = []

    def run(*_: object) -> int:
        start = _[3]
        assert callable(start)
        found.append(start(made, 1, RealClock(), print))
        return 0

    monkeypatch.setattr(server, "process_main", run)
    assert server.main([], "python -m handfast.plant", lambda fleet, robot, *_: from_fleet(fleet, robot)) == 0
    assert found[0].listen == ("tls/10.0.0.1:7601", "tls/127.0.0.1:7601")
    assert found[0].connect == ["tls/127.0.0.1:7600"]


def test_robots_may_share_a_host_and_take_it_from_the_defaults():
    shared = fleet('[robot_defaults]\nhost = "left"\n' + HOSTS, "", "")
    assert [robot.host for robot in shared.robots] == ["left", "left"]
    assert shared.agent_endpoint(2) == "tls/10.0.0.1:7602"


def test_without_hosts_nothing_is_secured_and_all_is_as_before():
    local = fleet("", "", "")
    assert not local.is_secured
    assert local.agent_endpoint(1) == local.agent_near(1) == "tcp/127.0.0.1:7600"
    assert local.agent_listens(1) == ("tcp/127.0.0.1:7600",)
    assert fleet('[network]\nsecurity = "mtls"', "", "").agent_endpoint(1) == "tls/127.0.0.1:7600"


def test_hosts_are_written_and_read_again():
    there = fleet(HOSTS + '[network]\nrouters = ["10.0.0.9:7447"]\n[recording]\nmax_mb = 20')
    text = tomli_w.dumps(to_dict(there))
    assert tomllib.loads(text)["host"]["right"] == {"address": "10.0.0.2", "listen": "0.0.0.0", "user": "r"}
    assert parse_fleet(text, source="again") == there


def test_the_digest_is_of_what_is_driven_not_of_where():
    assert digest(fleet()) == digest(fleet("", "", ""))
    recorded = fleet(HOSTS + "[recording]\nmax_mb = 0")
    assert digest(recorded) == digest(fleet())


def test_a_field_of_a_host_can_be_overridden_by_its_name():
    changed = fleet(HOSTS, LEFT, RIGHT, "host.left.user=you", "host.right.user=me")
    assert [host.user for host in changed.hosts] == ["you", "me"]


@pytest.mark.parametrize(
    ("tables", "first", "second", "said"),
    [
        (HOSTS, LEFT, "", "robot[2].host: is missing: other robots have a host, so all must have one"),
        (HOSTS, LEFT, 'host = "rihgt"', "robot[2].host: there is no [host.rihgt]; hosts are left, right"),
        ("", LEFT, LEFT, "robot[1].host: there is no [host.left]; there is none"),
        (
            HOSTS + '[host.again]\naddress = "10.0.0.1"',
            LEFT,
            RIGHT,
            "host.again.address: host left has the address 10.0.0.1 already: robots may share a host by its",
        ),
        (HOSTS + ROUTERS % "b:", LEFT, RIGHT, "network.routers[1]: must be HOST:PORT, such as"),
        (
            HOSTS + ROUTERS % "b",
            LEFT,
            RIGHT,
            "network.routers[1]: there is no [host.b]; hosts are left, right. A router elsewhere is",
        ),
        (ROUTERS % "b", "", "", "network.routers[1]: there is no [host.b]; there is none. A router"),
        (
            HOSTS + ROUTERS % 'left", "left',
            LEFT,
            RIGHT,
            'network.routers[2]: "left" is network.routers[1] already',
        ),
        (
            HOSTS + ROUTERS % "left" + "\nbase_port = 32764",
            LEFT,
            RIGHT,
            "network.base_port: 2 robots and a router take ports 32764 to 32768, which must not pass "
            "32767 (the system uses those above): must be at most 32763",
        ),
        (
            HOSTS + ROUTERS % "b:7447" + '\ntopology = "mesh"',
            LEFT,
            RIGHT,
            "network.topology: is a mesh, which has no routers: leave out topology or routers",
        ),
        (HOSTS + ROUTERS % "b:40000", LEFT, RIGHT, "network.routers[1]: port 40000 must be at most 32767"),
        (
            "[host]\nleft = 3",
            LEFT,
            LEFT,
            "host.left: must be a table, [host.left] with its fields below it, got 3",
        ),
        ('[host."a b"]', LEFT, LEFT, 'host."a b": must be 1 to 63 letters'),
        (
            '[host.left]\nname = "x"',
            LEFT,
            LEFT,
            "host.left.name: unknown field: the name stands in the table",
        ),
        ('[host.left]\nadress = "x"', LEFT, LEFT, "host.left.adress: unknown field; did you mean address?"),
        (
            '[host.left]\naddress = "-o Proxy=x"',
            LEFT,
            LEFT,
            "host.left.address: must be a host name, an IPv4",
        ),
    ],
)
def test_what_is_wrong_with_hosts_is_said(tables: str, first: str, second: str, said: str):
    found = problems(tables, first, second)
    assert any(problem.startswith(said) for problem in found), found


def test_hosts_that_are_no_tables_are_refused():
    with pytest.raises(FleetError) as caught:
        parse_fleet("host = 3\n" + FLEET % ("", LEFT, LEFT), source="here")
    assert "host: must be tables: write [host.NAME] above each, got 3" in str(caught.value)


def test_an_override_of_a_host_that_is_not_there_makes_one_which_is_then_looked_at():
    with pytest.raises(FleetError) as caught:
        fleet(HOSTS, LEFT, RIGHT, "host.other.user=0 0")
    assert "--set host.other.user: must be a user name" in str(caught.value)


def large(*sets: str) -> Fleet:
    robots = ",".join(f"{{id = {k}, x_m = {k}, y_m = 0}}" for k in range(1, 26))
    head = FLEET.partition("[[robot]]")[0] % ""
    return parse_fleet(f"robot = [{robots}]\n{head}", source="here", overrides=sets)


@pytest.mark.parametrize(
    ("made", "routed"),
    [
        (large(), True),
        (large('network.topology="mesh"'), False),
        (fleet("", "", ""), False),
        (fleet('[network]\ntopology = "routed"', "", ""), True),
        (fleet(ROUTERS % "a:7447", "", ""), True),
        (fleet(), False),
    ],
)
def test_many_robots_are_routed_unless_the_file_says_otherwise(made: Fleet, routed: bool):
    assert made.is_routed == routed
