"""OpenDRIVE maps: written from a scene's drivable area and lanes, and read."""
