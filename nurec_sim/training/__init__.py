"""Training of the network in the true world (paper section 4): data, losses, stages, and the loop."""
