"""The world: water, bodies, thrusters, sensors. Written without the controller's model, so that no mistake cancels."""
