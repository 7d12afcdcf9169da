"""Messages of logs without control characters."""

import logging

from framework.errors import escape_unprintable


class PlainLogRecord(logging.LogRecord):
    """Record of a log in whose message control characters are escaped, because it may quote another person's file."""

    def getMessage(self) -> str:
        """Return the message with control characters escaped."""
        return escape_unprintable(super().getMessage())
