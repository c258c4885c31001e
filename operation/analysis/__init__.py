"""What a log shows: laps, results of a race, validation of weights."""
