"""Why there is no connection to a scheduler, in plain words: Dask may say anything of it, or nothing.

What listens at an address may be another service, whose bytes Dask takes for its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from handfast.agent.common.wording import printable

REASON_MAX: Final = 300
"""Characters of what others say."""
_DEPTH_MAX: Final = 10
_NONE_AT: Final = "there is no scheduler at {name}: "
_MEANINGS: Final = (
    (r"gaierror", _NONE_AT + "nobody knows that host name"),
    (r"Connection refused", _NONE_AT + "nobody listens there"),
    (r"No route to host|Network is unreachable", _NONE_AT + "there is no way to that address"),
    (
        r"CERTIFICATE_VERIFY_FAILED",
        "the scheduler at {name} shows a certificate that distributed.comm.tls.ca-file does not vouch for",
    ),
    (
        r"ALERT_UNKNOWN_CA|ALERT_\w*CERTIFICATE",
        "the scheduler at {name} does not take this certificate (distributed.comm.tls.client.cert)",
    ),
    (
        r"WRONG_VERSION_NUMBER|UNEXPECTED_EOF|IOStream is not idle|RECORD_LAYER|HTTP_REQUEST",
        _NONE_AT + "what listens there does not speak TLS: it may be tcp://, or no Dask scheduler",
    ),
    (
        r"identity\(\) got an unexpected",
        _NONE_AT + "a Dask worker listens there: give the address of its scheduler",
    ),
    (
        r"^tls:.*(SSLEOFError|Connection reset|CommClosedError)",
        "what listens at {name} ended the connection: it may not take this certificate "
        "(distributed.comm.tls.client.cert), or be no Dask scheduler",
    ),
    (
        r"^tcp:.*(Connection reset|CommClosedError)",
        _NONE_AT + "what listens there ended the connection: it may be tls://, or no Dask scheduler",
    ),
    (r"Timed out trying to connect", _NONE_AT + "nobody answers at that address"),
)
"""Of an address, and all that was raised at it, what it means; the first that fits."""
_SAID: Final = r"^Timed out trying to connect|^TLS certificate does not match|identity\(\) got an unexpected"
"""What our words say better."""


def why_not(address: str, name: str, error: BaseException, within_s: float) -> str:
    """Why there was no connection to `address`, which messages call `name`, within some time; one line."""
    if isinstance(error, TimeoutError) and not str(error):
        wait = f"within {within_s:.0f} s"
        return f"there is no scheduler at {name}: what listens there has not answered as one {wait}"
    if isinstance(error, ImportError):  # Dask's versions there are others, of which it says which
        return f"the scheduler at {name} cannot be used: {error_line(error)}"
    chain = list(_chain(error))
    raised = " ".join([address, *map(error_line, chain)])
    details = [text for each in chain if (text := _detail(each))]
    detail = f" ({details[0]})" if details else ""
    for pattern, meaning in _MEANINGS:
        if re.search(pattern, raised):
            return meaning.format(name=name) + detail
    if isinstance(error, OSError) and details:
        return f"there is no scheduler at {name}: {details[0]}"
    return f"there is no scheduler at {name}: what listens there is no Dask scheduler{detail}"


def error_line(error: BaseException) -> str:
    """An exception on one line."""
    return printable(" ".join(f"{type(error).__name__}: {error}".split())[:REASON_MAX])


def _chain(error: BaseException) -> Iterator[BaseException]:
    """An error and those that it came of."""
    found: BaseException | None = error
    for _ in range(_DEPTH_MAX):
        if found is None:
            return
        yield found
        found = found.__cause__ or found.__context__


def _detail(error: BaseException) -> str:
    """What an error says beside what is said in our words."""
    text = " ".join(str(error).split())[:REASON_MAX]
    if not text or isinstance(error, MemoryError) or re.search(_SAID, text):
        return ""
    if isinstance(error, OSError):
        return printable(re.sub(r"^in <.*?>: ", "", text))
    return error_line(error)
