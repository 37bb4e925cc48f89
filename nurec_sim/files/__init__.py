"""Files of any origin: read within limits, written whole or not at all."""
