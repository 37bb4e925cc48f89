"""What a server counts, for Prometheus."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, start_http_server
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

PREFIX = "nurec_sim_"
_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300)

Gauges = Callable[[], Mapping[str, tuple[str, float]]]
"""Figures of the moment: name without the prefix, what it is, value."""


class Telemetry:
    """Counters and gauges of one server, in a registry of its own: several servers may live in a process.

    Args:
        gauges: asked at every scrape.
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
        """Serves the figures over HTTP in a thread of its own; gives ``host:port`` and what ends it.

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
