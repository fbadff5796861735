"""What the robot is: frozen descriptions, read once at start."""
