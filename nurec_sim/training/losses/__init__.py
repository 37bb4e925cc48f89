"""Training losses (paper section 4)."""
