"""``python -m nurec_sim.cli``."""

from nurec_sim.cli import main

main()
