"""Images of a chunk, and chunks of a clip, brought to one world (paper section 3.4)."""
