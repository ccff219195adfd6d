"""Zenoh's log made readable. The lines are of Zenoh 1.10.2; test_security_links.py has it say them."""

from __future__ import annotations

import os
import sys

import pytest

from handfast.agent.security.refusals import KINDS_MAX, LINKS_MAX, PERIOD_NS, Refusals
from handfast.agent.transport.zenoh_log import POLL_NS, READ_MAX, SIZE_MAX, ZenohLog

TLS = (
    "2026-11-20T23:28:45.883366Z  WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: {}. "
    "Hint: increase the system open file limit.\n"
)
DIALLED = (
    "2026-11-20T23:31:04.349519Z DEBUG net-0 ThreadId(03) zenoh::net::runtime::orchestrator: "
    "Unable to connect to configured peer tls/10.0.0.2:7602! {} at /unicast.rs:378.. Retry in 50ms.\n"
)
LINK = (
    "2026-11-20T23:30:30.794143Z DEBUG acc-0 ThreadId(05) zenoh::net::routing::interceptor::low_pass: "
    "New low-pass filter transport unicast Transport Unicast {{ zid: {}, whatami: Peer, is_qos: true, "
    "is_shm: false, links: [Link {{ src: tls/127.0.0.1:17601, dst: tls/127.0.0.1:35562, group: None, "
    'mtu: 49152, is_streamed: true, interfaces: ["lo"], auth_identifier: Tls(Some("{}")), priorities: None, '
    "reliability: None }}], sn_resolution: U32 }}\n"
)
MESSAGE = (
    "2026-11-20T23:30:31.190924Z TRACE  rx-0 ThreadId(08) demux{{zid=38925811f81165851d132ba373fec837 "
    "src=north/{}:1}}: zenoh::net::routing::interceptor: Msg intercepted!\n"
)
ZID = "b5d6cee48fdf38368c9714493ddf6a15"
SENT = "a message of {} that it may not send, or that is too large"


def told(*lines: str, now_ns: int = 0) -> list[str]:
    refusals = Refusals()
    for line in lines:
        refusals.take(line.encode())
    return [line.removeprefix("refused: ") for line in refusals.lines(now_ns)]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("peer sent no certificates", "it has no certificate"),
        ("invalid peer certificate: UnknownIssuer", "its certificate is not from this fleet's authority"),
        (
            "invalid peer certificate: certificate expired: verification time 1795217315 (UNIX), but "
            "certificate is not valid after 1795130910 (86405 seconds ago)",
            "its certificate has expired",
        ),
        ("received corrupt message of type InvalidContentType", "it does not speak TLS"),
        ("received fatal alert: UnknownCA", "it does not know the authority of our certificate"),
        ("received fatal alert: HandshakeFailure", "it broke the handshake off"),
        ("Too many open files (os error 24)", "this process has no file handles left"),
        ("something new", "the handshake failed"),
    ],
)
def test_connections_to_us(text: str, why: str) -> None:
    assert told(TLS.format(text)) == [f"a connection of somebody: {why}"]


def test_connections_of_ours() -> None:
    wrong = (
        "Can not create a new TLS link bound to IpAddress(V4(Ipv4Addr([127, 0, 0, 2]))): "
        'invalid peer certificate: certificate not valid for name "127.0.0.2"; certificate is only valid for '
        "IpAddress(127.0.0.1)"
    )
    assert told(DIALLED.format(wrong)) == [
        "the connection to tls/10.0.0.2:7602: its certificate is for other addresses"
    ]
    assert told(DIALLED.format("received fatal alert: CertificateExpired")) == [
        "the connection to tls/10.0.0.2:7602: by its clock our certificate is not valid: are both right?"
    ]


def test_nobody_there_refuses_nobody() -> None:
    for text in (
        "Can not create a new TLS link: [127.0.0.1:17602: Connection refused (os error 111)",
        "deadline has elapsed",
        "Read error on TCP link: early eof",
    ):
        assert told(DIALLED.format(text)) == []


def test_messages_are_of_whom_the_link_is() -> None:
    link = LINK.format(ZID, "delta.robot.2")
    assert told(link) == []
    assert told(link, MESSAGE.format(ZID[:8])) == [SENT.format("delta.robot.2")]
    assert told(MESSAGE.format(ZID[:8])) == [SENT.format("somebody")]


@pytest.mark.parametrize(
    ("zid", "short"),
    [
        ("abcdef0123456789abcdef0123456789", "abcdef01"),
        ("abcdef0123456789abcdef012345678", "abcdef0"),  # its first digit is 0, and so left out
        ("123456789", "1234567"),
        ("1234567", "1234567"),
    ],
)
def test_numbers_of_links_as_zenoh_shortens_them(zid: str, short: str) -> None:
    assert told(LINK.format(zid, "delta.robot.2"), MESSAGE.format(short)) == [SENT.format("delta.robot.2")]


def test_colours_are_no_matter() -> None:
    line = (
        MESSAGE.format("b5d6cee4")
        .replace("TRACE", "\x1b[35mTRACE\x1b[0m")
        .replace("src", "\x1b[3msrc\x1b[0m\x1b[2m")
    )
    assert told(LINK.format(ZID, "delta.robot.2"), line) == [SENT.format("delta.robot.2")]


def test_who_takes_anothers_number_is_not_taken_for_him() -> None:
    lines = LINK.format(ZID, "delta.robot.1"), LINK.format(ZID, "delta.robot.2"), MESSAGE.format(ZID[:8])
    assert told(*lines) == [SENT.format("delta.robot.1 or delta.robot.2")]


def test_each_kind_has_a_line_now_and_then() -> None:
    refusals = Refusals()
    line = TLS.format("peer sent no certificates").encode()
    refusals.take(line)
    assert [*refusals.lines(5)] == ["refused: a connection of somebody: it has no certificate"]
    for _ in range(50):
        refusals.take(line * 2)
        assert [*refusals.lines(PERIOD_NS)] == []
    refusals.take(TLS.format("invalid peer certificate: UnknownIssuer").encode())
    assert len([*refusals.lines(PERIOD_NS)]) == 1, "another kind does not wait"
    assert [*refusals.lines(PERIOD_NS + 5)] == [
        "refused: a connection of somebody: it has no certificate (100 times)"
    ]
    assert [*refusals.lines(9 * PERIOD_NS)] == []
    assert refusals.total == 102


def test_a_part_of_a_flood_stands_for_all() -> None:
    refusals = Refusals()
    refusals.take(TLS.format("peer sent no certificates").encode() * 10, share=0.1)
    assert refusals.total == 100
    assert [*refusals.lines(0)][1] == "refused: attempts in a flood of them (90 times)"
    refusals.take(b"nothing of interest\n" * 100, share=0.5)
    assert refusals.total == 100


def test_next_to_nothing_more_is_not_told() -> None:
    refusals = Refusals()
    refusals.take(TLS.format("peer sent no certificates").encode(), share=0.99)
    assert [*refusals.lines(0)] == ["refused: a connection of somebody: it has no certificate"]


def test_what_is_kept_is_bounded() -> None:
    refusals = Refusals()
    for number in range(2 * LINKS_MAX):
        refusals.take(LINK.format(f"a{number:07x}" + ZID[8:], f"delta.robot.{number}").encode())
        refusals.take(MESSAGE.format(f"a{number:07x}").encode())
    assert len(refusals._links) <= LINKS_MAX
    lines = [*refusals.lines(0)]
    assert len(lines) == KINDS_MAX + 1
    assert lines[-1] == f"refused: other attempts ({2 * LINKS_MAX - KINDS_MAX} times)"
    assert len(refusals._said_ns) <= KINDS_MAX + 1


def test_kinds_without_end_have_few_lines_however_often_it_is_asked() -> None:
    refusals, said = Refusals(3), 0
    for turn in range(200):  # of a tenth of a second
        for number in range(50):
            refusals.add(f"kind {turn * 7 + number}")
        said += len([*refusals.lines(turn * PERIOD_NS // 100)])
    assert 4 <= said <= 2 * 4
    assert len(refusals._waiting) + len(refusals._said_ns) <= 2 * 4


def test_garbage() -> None:
    refusals = Refusals()
    refusals.take(
        os.urandom(100_000) + b"Msg intercepted!" + b"zenoh_link_tls::" + b"Unable to connect to " * 100
    )
    refusals.take(
        b"Unable to connect to a "
        + b"x" * 50_000
        + b"low_pass: New low-pass filter transport"
        + b" zid: a" * 9000
    )
    assert all(len(line) < 200 for line in refusals.lines(0))


# ---------------------------------------------------------------------- the file that it comes from


def test_the_log_is_read_now_and_then() -> None:
    with ZenohLog() as log:
        os.write(1, TLS.format("peer sent no certificates").encode())
        assert [*log.lines(0)] == ["refused: a connection of somebody: it has no certificate"]
        os.write(1, TLS.format("invalid peer certificate: UnknownIssuer").encode())
        assert [*log.lines(POLL_NS - 1)] == []
        assert len([*log.lines(POLL_NS)]) == 1
        assert log.refusals.total == 2


def test_a_flood_takes_neither_memory_nor_time() -> None:
    line = TLS.format("peer sent no certificates").encode()
    with ZenohLog() as log:
        [*log.lines(0)]
        for _ in range(3):
            os.write(1, line * (SIZE_MAX // len(line) + 1))
            [*log.lines(1)]  # long before it is due
            assert os.fstat(1).st_size == 0
        assert log.refusals.total == pytest.approx(3 * SIZE_MAX / len(line), rel=0.01)
        assert READ_MAX < SIZE_MAX


def test_standard_output_goes_on(capfd: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout
    print("before")
    with ZenohLog():
        print("during")
        os.write(1, b"of Zenoh\n")
    print("after")
    assert sys.stdout is before
    assert capfd.readouterr().out == "before\nduring\nafter\n"
