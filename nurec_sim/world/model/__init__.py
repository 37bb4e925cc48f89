"""From a plan to a compiled MuJoCo model."""
