"""Reads the metrics of a server over HTTP, as Prometheus would."""

from __future__ import annotations

import urllib.request

from prometheus_client.parser import text_string_to_metric_families


def scrape(address: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """All samples by name and labels."""
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=10) as reply:
        text = reply.read().decode()
    families = text_string_to_metric_families(text)
    return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def metric(address: str, name: str, **labels: str) -> float:
    """One sample; 0 if there is none yet."""
    return scrape(address).get((f"nurec_sim_{name}", frozenset(labels.items())), 0.0)
