"""Learning while a car drives: publishing weights, and the loop that makes them lap by lap."""
