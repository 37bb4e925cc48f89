"""The text of the wire contract and its compiled descriptor set."""
