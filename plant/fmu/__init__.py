"""The car as an FMU: exported from our equations, or any Co-Simulation FMU as the plant."""
