"""Reads MCAP whose messages are JSON, as the Foxglove SDK writes it."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.text import printable
from palpate_train.data.extras import library
from palpate_train.data.files.json_lines import flat, table_of
from palpate_train.data.files.table import ReadPlan, Table, asked_topics, labelled, normal, only

JSON = "json"
MAGIC_BYTES = 8
TIME = "received"
"""The vector of the times of recording, in s."""

Message = tuple[int, Any]
"""Time of recording in ns, and content."""


def may_hold(path: Path) -> bool:
    """Whether an MCAP file is not of ROS 2, as its header says (mcap.dev/spec)."""
    with path.open("rb") as file:
        head = file.read(MAGIC_BYTES + 1 + 8 + 4)
        if len(head) < MAGIC_BYTES + 13:
            return False
        (length,) = struct.unpack_from("<I", head, MAGIC_BYTES + 9)
        return not file.read(min(length, 16)).startswith(b"ros2")


def read(path: Path, wanted: ReadPlan) -> Table:
    """The messages of the only topic with numbers, or of the topic `wanted.variable`, one frame
    each. Raises FormatError that lists the topics."""
    topics, others = _topics(path)
    if not topics:
        raise FormatError(
            f"holds no topic of JSON or ROS 2, but {', '.join(others) or 'nothing'}; record in one "
            "of the two"
        )
    known = dict.fromkeys(topics, "JSON")
    name = only("topic", known, wanted.variable, lambda n: _numbers(topics[n]) > 1)
    messages = topics[name]
    at_ns = [t_ns for t_ns, _ in messages]
    rows = [(i, dict(flat("", value))) for i, (_, value) in enumerate(messages, 1)]
    table = replace(
        table_of(rows, "message", ()),
        vectors={TIME: 1e-9 * (np.array(at_ns) - at_ns[0])},
        beside=(TIME,),
    )
    asked = asked_topics(topics, wanted).items()
    said = {n: _texts(at, topics[at]) for n, at in asked}
    return labelled(table, at_ns, said)


def _topics(path: Path) -> tuple[dict[str, list[Message]], list[str]]:
    """The messages of each topic that is JSON, in the order of their times, and the other topics
    with their encodings."""
    reader = library("mcap.reader", "MCAP with JSON")
    topics: dict[str, list[Message]] = {}
    others: dict[str, None] = {}
    with path.open("rb") as file:
        for _, channel, message in reader.make_reader(file).iter_messages():
            if channel.message_encoding != JSON:
                others[f"{printable(channel.topic)} ({printable(channel.message_encoding)})"] = None
            else:
                known = topics.setdefault(normal(channel.topic), [])
                try:
                    known.append((message.log_time, json.loads(message.data)))
                except ValueError as e:
                    raise FormatError(
                        f"message {len(known) + 1} of {printable(channel.topic)} is not JSON, as "
                        f"its encoding says: {e}; record it again"
                    ) from e
    return topics, list(others)


def _numbers(messages: list[Message]) -> int:
    return sum(type(value) in (int, float) for _, value in flat("", messages[0][1]))


def _texts(name: str, messages: list[Message]) -> list[tuple[int, str]]:
    """Times and texts of a topic. Raises FormatError for a message with another number of texts."""
    texts: list[tuple[int, str]] = []
    for t_ns, value in messages:
        said = [text for _, text in flat("", value) if isinstance(text, str)]
        if len(said) != 1:
            raise FormatError(f"{name} holds {len(said)} texts in a message; --field needs one")
        texts.append((t_ns, said[0]))
    return texts
