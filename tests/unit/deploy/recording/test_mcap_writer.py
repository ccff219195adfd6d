"""Our writer of MCAP files against that of the `mcap` library: the same bytes, whatever is written."""

from __future__ import annotations

from io import BytesIO
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from deploy.recording.mcap_writer import McapWriter

CHUNK_BYTES = 300
times = st.integers(0, 2**64 - 1)
texts = st.dictionaries(st.text(max_size=8), st.text(max_size=8), max_size=3)
short = st.text(max_size=8)
steps = st.lists(
    st.one_of(
        st.tuples(
            st.just("message"),
            st.integers(0, 9),
            times,
            st.binary(max_size=200),
            times,
            st.integers(0, 2**32 - 1),
        ),
        st.tuples(st.just("channel"), short, st.sampled_from(["json", ""]), st.integers(0, 3), texts),
        st.tuples(st.just("schema"), short, st.just("jsonschema"), st.binary(max_size=400)),
        st.tuples(st.just("metadata"), short, texts),
        st.tuples(st.just("attachment"), short, st.just("text/plain"), st.binary(max_size=50)),
        st.tuples(st.just("flush")),
    ),
    max_size=40,
)


def by_the_library(written: list[tuple[Any, ...]]) -> bytes:
    stream = BytesIO()
    writer = Writer(stream, chunk_size=CHUNK_BYTES)
    writer.start("", "somebody")
    channels = 0
    for what, *values in written:
        if what == "message" and channels:
            channel, log_ns, content, publish_ns, sequence = values
            writer.add_message(1 + channel % channels, log_ns, content, publish_ns, sequence)
        elif what == "channel":
            writer.register_channel(*values)
            channels += 1
        elif what == "schema":
            writer.register_schema(*values)
        elif what == "metadata":
            writer.add_metadata(*values)
        elif what == "attachment":
            writer.add_attachment(0, 0, *values)
        elif what == "flush":
            writer.flush()
    writer.finish()
    return stream.getvalue()


def by_ours(written: list[tuple[Any, ...]]) -> bytes:
    stream = BytesIO()
    writer = McapWriter(stream, "somebody", CHUNK_BYTES)
    channels = 0
    for what, *values in written:
        if what == "message" and channels:
            channel, *rest = values
            writer.add_message(1 + channel % channels, *rest)
        elif what == "channel":
            channels = writer.add_channel(*values)
        elif what == "schema":
            writer.add_schema(*values)
        elif what == "metadata":
            writer.add_metadata(*values)
        elif what == "attachment":
            writer.add_attachment(*values)
        elif what == "flush":
            writer.flush()
    writer.finish()
    return stream.getvalue()


@given(steps)
def test_the_bytes_are_those_of_the_library(written: list[tuple[Any, ...]]) -> None:
    assert by_ours(written) == by_the_library(written)


def test_a_long_file_is_the_same_and_is_read_by_the_library() -> None:
    written: list[tuple[Any, ...]] = [("schema", "some", "jsonschema", b"{}")]
    written += [("channel", f"key/{k}", "json", 1, {}) for k in range(3)]
    written += [("message", k, 1000 - k, b'{"x":%d}' % k, 7, k) for k in range(100)]
    content = by_ours(written)
    assert content == by_the_library(written)
    reader = make_reader(BytesIO(content))
    assert [stored.data for _, _, stored in reader.iter_messages()] == [
        b'{"x":%d}' % k for k in reversed(range(100))
    ]
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert (summary.statistics.message_count, summary.statistics.chunk_count) == (
        100,
        len(summary.chunk_indexes),
    )
    assert len(summary.chunk_indexes) > 5
