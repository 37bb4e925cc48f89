"""From a window of a clip to the network's inputs."""
