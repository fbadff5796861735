"""The bench: an independent model of the world behind the same CAN messages, and what judges a run."""
