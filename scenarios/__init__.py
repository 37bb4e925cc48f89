"""Scenario files and the demo clip; data only."""
