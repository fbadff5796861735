"""Simulated plant: water, bodies, thrusters, sensors. Shares no model with the controller, so no modelling error cancels out."""
