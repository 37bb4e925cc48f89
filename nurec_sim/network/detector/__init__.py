"""The camera detector."""
