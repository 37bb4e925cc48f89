"""OpenUSD particle fields of other programs, read in a process of their own."""
