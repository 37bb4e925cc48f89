"""The Instant NuRec methods: clips cut into chunks, one forward pass each, layers merged (docs/network.md)."""
