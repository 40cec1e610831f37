"""Reads one message of a projector from a link: a line, a counted frame or a JSON object, as its table says."""

from __future__ import annotations

from hal.codecs.projectors.json_rpc import OBJECT_END, is_complete
from hal.codecs.projectors.serial_protocol import head_bytes, rest_bytes
from hal.codecs.projectors.serial_table import Frame, SerialTable
from hal.deadline import Deadline
from hal.links import ByteLink


def read_message(link: ByteLink, table: SerialTable, deadline: Deadline) -> bytes:
    """The next message. Raises what the link raises, and ProtocolError for one that can't be of this family."""
    if table.frame is not None:
        return _framed(link, table.frame, table.longest_answer, deadline)
    return _object(link, table, deadline) if table.json else _ended(link, table, deadline)


def _framed(link: ByteLink, frame: Frame, longest: int, deadline: Deadline) -> bytes:
    head = link.read_exactly(head_bytes(frame), deadline=deadline)
    return head + link.read_exactly(rest_bytes(frame, head, longest=longest), deadline=deadline)


def _object(link: ByteLink, table: SerialTable, deadline: Deadline) -> bytes:
    """A JSON object, up to the brace that closes it."""
    data = link.read_until(OBJECT_END, limit=table.longest_answer, deadline=deadline)
    while not is_complete(data) and len(data) < table.longest_answer:
        data += link.read_until(OBJECT_END, limit=table.longest_answer - len(data), deadline=deadline)
    return data


def _ended(link: ByteLink, table: SerialTable, deadline: Deadline) -> bytes:
    """A line up to its terminator; a terminator in quotes does not end the line."""
    quote = table.quirks.quote.encode("latin-1")
    line = link.read_until(table.terminator, limit=table.longest_answer, deadline=deadline)
    while quote and line.count(quote) % 2 and len(line) < table.longest_answer:
        line += link.read_until(table.terminator, limit=table.longest_answer - len(line), deadline=deadline)
    return line
