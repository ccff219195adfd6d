"""Why there is no connection to a scheduler; errors as Dask has raised them."""

from __future__ import annotations

import socket
import ssl

import pytest
from distributed.comm.core import CommClosedError, FatalCommClosedError

from handfast.deploy.cluster.reasons import error_line, why_not

TCP = "tcp://there:8786"
TLS = "tls://there:8786"
NONE = "there is no scheduler at it: "
RESET = "ConnectionResetError: [Errno 104] Connection reset by peer"


def because(error: Exception, cause: BaseException) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("address", "error", "says"),
    [
        (TCP, TimeoutError(), NONE + "what listens there has not answered as one within 10 s"),
        (
            TCP,  # what sshd says first, read as a length
            MemoryError("Unable to allocate 2.82 EiB for an array with shape (3256153323631825747,)"),
            NONE + "what listens there is no Dask scheduler",
        ),
        (
            TCP,
            TypeError("Worker.identity() got an unexpected keyword argument 'n_workers'"),
            NONE + "a Dask worker listens there: give the address of its scheduler",
        ),
        (
            TCP,
            CommClosedError(f"in <TCP (closed)  local=tcp://1.2.3.4:5 remote={TCP}>: {RESET}"),
            NONE + "what listens there ended the connection: it may be tls://, or no Dask scheduler "
            f"({RESET})",
        ),
        (
            TCP,
            because(
                OSError(f"Timed out trying to connect to {TCP} after 10 s"),
                socket.gaierror(-2, "Name or service not known"),
            ),
            NONE + "nobody knows that host name ([Errno -2] Name or service not known)",
        ),
        (
            TCP,
            because(
                OSError(f"Timed out trying to connect to {TCP} after 10 s"),
                ConnectionRefusedError(111, "Connection refused"),
            ),
            NONE + "nobody listens there ([Errno 111] Connection refused)",
        ),
        (
            TCP,
            because(OSError(f"Timed out trying to connect to {TCP} after 10 s"), TimeoutError()),
            NONE + "nobody answers at that address",
        ),
        (
            TLS,  # an HTTP server
            because(
                FatalCommClosedError(), ssl.SSLError(1, "[SSL: WRONG_VERSION_NUMBER] wrong version number")
            ),
            NONE + "what listens there does not speak TLS: it may be tcp://, or no Dask scheduler "
            "([SSL: WRONG_VERSION_NUMBER] wrong version number)",
        ),
        (
            TLS,  # who speaks first: sshd, a scheduler without TLS
            ValueError("IOStream is not idle; cannot convert to SSL"),
            NONE + "what listens there does not speak TLS: it may be tcp://, or no Dask scheduler "
            "(ValueError: IOStream is not idle; cannot convert to SSL)",
        ),
        (
            TLS,
            because(
                FatalCommClosedError("TLS certificate does not match. Check your security settings."),
                ssl.SSLCertVerificationError(1, "[SSL: CERTIFICATE_VERIFY_FAILED] self-signed certificate"),
            ),
            "the scheduler at it shows a certificate that distributed.comm.tls.ca-file does not vouch for "
            "([SSL: CERTIFICATE_VERIFY_FAILED] self-signed certificate)",
        ),
        (
            TLS,
            FatalCommClosedError(
                f"in <TLS (closed)  local=tls://1.2.3.4:5 remote={TLS}>: SSLError: "
                "[SSL: TLSV1_ALERT_UNKNOWN_CA] tlsv1 alert unknown ca"
            ),
            "the scheduler at it does not take this certificate (distributed.comm.tls.client.cert) "
            "(SSLError: [SSL: TLSV1_ALERT_UNKNOWN_CA] tlsv1 alert unknown ca)",
        ),
        (
            TLS,
            because(
                CommClosedError(f"in <TLS (closed)  remote={TLS}>: SSLEOFError: EOF occurred in violation"),
                ssl.SSLEOFError(8, "EOF occurred in violation of protocol"),
            ),
            "what listens at it ended the connection: it may not take this certificate "
            "(distributed.comm.tls.client.cert), or be no Dask scheduler "
            "(SSLEOFError: EOF occurred in violation)",
        ),
        (TCP, OSError("something\nelse"), NONE + "something else"),
        (TCP, KeyError("op"), NONE + "what listens there is no Dask scheduler (KeyError: 'op')"),
        (
            TCP,
            ImportError("Mismatched versions found\n\n| a | b |"),
            "the scheduler at it cannot be used: ImportError: Mismatched versions found | a | b |",
        ),
    ],
)
def test_what_is_wrong_is_said_in_plain_words(address: str, error: Exception, says: str) -> None:
    assert why_not(address, "it", error, 10.0) == says


def test_an_error_that_came_of_itself_has_an_end() -> None:
    error = OSError("wrong")
    error.__cause__ = error
    assert why_not(TCP, "it", error, 10.0) == NONE + "wrong"


def test_an_exception_is_one_line() -> None:
    assert error_line(ValueError("a\n b\x1b" + 400 * "c")).startswith(r"ValueError: a b\x1bccc")
    assert len(error_line(ValueError(400 * "c"))) == 300
