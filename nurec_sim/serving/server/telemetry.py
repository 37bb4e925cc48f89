"""What a server reports of its calls: metrics for Prometheus, and log lines as text or JSON.

Nothing that a request holds is logged, beyond the name of its scene.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from typing import Literal, TextIO

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, start_http_server
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

log = logging.getLogger(__name__)

PREFIX = "nurec_sim_"
_LONGEST_NAME = 200
_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300)

Gauges = Callable[[], Mapping[str, tuple[str, float]]]
"""Figures of the moment: name without the prefix, what it is, value."""


class Telemetry:
    """Counters and gauges of one server, in a registry of its own: several servers may live in a process.

    Args:
        gauges: called at every scrape.
    """

    def __init__(self, gauges: Gauges) -> None:
        self.registry = CollectorRegistry()
        self._calls = Counter(f"{PREFIX}requests_total", "Calls that ended", ("method", "code"), registry=self.registry)
        self._seconds = Histogram(
            f"{PREFIX}request_seconds", "How long calls took", ("method",), registry=self.registry, buckets=_SECONDS
        )
        self.registry.register(_Gauges(gauges))
        ProcessCollector(registry=self.registry)

    def count(self, method: str, code: str, seconds: float) -> None:
        """Notes a call that ended."""
        self._calls.labels(method, code).inc()
        self._seconds.labels(method).observe(seconds)

    def listen(self, host: str, port: int) -> tuple[str, Callable[[], None]]:
        """Serves the metrics over HTTP in a background thread; returns ``host:port`` and a function that stops it.

        Raises:
            OSError: the address cannot be listened at.
        """
        try:
            server, thread = start_http_server(port, host, self.registry)
        except (OSError, OverflowError) as error:
            raise OSError(f"metrics cannot be offered at {host}:{port}: {error}") from error

        def close() -> None:
            server.shutdown()
            server.server_close()
            thread.join()

        return f"{host}:{server.server_port}", close


class _Gauges(Collector):
    def __init__(self, gauges: Gauges) -> None:
        self._gauges = gauges

    def collect(self) -> Iterable[Metric]:
        for name, (meaning, value) in self._gauges().items():
            yield GaugeMetricFamily(f"{PREFIX}{name}", meaning, value=value)

    def describe(self) -> Iterable[Metric]:
        return ()


def log_call(method: str, code: str, seconds: float, scene: str, peer: str) -> None:
    """Writes the log line of a call that ended, at level info.

    Args:
        method: service and procedure.
        code: name of the gRPC status.
        seconds: duration.
        scene: that the request names.
        peer: address and port of the client.
    """
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
    # gRPC logs a traceback whenever a client leaves before it has read its reply; the call's log line has it too.
    logging.getLogger("grpc._cython.cygrpc").addFilter(_is_not_about_a_client_that_left)


def _is_not_about_a_client_that_left(record: logging.LogRecord) -> bool:
    return "ExecuteBatchError raised in core" not in record.getMessage()
