"""Third-party OpenUSD particle fields, read in a subprocess."""
