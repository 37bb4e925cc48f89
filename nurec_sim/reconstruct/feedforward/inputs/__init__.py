"""From a window of a clip to what the network takes."""
