"""Log lines as text or JSON, one for each call; never what a request holds beyond the name of its scene."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal, TextIO

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

log = logging.getLogger(__name__)

_LONGEST_NAME = 200


def log_call(method: str, code: str, seconds: float, scene: str, peer: str) -> None:
    """Writes the line of a call that ended; at level info."""
    if log.isEnabledFor(logging.INFO):
        fields = {
            "method": method,
            "code": code,
            "ms": round(1e3 * seconds, 1),
            "scene": scene[:_LONGEST_NAME],
            "peer": peer,
        }
        text = "%(method)s %(code)s %(ms).1f ms scene=%(scene)r peer=%(peer)s"
        log.info(text, fields, extra={"call": fields})


class JsonLines(logging.Formatter):
    """One JSON object a line: ``time`` (UTC), ``level``, ``logger``, ``message``; a call's fields; ``error``."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        entry = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "call", {}),
        }
        if record.exc_info:
            entry["error"] = self.formatException(record.exc_info)
        return json.dumps(entry)


def set_up_logging(form: LogFormat = "text", level: LogLevel = "warning", stream: TextIO | None = None) -> None:
    """Sends the log of this process to a stream, stderr if None; for programs, not for libraries."""
    handler = logging.StreamHandler(stream or sys.stderr)
    plain = logging.Formatter("%(asctime)s %(levelname)s %(message)s")
    handler.setFormatter(JsonLines() if form == "json" else plain)
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)
    logging.getLogger("nurec_sim").setLevel(level.upper())
    # gRPC logs a traceback whenever a client leaves before it has read its reply; the call's own line says it too.
    logging.getLogger("grpc._cython.cygrpc").addFilter(_is_not_about_a_client_that_left)


def _is_not_about_a_client_that_left(record: logging.LogRecord) -> bool:
    return "ExecuteBatchError raised in core" not in record.getMessage()
