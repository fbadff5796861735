"""What a body can do: reachable wrench, power, thrust variance and the shape of these spaces."""
