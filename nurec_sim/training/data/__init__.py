"""Training data: logs, windows, samples, augmentation, caches."""
