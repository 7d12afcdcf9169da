"""Messages of logs: without control characters, and without repetitions."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from framework.errors import escape_unprintable


class PlainLogRecord(logging.LogRecord):
    """Record of a log in whose message control characters are escaped, because it may quote another person's file."""

    def getMessage(self) -> str:
        """Return the message with control characters escaped."""
        return escape_unprintable(super().getMessage())


class _Once(logging.Filter):
    """Filter that lets each message pass once."""

    def __init__(self) -> None:
        super().__init__()
        self.written: set[tuple[str, str]] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether no record of the same logger had the same message."""
        message = (record.name, record.getMessage())
        is_new = message not in self.written
        self.written.add(message)
        return is_new


@contextmanager
def log_each_message_once() -> Iterator[None]:
    """Let no handler write a message twice inside the block, such as a warning that holds for many tested cases."""
    last_resort = [] if logging.lastResort is None else [logging.lastResort]
    filters = [(handler, _Once()) for handler in logging.getLogger().handlers or last_resort]
    for handler, once in filters:
        handler.addFilter(once)
    try:
        yield
    finally:
        for handler, once in filters:
            handler.removeFilter(once)
