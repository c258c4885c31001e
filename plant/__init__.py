"""The process that simulates the car: simulator, sensors, runs, and the requests it serves."""
