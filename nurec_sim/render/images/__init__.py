"""Rendered images as files and bytes."""
