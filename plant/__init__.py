"""The process that plays the car: simulator, sensors, runs, and the requests it serves."""
