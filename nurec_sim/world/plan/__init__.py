"""A town as pure data: roads, buildings, traffic, weather, rigs."""
