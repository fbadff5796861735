"""Frozen descriptions of the robot, read once at start."""
