"""Readers of log formats, one file and one class each; ``logs.open_clip`` finds them here by themselves."""
