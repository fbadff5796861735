"""Capability of a body: reachable wrench, power, thrust variance and the shape of these spaces."""
